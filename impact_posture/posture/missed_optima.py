"""Estimates of what a multi-start search missed, from how often each optimum was found."""

from __future__ import annotations

from collections.abc import Sequence


def unseen_share(hits: Sequence[int]) -> float:
    """Return the share of further starts that would end in an optimum not seen yet.

    This is Good–Turing's estimate, the share of starts that ended in an optimum found once (I. J. Good, "The
    population frequencies of species and the estimation of population parameters", Biometrika 1953).

    Args:
        hits: Starts that ended in each optimum, at least one.
    """
    return sum(count == 1 for count in hits) / sum(hits)


def estimated_optima(hits: Sequence[int]) -> float:
    """Return an estimate of the number of optima, seen and unseen, that tends to be low.

    This is Chao1 without bias, ``n + f₁(f₁ − 1)/(2(f₂ + 1))`` with the numbers ``f_k`` of optima found k times
    (A. Chao, "Nonparametric estimation of the number of classes in a population", Scand. J. Statist. 1984).

    Args:
        hits: Starts that ended in each optimum.
    """
    once, twice = (sum(count == k for count in hits) for k in (1, 2))
    return len(hits) + once * (once - 1) / (2 * (twice + 1))
