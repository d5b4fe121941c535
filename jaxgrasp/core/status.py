"""The one list of words that an answer may end with: a number in arrays and tables, a sentence for people."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

__all__ = ["Status"]


class Status(IntEnum):
    """What a lane of a batch ended with. ``Status(3).sentence`` says it in words.

    One number a word, in every answer. The numbers are part of the file formats: they never change and are never used
    again. An answer may say a word more precisely than this list does: ``answer.sentence(lane)``.
    """

    sentence: str

    def __new__(cls, value: int, sentence: str):
        member = int.__new__(cls, value)
        member._value_ = value
        member.sentence = sentence
        return member

    @classmethod
    def _missing_(cls, value: Any):
        # An entry of a JAX array: equal to a member, but no key of the enum's table on every Python.
        return next((member for member in cls if np.ndim(value) == 0 and member.value == value), None)

    # Why an iteration ended, before there is an answer.
    RUNNING = 0, "Running: the iteration budget ended first; the best iterate is kept."
    # Wrench resistance (force closure).
    RESISTANT = 1, "Wrench resistant (force closure): the internal force proves it."
    NOT_RESISTANT = 2, "Not wrench resistant: the escape twist is a motion no finger force can oppose."
    MARGINAL = 3, "Marginal: at the edge to within the tolerance, so that a small change may turn the answer."
    UNDECIDED = 4, "Undecided: the solver stopped before it had a proof either way."
    INVALID = (
        5,
        (
            "Invalid: the numbers are not a grasp (NaN or infinite entry, zero-length normal, negative friction, "
            "or no active contact), or what is asked of it is no number."
        ),
    )
    # Optimal forces, and every other optimum.
    OPTIMAL = 6, "Optimal: the point satisfies every constraint, and the bound proves its cost."
    INFEASIBLE = 7, "Infeasible: nothing satisfies the constraints, and the multipliers prove it."
    STALLED = (
        8,
        (
            "Stalled: rounding stopped the solver before its gap or a proof of infeasibility; the best point and the "
            "gap reached are given."
        ),
    )
    # Why an iteration ended.
    CONVERGED = 9, "Converged: the duality gap reached its tolerance."
    DECIDED = 10, "Decided: the question was answered before the gap closed."
    BREAKDOWN = 11, "Breakdown: the next step was not finite or left the cones; the best iterate is kept."
    SKIPPED = 12, "Skipped: nothing to solve, the lane was excluded from the start."
    # Equilibria (Definition 2).
    NON_MARGINAL = (
        13,
        "Non-marginal equilibrium: forces strictly inside every friction cone balance the load.",
    )
    NO_EQUILIBRIUM = 14, "No equilibrium: no admissible contact forces balance the load."
    NOT_BALANCED = 15, "Not balanced: the given forces do not carry the weight, or leave their cones."
    # Controllability (11.30).
    CONTROLLABLE = (
        16,
        (
            "Controllable though not wrench resistant: with the forces strictly inside their cones, small changes of "
            "them and gravity together reach every motion."
        ),
    )
    NOT_CONTROLLABLE = (
        17,
        (
            "Not controllable to first order: no small change of the contact forces affects the uncontrollable motion."
        ),
    )
    # What became of a controller's command.
    COMMANDED = (
        18,
        "Commanded: the contact forces produce the wanted wrench, each inside its cone and limits.",
    )
    PROJECTED = (
        19,
        "Projected: the commanded forces left their cones; the nearest admissible ones are applied.",
    )
    UNREGULATED = (
        20,
        (
            "Unregulated: no equilibrium, or no feedback on its linearisation is stable; the forces of rest are kept."
        ),
    )
    # Linear matrix inequalities.
    FEASIBLE = 21, "Feasible: the point satisfies every constraint strictly."
    UNBOUNDED = 22, "Unbounded: the cost falls for ever along the ray, which never leaves the feasible set."
    # What an answer's evidence proves.
    PROVED_EXACTLY = (
        23,
        "Proved exactly: true of the very numbers given, in real arithmetic, without any tolerance.",
    )
    PROVED_TO_ROUNDING = (
        24,
        "Proved to rounding: true of numbers so near that rounding tells them from the given ones.",
    )
    REFUSED = 25, "Refused: the evidence does not prove what the answer says."
