"""Estimate, from how often a search reached each optimum, what further starts would find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.config.json_block import JsonBlock

# Rule of three.  If N starts reached every optimum at least twice, at most the fraction ``_RULE_OF_THREE / N`` of
# further starts leads to a new optimum, with a confidence of 95 %.
_RULE_OF_THREE = 3
# Two objectives are treated as equal up to this relative difference.
SAME_VALUE = 5e-3


@dataclass(frozen=True)
class SearchEstimate(JsonBlock):
    """The optima that a search reached, and an estimate of the others.  Optima with equal objectives count as one.

    Attributes:
        method: ``adaptive`` or ``multistart``.
        starts: Number of starts at random postures, without hops.
        hops: Number of starts at changed postures of the best optima.
        optima: Number of distinct objectives that starts or hops reached.
        hits_of_best: Number of starts that reached the best objective; 0 if only hops reached it.
        unseen_share: Estimated share of further starts that would lead to an objective not seen yet.
        estimated_optima: Estimated number of objectives, seen and unseen.
        bound: Whether the share is probably too high, because some starts were stopped early.
        partial: Whether the starts ignored some constraints, such as clearances.
    """

    method: str
    starts: int
    hops: int
    optima: int
    hits_of_best: int
    unseen_share: float
    estimated_optima: float
    bound: bool
    partial: bool
    derived = ("line",)

    @staticmethod
    def of(
        method: str, hits: Sequence[int], hits_of_best: int, hops: int = 0, bound: bool = False, partial: bool = False
    ) -> SearchEstimate:
        """Estimate from the number of starts at each objective that a start (not only a hop) reached."""
        share, optima = unseen_share(hits), estimated_optima(hits)
        return SearchEstimate(method, sum(hits), hops, len(hits), hits_of_best, share, optima, bound, partial)

    @property
    def line(self) -> str:
        """One sentence for users."""
        optima = "one objective" if self.optima == 1 else f"{self.optima} different objectives"
        times = {0: "reached by hops only", 1: "hit once"}.get(self.hits_of_best, f"hit {self.hits_of_best} times")
        most = min(1.0, _RULE_OF_THREE / max(self.starts, 1))
        near = "at most about" if self.bound else "about"
        elsewhere = f"{near} {_percent(self.unseen_share)}" if self.unseen_share else f"fewer than {_percent(most)}"
        hops = f" and {self.hops} hops" if self.hops else ""
        starts = "1 start" if self.starts == 1 else f"{self.starts} starts"
        ignored = " if these starts ignore clearances and loads" if self.partial else ""
        reached = f"{starts}{hops} reached optima with {optima}, the best {times}"
        return f"{reached}; {elsewhere} of further starts would lead to another objective{ignored}"


def _percent(share: float) -> str:
    return f"{100 * share:.{0 if share >= 0.1 else 1}f} %"


def hits_by_value(values: ArrayLike, hits: ArrayLike) -> tuple[int, ...]:
    """Return the number of hits of each distinct value, the least value first.

    ``values`` and ``hits`` have shape (N,).  Values that exceed the least value of a group by at most
    :data:`SAME_VALUE` belong to the group.
    """
    groups = list[tuple[float, int]]()
    for value, count in sorted(zip(np.asarray(values, dtype=float), np.asarray(hits, dtype=int), strict=True)):
        if groups and value <= groups[-1][0] + SAME_VALUE:
            groups[-1] = groups[-1][0], groups[-1][1] + int(count)
        else:
            groups.append((value, int(count)))
    return tuple(count for _, count in groups)


def unseen_share(hits: Sequence[int]) -> float:
    """Estimate, from the hits of each optimum, the fraction of further starts that would end in a new optimum.

    The Good–Turing estimate is the fraction of starts that ended in an optimum with only one hit (I. J. Good, "The
    population frequencies of species and the estimation of population parameters", Biometrika 1953).
    """
    return sum(count == 1 for count in hits) / max(sum(hits), 1)


def estimated_optima(hits: Sequence[int]) -> float:
    """Estimate the number of optima, seen and unseen, from the hits of each seen optimum; tends to be too low.

    This is the bias-corrected Chao1 estimate ``n + f₁(f₁ − 1)/(2(f₂ + 1))`` with the numbers ``f_k`` of optima with k
    hits (A. Chao, "Nonparametric estimation of the number of classes in a population", Scand. J. Statist. 1984).
    """
    once, twice = (sum(count == k for count in hits) for k in (1, 2))
    return len(hits) + once * (once - 1) / (2 * (twice + 1))
