"""Why a lane of an interior-point method stopped."""

from __future__ import annotations

from ..core import SpokenEnum

__all__ = ["Stop"]


class Stop(SpokenEnum):
    """Why a lane stopped; ``Stop(2).sentence`` says it in words."""

    RUNNING = 0, "The iteration budget ended first; the best iterate is kept."
    CONVERGED = 1, "The duality gap reached its tolerance."
    DECIDED = 2, "The question was answered before the gap closed."
    STALLED = 3, "The gap stopped shrinking: rounding limits this lane; the best iterate is kept."
    BREAKDOWN = 4, "The next step was not finite or left the cones; the best iterate is kept."
    SKIPPED = 5, "Nothing to solve: the lane was excluded from the start."
