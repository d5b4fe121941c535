"""Sections 11.1-11.2: wrench resistance (force closure), its margin with a proof either way, and its derivatives."""

from .derivatives import Scales, Solved, differentiable
from .problem import margin_program, starting_point, upper_bound
from .solve import TOTAL_BUDGET, WrenchResistance, wrench_resistance
from .trace import Trace, trace
from .verdict import Verdict, judge

__all__ = [
    "Scales",
    "Solved",
    "TOTAL_BUDGET",
    "Trace",
    "Verdict",
    "WrenchResistance",
    "differentiable",
    "judge",
    "margin_program",
    "starting_point",
    "trace",
    "upper_bound",
    "wrench_resistance",
]
