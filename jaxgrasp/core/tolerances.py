"""Every tolerance of the library as a function of dtype, in one place."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike

from .arrays import Array, placed

__all__ = [
    "balance_tolerance",
    "complementary_ratio",
    "edge_tolerance",
    "gap_floor",
    "gap_goal",
    "load_limit",
    "largest_response",
    "largest_sensitivity",
    "pivot_tolerance",
    "perturbation_tolerance",
    "proven_gap",
    "proven_limit",
    "rank_tolerance",
    "rounding_constant",
    "size_limit",
    "stationary_tolerance",
    "unit_roundoff",
    "vanishing_friction",
    "visibility_tolerance",
    "widest_scaling",
]


def unit_roundoff(dtype) -> float:
    """Machine epsilon of ``dtype``: 2.2e-16 (float64), 1.2e-7 (float32)."""
    return float(np.finfo(jnp.dtype(dtype)).eps)


def gap_floor(dtype) -> float:
    """Smallest duality gap that is worth iterating for: about 4e-12 (float64), 2e-5 (float32).

    Tighter requests are served as far as this floor; the reported gap stays the measured one.
    """
    return 2e4 * unit_roundoff(dtype) if jnp.dtype(dtype).itemsize == 8 else 160 * unit_roundoff(dtype)


def gap_goal(tolerance: ArrayLike, dtype: DTypeLike) -> Array:
    """The duality gap to reach: ``tolerance``, but no less than ``gap_floor``."""
    floor = gap_floor(dtype)
    if isinstance(tolerance, int | float):
        return placed(np.asarray(max(tolerance, floor), dtype))
    return jnp.maximum(jnp.asarray(tolerance, dtype), jnp.asarray(floor, dtype))


def largest_sensitivity(dtype) -> float:
    """Relative error of a robust cost per relative error of its forces, where both can still be told: 5e5, or 512.

    Beyond, 8 eps of the forces would change the cost by more than 1e-9 (float64) or 5e-4 (float32) of it, which is
    what its proof allows to rounding.
    """
    return max(1e-9, 4096 * unit_roundoff(dtype)) / (8 * unit_roundoff(dtype))


def rank_tolerance(dtype) -> float:
    """A singular value at or below this times the largest one counts as zero: 64 eps."""
    return 64 * unit_roundoff(dtype)


def perturbation_tolerance(dtype) -> float:
    """What "holds only by rounding" may change: 12 eps in positions over L and in normals.

    The checker allows 64 eps for each, and measures up to five times as much: it divides by the angular velocity, or by
    that of the contact, alone.
    """
    return 12 * unit_roundoff(dtype)


def vanishing_friction(dtype) -> float:
    """mu and gamma / L up to this, 64 eps, may be 0 by rounding: as much as the checker allows."""
    return 64 * unit_roundoff(dtype)


def pivot_tolerance(dtype) -> float:
    """A Cholesky pivot at or below this times its own diagonal entry is rounding, not information."""
    return 32 * unit_roundoff(dtype)


def widest_scaling(dtype) -> float:
    """Largest squared scaling a derivative's Newton matrix is built with: 1e7 (float64), 1e3 (float32).

    Beyond it, what the matrix must resolve next to its largest entries is lost; refinement makes up for the cut.
    """
    return 1e7 if jnp.dtype(dtype).itemsize == 8 else 1e3


def complementary_ratio(dtype) -> float:
    """A pair of complementary numbers counts as (positive, 0) from this ratio on: 1e3 (float64), 30 (float32).

    At a relative gap of 1e-8 it is about 1e8 where complementarity is strict, and about 1 where it is not.
    """
    return 1e3 if jnp.dtype(dtype).itemsize == 8 else 30.0


def largest_response(dtype) -> float:
    """Forces that answer a change of size 1 by more than this are not unique: 1e5 (float64), 1e3 (float32)."""
    return 1e5 if jnp.dtype(dtype).itemsize == 8 else 1e3


def edge_tolerance(dtype) -> float:
    """Optimal forces may lie outside their cones and limits by this share of the largest: 64 eps.

    So they are right for some problem within 64 eps of the one given, which is all that a proof to rounding may say.
    """
    return 64 * unit_roundoff(dtype)


def stationary_tolerance(dtype) -> float:
    """Newton's method for the weakest direction has arrived at this residual: 1e-9 (float64), 1e-4 (float32)."""
    return 1e-9 if jnp.dtype(dtype).itemsize == 8 else 1e-4


def visibility_tolerance(dtype) -> float:
    """A vertex lies outside a facet from this share of the facet's distance on: 1e-9 (float64), 1e-4 (float32).

    The discs of a friction cone fill facets exactly; what rounding lifts off them must not split them.
    """
    return 1e-9 if jnp.dtype(dtype).itemsize == 8 else 1e-4


def rounding_constant() -> float:
    """The small constant c in the solver's ``c * eps * |A| * |s|``.

    Twice the checker's, so that what the solver certifies the checker accepts.
    """
    return 32.0


def size_limit(dtype) -> float:
    """Lengths in m lie between this and its inverse, mu and gamma / L below it: 2^256 (float64), 2^32 (float32).

    Products of four such numbers neither over- nor underflow.
    """
    return 2.0 ** (np.finfo(jnp.dtype(dtype)).maxexp // 4)


def load_limit(dtype) -> float:
    """Loads in N (torques over L) lie between this and its inverse: 2^510 (float64), 2^62 (float32).

    Their squares neither over- nor underflow.
    """
    return 2.0 ** (np.finfo(jnp.dtype(dtype)).maxexp // 2 - 2)


def proven_gap(dtype) -> float:
    """The relative gap OPTIMAL may leave with all rounding of its bound allowed for: 5e-7 (float64), 1e-3 (float32).

    Half of what the checker accepts.
    """
    return 5e-7 if jnp.dtype(dtype).itemsize == 8 else 1e-3


def proven_limit(dtype) -> float:
    """Loads: a twist must exclude forces up to this many for INFEASIBLE; the checker asks for 1e6.

    In float32 rounding of the twist itself takes a part of the difference.
    """
    return 2e6 if jnp.dtype(dtype).itemsize == 8 else 1e7


def balance_tolerance(dtype) -> float:
    """Given forces balance a load, or lie on the edge of their cones, to this share of their size: 1e-7 (float64).

    Forces that a solver found to 1e-8, or that a person wrote down, still count as an equilibrium.
    """
    return 1e-7 if jnp.dtype(dtype).itemsize == 8 else 1e-4
