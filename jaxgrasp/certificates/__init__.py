"""The checker: every answer proved again, without trusting the solver; NumPy and nothing else of ours."""

from .check import check, prove, proved_by
from .epsilon import prove_epsilon
from .forces import prove_forces
from .proof import Proof
from .resistance import prove_resistance

__all__ = [
    "Proof", "check", "prove", "prove_epsilon", "prove_forces", "prove_resistance", "proved_by",
]  # fmt: skip
