"""Numbers of twice the precision: a pair of floats whose sum is the number, for the few lanes that need it.

    a + b = s + e,   a b = p + e   without error,   e computed from a, b and the rounded s, p

About 100 bits in float64 and 45 in float32. Products are split by bits into parts whose products are exact, so that a
compiler which contracts ``a b + c`` into one instruction changes nothing. Sources: Dekker 1971; Knuth, The Art of
Computer Programming 2, 4.2.2; Hida, Li, Bailey, Library for double-double and quad-double arithmetic, 2007.
"""

from __future__ import annotations

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
        s, e = _two_sum(self.hi, other.hi)
        t, f = _two_sum(self.lo, other.lo)
        s, e = _quick_two_sum(s, e + t)
        return Pair(*_quick_two_sum(s, e + f))

    def __sub__(self, other: Number) -> Pair:
        return self + -pair(other, self.hi.dtype)

    def __mul__(self, other: Number) -> Pair:
        other = pair(other, self.hi.dtype)
        p, e = _two_product(self.hi, other.hi)
        return Pair(*_quick_two_sum(p, e + (self.hi * other.lo + self.lo * other.hi)))

    def __truediv__(self, other: Number) -> Pair:
        other = pair(other, self.hi.dtype)
        first = self.hi / other.hi
        rest = self - other * first
        second = rest.hi / other.hi
        rest = rest - other * second
        return Pair(*_quick_two_sum(first, second)) + rest.hi / other.hi

    def __rtruediv__(self, other: Number) -> Pair:
        return pair(other, self.hi.dtype) / self

    __radd__, __rmul__ = __add__, __mul__

    def __getitem__(self, index: Any) -> Pair:
        return Pair(self.hi[index], self.lo[index])


Number = Pair | Array | float


def pair(x: Number, dtype: Any = None) -> Pair:
    """``x`` as a pair."""
    if isinstance(x, Pair):
        return x
    x = jnp.asarray(x, dtype)
    return Pair(x, jnp.zeros_like(x))


def pair_sqrt(x: Pair) -> Pair:
    """``sqrt(x)``; 0 where x is not positive."""
    there = x.hi > 0
    root = jnp.sqrt(jnp.where(there, x.hi, jnp.ones_like(x.hi)))
    rest = x - pair(root) * pair(root)
    found = Pair(*_quick_two_sum(root, rest.hi / (2 * root)))
    return pair_where(there, found, pair(jnp.zeros_like(x.hi)))


def pair_where(condition: Array, x: Pair, y: Pair) -> Pair:
    """``jnp.where``."""
    return Pair(jnp.where(condition, x.hi, y.hi), jnp.where(condition, x.lo, y.lo))


def pair_sum(x: Pair, *axes: int) -> Pair:
    """The sum over ``axes``."""
    zero = np.zeros((), x.hi.dtype)

    def combine(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
        total = Pair(*a) + Pair(*b)
        return total.hi, total.lo

    return Pair(*lax.reduce((x.hi, x.lo), (zero, zero), combine, axes))
