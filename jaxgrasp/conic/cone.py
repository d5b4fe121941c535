"""Second-order cone algebra: ``K = {x : x_0 >= |x_1..|}``, one cone per contact, batch on the last axis.

A cone vector is a tuple ``(x_0, x_1, .., x_{d-1})`` of arrays (k, L): k cones, L lanes. Keeping the d components
apart lets every formula below fuse into straight vector code. -log det x = -log(x_0^2 - |x_1..|^2) is the barrier of
the cone, and of the friction LMIs (11.4), (11.35) up to a factor.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from ..core import Array

__all__ = [
    "Cone",
    "Scaling",
    "cone_max",
    "cone_min",
    "cone_sum",
    "determinant",
    "inner",
    "interior_distance",
    "scaled_product",
    "tail_norm",
]

Cone = tuple[Array, ...]


def _total(terms: list[Array]) -> Array:
    # An explicit sum: a reduction would keep the compiler from vectorising over lanes.
    return reduce(jnp.add, terms)


def cone_sum(x: Array) -> Array:
    """Sum over the k cones: (k, ..) to (..)."""
    return _total([x[i] for i in range(x.shape[0])])


def cone_max(x: Array) -> Array:
    """Maximum over the k cones."""
    return reduce(jnp.maximum, [x[i] for i in range(x.shape[0])])


def cone_min(x: Array) -> Array:
    """Minimum over the k cones."""
    return reduce(jnp.minimum, [x[i] for i in range(x.shape[0])])


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


def scaled_product(x: Cone, y: Cone) -> Cone:
    """Jordan product ``x o y = (<x, y>, x_0 y_j + y_0 x_j)``."""
    return (inner(x, y), *(x[0] * b + y[0] * a for a, b in zip(x[1:], y[1:], strict=True)))


class Scaling(NamedTuple):
    """Nesterov-Todd scaling W with ``W z = W^-1 u = lambda``; W is symmetric and maps the cone onto itself.

    ``W x = eta (w_0 x_0 + <w_1, x_1>, x_1 + (x_0 + <w_1, x_1> / (1 + w_0)) w_1)`` with det w = 1.
    Source: Nesterov, Todd 1997; the formulas of Vandenberghe, The CVXOPT linear and quadratic cone program
    solvers, 2010, section 5.
    """

    w: Cone
    inverse: Array  # 1 / (1 + w_0)
    eta: Array
    root: Array  # 1 / sqrt(det lambda)

    def apply(self, x: Cone) -> Cone:
        """``W x``; arrays (.., k, L) broadcast, so the columns of a matrix scale in one call."""
        along = tail_inner(self.w, x)
        shift = x[0] + along * self.inverse
        return (
            self.eta * (self.w[0] * x[0] + along),
            *(self.eta * (a + shift * b) for a, b in zip(x[1:], self.w[1:], strict=True)),
        )

    def step_reach(self, point: Cone, direction: Cone) -> Array:
        """Largest rate ``|rho_1..| - rho_0`` at which ``point + t direction`` runs into its cone, per cone.

        ``rho = T direction`` where T maps lambda (= ``point``) to the identity e. The longest step that stays inside is
        1 / max(reach, 0). Source: Vandenberghe 2010, section 8.
        """
        return interior_rate(self.to_identity(point, direction))

    def to_identity(self, point: Cone, direction: Cone) -> Cone:
        """``rho = T direction`` for the automorphism T of the cone with ``T lambda = e``."""
        bar = tuple(a * self.root for a in point)
        first = bar[0] * direction[0] - tail_inner(bar, direction)
        shift = (first + direction[0]) / (1 + bar[0])
        return (
            first * self.root,
            *((a - shift * b) * self.root for a, b in zip(direction[1:], bar[1:], strict=True)),
        )


def interior_rate(rho: Cone) -> Array:
    """``|rho_1..| - rho_0``: how fast ``e + t rho`` approaches the boundary of its cone."""
    return tail_norm(rho) - rho[0]
