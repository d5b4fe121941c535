"""The numbers of one grasp as integers: every float is an integer times a power of two.

    lengths (p_i, gamma_i)  one power for all        normals   one power each: only their direction counts
    mu_i                    one power for all        forces    one power for all

Cones are compared by squares, so nothing is rounded. With h = F . N, q = |F|^2 |N|^2 - h^2 and torque S N, a force lies
in its cone iff h >= 0 and ``q / mu^2 + S^2 |N|^4 / gamma^2 <= h^2``; with u = v + omega x p and h = u . N, a twist
opposes no force of the contact iff h >= 0 and ``mu^2 (|u|^2 |N|^2 - h^2) + gamma^2 (omega . N)^2 <= h^2``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

__all__ = ["ExactGrasp", "ForceSet", "Twist", "cross", "dot", "exact_grasp", "integers", "twist_of"]

Triple = tuple[int, int, int]


def integers(values: Iterable[float]) -> tuple[list[int], int]:
    """(n_j, e) with ``value_j = n_j 2^e`` exactly."""
    parts = [math.frexp(float(x)) for x in values]
    exponents = [e - 53 for m, e in parts if m]
    low = min(exponents, default=0)
    return [int(m * 2**53) << (e - 53 - low) if m else 0 for m, e in parts], low


def dot(a: Sequence[int], b: Sequence[int]) -> int:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[int], b: Sequence[int]) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


class Twist(NamedTuple):
    """Velocity v and angular velocity omega as integers; v in units of the grasp's lengths."""

    velocity: Sequence[int]
    rotation: Sequence[int]


class ForceSet(NamedTuple):
    """Contact forces F_i and the torques ``spin_i N_i`` about the contacts, integers in one unit."""

    force: list[list[int]]
    spin: list[int]


class ExactGrasp(NamedTuple):
    """The contacts of a grasp that count, as integers; planar ones lie in the plane z = 0.

    position, normal  triples      normal_square  |N_i|^2      friction, torsion  mu_i, gamma_i
    length_exponent, normal_exponent, friction_exponent  powers of two of (p, gamma), of each normal, and of mu
    """

    dimension: int
    position: list[Triple]
    normal: list[Triple]
    normal_square: list[int]
    friction: list[int]
    torsion: list[int]
    length_exponent: int
    normal_exponent: list[int]
    friction_exponent: int

    @property
    def contacts(self) -> range:
        return range(len(self.position))

    @property
    def rows(self) -> tuple[int, ...]:
        """Entries of a wrench that may differ from 0: all six, in the plane (F_x, F_y, tau_z)."""
        return (0, 1, 5) if self.dimension == 2 else (0, 1, 2, 3, 4, 5)

    def wrench(self, forces: ForceSet) -> list[int]:
        """``sum_i (F_i; p_i x F_i + S_i N_i)``."""
        total = [0] * 6
        for p, n, f, s in zip(self.position, self.normal, forces.force, forces.spin, strict=True):
            moment = cross(p, f)
            for j in range(3):
                total[j] += f[j]
                total[3 + j] += moment[j] + s * n[j]
        return total

    def unit_wrenches(self) -> tuple[list[list[int]], list[tuple[int, Triple | None]]]:
        """Wrenches of the forces each contact can have either way, and what they are: (contact, F), None for a spin."""
        columns: list[list[int]] = []
        which: list[tuple[int, Triple | None]] = []
        for i in self.contacts:
            p, n = self.position[i], self.normal[i]
            axes: Sequence[Triple] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))[: self.dimension]
            for axis in axes if self.friction[i] else (n,):
                columns.append([*axis, *cross(p, axis)])
                which.append((i, axis))
            if self.torsion[i]:
                columns.append([0, 0, 0, *n])
                which.append((i, None))
        return [[c[j] for j in self.rows] for c in columns], which

    def cone_sides(self, i: int, force: Sequence[int], spin: int) -> tuple[int, Fraction | None]:
        """h = F . N and ``|N|^2 psi^2``: the force is in its cone iff h >= 0 and h^2 is not smaller; None for never."""
        n, nn = self.normal[i], self.normal_square[i]
        h = dot(force, n)
        q = dot(force, force) * nn - h * h
        if (q and not self.friction[i]) or (spin and not self.torsion[i]):
            return h, None
        square = Fraction(0)
        if q:
            square += _scaled(q, -2 * self.friction_exponent) / self.friction[i] ** 2
        if spin:
            square += Fraction((spin * nn) ** 2, self.torsion[i] ** 2)
        return h, square

    def strictly_inside(self, forces: ForceSet) -> bool:
        """Every force lies in the relative interior of its cone."""
        for i in self.contacts:
            h, square = self.cone_sides(i, forces.force[i], forces.spin[i])
            if square is None or h <= 0 or square >= h * h:
                return False
        return True

    def velocity(self, i: int, twist: Twist) -> Triple:
        """``u_i = v + omega x p_i``."""
        turn = cross(twist.rotation, self.position[i])
        v = twist.velocity
        return v[0] + turn[0], v[1] + turn[1], v[2] + turn[2]

    def dual_sides(self, i: int, twist: Twist) -> tuple[int, Fraction]:
        """h = u . N and ``|N|^2 |(mu u_t, gamma omega_n)|^2``: the twist escapes iff h >= 0 and h^2 is not smaller."""
        n = self.normal[i]
        u, turn = self.velocity(i, twist), dot(twist.rotation, n)
        h = dot(u, n)
        tangential = dot(u, u) * self.normal_square[i] - h * h
        square = _scaled(tangential * self.friction[i] ** 2, 2 * self.friction_exponent)
        return h, square + (self.torsion[i] * turn) ** 2

    def opposes(self, i: int, twist: Twist) -> bool:
        """Whether the contact can oppose the twist."""
        h, square = self.dual_sides(i, twist)
        return h < 0 or square > h * h

    def escapes(self, twist: Twist) -> bool:
        """Whether the twist is a motion, and no contact can oppose it."""
        moves = any(twist.velocity) or any(twist.rotation)
        return moves and not any(self.opposes(i, twist) for i in self.contacts)


