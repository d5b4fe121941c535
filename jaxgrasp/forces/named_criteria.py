"""Criteria by the names that the command line and files use, with what their cost is and its unit."""

from __future__ import annotations

import numpy as np

from ..core import UserError
from .criteria import Criterion, Gentlest, LeastNorm, Robust, SmallestSum, SumOfSquares

__all__ = ["CRITERIA", "closeness", "make_criterion", "positive_option"]

# What the cost is, and its unit.
CRITERIA = {
    "gentlest": ("the largest normal force", "N"),
    "robust": ("the largest normal force less weight times log det P", "N"),
    "smallest-sum": ("the sum of the normal forces", "N"),
    "sum-of-squares": ("the sum of the squared normal forces", "N^2"),
    "least-norm": ("the sum of the squared contact forces", "N^2"),
}

PLAIN: dict[str, type[Criterion]] = {
    "gentlest": Gentlest,
    "smallest-sum": SmallestSum,
    "sum-of-squares": SumOfSquares,
}


def make_criterion(name: str, *, weight: float | None = None, length: float | None = None) -> Criterion:
    """The criterion of this name; UserError where the name is unknown or the option is another's."""
    if name not in CRITERIA:
        raise UserError(f"unknown criterion {name!r}; take one of {', '.join(CRITERIA)}")
    for option, value, owner in (("weight", weight, "robust"), ("length", length, "least-norm")):
        if value is not None and name != owner:
            raise UserError(f"--{option} belongs to --criterion {owner}, not to {name}")
        positive_option(option, value)
    if name == "robust":
        return Robust(1.0 if weight is None else float(weight))
    if name == "least-norm":
        return LeastNorm(length)
    return PLAIN[name]()


def closeness(tolerance: float) -> float:
    """The relative gap that OPTIMAL may leave, for the checker: room around what the solver was asked for."""
    return max(1e-6, 8 * tolerance)


def positive_option(option: str, value: float | None) -> None:
    """UserError where the option's value is given and not a positive finite number."""
    if value is not None and not (np.isfinite(value) and value > 0):
        raise UserError(f"--{option} must be a number > 0, got {value}")
