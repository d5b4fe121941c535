"""What makes one set of contact forces better than another (section 11.3): convex costs that carry their weights.

f_n,i is the normal force of contact i in N, P_i the matrix of its friction LMI (11.4), (11.35). A criterion states its
cost as the pieces a cone program is made of:

    level       the largest normal force xi counts, once                  (gentlest, robust)
    price       each normal force counts by itself                        (smallest sum)
    curvature   each squared component counts                             (sum of squares, least norm)
    barrier     -log det P_i counts                                       (robust)
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp

from ..contacts import Component, Grasp, cleared
from ..core import Array, ArrayLike, Float, largest_of, real_array

__all__ = ["Criterion", "Gentlest", "LeastNorm", "Robust", "SmallestSum", "SumOfSquares"]


def _by_contact(grasp: Grasp, force: Array) -> Array:
    n = grasp.model.force_size(grasp.dimension)
    parts = force.reshape(*force.shape[:-1], force.shape[-1] // n, n)
    return jnp.where(grasp.active[..., None], parts, jnp.zeros_like(parts))


def _normal_forces(grasp: Grasp, force: Array) -> Array:
    return _by_contact(grasp, force)[..., grasp.model.normal_index(grasp.dimension)]


class Criterion(eqx.Module):
    """A convex cost of contact forces. ``criterion.cost(grasp, force)`` is its definition."""

    @property
    def level(self) -> bool:
        """Whether the largest normal force is part of the cost."""
        return False

    @property
    def price(self) -> bool:
        """Whether the sum of the normal forces is the cost."""
        return False

    def curvature(
        self, component: Component, friction: Float[Array, "*lanes"], torsion: Float[Array, "*lanes"]
    ) -> Float[Array, "*lanes"] | None:
        """c in ``c s^2``, the cost of a scaled component s (f = mu s, gamma s or s); None: no such cost."""
        return None

    @property
    def barrier_weight(self) -> Float[Array, "*batch"] | None:
        """``w`` in ``-w log det P``, in N; None where the barrier is no part of the cost."""
        return None

    @abstractmethod
    def cost(self, grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
        """The cost of ``force`` (chapter's component order), whether it is feasible or not."""


class Gentlest(Criterion):
    """``max_i f_n,i`` in N: the least pressure on the object (11.3, gentlest grasp criterion)."""

    @property
    def level(self) -> bool:
        """``max_i f_n,i`` counts: True."""
        return True

    def cost(self, grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
        """``max_i f_n,i``, N."""
        normal = _normal_forces(grasp, force)
        return largest_of(jnp.where(grasp.active, normal, -jnp.inf))


class Robust(Criterion):
    """``max_i f_n,i - weight * sum_i log det P_i(f_i)``: gentle, but away from the edge of friction (11.3, robust).

    ``weight`` in N (default 1). P_i is (11.4) for hard fingers, ``[[mu f_n, f_t], [f_t, mu f_n]]`` in the plane,
    (11.35) for soft fingers, the scalar f_n for frictionless contacts and wherever mu = 0; forces in N under the
    logarithm. The cost is in N up to the constant that a change of the unit under the logarithm adds.
    """

    weight: Float[Array, "*batch"]

    def __init__(self, weight: Float[ArrayLike, "*batch"] = 1.0):
        self.weight = _positive(weight, "weight")

    @property
    def level(self) -> bool:
        """``max_i f_n,i`` counts: True."""
        return True

    @property
    def barrier_weight(self) -> Float[Array, "*batch"] | None:
        """``weight``, N."""
        return self.weight

    def cost(self, grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
        """``max_i f_n,i - weight * sum_i log det P_i``, N; infinite outside the cones."""
        normal = _normal_forces(grasp, force)
        top = largest_of(jnp.where(grasp.active, normal, -jnp.inf))
        model = cleared(grasp).model
        on_normal, on_cone, constant = model.log_det_terms(grasp.dimension)
        psi = model.friction_function(_by_contact(grasp, force), grasp.dimension)
        inside = grasp.active & (normal > 0) & ((psi < normal) | (on_cone == 0))
        safe = jnp.where(inside, normal, 1.0)
        counted = inside & (on_cone > 0)
        room = jnp.where(counted, (safe - psi) * (safe + psi), 1.0)
        log_det = on_normal * jnp.log(safe) + on_cone * jnp.log(room) + constant
        log_det = jnp.where(inside, log_det, jnp.where(grasp.active, -jnp.inf, 0.0))
        return top - self.weight.astype(top.dtype) * jnp.sum(log_det, axis=-1)


class SmallestSum(Criterion):
    """``sum_i f_n,i`` in N: the least total squeeze (11.3, smallest sum of normal forces criterion)."""

    @property
    def price(self) -> bool:
        """``sum_i f_n,i`` is the cost: True."""
        return True

    def cost(self, grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
        """``sum_i f_n,i``, N."""
        return jnp.sum(_normal_forces(grasp, force), axis=-1)


class SumOfSquares(Criterion):
    """``sum_i f_n,i^2`` in N^2: evenly shared normal forces (11.3, sum of squared normal forces)."""

    def curvature(
        self, component: Component, friction: Float[Array, "*lanes"], torsion: Float[Array, "*lanes"]
    ) -> Float[Array, "*lanes"] | None:
        """1 for the normal component, 0 for the others."""
        return jnp.ones_like(friction) if component is Component.NORMAL else jnp.zeros_like(friction)

    def cost(self, grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
        """``sum_i f_n,i^2``, N^2."""
        normal = _normal_forces(grasp, force)
        return jnp.sum(normal * normal, axis=-1)


class LeastNorm(Criterion):
    """``sum_i |f_i|^2`` in N^2, torques over a length: the least Euclidean norm of all contact forces (11.3).

    A soft finger's torque counts as ``(tau_n / length)^2``. ``length`` in m, a number or one per grasp; by default
    gamma of each contact, which weighs the largest torque like the normal force it comes from.
    """

    length: Float[Array, "*batch"] | None

    def __init__(self, length: Float[ArrayLike, "*batch"] | None = None):
        self.length = None if length is None else _positive(length, "length")

    def curvature(
        self, component: Component, friction: Float[Array, "*lanes"], torsion: Float[Array, "*lanes"]
    ) -> Float[Array, "*lanes"] | None:
        """``mu^2``, ``(gamma / length)^2`` or 1, as the component is scaled."""
        if component is Component.NORMAL:
            return jnp.ones_like(friction)
        if component is not Component.SPIN:
            return friction * friction
        if self.length is None:
            return jnp.ones_like(torsion)
        ratio = torsion / self.length.astype(torsion.dtype)
        return ratio * ratio

    def cost(self, grasp: Grasp, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch"]:
        """``sum_i |f_i|^2``, N^2."""
        parts = _by_contact(grasp, force)
        total = jnp.zeros(parts.shape[:-1], parts.dtype)
        gamma = cleared(grasp).model.torsion_coefficient
        for j, component in enumerate(grasp.model.components(grasp.dimension)):
            value = parts[..., j]
            if component is Component.SPIN:
                if self.length is None:
                    length = jnp.where(gamma > 0, gamma, 1.0)
                else:
                    length = self.length.astype(parts.dtype)[..., None]
                value = value / length
            total = total + value * value
        return jnp.sum(jnp.where(grasp.active, total, 0.0), axis=-1)


def _positive(value: ArrayLike, name: str) -> Array:
    array = real_array(value, name, "a positive number, or one per grasp")
    if isinstance(value, int | float) and not value > 0:
        raise ValueError(f"{name} must be positive, got {value}")
    return array
