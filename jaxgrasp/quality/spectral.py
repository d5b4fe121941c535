"""Isotropy and volume of the grasp map's ellipsoid: measures of other tools that know no friction cone."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..conic import singular_values
from ..contacts import Grasp, grasp_map
from ..core import Array, Float, wrench_dimension
from .unit_wrench_space import torque_lengths

__all__ = ["grasp_isotropy", "grasp_volume"]


@eqx.filter_jit
def _singular_values(grasp: Grasp, torque_scale: Any) -> Array:
    m = wrench_dimension(grasp.dimension)
    length = torque_lengths(grasp, torque_scale)
    rows = jnp.where(jnp.arange(m) < grasp.dimension, 1.0, 1 / length[..., None])
    return singular_values(grasp_map(grasp) * rows[..., None])


def grasp_isotropy(
    grasp: Grasp, *, torque_scale: Float[ArrayLike, "*batch"] | None = None
) -> Float[Array, "*batch"]:
    """``sigma_min / sigma_max`` of G, torques over ``torque_scale`` (m; by default L): 1 is best.

    Unit contact forces in all directions, pulling ones too: no friction cone. Source: Kim et al. 2001.
    """
    values = _singular_values(grasp, torque_scale)
    return values[..., -1] / values[..., 0]


def grasp_volume(
    grasp: Grasp, *, torque_scale: Float[ArrayLike, "*batch"] | None = None
) -> Float[Array, "*batch"]:
    """``sqrt(det(G G^T)) = product of the singular values`` of G, torques over ``torque_scale`` (m; by default L).

    Proportional to the volume of the ellipsoid of wrenches that unit contact forces reach. Source: Li, Sastry 1988.
    """
    return jnp.prod(_singular_values(grasp, torque_scale), axis=-1)
