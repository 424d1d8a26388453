"""Estimate, from how often a search reached each optimum, what further starts would find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
        starts: Number of starts, without hops; for ``adaptive`` without the given postures.
        hops: Number of starts at changed postures of the best optima.
        optima: Number of distinct objectives at which starts, hops or given postures ended.
        hits_of_best: Number of starts and given postures that reached the best objective; 0 if only hops reached it.
        unseen_share: Estimated share of further starts that would lead to an objective not seen yet.
        estimated_optima: Estimated number of objectives, seen and unseen.
        bound: Whether the share is probably too high, because some starts were stopped early.
        partial: Whether the starts ignored some constraints, such as clearances.
        given: Number of given postures that count in addition to ``starts``.
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
    given: int = 0
    derived = ("line",)

    @staticmethod
    def of(
        method: str, hits: Sequence[int], hops: int = 0, bound: bool = False, partial: bool = False, given: int = 0
    ) -> SearchEstimate:
        """Estimate from the number of starts and given postures at each objective, the best objective first."""
        share, optima, starts = unseen_share(hits), estimated_optima(hits), sum(hits) - given
        return SearchEstimate(method, starts, hops, len(hits), hits[0], share, optima, bound, partial, given)

    @property
    def line(self) -> str:
        """One sentence for users."""
        optima = "one objective" if self.optima == 1 else f"{self.optima} different objectives"
        times = {0: "reached by hops only", 1: "hit once"}.get(self.hits_of_best, f"hit {self.hits_of_best} times")
        most = min(1.0, _RULE_OF_THREE / max(self.starts, 1))
        near = "at most about" if self.bound else "about"
        elsewhere = f"{near} {_percent(self.unseen_share)}" if self.unseen_share else f"fewer than {_percent(most)}"
        parts = ["1 start" if self.starts == 1 else f"{self.starts} starts"]
        parts += [f"{self.hops} hops"] if self.hops else []
        parts += ["the given posture" if self.given == 1 else f"{self.given} given postures"] if self.given else []
        subject = " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts)
        # The end of a start that was stopped early is not an optimum.
        ended = "ended at" if self.bound else "reached optima with"
        ignored = " if these starts ignore clearances and loads" if self.partial else ""
        reached = f"{subject} {ended} {optima}, the best {times}"
        return f"{reached}; {elsewhere} of further starts would lead to another objective{ignored}"


def _percent(share: float) -> str:
    return f"{100 * share:.{0 if share >= 0.1 else 1}f} %"


def groups_by_value(values: ArrayLike) -> NDArray[np.int_]:
    """Return the index of the group of each value, shape (N,); the group with the least values is 0.

    Values that exceed the least value of a group by at most :data:`SAME_VALUE` belong to the group.
    """
    numbers, group, least = np.asarray(values, dtype=float), -1, -np.inf
    groups = np.zeros(len(numbers), dtype=int)
    for k in np.argsort(numbers):
        if group < 0 or numbers[k] > least + SAME_VALUE:
            group, least = group + 1, numbers[k]
        groups[k] = group
    return groups


def hits_by_value(values: ArrayLike, hits: ArrayLike) -> tuple[int, ...]:
    """Return the number of hits of each group of :func:`groups_by_value`; ``values`` and ``hits`` have shape (N,)."""
    counts = np.bincount(groups_by_value(values), np.asarray(hits, dtype=int))
    return tuple(counts.astype(int).tolist())


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
