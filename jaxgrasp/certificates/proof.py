"""What a proof ends with, lane by lane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["EXACTLY", "LEVELS", "REFUSED", "TO_ROUNDING", "Proof", "refused"]

# As in core.Status: this room imports nothing of ours.
EXACTLY, TO_ROUNDING, REFUSED = 23, 24, 25
LEVELS = np.array(
    [REFUSED, TO_ROUNDING, EXACTLY], np.int32
)  # inside, a level is 0, 1 or 2: the least of its parts

WORDS = {
    EXACTLY: "Proved exactly: true of the very numbers given, without any tolerance.",
    TO_ROUNDING: "Proved to rounding: it holds only by rounding, of numbers within {distance:.1e} of the given ones.",
    REFUSED: "Refused: the evidence does not prove what the answer says.",
}


@dataclass(frozen=True)
class Proof:
    """What the evidence of an answer proves, lane by lane.

    status         int32 (*batch), a ``Status``: PROVED_EXACTLY, PROVED_TO_ROUNDING or REFUSED
    distance       (*batch) PROVED_TO_ROUNDING: how far the numbers lie for which it is true, at most; 0 where exact,
                   infinite where refused. Of positions and gamma over the largest |p_i|, angles of normals in rad, mu
                   without unit; for forces the share by which mu, gamma, caps, torques and J are better, and the load
                   that is missing over the sizes of all forces and of the load
    lower, upper   (*batch) what is proved of the bracketed value (t*, the optimal cost, epsilon), rounded outwards;
                   NaN where refused. For OPTIMAL the optimum of the numbers the status speaks of
    force_distance (*batch) OPTIMAL: exact forces lie within this share of the largest of those given; else 0
    """

    status: np.ndarray
    distance: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    force_distance: np.ndarray

    def __getitem__(self, index: Any) -> Proof:
        """The proofs at ``index`` of the batch."""
        return Proof(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def sentence(self, index: int | tuple[int, ...] = ()) -> str:
        """One lane in words."""
        return WORDS[int(self.status[index])].format(distance=float(self.distance[index]))

    def __str__(self) -> str:
        if not self.status.ndim:
            return self.sentence()
        total = self.status.size
        count = {name: int((self.status == code).sum()) for name, code in _NAMES.items()}
        lines = [f"Proof of {total} lanes"]
        lines += [f"{n:>10}  {n / total:6.1%}  {name}" for name, n in count.items() if n]
        return "\n".join(lines)


_NAMES = {"PROVED_EXACTLY": EXACTLY, "PROVED_TO_ROUNDING": TO_ROUNDING, "REFUSED": REFUSED}


def refused(shape: tuple[int, ...]) -> Proof:
    """Nothing is proved."""
    nan = np.full(shape, np.nan)
    return Proof(np.full(shape, REFUSED, np.int32), np.full(shape, np.inf), nan, nan, np.zeros(shape))
