"""The Nesterov-Todd scaling of a pair (u, z), and how far a step may go inside its cone.

Sources: Nesterov, Todd, Self-scaled barriers and interior-point methods for convex programming, 1997; Vandenberghe,
The CVXOPT linear and quadratic cone program solvers, 2010, sections 5 and 8.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array
from .cone import Cone, cone_max, determinant, inner, tail_inner, tail_norm

__all__ = ["Scaling", "interior_rate", "largest_rate", "nesterov_todd"]


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
        head, tails = _towards_identity(self.root, point, direction)
        return (head * self.root, *(x * self.root for x in tails))


def _towards_identity(root: Array, point: Cone, direction: Cone) -> tuple[Array, Cone]:
    """Head and tails of ``T direction / root`` with ``T point = e`` and ``root = 1 / sqrt(det point)``.

    Source: Vandenberghe 2010, section 8.
    """
    unit = tuple(a * root for a in point)
    head = unit[0] * direction[0] - tail_inner(unit, direction)
    shift = (head + direction[0]) / (1 + unit[0])
    return head, tuple(a - shift * b for a, b in zip(direction[1:], unit[1:], strict=True))


def interior_rate(rho: Cone) -> Array:
    """``|rho_1..| - rho_0``: how fast ``e + t rho`` approaches the boundary of its cone."""
    return tail_norm(rho) - rho[0]


def _rate(lam: Cone, direction: Cone) -> Array:
    """``interior_rate`` of ``T direction``, scaled last: for points whose determinant is not known otherwise."""
    root = lax.rsqrt(determinant(lam))
    head, tails = _towards_identity(root, lam, direction)
    size = jnp.sqrt(inner(tails, tails)) if tails else jnp.zeros_like(head)
    return (size - head) * root


@stage
def largest_rate(exists: Array, lam: Cone, p: Cone, q: Cone) -> Array:
    """The largest rate (L,) at which ``lambda + t p`` and ``lambda + t q`` run into their cones; 0 where none does."""
    return cone_max(exists * jnp.maximum(_rate(lam, p), _rate(lam, q)))


@stage
def _determinant_roots(u: Cone, z: Cone) -> tuple[Array, Array]:
    return jnp.sqrt(determinant(u)), jnp.sqrt(determinant(z))


@stage
def _scaling_factors(root_u: Array, root_z: Array) -> tuple[Array, Array, Array, Array]:
    return 1 / root_u, 1 / root_z, jnp.sqrt(root_u / root_z), lax.rsqrt(root_u * root_z)


@stage
def _half_angle(u: Cone, z: Cone, inverse_u: Array, inverse_z: Array) -> Array:
    return lax.rsqrt(2 * (1 + inner(u, z) * inverse_u * inverse_z))


@stage
def _scaling_point(u: Cone, z: Cone, inverse_u: Array, inverse_z: Array, half: Array) -> tuple[Cone, Array]:
    first = (u[0] * inverse_u + z[0] * inverse_z) * half
    rest = ((a * inverse_u - b * inverse_z) * half for a, b in zip(u[1:], z[1:], strict=True))
    return (first, *rest), 1 / (1 + first)


def nesterov_todd(u: Cone, z: Cone) -> Scaling:
    """The scaling with ``W z = W^-1 u``."""
    root_u, root_z = _determinant_roots(u, z)
    inverse_u, inverse_z, eta, root = _scaling_factors(root_u, root_z)
    half = _half_angle(u, z, inverse_u, inverse_z)
    w, inverse = _scaling_point(u, z, inverse_u, inverse_z, half)
    return Scaling(w, inverse, eta, root)
