"""One grasp and its evidence in exact arithmetic: what floating point left open, and what a written proof holds."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from .dyadic import ForceSet, Twist, twist_of
from .elimination import independent
from .enclosures import DIGITS
from .exact_force import exact_and_scaled, internal_force, margin_at_least
from .exact_twist import escape_twist, margin_at_most, moves_all_alike
from .nearby import rounding_distance
from .rebuilt import EPS, Rebuilt

__all__ = ["ExactLane"]


class ExactLane:
    """Lane ``lane`` of the grasps ``known``, and the evidence for it.

    s (k, n)            an internal force near which an exact one is sought, scaled, |s| = 1
    escape, bound (m,)  twists, lengths over L
    given               both twists as they stand, in body units: a rounded copy shows less where A is ill-conditioned
    nearby              how far numbers may lie of which a proof to rounding speaks
    """

    def __init__(
        self, known: Rebuilt, lane: int, dimension: int, s: np.ndarray, escape: np.ndarray, bound: np.ndarray,
        given: tuple[np.ndarray, np.ndarray], nearby: float,
    ):  # fmt: skip
        live = known.live[lane]
        self.grasp, self.scaled = exact_and_scaled(known, lane, dimension)
        self.s = s[live]
        self.twist, self.bound, self.given, self.nearby = escape, bound, given, nearby

    @cached_property
    def _balanced(self) -> tuple[ForceSet, int] | None:
        return internal_force(self.grasp, self.scaled, self.s)

    @property
    def forces(self) -> ForceSet | None:
        """Exact internal forces; None where there are none near."""
        return None if self._balanced is None else self._balanced[0]

    @property
    def full_rank(self) -> bool:
        """The contacts span all wrenches."""
        return self._balanced is not None and self._balanced[1] == len(self.grasp.rows)

    @property
    def resistant(self) -> bool:
        """Exact internal forces lie strictly inside every cone, and the contacts span all wrenches."""
        return self.full_rank and self.forces is not None and self.grasp.strictly_inside(self.forces)

    @cached_property
    def escape(self) -> Twist | None:
        """A twist that no contact can oppose, exactly."""
        if not (np.isfinite(self.twist).all() and np.isfinite(self.given[0]).all()):
            return None
        direct = twist_of(self.grasp, self.given[0])
        if self.grasp.escapes(direct):
            return direct
        return escape_twist(self.grasp, self.scaled, self.twist)

    @cached_property
    def nearest(self) -> tuple[float, Twist | None]:
        """How far the numbers lie, at most, for which a twist next to the given one escapes, and that twist."""
        if not np.isfinite(self.twist).all():
            return np.inf, None
        return rounding_distance(self.grasp, self.scaled, self.twist, self.nearby)

    @property
    def distance(self) -> float:
        return self.nearest[0]

    def at_least(self, lower: float) -> bool:
        """Whether exact internal forces show ``t* >= lower``."""
        if not np.isfinite(lower):
            return lower == -np.inf
        forces = self.forces
        return forces is not None and any(margin_at_least(self.grasp, forces, lower, d) for d in DIGITS)

    def at_most(self, upper: float) -> bool:
        """Whether the bound twist, or for -inf the contacts alone, show ``t* <= upper``."""
        if upper == -np.inf:
            return independent(self.grasp.unit_wrenches()[0]) or moves_all_alike(self.grasp)
        known = np.isfinite(self.given[1]).all()
        return bool(known) and any(
            margin_at_most(self.grasp, twist_of(self.grasp, self.given[1]), upper, d) for d in DIGITS
        )

    def at_least_nearby(self, lower: float) -> float:
        """How far a map lies, relatively, that has an internal force next to s which shows ``lower``; else infinite."""
        s, A = self.s, self.scaled.A
        if not np.isfinite(s).all():
            return np.inf
        # Balanced along all but the directions that rounding makes.
        s = s - (np.linalg.pinv(A, rcond=self.nearby) @ (A @ s.ravel())).reshape(s.shape)
        tails, total = np.linalg.norm(s[:, 1:], axis=-1), float(s[:, 0].sum())
        if not total > 0:
            return np.inf
        shown = len(s) * float(np.min(s[:, 0] - tails)) / total
        left = [math.fsum(row * s.ravel()) for row in A]
        residual = float(np.linalg.norm(left) / np.linalg.norm(A)) + 2 * EPS
        return residual if shown >= lower - self.nearby else np.inf

    def at_most_nearby(self, upper: float) -> float:
        """How far a map lies, contact by contact and relatively, of which the bound twist shows t* = -inf: all contacts
        move alike, along their normals."""
        if upper != -np.inf or not np.isfinite(self.bound).all():
            return np.inf
        x = (self.scaled.A.T @ self.bound).reshape(self.s.shape)
        mean = float(x[:, 0].mean())
        x[:, 0] -= mean
        size = np.linalg.norm(self.scaled.A, axis=0).reshape(self.s.shape)
        off = np.linalg.norm(x, axis=-1) / np.linalg.norm(size, axis=-1)
        return float(off.max()) if mean > self.nearby * float(size[:, 0].max()) else np.inf
