"""How placement searches: how many starts, how long each climbs, by which optimiser, and what it reports on its way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import optax

from .settle import ROUNDS

__all__ = ["CANDIDATES", "PlacementProgress", "Search"]

CANDIDATES = 2048  # random grasps a start is the best of
ADAM = optax.adam(0.05)  # of the radius a step; one object, hence one compilation


class PlacementProgress(NamedTuple):
    """How far a placement is: what it is doing, starts that are through with it, of how many, the best value so far."""

    phase: str
    done: int
    starts: int
    best: float


@dataclass(frozen=True)
class Search:
    """``p <- retract(p + scale * optimizer(grad q))`` from ``starts`` points: how placement searches.

    starts      random starts, each the best of ``candidates`` random grasps by the objective's guide
    steps       at most, of each climb; a start ends earlier when halving its steps helps no more
    candidates  random grasps a start is the best of
    settling    rounds of random moves on a mesh's own triangles at the end, 16 trials of the objective each; 0: none
    distinct    two grasps are distinct where some contact differs by more than this share of the surface's radius
    optimizer   an optax optimiser over contacts (k, 3) in units of the surface's radius, a state for each start; by
                default ``optax.adam(0.05)``. Its steps are halved where a start no longer improves
    seed        the same seed gives the same grasps

    ValueError for numbers that are no counts.
    """

    starts: int = 256
    steps: int = 150
    candidates: int = CANDIDATES
    settling: int = ROUNDS
    distinct: float = 0.1
    optimizer: optax.GradientTransformation = ADAM
    seed: int = 0

    def __post_init__(self):
        for name in ("starts", "steps", "candidates"):
            expect_count(name, getattr(self, name))
        if not isinstance(self.settling, int | np.integer) or self.settling < 0:
            raise ValueError(f"settling must be an integer of 0 or more, got {self.settling!r}")


def expect_count(name: str, value: int) -> None:
    """ValueError where ``value`` is no integer of 1 or more."""
    if not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} must be an integer of 1 or more, got {value!r}")
