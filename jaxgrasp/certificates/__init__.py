"""The checker: every answer proved again in float64, without trusting the solver; NumPy and nothing else of ours."""

from .check import check, checked_by, force_claim
from .epsilon import check_epsilon
from .forces import check_forces
from .resistance import check_resistance

__all__ = ["check", "check_epsilon", "check_forces", "check_resistance", "checked_by", "force_claim"]
