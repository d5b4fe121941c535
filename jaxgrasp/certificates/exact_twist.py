"""An escape twist in exact arithmetic, next to one in floating point; and the upper bound that a twist shows."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from .dyadic import ExactGrasp, Twist, dot, twist_of
from .elimination import null_vector, solve
from .enclosures import root_above, root_below
from .exact_force import Scaled

__all__ = ["escape_twist", "margin_at_most", "moves_all_alike", "physical"]

UNSEEN = 1e-9  # of its size: a contact that a twist moves by less may not move at all
EDGE = 1e-6  # of its size: a contact this near the edge of its cone is pushed inwards
STEPS = tuple(2.0**-e for e in (52, 48, 44, 40, 34, 28))


def escape_twist(grasp: ExactGrasp, lane: Scaled, xi: np.ndarray) -> Twist | None:
    """A twist that no contact can oppose, exactly: xi (m,) itself, or one within rounding of it; lengths over L.

    Three attempts: as it is; at rest exactly at the contacts it hardly moves; a little further inside the cones. None
    where a contact clearly opposes xi: a twist far from it is no proof of what was said.
    """
    direct = twist_of(grasp, physical(lane, grasp.dimension, xi))
    if grasp.escapes(direct):
        return direct
    x = _velocities(lane, xi)
    size = float(np.linalg.norm(lane.A) * np.linalg.norm(xi))
    if not (x[:, 0] - np.linalg.norm(x[:, 1:], axis=-1) >= -EDGE * size).all():
        return None
    unseen = np.linalg.norm(x, axis=-1) <= UNSEEN * size
    if unseen.any():
        still = _at_rest(grasp, direct, np.flatnonzero(unseen))
        if still is not None and grasp.escapes(still):
            return still
    inwards = _inwards(lane, x, unseen, size)
    for step in STEPS if np.isfinite(inwards).all() else ():
        nudged = twist_of(grasp, physical(lane, grasp.dimension, xi + step * inwards))
        if grasp.escapes(nudged):
            return nudged
    return None


def physical(lane: Scaled, dimension: int, xi: np.ndarray) -> np.ndarray:
    """(velocity / length; angular velocity): the units of the positions."""
    return np.concatenate([xi[:dimension] * lane.length, xi[dimension:]])


def _velocities(lane: Scaled, xi: np.ndarray) -> np.ndarray:
    """``x_i = A_i^T xi`` (k, n), normal first."""
    k, n = len(lane.torsion), len(lane.kinds)
    return (lane.A.T @ xi).reshape(k, n)


def _at_rest(grasp: ExactGrasp, near: Twist, contacts: np.ndarray) -> Twist | None:
    """The twist next to ``near`` that these contacts cannot notice at all."""
    columns, which = grasp.unit_wrenches()
    seen = [column for column, (i, _) in zip(columns, which, strict=True) if i in set(contacts)]
    full = [*near.velocity, *near.rotation]
    found = null_vector(seen, [full[j] for j in grasp.rows])
    if found is None:
        return None
    out = [0] * 6
    for j, x in zip(grasp.rows, found, strict=True):
        out[j] = x
    pivot_sign = 1 if sum(a * b for a, b in zip(out, full, strict=True)) >= 0 else -1
    out = [pivot_sign * x for x in out]
    return Twist(out[:3], out[3:])


def _inwards(lane: Scaled, x: np.ndarray, unseen: np.ndarray, size: float) -> np.ndarray:
    """The smallest change of the twist that moves every contact near its edge inwards at speed ``size``."""
    k, n = x.shape
    tails = np.linalg.norm(x[:, 1:], axis=-1)
    near = (x[:, 0] - tails <= EDGE * size) & ~unseen
    blocks = lane.A.T.reshape(k, n, -1)
    rows, right = [], []
    for i in range(k):
        if unseen[i]:
            rows.extend(blocks[i])
            right.extend([size] + [0.0] * (n - 1))
        elif near[i]:
            inner = np.concatenate([[1.0], -x[i, 1:] / tails[i] if tails[i] > 0 else x[i, 1:]])
            rows.append(inner @ blocks[i])
            right.append(size)
    if not rows or not np.isfinite(rows).all():
        return np.zeros(lane.A.shape[0])
    return np.linalg.lstsq(np.array(rows), np.array(right), rcond=1e-12)[0]


def margin_at_most(grasp: ExactGrasp, twist: Twist, claim: float, digits: int) -> bool:
    """Whether the largest multiple of -xi that the dual admits shows ``t* <= claim``.

    With x_i the contact's velocity, T = sum_i x_n,i: ``claim T + (1 - claim) k (x_n,i - |x_t,i|) >= 0`` for all i.
    """
    if claim >= 1:
        return True
    if not (any(twist.velocity) or any(twist.rotation)):
        return False
    heads, tails = [], []
    for i in grasp.contacts:
        h, square = grasp.dual_sides(i, twist)
        nn = grasp.normal_square[i]
        head = Fraction(h * h, nn)
        low, high = root_below(head, digits), root_above(head, digits)
        heads.append((low, high) if h >= 0 else (-high, -low))
        tails.append(root_above(square / nn, digits))
    bound, count = Fraction(claim), len(heads)
    total = sum(low for low, _ in heads) if bound >= 0 else sum(high for _, high in heads)
    return (
        all(
            bound * total + (1 - bound) * count * (low - tail) >= 0
            for (low, _), tail in zip(heads, tails, strict=True)
        )
        and sum(low for low, _ in heads) > 0
    )


def moves_all_alike(grasp: ExactGrasp) -> bool:
    """Whether some twist moves every contact at one speed along its normal and across nothing: then t* = -inf.

    Decided where the lengths of the normals have rational ratios; False elsewhere.
    """
    columns, which = grasp.unit_wrenches()
    first, right = grasp.normal_square[0], []
    for i, axis in which:
        square = grasp.normal_square[i] * first
        root = math.isqrt(square)
        if root * root != square:
            return False
        along = 0 if axis is None else dot(axis, grasp.normal[i])
        # u_i = N_i / |N_i|; times |N_1|, a common factor: N_i first / root
        right.append(Fraction(along * first, root))
    scale = math.lcm(*(x.denominator for x in right))
    rows = list(zip(*columns, strict=True))
    return solve(rows, [int(x * scale) for x in right]) is not None