def _scaled(value: int, exponent: int) -> Fraction:
    """``value * 2^exponent``."""
    return Fraction(value << exponent) if exponent >= 0 else Fraction(value, 1 << -exponent)


def exact_grasp(
    position: np.ndarray, normal: np.ndarray, friction: np.ndarray, torsion: np.ndarray
) -> ExactGrasp:
    """Of positions and normals (k, d) and coefficients (k,), only contacts that count."""
    k, d = position.shape

    def triple(numbers: Sequence[int]) -> Triple:
        x, y, *rest = numbers
        return x, y, rest[0] if rest else 0

    lengths, exponent = integers([*position.ravel(), *torsion])
    points = [triple(lengths[d * i : d * i + d]) for i in range(k)]
    rows = [integers(row) for row in normal]
    normals = [triple(numbers) for numbers, _ in rows]
    mu, mu_exponent = integers(friction)
    squares = [dot(n, n) for n in normals]
    return ExactGrasp(
        d, points, normals, squares, mu, lengths[d * k :], exponent, [e for _, e in rows], mu_exponent
    )


def twist_of(grasp: ExactGrasp, numbers: np.ndarray) -> Twist:
    """The twist (velocity; angular velocity) of m floats, in the units of the grasp's integers."""
    d = grasp.dimension
    velocity, v_exponent = integers(numbers[:d])
    rotation, w_exponent = integers(numbers[d:])
    shift = v_exponent - (
        w_exponent + grasp.length_exponent
    )  # v = velocity 2^v_exp, in units 2^(w_exp + length_exp)
    if shift >= 0:
        velocity = [x << shift for x in velocity]
    else:
        rotation = [x << -shift for x in rotation]
    if d == 2:
        return Twist([*velocity, 0], [0, 0, *rotation])
    return Twist(velocity, rotation)
