"""A load that no admissible forces hold, proved again (theory section 3; Farkas).

    y . w > sum_i min(cap_i, 10^6 |w|) (|x_t,i| - x_0,i)+ + sum_j |beta_j| tau_j,    x_i = A_i^T y + J_i beta

The load does more work along the twist y, the joints turning at beta, than admissible forces can take up, with normal
parts up to a million times the load. Where the twist is one that no contact can oppose, the right side is 0.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from .criteria import Asked
from .dyadic import ExactGrasp, Twist, integers
from .exact_force import exact_and_scaled
from .exact_twist import escape_twist
from .nearby import rounding_distance
from .rebuilt import EPS

__all__ = ["prove_separation"]

LIMIT = 1e6  # loads


def prove_separation(
    asked: Asked, wrench: np.ndarray, twist: np.ndarray, rates: np.ndarray, nearby: float, lanes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Levels 0, 1, 2 and distances (N,) of the lanes (bool) that claim it; twists (N, m), lengths over L.

    wrench  (N, m) the load as given, in the units of the caller
    """
    # A proof may be scaled by any positive number: to size 1, so that nothing over- or underflows.
    largest = np.max(np.abs(np.concatenate([twist, rates], -1)), -1, keepdims=True)
    twist, rates = twist / largest, rates / largest
    shown = _separates(asked, twist, rates)
    level, distance = np.where(lanes & shown, 2, 0), np.zeros(len(lanes))
    # The twist alone: joints that turn beside it would say something else.
    turning = np.linalg.norm(asked.reach(), axis=(1, 2)) * np.linalg.norm(rates, axis=-1)
    moving = np.linalg.norm(asked.known.A, axis=(-2, -1)) * np.linalg.norm(twist, axis=-1)
    twist = twist / np.max(np.abs(twist), -1, keepdims=True)
    lanes = lanes & ~shown & (turning <= 64 * nearby * moving) & np.isfinite(twist).all(-1)
    for lane in np.flatnonzero(lanes):
        level[lane], distance[lane] = _in_integers(asked, wrench[lane], twist[lane], int(lane), nearby)
    return level, distance


def _separates(asked: Asked, twist: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """In floating point, with bounds of all rounding."""
    known, jacobian = asked.known, asked.scaled_jacobian()
    n, joints = jacobian.shape[2], rates.shape[-1]
    x = np.einsum("lkij,li->lkj", known.blocks, twist) + np.einsum("lkcj,lj->lkc", jacobian, rates)
    speed, size = np.linalg.norm(twist, axis=-1), np.linalg.norm(asked.load, axis=-1)
    blur = np.linalg.norm(known.blocks, axis=(-2, -1)) * speed[:, None]
    blur = blur + np.linalg.norm(asked.reach(), axis=-1) * np.linalg.norm(rates, axis=-1)[:, None]
    blur = (24 + n + joints) * EPS * blur
    violation = np.linalg.norm(x[..., 1:], axis=-1) - x[..., 0] + blur
    most = np.minimum(asked.cap, LIMIT * size[:, None])
    taken = np.sum(np.where(known.live, np.maximum(violation, 0.0) * most, 0.0), -1) + asked.joint_work(rates)
    power = np.sum(twist * asked.load, -1) - 16 * EPS * speed * size
    return power > taken * (1 + (asked.cap.shape[1] + joints + 8) * EPS)


def _in_integers(
    asked: Asked, wrench: np.ndarray, twist: np.ndarray, lane: int, nearby: float
) -> tuple[int, float]:
    """A twist near the given one that no contact can oppose, and the work of the load along it."""
    grasp, scaled = exact_and_scaled(asked.known, lane, asked.dimension)
    exact = escape_twist(grasp, scaled, twist)
    if exact is not None:
        return (2, 0.0) if _power(grasp, exact, wrench) > 0 else (0, np.inf)
    clear = float(twist @ asked.load[lane]) > 64 * nearby * float(
        np.linalg.norm(twist) * np.linalg.norm(asked.load[lane])
    )
    distance, _ = rounding_distance(grasp, scaled, twist, nearby)
    return (1, distance) if clear and distance <= nearby else (0, np.inf)


def _power(grasp: ExactGrasp, twist: Twist, wrench: np.ndarray) -> Fraction:
    """The work of the load along the twist, up to a positive factor."""
    d = grasp.dimension
    unit = Fraction(2) ** grasp.length_exponent
    parts = integers(wrench)[0]
    rows = [*twist.velocity, *twist.rotation]
    full = [*rows[:d], *(rows[3:] if d == 3 else rows[5:])]
    force = sum(f * v for f, v in zip(parts[:d], full[:d], strict=True))
    moment = sum(t * w for t, w in zip(parts[d:], full[d:], strict=True))
    return Fraction(force) * unit + moment
