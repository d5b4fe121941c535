"""Both bounds of the Ferrari-Canny quality proved again.

    lower          every vertex is the wrench of forces in their cones with unit effort, and the facets surround a ball
                   of that radius (``polytope``); so the grasp is RESISTANT if it is positive
    upper          h(direction), in closed form, is no larger
    NOT_RESISTANT  both bounds are 0, and ``direction`` is the negative of a twist that no contact can oppose
    touching       forces in their cones with unit effort at most

Both bounds are proved to 1e-9 of epsilon (64 eps of float32), and to rounding of the map; the proof states its own,
rounded outwards.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .exact_force import exact_and_scaled
from .exact_twist import escape_twist
from .nearby import rounding_distance
from .polytope import ball_inside
from .proof import LEVELS, Proof
from .reading import Fields, Malformed
from .rebuilt import EPS, Rebuilt, rebuild, scaled_force

__all__ = ["prove_epsilon"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID = 1, 2, 3, 4, 5
NORMS = ("L1", "Linf")
ROOM = 1e-9  # of epsilon; of unit effort
NEARBY = 64.0  # eps
LARGEST_CLAIM = 1e-3  # a margin this far from 0 is not marginal


class Claim(NamedTuple):
    """What N lanes say, lengths as given: scalars (N,), direction (N, m), forces (N, V, k, n), facets (N, F, m)."""

    status: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
    direction: np.ndarray
    touching: np.ndarray
    forces: np.ndarray
    facets: np.ndarray
    norm: str


def prove_epsilon(grasp, answer, tolerance: float | None = None) -> Proof:
    """What the evidence of ``answer`` proves of ``grasp``; shapes (*batch,)."""
    batch, dimension = grasp.position.shape[:-2], grasp.position.shape[-1]
    known, eps = rebuild(grasp), float(np.finfo(np.dtype(grasp.position.dtype)).eps)
    claim = _claim(answer, batch, known, 3 if dimension == 2 else 6)
    room = max(ROOM, NEARBY * eps) if tolerance is None else float(tolerance)
    lanes = len(known.valid)
    level, distance = np.zeros(lanes, int), np.zeros(lanes)
    lower, upper = np.full(lanes, np.nan), np.full(lanes, np.nan)
    with np.errstate(all="ignore"):
        for lane in range(lanes):
            if known.valid[lane]:
                found = _Lane(known, claim, lane, dimension, eps, room).proved()
                level[lane], distance[lane], lower[lane], upper[lane] = found
            elif (
                claim.status[lane] == INVALID and np.isnan(claim.lower[lane]) and np.isnan(claim.upper[lane])
            ):
                level[lane] = 2
    distance = np.where(level == 2, 0.0, np.where(level == 1, distance, np.inf))
    parts = (LEVELS[level], distance, lower, upper, np.zeros(lanes))
    return Proof(*(x.reshape(batch) for x in parts))


def _claim(answer, batch: tuple[int, ...], known: Rebuilt, m: int) -> Claim:
    said, (k, n) = Fields(answer, batch), known.scale.shape[1:]
    forces, facets, norm = said.array("forces"), said.array("facets"), getattr(answer, "norm", None)
    if not isinstance(norm, str) or norm not in NORMS or forces.ndim != len(batch) + 2:
        raise Malformed("forces or norm")
    if facets.dtype.kind not in "iu" or facets.shape != (*batch, *facets.shape[-2:][:1], m):
        raise Malformed("facets")
    vertices = forces.shape[-2]
    return Claim(
        said.integers("status"),
        said.numbers("lower"),
        said.numbers("upper"),
        said.numbers("torque_scale"),
        said.numbers("direction", m),
        said.numbers("touching", k * n).reshape(-1, k, n),
        said.numbers("forces", vertices, k * n).reshape(len(known.valid), vertices, k, n),
        facets.reshape(len(known.valid), facets.shape[-2], m).astype(np.int64),
        norm,
    )


class _Lane:
    """One valid lane."""

    def __init__(self, known: Rebuilt, claim: Claim, lane: int, dimension: int, eps: float, room: float):
        self.known, self.claim, self.lane, self.dimension = known, claim, lane, dimension
        self.eps, self.room = eps, room
        self.live = known.live[lane]
        self.row_scale = np.ones(claim.direction.shape[-1])
        self.row_scale[dimension:] = known.length[lane] / claim.scale[lane]
        self.blocks = known.blocks[lane] * self.row_scale[:, None]  # (k, m, n), torques over the torque scale
        self.size = float(np.linalg.norm(self.blocks))

    def proved(self) -> tuple[int, float, float, float]:
        """Level, distance, and the bracket that is proved."""
        claim, lane, nothing = self.claim, self.lane, (0, np.inf, np.nan, np.nan)
        status, lower, upper = int(claim.status[lane]), float(claim.lower[lane]), float(claim.upper[lane])
        length = float(np.linalg.norm(claim.direction[lane]))
        # A size that is a number bounds all that is computed from the scale.
        sound = 0 < claim.scale[lane] < np.inf and np.isfinite(self.size) and np.isfinite(upper)
        sound = sound and abs(length - 1) <= NEARBY * self.eps and 0 <= lower <= upper
        if not (sound and self._touching_is_possible()):
            return nothing
        if status == NOT_RESISTANT:
            level, distance = self._escapes() if upper == 0 else (0, np.inf)
            return (level, distance, 0.0, 0.0) if level else nothing
        direction = claim.direction[lane] / length
        shown, top = self._support(direction)
        terms = float((np.abs(self.blocks).sum((0, 2)) * np.abs(direction)).sum())
        if not shown <= upper * (1 + self.room) + 16 * self.eps * terms:
            return nothing
        if status == RESISTANT and lower > 0:
            ball, fine = self._ball(), NEARBY * self.eps * self.size
            return (2, 0.0, ball, top) if ball > 0 and ball + fine >= lower * (1 - self.room) else nothing
        idle = status == UNDECIDED or (status == MARGINAL and self._nearly_escapes())
        return (2, 0.0, 0.0, top) if idle and lower == 0 else nothing

    def _support(self, direction: np.ndarray) -> tuple[float, float]:
        """h(direction), as floating point has it and rounded up."""
        v = np.einsum("kmn,m->kn", self.blocks, direction)
        blur = 32 * EPS * np.linalg.norm(self.blocks, axis=(-2, -1))
        h = np.where(self.live, v[:, 0] + np.linalg.norm(v[:, 1:], axis=-1), 0.0)
        shown, top = np.maximum(h, 0.0), np.maximum(np.where(self.live, h + blur, 0.0), 0.0)
        if self.claim.norm == "Linf":
            return float(shown.sum()), float(top.sum() * (1 + len(h) * EPS))
        return float(shown.max()), float(top.max())

    def _unit_effort(self, forces: np.ndarray) -> tuple[np.ndarray, bool]:
        """Scaled forces (V, k, n) pulled into their cones and to unit effort; whether that was rounding."""
        s = scaled_force(forces, self.known.scale[self.lane], self.known.normal_index)
        head, tail = s[..., 0], np.linalg.norm(s[..., 1:], axis=-1)
        effort = head.sum(-1) if self.claim.norm == "L1" else head.max(-1)
        fits = np.isfinite(s).all() and (tail <= head + self.room).all() and (effort <= 1 + self.room).all()
        fits = bool(fits) and not s[:, ~self.live].any()
        head = np.maximum(head, 0.0)
        shrink = np.minimum(1.0, head / np.where(tail > 0, tail, 1.0)) * (1 - 8 * EPS)
        s = np.concatenate([head[..., None], s[..., 1:] * shrink[..., None]], -1)
        effort = head.sum(-1) if self.claim.norm == "L1" else head.max(-1)
        return s / (np.maximum(effort, 1.0) * (1 + 64 * EPS))[:, None, None], fits

    def _touching_is_possible(self) -> bool:
        return self._unit_effort(self.claim.touching[self.lane][None])[1]

    def _ball(self) -> float:
        """The radius that the vertices' hull surely holds."""
        facets = self.claim.facets[self.lane]
        facets = facets[facets[:, 0] >= 0]
        s, fits = self._unit_effort(self.claim.forces[self.lane])
        if not fits or not len(facets) or not len(s):
            return 0.0
        points = np.einsum("kmn,vkn->vm", self.blocks, s)
        terms = s.shape[1] * s.shape[2] + 24
        blur = terms * EPS * self.size * float(np.max(np.linalg.norm(s.reshape(len(s), -1), axis=-1)))
        return ball_inside(points, facets) - blur

    def _nearly_escapes(self) -> bool:
        """``direction`` turned round is a twist that shows a margin of 0, neither clearly more nor clearly less."""
        xi = -self.claim.direction[self.lane] * self.row_scale
        x = np.einsum("kmn,m->kn", self.known.blocks[self.lane], xi)[self.live]
        total, least = (
            float(x[:, 0].sum()),
            len(x) * float((x[:, 0] - np.linalg.norm(x[:, 1:], axis=-1)).min()),
        )
        # t* <= -least / (total - least), see ``exact_twist``.
        return total > 0 and abs(least) < LARGEST_CLAIM * (total - least)

    def _escapes(self) -> tuple[int, float]:
        """``direction`` as a twist that no contact can oppose, turned round."""
        grasp, scaled = exact_and_scaled(self.known, self.lane, self.dimension)
        xi = -self.claim.direction[self.lane] * self.row_scale
        if escape_twist(grasp, scaled, xi) is not None:
            return 2, 0.0
        nearby = NEARBY * self.eps
        distance, _ = rounding_distance(grasp, scaled, xi, nearby)
        return (1, distance) if distance <= nearby else (0, np.inf)
