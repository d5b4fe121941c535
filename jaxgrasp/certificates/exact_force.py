"""An internal force in exact arithmetic, next to one in floating point, and the margin it shows.

    F + correction,   sum_i W_i (F_i + correction_i) = 0 exactly

The correction goes through the range of A^T, so that a contact with little friction is asked for little tangential
force; what is left after a few steps, some 1e-40 of the forces, goes through six independent unit wrenches.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from .dyadic import ExactGrasp, ForceSet, exact_grasp
from .elimination import solve
from .enclosures import root_above, root_below
from .rebuilt import Rebuilt

__all__ = ["Scaled", "exact_and_scaled", "internal_force", "margin_at_least"]

LARGEST_CHANGE = 0.5  # of the forces
BITS = 60  # of a force when it becomes an integer
STEPS, MORE_BITS = 2, 50  # corrections in floating point, each with so many bits more


class Scaled(NamedTuple):
    """One lane in floating point, lengths over ``length``, only contacts that count, forces normal first.

    A         (m, k n) folded grasp map     directions  (k, n, d) the force of each component, spin left out as zeros
    friction, torsion (k,)                  kinds       per component "n", "t" or "s"
    """

    A: np.ndarray
    directions: np.ndarray
    friction: np.ndarray
    torsion: np.ndarray
    kinds: str
    length: float


def exact_and_scaled(known: Rebuilt, lane: int, dimension: int) -> tuple[ExactGrasp, Scaled]:
    """Lane ``lane`` of the grasps: in whole numbers, and in floating point."""
    live = known.live[lane]
    numbers = (known.position, known.normal, known.friction, known.torsion)
    return exact_grasp(*(x[lane][live] for x in numbers)), _scaled_lane(known, lane, dimension)


def _scaled_lane(known: Rebuilt, lane: int, dimension: int) -> Scaled:
    """Lane ``lane`` of the grasps."""
    live = known.live[lane]
    blocks = known.blocks[lane][live]
    k, m, n = blocks.shape
    kinds = "n" + "".join("s" if c == "tau_n" else "t" for c in known.components if c != "f_n")
    return Scaled(
        np.moveaxis(blocks, 0, 1).reshape(m, k * n),
        np.swapaxes(blocks[:, :dimension], 1, 2),
        known.friction[lane][live],
        known.torsion[lane][live] / known.length[lane],
        kinds,
        float(known.length[lane]),
    )


class _Parts:
    """Forces as integers in units of 2^-bits: ``F_i = along_i N_i + across_i``, torques ``spin_i N_i``."""

    def __init__(self, grasp: ExactGrasp, lane: Scaled):
        self.grasp, self.lane = grasp, lane
        self.root = [math.isqrt(square) for square in grasp.normal_square]
        unit = Fraction(2) ** grasp.length_exponent
        self.length = max(int(Fraction(lane.length) / unit), 1)
        self.bits = max(root.bit_length() for root in self.root) + BITS
        k = len(self.root)
        self.along, self.spin = [0] * k, [0] * k
        self.across = [[0, 0, 0] for _ in range(k)]

    def finer(self, bits: int) -> None:
        self.bits += bits
        self.along = [x << bits for x in self.along]
        self.spin = [x << bits for x in self.spin]
        self.across = [[x << bits for x in row] for row in self.across]

    def add(self, s: np.ndarray) -> None:
        """The scaled forces s (k, n), normal first."""
        rough = [bool(mu) for mu in self.grasp.friction]
        for i, row in enumerate(s):
            for j, kind in enumerate(self.lane.kinds):
                if kind == "n":
                    self.along[i] += self._integer(row[j]) // self.root[i]
                elif kind == "s":
                    if self.grasp.torsion[i]:
                        torque = self._integer(row[j] * self.lane.torsion[i]) * self.length
                        self.spin[i] += torque // self.root[i]
                elif rough[i]:
                    for axis, x in enumerate(self.lane.directions[i, j] * row[j]):
                        self.across[i][axis] += self._integer(x)

    def _integer(self, x: float) -> int:
        mantissa, exponent = math.frexp(x)
        shift = exponent - 53 + self.bits
        whole = int(mantissa * 2**53)
        return whole << shift if shift >= 0 else whole >> -shift

    def forces(self) -> ForceSet:
        rows = [
            [a * x + t for x, t in zip(n, across, strict=True)]
            for a, n, across in zip(self.along, self.grasp.normal, self.across, strict=True)
        ]
        return ForceSet(rows, list(self.spin))

    def residual(self, wrench: list[int]) -> np.ndarray:
        """(m,) floats, in units of the scaled forces, torques over the length."""
        unit = 1 << self.bits
        sizes = [unit] * 3 + [unit * self.length] * 3
        return np.array([wrench[j] / sizes[j] for j in self.grasp.rows])


def internal_force(grasp: ExactGrasp, lane: Scaled, s: np.ndarray) -> tuple[ForceSet, int] | None:
    """Forces that balance exactly, next to the scaled s (k, n); and the rank of the folded map, m or less.

    None where there are none near: the system has no solution. A rank below m is a lower bound only where the first
    six wrenches were enough.
    """
    size = float(np.max(np.abs(s), initial=0.0))
    if not (np.isfinite(s).all() and size > 0 and np.isfinite(lane.A).all()):
        return None
    parts = _Parts(grasp, lane)
    parts.add(s / size)
    inverse = np.linalg.pinv(lane.A, rcond=1e-15)
    for _ in range(STEPS):
        change = -(inverse @ parts.residual(grasp.wrench(parts.forces())))
        # Forces that are mostly no internal ones are no evidence, whatever is left of them.
        if not np.linalg.norm(change) <= LARGEST_CHANGE * np.linalg.norm(s / size):
            return None
        parts.finer(MORE_BITS)
        parts.add(change.reshape(s.shape))
    return _balanced(grasp, lane, parts.forces())


def _balanced(grasp: ExactGrasp, lane: Scaled, forces: ForceSet) -> tuple[ForceSet, int] | None:
    """Without the last residual, forces multiplied by a common positive integer."""
    right = [-x for x in grasp.wrench(forces)]
    right = [right[j] for j in grasp.rows]
    columns, which = grasp.unit_wrenches()
    order = _best_first(grasp, lane, columns)
    m = len(right)
    solution = solve([columns[j] for j in order[:m]], right)
    if solution is None or solution[2] < m:
        solution = solve([columns[j] for j in order], right)
    if solution is None:
        return None
    x, factor, rank = solution
    force = [[factor * y for y in row] for row in forces.force]
    spin = [factor * y for y in forces.spin]
    for j, amount in zip(order, x, strict=False):
        contact, axis = which[j]
        if axis is None:
            spin[contact] += amount
        else:
            force[contact] = [y + amount * a for y, a in zip(force[contact], axis, strict=True)]
    return ForceSet(force, spin), rank


def _best_first(grasp: ExactGrasp, lane: Scaled, columns: list[list[int]]) -> list[int]:
    """The columns, each time the one that the columns before it explain least (as a pivoted QR does)."""
    length = 1 << max(abs(x).bit_length() for p in grasp.position for x in p)
    d = grasp.dimension
    rows = np.array([[_ratio(x, 1 if j < d else length) for j, x in enumerate(column)] for column in columns])
    rows = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-300)
    rest, order = rows.copy(), []
    left = list(range(len(rows)))
    while left and len(order) < len(grasp.rows):
        sizes = np.linalg.norm(rest[left], axis=-1)
        best = left[int(np.argmax(sizes))]
        order.append(best)
        left.remove(best)
        size = np.linalg.norm(rest[best])
        if size > 0:
            direction = rest[best] / size
            rest -= np.outer(rest @ direction, direction)
    return order + left


def _ratio(x: int, unit: int) -> float:
    try:
        return x / unit
    except OverflowError:
        return math.copysign(1e300, x)


def margin_at_least(grasp: ExactGrasp, forces: ForceSet, claim: float, digits: int) -> bool:
    """Whether exact internal forces show ``t >= claim``: ``k (f_n,i - psi_i) >= claim sum_j f_n,j`` for all i.

    Roots are enclosed to ``digits`` decimal digits; what they leave open is False.
    """
    heads, tails = [], []
    for i in grasp.contacts:
        h, square = grasp.cone_sides(i, forces.force[i], forces.spin[i])
        if square is None:
            return False
        nn = grasp.normal_square[i]
        head = Fraction(h * h, nn)
        low, high = root_below(head, digits), root_above(head, digits)
        heads.append((low, high) if h >= 0 else (-high, -low))
        tails.append(root_above(square / nn, digits))
    total = sum(low for low, _ in heads), sum(high for _, high in heads)
    if total[0] <= 0:
        return False
    bound, count = Fraction(claim), len(heads)
    most = bound * (total[1] if bound >= 0 else total[0])
    return all(count * (low - tail) >= most for (low, _), tail in zip(heads, tails, strict=True))
