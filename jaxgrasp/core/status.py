"""The one list of answers: an int in arrays and tables, a sentence for people."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

__all__ = ["SpokenEnum", "Status"]


class SpokenEnum(IntEnum):
    """Integers for arrays and tables whose members carry the sentence a person reads."""

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


class Status(SpokenEnum):
    """What a lane of a batch ended with. ``Status(3).sentence`` says it in words.

    The numbers are part of the file format and never change.
    """

    RESISTANT = 1, "Wrench resistant (force closure): the internal force proves it."
    NOT_RESISTANT = 2, "Not wrench resistant: the escape twist is a motion no finger force can oppose."
    MARGINAL = (
        3,
        "Marginal: the margin is zero to within the tolerance, so any disturbance may break the grasp.",
    )
    UNDECIDED = 4, "Undecided: the solver stopped before it had a proof either way."
    INVALID = (
        5,
        (
            "Invalid: the numbers are not a grasp (NaN or infinite entry, zero-length normal, negative friction, "
            "or no active contact)."
        ),
    )
    OPTIMAL = 6, "Optimal: the forces balance the load inside every cone, and the bound proves the cost."
    INFEASIBLE = (
        7,
        (
            "Infeasible: no admissible forces balance the load; along the escape twist the load does work "
            "that no force can take up."
        ),
    )
    STALLED = (
        8,
        (
            "Stalled: rounding stopped the solver before its gap or a proof of infeasibility; the best forces and "
            "the gap reached are given."
        ),
    )
