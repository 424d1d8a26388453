"""The feasible starts of a search."""

from __future__ import annotations

from impact_posture.posture.manifold.feasible_start import ATTEMPTS, CANDIDATES, Projector, StartDraw
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.arrays import Array


class StartDraws:
    """Starting postures of a search: first the known postures, then random postures.

    Random starts are drawn as in :func:`impact_posture.posture.manifold.feasible_start.feasible_start`.

    The process that runs a start also draws it.  The constraints on the starts stay the same when rows are added to
    the program.  ``known`` contains at least one start.  Every second random start lies near the first known start,
    because the posture of the problem may be far from all postures that satisfy the constraints.
    """

    def __init__(self, problem: ConstrainedProblem, known: tuple[Array, ...], count: int, seed: int) -> None:
        self.count, self._known = count, known
        self._problem, self._seed, self._projector = problem, seed, Projector(problem)

    def choose(self, index: int, trapped: int = 0) -> Array | None:
        """Return start number ``index``, shape (nq,); ``None`` if no attempt reached the constraints.

        ``trapped`` is the number of trapped runs (:attr:`SolverRun.trapped`) from this start.  After the first
        trapped run, the start is chosen from more candidates.  If further runs from the start are trapped, another
        start is drawn.
        """
        if index < len(self._known) and trapped <= 1:
            return self._known[index]
        other = index + max(trapped - 1, 0) * self.count
        draw = StartDraw(self._problem, other, self._seed, self._known[0], self._projector)
        # A run that starts between bodies may stay between them, so more candidates are drawn after a trapped run.
        return draw.choose(ATTEMPTS if trapped else CANDIDATES)
