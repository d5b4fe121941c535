"""Counts of many answers, and quantiles of their margins or costs, in a size that does not depend on how many they are.

Quantiles of margins come from a histogram over ``u = s / (1 + s)``, s = 1 - margin >= 0, in ``BINS`` equal steps: a
quantile is right to ``(1 + s)^2 / (2 BINS)``, 3e-5 at margin 0. Histograms add up, so the order of chunks
does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..core import Status

__all__ = ["ForceSummary", "Summary"]

BINS = 65536
FINEST, LARGEST, STEP = 1e-9, 1e15, 1e-3  # costs are told apart to STEP relative, near 0 to FINEST STEP
HALF = int(np.arcsinh(LARGEST / FINEST) / STEP) + 1
COST_BINS = 2 * HALF + 1


@dataclass
class Summary:
    """A run so far. ``counts`` by Status, ``removed`` by the filter's reasons; seconds of wall clock.

    candidates       offered in the whole run
    solved           grasps that went through the solver in this process
    resumed          candidates taken over from earlier shards
    seconds          overall, without compiling
    solve_seconds    in the solver, all threads together counted as one
    """

    candidates: int = 0
    counts: dict[Status, int] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=dict)
    histogram: np.ndarray = field(default_factory=lambda: np.zeros(BINS + 1, np.int64))
    solved: int = 0
    resumed: int = 0
    seconds: float = 0.0
    solve_seconds: float = 0.0
    compile_seconds: float = 0.0

    @classmethod
    def of(cls, status: np.ndarray, margin: np.ndarray, removed: dict[str, int] | None = None) -> Summary:
        """The summary of these rows."""
        values, numbers = np.unique(status, return_counts=True)
        counts = {Status(int(v)): int(n) for v, n in zip(values, numbers, strict=True)}
        known = margin[~np.isnan(margin)].astype(np.float64)
        with np.errstate(invalid="ignore"):
            shortfall = np.maximum(1 - known, 0)
            u = np.where(np.isinf(shortfall), 1.0, shortfall / (1 + shortfall))
        histogram = np.bincount((u * BINS).astype(np.int64), minlength=BINS + 1)
        return cls(counts=counts, removed=dict(removed or {}), histogram=histogram)

    def add(self, other: Summary) -> None:
        """Take the rows of ``other`` in as well."""
        for status, number in other.counts.items():
            self.counts[status] = self.counts.get(status, 0) + number
        for reason, number in other.removed.items():
            self.removed[reason] = self.removed.get(reason, 0) + number
        self.histogram = self.histogram + other.histogram
        self.solved += other.solved
        self.solve_seconds += other.solve_seconds

    @property
    def rows(self) -> int:
        """Grasps with a verdict."""
        return sum(self.counts.values())

    @property
    def done(self) -> int:
        """Candidates dealt with: verdicts and those the filter removed."""
        return self.rows + sum(self.removed.values())

    def share(self, status: Status) -> float:
        """Part of the verdicts that are ``status``; 0 before the first."""
        return self.counts.get(status, 0) / max(self.rows, 1)

    def quantile(self, q: float) -> float:
        """The margin that a share q of the grasps lie at or below; NaN if there are none."""
        number = int(self.histogram.sum())
        if not number:
            return float("nan")
        # Bins go from margin 1 down, so look for the share 1 - q from the top.
        ranks = np.cumsum(self.histogram)
        place = int(np.searchsorted(ranks, min(max((1 - q) * number, 1), number), side="left"))
        u = (place + 0.5) / BINS if place < BINS else 1.0
        return 1 - u / (1 - u) if u < 1 else float("-inf")


@dataclass
class ForceSummary(Summary):
    """Counts by status, and the costs of the optimal grasps, in a size that does not depend on how many they are.

    Costs c go into bins of ``asinh(c / FINEST)`` of width STEP, so a quantile is right to 0.05 %. ``proved``: optimal
    and infeasible answers that the checker accepted.
    """

    histogram: np.ndarray = field(default_factory=lambda: np.zeros(COST_BINS, np.int64))
    proved: int = 0

    @classmethod
    def of_costs(cls, status: np.ndarray, cost: np.ndarray, proved: np.ndarray) -> ForceSummary:
        """The summary of these rows."""
        values, numbers = np.unique(status, return_counts=True)
        counts = {Status(int(v)): int(n) for v, n in zip(values, numbers, strict=True)}
        known = cost[(status == Status.OPTIMAL.value) & np.isfinite(cost)]
        place = np.rint(np.arcsinh(np.clip(known, -LARGEST, LARGEST) / FINEST) / STEP).astype(np.int64)
        histogram = np.bincount(place + HALF, minlength=COST_BINS)
        return cls(counts=counts, histogram=histogram, solved=len(status), proved=int(proved.sum()))

    def add(self, other: Summary) -> None:
        """Take the rows of ``other`` in as well."""
        super().add(other)
        if isinstance(other, ForceSummary):
            self.proved += other.proved

    def quantile(self, q: float) -> float:
        """The cost that a share q of the optimal grasps lie at or below; NaN if there are none."""
        number = int(self.histogram.sum())
        if not number:
            return float("nan")
        rank = min(max(q * number, 1), number)
        place = int(np.searchsorted(np.cumsum(self.histogram), rank, side="left"))
        return float(FINEST * np.sinh((place - HALF) * STEP))
