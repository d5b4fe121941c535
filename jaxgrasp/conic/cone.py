"""Second-order cone algebra: ``K = {x : x_0 >= |x_1..|}``, one cone per contact, batch on the last axis.

A cone vector is a tuple ``(x_0, x_1, .., x_{d-1})`` of arrays (k, L): k cones, L lanes. Keeping the d components
apart lets every formula below fuse into straight vector code. -log det x = -log(x_0^2 - |x_1..|^2) is the barrier of
the cone, and of the friction LMIs (11.4), (11.35) up to a factor.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce

import jax.numpy as jnp

from ..core import Array

__all__ = [
    "Cone",
    "cone_all",
    "cone_any",
    "cone_max",
    "cone_min",
    "cone_sum",
    "determinant",
    "entries",
    "inner",
    "interior_distance",
    "jordan_product",
    "tail_inner",
    "tail_norm",
]

Cone = tuple[Array, ...]


def _total(terms: list[Array]) -> Array:
    return reduce(jnp.add, terms)


def entries(x: Array) -> list[Array]:
    """The entries of the first axis, each (1, ..).

    They keep the axis, because XLA moves a reshape behind one operation in each round of its simplifications: a chain
    of operations on ``x[i]`` takes it as many rounds as it is long.
    """
    return [x[i : i + 1] for i in range(x.shape[0])]


def _over_cones(combine: Callable[[Array, Array], Array], x: Array) -> Array:
    # Written out: a reduction would keep the compiler from vectorising over lanes.
    return reduce(combine, entries(x))[0]


def cone_sum(x: Array) -> Array:
    """Sum over the k cones: (k, ..) to (..)."""
    return _over_cones(jnp.add, x)


def cone_max(x: Array) -> Array:
    """Maximum over the k cones."""
    return _over_cones(jnp.maximum, x)


def cone_min(x: Array) -> Array:
    """Minimum over the k cones."""
    return _over_cones(jnp.minimum, x)


def cone_all(x: Array) -> Array:
    """Whether x holds in all cones."""
    return _over_cones(jnp.logical_and, x)


def cone_any(x: Array) -> Array:
    """Whether x holds in some cone."""
    return _over_cones(jnp.logical_or, x)


def inner(x: Cone, y: Cone) -> Array:
    """``<x, y>`` per cone."""
    return _total([a * b for a, b in zip(x, y, strict=True)])


def tail_inner(x: Cone, y: Cone) -> Array:
    """``<x_1.., y_1..>`` per cone; zero for one-dimensional cones."""
    if not x[1:]:
        return jnp.zeros_like(x[0])
    return _total([a * b for a, b in zip(x[1:], y[1:], strict=True)])


def tail_norm(x: Cone) -> Array:
    """``|x_1..|`` per cone."""
    return jnp.sqrt(tail_inner(x, x)) if x[1:] else jnp.zeros_like(x[0])


def interior_distance(x: Cone) -> Array:
    """``x_0 - |x_1..|``: positive inside the cone."""
    return x[0] - tail_norm(x)


def determinant(x: Cone) -> Array:
    """``(x_0 - |x_1..|)(x_0 + |x_1..|)``, in the form that keeps its accuracy near the boundary."""
    tail = tail_norm(x)
    return (x[0] - tail) * (x[0] + tail)


def jordan_product(x: Cone, y: Cone) -> Cone:
    """``x o y = (<x, y>, x_0 y_j + y_0 x_j)``, the product whose unit is e = (1, 0, ..)."""
    return (inner(x, y), *(x[0] * b + y[0] * a for a, b in zip(x[1:], y[1:], strict=True)))
