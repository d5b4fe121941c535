"""One cone's share of the Newton matrix, in the frame of its scaling: ``K = I + W D W = L L^T``, stable in closed form.

Near the solution W has eigenvalues from 0 to infinity, and any sum of ``W^-2`` and D loses the small ones to rounding.
In the Jordan frame of W it is diagonal. There K is I plus a small matrix of products, and its determinant a sum of
positive terms. The purpose is that of Goldfarb, Scheinberg, Product-form Cholesky factorization in interior point
methods for second-order cone programming, 2005; K is small enough to be factored entry by entry.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..core import Array
from .cone import Cone
from .convex_cone_program import Curvature
from .jordan_frame import HALF, JordanFrame

__all__ = ["ConeBlocks", "factor_blocks"]


class ConeBlocks(NamedTuple):
    """``K = L L^T`` per cone in frame coordinates; ``lower[i][j]`` is L[i, j] for j < i, ``inverse[i]`` is 1 / L[i, i].

    None entries are structural zeros (lower) and ones (inverse). For the level's column, free of cancellation:
    ``head_response`` is ``e_0^T W K'^-1 W e_0`` with K' = K less the level's share, and ``head_second`` the factor of
    the second entry of ``L^-1 W e_0``.
    """

    frame: JordanFrame
    lower: tuple[tuple[Array | None, ...], ...] | None
    inverse: tuple[Array | None, ...]
    head_response: Array | None
    head_second: Array | None = None

    def solve_lower(self, x: Cone) -> Cone:
        """``L^-1 x`` in frame coordinates; arrays (.., k, L) broadcast."""
        if self.lower is None:
            return x
        out: list[Array] = []
        for i, value in enumerate(x):
            for j in range(i):
                entry = self.lower[i][j]
                if entry is not None:
                    value = value - entry * out[j]
            scale = self.inverse[i]
            out.append(value if scale is None else value * scale)
        return tuple(out)

    def solve_head(self, value: Array) -> Cone:
        """``L^-1 W (value, 0, ..)``, without the cancellation of the general substitution."""
        scaled = self.frame.head(value)
        if self.head_second is None or self.lower is None:
            return self.solve_lower(scaled)
        first, corner = self.inverse[0], self.inverse[1]
        assert first is not None and corner is not None
        return (scaled[0] * first, scaled[1] * self.head_second * corner, *scaled[2:])

    def solve_upper(self, x: Cone) -> Cone:
        """``L^-T x``."""
        if self.lower is None:
            return x
        out: list[Array] = list(x)
        for i in reversed(range(len(x))):
            for j in range(i + 1, len(x)):
                entry = self.lower[j][i]
                if entry is not None:
                    out[i] = out[i] - entry * out[j]
            scale = self.inverse[i]
            if scale is not None:
                out[i] = out[i] * scale
        return tuple(out)


def factor_blocks(
    frame: JordanFrame, head: Array | None, curvature: Curvature | None, level: Array | None
) -> ConeBlocks:
    """L of ``I + W (D + diag(head + level, 0..)) W``; head and level (k, L) are rates price / slack."""
    size = len(frame.basis) + 1
    if head is None and curvature is None and level is None:
        return ConeBlocks(frame, None, (None,) * size, None)
    zero = jnp.zeros_like(frame.along)
    rest = zero if head is None else head
    if curvature is not None:
        rest = rest + curvature.head
    total = rest if level is None else rest + level
    first = frame.along * frame.along
    if frame.against is None:
        inverse = 1 / jnp.sqrt(1 + first * total)
        gain = None if level is None else first / (1 + first * rest)
        return ConeBlocks(frame, ((),), (inverse,), gain)
    second = frame.against * frame.against
    tail = zero if curvature is None else curvature.tail
    if curvature is not None and curvature.last is not None:
        assert level is None, "a level next to unequal curvatures is not needed by any criterion"
        return _full_blocks(frame, total, tail, curvature.last - tail)

    def determinant(value: Array) -> Array:
        return 1 + (value + tail) * (first + second) / 2 + first * second * value * tail

    det = determinant(total)
    top = 1 + first * (total + tail) / 2
    inverse = 1 / jnp.sqrt(top)
    below = frame.along * frame.against * (total - tail) / 2 * inverse
    corner = jnp.sqrt(top / det)
    lower: list[tuple[Array | None, ...]] = [(), (below,)]
    inverses: list[Array | None] = [inverse, corner]
    for i in range(2, size):
        assert frame.across is not None
        lower.append((None,) * i)
        inverses.append(None if curvature is None else 1 / jnp.sqrt(1 + frame.across * frame.across * tail))
    gain = None
    if level is not None:
        gain = ((first + second) / 2 + first * second * tail) / determinant(rest)
    return ConeBlocks(frame, tuple(lower), tuple(inverses), gain, (1 + first * tail) * inverse * inverse)


def _full_blocks(frame: JordanFrame, head: Array, tail: Array, extra: Array) -> ConeBlocks:
    """Four dimensions, the last tail curved by ``extra`` more than the others: Cholesky of K written out."""
    size = len(frame.basis) + 1
    half = jnp.asarray(HALF, head.dtype)
    v = [b[-1] for b in frame.basis]  # coordinates of the last axis
    # The columns of extra * axis axis^T in frame coordinates.
    axis = [v[0] * half, -v[0] * half, *v[1:]]
    assert frame.against is not None
    w = [frame.along, frame.against, *([frame.across] * (size - 2))]
    mean, difference = (head + tail) / 2, (head - tail) / 2
    K: list[list[Array]] = []
    for i in range(size):
        row = []
        for j in range(i + 1):
            entry = extra * axis[i] * axis[j]
            if i == j:
                entry = entry + (mean if i < 2 else tail)
            elif i == 1 and j == 0:
                entry = entry + difference
            w_i, w_j = w[i], w[j]
            assert w_i is not None and w_j is not None
            entry = w_i * w_j * entry
            row.append(1 + entry if i == j else entry)
        K.append(row)
    lower: list[list[Array]] = []
    inverse: list[Array] = []
    for i in range(size):
        row: list[Array] = []
        for j in range(i):
            value = K[i][j]
            for q in range(j):
                value = value - row[q] * lower[j][q]
            row.append(value * inverse[j])
        pivot = K[i][i]
        for q in range(i):
            pivot = pivot - row[q] * row[q]
        inverse.append(
            1 / jnp.sqrt(jnp.maximum(pivot, jnp.ones_like(pivot)))
        )  # K >= I, so no pivot is below 1
        lower.append(row)
    return ConeBlocks(frame, tuple(tuple(row) for row in lower), tuple(inverse), None)
