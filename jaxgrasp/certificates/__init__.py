"""The checker: every answer proved again, without trusting the solver; NumPy and nothing else of ours."""

from .check import check, prove, proved_by
from .epsilon import prove_epsilon
from .forces import prove_forces
from .proof import Proof
from .proof_lines import proof_lines
from .reading import Malformed
from .resistance import prove_resistance

__all__ = [
    "Malformed", "Proof", "check", "proof_lines", "prove", "prove_epsilon", "prove_forces", "prove_resistance",
    "proved_by",
]  # fmt: skip
