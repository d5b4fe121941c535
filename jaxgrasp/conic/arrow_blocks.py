"""One cone's share of the Newton matrix, in the frame of its scaling: ``K = I + W D W = L L^T``, stable in closed form.

Near the solution W has eigenvalues from 0 to infinity, and any sum of ``W^-2`` and D loses the small ones to rounding.
In the Jordan frame of W it is diagonal: along (1, d), (1, -d), and across, with eigenvalues ``along``, ``against``,
``across``. There K is I plus a small matrix of products, and its determinant a sum of positive terms.

Frame coordinates of a cone vector x: ``((x_0 + d.x_t) / sqrt 2, (x_0 - d.x_t) / sqrt 2, rest)``, ``rest`` across d.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp

from ..core import Array
from .cone import Cone
from .convex_program import Curvature

__all__ = ["Blocks", "Frame", "factor_blocks", "frame_of"]

HALF = math.sqrt(0.5)


class Frame(NamedTuple):
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
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


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


def frame_of(w: Cone, eta: Array) -> Frame:
    """The frame of the Nesterov-Todd scaling point w (det w = 1) and eta: ``W = eta (w_0 +- |w_t|)``, eta across."""
    if len(w) == 1:
        return Frame((), eta, None, None)
    direction, size = unit_direction(w[1:])
    reach = w[0] + size
    across = eta if len(w) > 2 else None
    return Frame(tail_basis(direction), eta * reach, eta / reach, across)


class Blocks(NamedTuple):
    """``K = L L^T`` per cone in frame coordinates; ``lower[i][j]`` is L[i, j] for j < i, ``inverse[i]`` is 1 / L[i, i].

    None entries are structural zeros (lower) and ones (inverse). ``head`` is ``e_0^T W K'^-1 W e_0`` with K' = K less
    the level's share: what the level's column needs, free of cancellation.
    """

    frame: Frame
    lower: tuple[tuple[Array | None, ...], ...] | None
    inverse: tuple[Array | None, ...]
    head: Array | None
    second: Array | None = None

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
        pushed = self.frame.head(value)
        if self.second is None or self.lower is None:
            return self.solve_lower(pushed)
        first, corner = self.inverse[0], self.inverse[1]
        assert first is not None and corner is not None
        return (pushed[0] * first, pushed[1] * self.second * corner, *pushed[2:])

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
    frame: Frame, head: Array | None, curvature: Curvature | None, level: Array | None
) -> Blocks:
    """L of ``I + W (D + diag(head + level, 0..)) W``; head and level (k, L) are rates price / slack."""
    size = len(frame.basis) + 1
    if head is None and curvature is None and level is None:
        return Blocks(frame, None, (None,) * size, None)
    zero = jnp.zeros_like(frame.along)
    rest = zero if head is None else head
    if curvature is not None:
        rest = rest + curvature.head
    total = rest if level is None else rest + level
    first = frame.along * frame.along
    if frame.against is None:
        inverse = 1 / jnp.sqrt(1 + first * total)
        gain = None if level is None else first / (1 + first * rest)
        return Blocks(frame, ((),), (inverse,), gain)
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
    return Blocks(frame, tuple(lower), tuple(inverses), gain, (1 + first * tail) * inverse * inverse)


def _full_blocks(frame: Frame, head: Array, tail: Array, extra: Array) -> Blocks:
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
    return Blocks(frame, tuple(tuple(row) for row in lower), tuple(inverse), None)
