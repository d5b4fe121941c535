"""Answers as people read them: verdicts, forces and motions in words and pictures."""

from .answers import ForceAnswer, Verdict
from .controllability_words import explain_controllability
from .drawing import draw
from .force_words import contact_rows, cost_words, infeasible_words, load_words
from .proofs import reprove_forces, reprove_verdict
from .verdict_words import explain
from .words import status_words

__all__ = [
    "ForceAnswer",
    "Verdict",
    "contact_rows",
    "cost_words",
    "draw",
    "explain",
    "explain_controllability",
    "infeasible_words",
    "load_words",
    "reprove_forces",
    "reprove_verdict",
    "status_words",
]
