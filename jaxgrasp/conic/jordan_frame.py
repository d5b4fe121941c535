"""The Jordan frame of a Nesterov-Todd scaling W, in which W is diagonal.

Its eigenvalues are ``along`` on (1, d), ``against`` on (1, -d) and ``across`` on the tails orthogonal to the unit
direction d.
Frame coordinates of a cone vector x: ``((x_0 + d.x_t) / sqrt 2, (x_0 - d.x_t) / sqrt 2, rest)``, ``rest`` across d.
Source: Alizadeh, Goldfarb, Second-order cone programming, 2003, section 4 (spectral decomposition).
"""

from __future__ import annotations

import math
from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..core import Array
from .cone import Cone

__all__ = [
    "HALF",
    "JordanFrame",
    "jordan_frame",
    "smooth_determinant",
    "spectral",
    "stored_spectral",
    "tail_basis",
    "tail_size",
    "unit_direction",
]

HALF = math.sqrt(0.5)


class JordanFrame(NamedTuple):
    """An orthonormal basis of the tails, its first vector the direction d, and the eigenvalues of W.

    basis    d - 1 vectors of d - 1 arrays (k, L); none for one-dimensional cones
    along, against, across  (k, L); ``across`` None below three dimensions, and all but ``along`` in one
    """

    basis: tuple[Cone, ...]
    along: Array
    against: Array | None
    across: Array | None

    def to_frame(self, x: Cone) -> Cone:
        """Frame coordinates of x; arrays (.., k, L) broadcast."""
        if not self.basis:
            return x
        first, *rest = (_dot(b, x[1:]) for b in self.basis)
        half = jnp.asarray(HALF, first.dtype)
        return ((x[0] + first) * half, (x[0] - first) * half, *rest)

    def from_frame(self, x: Cone) -> Cone:
        """The inverse of ``to_frame``, which is orthogonal."""
        if not self.basis:
            return x
        half = jnp.asarray(HALF, x[0].dtype)
        first = (x[0] - x[1]) * half
        tails = (first, *x[2:])
        return (
            (x[0] + x[1]) * half,
            *(
                _sum([t * b[j] for t, b in zip(tails, self.basis, strict=True)])
                for j in range(len(self.basis))
            ),
        )

    def eigenvalues(self) -> Cone:
        """Of W, one for each frame coordinate."""
        across = [self.across] * (len(self.basis) - 1)
        return tuple(w for w in (self.along, self.against, *across) if w is not None)

    def scale(self, x: Cone) -> Cone:
        """``W x`` in frame coordinates."""
        return tuple(f * a for f, a in zip(self.eigenvalues(), x, strict=True))

    def head_of_unscaled(self, x: Cone) -> Array:
        """The head of ``W^-1 x``, x in frame coordinates."""
        if self.against is None:
            return x[0] / self.along
        return (x[0] / self.along + x[1] / self.against) * jnp.asarray(HALF, x[0].dtype)

    def head(self, value: Array) -> Cone:
        """``W (value, 0, ..)`` in frame coordinates; zeros across."""
        if self.against is None:
            return (self.along * value,)
        half = jnp.asarray(HALF, value.dtype)
        zero = jnp.zeros_like(value)
        return (self.along * value * half, self.against * value * half, *([zero] * (len(self.basis) - 1)))


def _sum(terms: list[Array]) -> Array:
    return reduce(jnp.add, terms)


def _dot(x: Cone, y: Cone) -> Array:
    return _sum([a * b for a, b in zip(x, y, strict=True)])


def tail_basis(direction: Cone) -> tuple[Cone, ...]:
    """The direction and unit vectors orthogonal to it: rows of the Householder reflection that sends it to +-e_1."""
    if len(direction) == 1:
        return (direction,)
    first = direction[0]
    one = jnp.ones_like(first)
    sign = jnp.where(first >= 0, one, -one)
    mirror = (first + sign, *direction[1:])
    shrink = 1 / (1 + jnp.abs(first))
    others = []
    for j in range(1, len(direction)):
        weight = mirror[j] * shrink
        others.append(tuple((one if i == j else 0 * one) - weight * v for i, v in enumerate(mirror)))
    return (direction, *others)


def unit_direction(tails: Cone) -> tuple[Cone, Array]:
    """``tails / |tails|`` and ``|tails|``; the first axis where that is 0."""
    square = _dot(tails, tails)
    nonzero = square > 0
    size = jnp.sqrt(jnp.where(nonzero, square, jnp.ones_like(square)))
    zero = jnp.zeros_like(size)
    first = (jnp.ones_like(size), *([zero] * (len(tails) - 1)))
    direction = tuple(jnp.where(nonzero, t / size, f) for t, f in zip(tails, first, strict=True))
    return direction, jnp.where(nonzero, size, zero)


def spectral(x: Cone) -> Cone:
    """``((x_0 + x_1) / sqrt 2, (x_0 - x_1) / sqrt 2, rest)``: frame coordinates of head and rotated tails, and back."""
    if len(x) == 1:
        return x
    half = jnp.asarray(HALF, x[0].dtype)
    return ((x[0] + x[1]) * half, (x[0] - x[1]) * half, *x[2:])


stored_spectral = stage(spectral)


def tail_size(x: Cone) -> Array:
    """``|x_1..|`` with a derivative where it is 0."""
    if len(x) == 1:
        return jnp.zeros_like(x[0])
    return unit_direction(x[1:])[1]


def smooth_determinant(x: Cone) -> Array:
    """``(x_0 - |x_1..|)(x_0 + |x_1..|)`` with a derivative where the tails are 0."""
    return (x[0] - tail_size(x)) * (x[0] + tail_size(x))


def jordan_frame(w: Cone, eta: Array) -> JordanFrame:
    """The frame of the Nesterov-Todd scaling point w (det w = 1) and eta: ``W = eta (w_0 +- |w_t|)``, eta across."""
    if len(w) == 1:
        return JordanFrame((), eta, None, None)
    direction, size = unit_direction(w[1:])
    reach = w[0] + size
    across = eta if len(w) > 2 else None
    return JordanFrame(tail_basis(direction), eta * reach, eta / reach, across)
