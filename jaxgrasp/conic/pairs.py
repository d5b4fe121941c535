"""Numbers of twice the precision: a pair of floats whose sum is the number, for the few lanes that need it.

    a + b = s + e,   a b = p + e   without error,   e computed from a, b and the rounded s, p

About 100 bits in float64 and 45 in float32. Products are split by bits into parts whose products are exact, so that a
compiler which contracts ``a b + c`` into one instruction changes nothing. Sources: Dekker 1971; Knuth, The Art of
Computer Programming 2, 4.2.2; Hida, Li, Bailey, Library for double-double and quad-double arithmetic, 2007.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..core import Array

__all__ = ["Pair", "pair", "pair_roundoff", "pair_sqrt", "pair_sum", "pair_where"]


def pair_roundoff(dtype) -> float:
    """Relative error of one operation, with room: 2^-98 (float64), 2^-42 (float32)."""
    return 2.0**-98 if jnp.dtype(dtype).itemsize == 8 else 2.0**-42


def _two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def _quick_two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """For |a| >= |b|."""
    s = a + b
    return s, b - (s - a)


def _split(a: Array) -> tuple[Array, Array]:
    """The upper half of the bits of ``a``, and the rest."""
    wide = a.dtype == jnp.float64
    mask = np.uint64(0xFFFFFFFFF8000000) if wide else np.uint32(0xFFFFF000)
    bits = lax.bitcast_convert_type(a, jnp.uint64 if wide else jnp.uint32) & mask
    upper = lax.bitcast_convert_type(bits, a.dtype)
    return upper, a - upper


def _two_product(a: Array, b: Array) -> tuple[Array, Array]:
    (ah, al), (bh, bl) = _split(a), _split(b)
    middle, rest = _two_sum(ah * bl, al * bh)
    p, e = _quick_two_sum(ah * bh, middle)
    return p, e + (rest + al * bl)


Parts = tuple[Array, Array]


def _added(x: Parts, y: Parts) -> Parts:
    s, e = _two_sum(x[0], y[0])
    t, f = _two_sum(x[1], y[1])
    s, e = _quick_two_sum(s, e + t)
    return _quick_two_sum(s, e + f)


def _multiplied(x: Parts, y: Parts) -> Parts:
    p, e = _two_product(x[0], y[0])
    return _quick_two_sum(p, e + (x[0] * y[1] + x[1] * y[0]))


def _folded(
    combine: Callable[[Parts, Parts], Parts], unit: float, hi: Array, lo: Array, axes: tuple[int, ...]
) -> Pair:
    """``combine`` over ``axes``. As a reduction an operation is one loop, its code compiled once, and no half of a
    result is computed twice, with other rounding."""
    units = np.asarray(unit, hi.dtype), np.zeros((), hi.dtype)
    return Pair(*lax.reduce((hi, lo), units, combine, axes))


def _both(combine: Callable[[Parts, Parts], Parts], unit: float, x: Pair, y: Pair) -> Pair:
    hi, lo = (jnp.stack(jnp.broadcast_arrays(a, b)) for a, b in ((x.hi, y.hi), (x.lo, y.lo)))
    return _folded(combine, unit, hi, lo, (0,))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pair:
    """``hi + lo`` with |lo| at most half a unit in the last place of hi; plain arrays mix in as exact numbers."""

    hi: Array
    lo: Array

    def __neg__(self) -> Pair:
        return Pair(-self.hi, -self.lo)

    def __add__(self, other: Number) -> Pair:
        other = pair(other, self.hi.dtype)
        return _both(_added, 0.0, self, other)

    def __sub__(self, other: Number) -> Pair:
        return self + -pair(other, self.hi.dtype)

    def __mul__(self, other: Number) -> Pair:
        other = pair(other, self.hi.dtype)
        return _both(_multiplied, 1.0, self, other)

    def __truediv__(self, other: Number) -> Pair:
        return self * reciprocal(pair(other, self.hi.dtype))

    def __rtruediv__(self, other: Number) -> Pair:
        return reciprocal(self) * other

    __radd__, __rmul__ = __add__, __mul__

    def scaled(self, power: float) -> Pair:
        """Times a power of two."""
        return Pair(power * self.hi, power * self.lo)

    def __getitem__(self, index: Any) -> Pair:
        return Pair(self.hi[index], self.lo[index])


Number = Pair | Array | float


def pair(x: Number, dtype: Any = None) -> Pair:
    """``x`` as a pair."""
    if isinstance(x, Pair):
        return x
    x = jnp.asarray(x, dtype)
    return Pair(x, jnp.zeros_like(x))


def reciprocal(x: Pair) -> Pair:
    """``1 / x``: the rounded one and a step of Newton's."""
    y = pair(1 / x.hi)
    return y + y * (1.0 + -(x * y))


def pair_sqrt(x: Pair) -> Pair:
    """``sqrt(x)``; 0 where x is not positive."""
    there = x.hi > 0
    root = jnp.sqrt(jnp.where(there, x.hi, jnp.ones_like(x.hi)))
    rest = x + -(pair(root) * root)
    return pair_where(there, pair(root) + rest.hi / (2 * root), pair(jnp.zeros_like(x.hi)))


def pair_where(condition: Array, x: Pair, y: Pair) -> Pair:
    """``jnp.where``."""
    return Pair(jnp.where(condition, x.hi, y.hi), jnp.where(condition, x.lo, y.lo))


def pair_sum(x: Pair, *axes: int) -> Pair:
    """The sum over ``axes``."""
    return _folded(_added, 0.0, x.hi, x.lo, axes)
