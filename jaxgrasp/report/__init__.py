"""Answers as people read them: verdicts, forces and motions in words and pictures."""

from .controllability_words import explain_controllability
from .force_words import ForceAnswer, contact_rows, cost_words, infeasible_words, load_words, reprove_forces
from .verdict_words import Verdict, draw, explain, reprove_verdict

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
]
