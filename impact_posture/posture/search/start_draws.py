"""The starts of a search, which a copy of the process draws while the program is built."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from impact_posture.posture.manifold.feasible_start import ATTEMPTS, CANDIDATES, Projector, StartDraw
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.arrays import Array
from impact_posture.system.processes import fork_server

_Drawn = dict[int, Array | None]


class StartDraws:
    """Known starts, then random ones (:func:`impact_posture.posture.manifold.feasible_start.feasible_start`).

    The constraints that starts are pulled onto do not grow with the problem.

    Args:
        problem: The posture problem.
        known: The first starts, one at least; odd random ones lie near the very first, because the given posture may
            be far from all that satisfies the constraints.
        count: Number of starts.
        seed: Seed of the random ones.
    """

    def __init__(self, problem: ConstrainedProblem, known: tuple[Array, ...], count: int, seed: int) -> None:
        self.count, self._known = count, known
        self._problem, self._seed, self._projector = problem, seed, Projector(problem)
        # A start that begins anew goes on with the postures that it drew before.
        self._draws: dict[int, StartDraw] = {}
        self._drawn: _Drawn = {}
        self._ask: Callable[[None], Iterable[_Drawn]] | None = None

    def choose(self, index: int, trapped: int = 0) -> Array | None:
        """Return a start; ``None`` if no attempt reached the constraints.

        Args:
            index: Its index.
            trapped: Number of runs from it that ended in a trap, after which it is drawn with more care, or anew.
        """
        if index < len(self._known) and trapped <= 1:
            return self._known[index]
        if index in self._drawn and not trapped:
            return self._drawn[index]
        other = index + max(trapped - 1, 0) * self.count
        if other not in self._draws:
            self._draws[other] = StartDraw(self._problem, other, self._seed, self._known[0], self._projector)
        # What is not clear of other bodies may not get out from between them.
        return self._draws[other].choose(ATTEMPTS if trapped else CANDIDATES)

    @contextmanager
    def ahead(self, first: int) -> Iterator[None]:
        """Let a copy of this process draw the starts from ``first`` on, in the block and until :meth:`collect`."""

        def begin(asked: Callable[[], bool]) -> Callable[[None], Iterable[_Drawn]]:
            drawn = {index: self.choose(index) for index in range(first, self.count) if not asked()}
            return lambda _: [drawn]

        with ExitStack() as stack:
            # Where the system has no place for a process, the starts are drawn when they run.
            if first < self.count:
                with suppress(OSError):
                    self._ask = stack.enter_context(fork_server(begin))
            yield

    def collect(self) -> None:
        """Take over the starts that the copy has drawn, none where it failed; :meth:`choose` draws the others."""
        ask, self._ask = self._ask, None
        if ask:
            # An error of a start is raised again where this start runs.
            with suppress(Exception):
                self._drawn = next(iter(ask(None)))
