"""Singular values and the null twist of small matrices, lanes on the last axis: one-sided Jacobi on the rows.

Rotations make the m rows of A orthogonal, ``U^T A = diag(sigma) V^T``; U accumulates them. Singular values come out
to eps |A|, without squaring A. Source: Hestenes 1958; Demmel, Veselic 1992.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import fori_loop, stage
from ..core import Array

__all__ = ["RowSVD", "row_svd"]

SWEEPS = 10  # quadratic convergence: 6 or 7 suffice in float64


class RowSVD(NamedTuple):
    """values (m, L), unordered; vectors (m, m, L): vectors[j] is the left singular vector of values[j]."""

    values: Array
    vectors: Array

    def smallest(self) -> tuple[Array, Array]:
        """The least singular value (L,) and its left vector (m, L)."""
        value, vector = self.values[0], self.vectors[0]
        for j in range(1, self.values.shape[0]):
            less = self.values[j] < value
            value, vector = jnp.where(less, self.values[j], value), jnp.where(less, self.vectors[j], vector)
        return value, vector


def _dot(x: Array, y: Array) -> Array:
    total = x[:, 0] * y[:, 0]
    for j in range(1, x.shape[1]):
        total = total + x[:, j] * y[:, j]
    return total


@stage
def _rotation(x: Array, y: Array) -> tuple[Array, Array]:
    """Cosine and sine of the rotations that make the rows x and y orthogonal, pair by pair.

    ``t = 2 x.y / (d +- sqrt(d^2 + 4 (x.y)^2))``, d = |y|^2 - |x|^2. It follows x.y continuously: a compiler may compute
    x.y twice, and rounding make it zero once.
    """
    gamma, d = _dot(x, y), _dot(y, y) - _dot(x, x)
    size = jnp.abs(d) + jnp.sqrt(d * d + 4 * gamma * gamma)
    t = 2 * gamma / jnp.where(size > 0, size, jnp.ones_like(size))
    t = jnp.where(d >= 0, t, -t)
    c = 1 / jnp.sqrt(1 + t * t)
    return c[:, None], (c * t)[:, None]


@stage
def _rotated(x: Array, y: Array, c: Array, s: Array) -> tuple[Array, Array]:
    return c * x - s * y, s * x + c * y


def _round(halves: tuple[Array, Array], width: int) -> tuple[Array, Array]:
    """Rotate the pairs (upper[i], lower[i]), then move everyone but the first one seat round the table."""
    upper, lower = halves
    c, s = _rotation(upper[:, :width], lower[:, :width])
    upper, lower = _rotated(upper, lower, c, s)
    return (
        jnp.concatenate([upper[:1], lower[:1], upper[1:-1]], axis=0),
        jnp.concatenate([lower[1:], upper[-1:]], axis=0),
    )


def row_svd(A: Array) -> RowSVD:
    """SVD of ``A`` (m, N, L), m >= 3, by Jacobi rotations of its rows, round-robin over all pairs."""
    m, width, lanes = A.shape
    seats = m + m % 2
    identity = jnp.broadcast_to(jnp.eye(m, dtype=A.dtype)[:, :, None], (m, m, lanes))
    rows = jnp.concatenate([A, identity], axis=1)  # the appended block collects U^T
    rows = jnp.concatenate([rows, jnp.zeros((seats - m, width + m, lanes), A.dtype)], axis=0)
    halves = (rows[: seats // 2], rows[seats // 2 :])
    rounds = SWEEPS * (seats - 1)  # whole sweeps bring every row back to its seat
    halves = fori_loop(0, rounds, lambda _, x: _round(x, width), halves)
    rows = jnp.concatenate(halves, axis=0)[:m]
    square = rows[:, 0] * rows[:, 0]
    for j in range(1, width):
        square = square + rows[:, j] * rows[:, j]
    return RowSVD(jnp.sqrt(square), rows[:, width:])
