"""Section 11.3: optimal contact forces for a load, by any criterion, with bounds, proofs and derivatives."""

from .criteria import Criterion, Gentlest, LeastNorm, Robust, SmallestSum, SumOfSquares
from .equilibria import Equilibrium, ResistibleWrenches, Squeeze, equilibrium, resistible_wrenches, squeeze
from .named_criteria import CRITERIA, closeness, make_criterion, positive_option
from .solve import OptimalForces, optimize_forces

__all__ = [
    "CRITERIA",
    "Criterion",
    "Equilibrium",
    "OptimalForces",
    "Gentlest",
    "LeastNorm",
    "ResistibleWrenches",
    "Robust",
    "SmallestSum",
    "Squeeze",
    "SumOfSquares",
    "closeness",
    "equilibrium",
    "make_criterion",
    "optimize_forces",
    "positive_option",
    "resistible_wrenches",
    "squeeze",
]
