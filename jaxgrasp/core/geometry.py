"""Rigid-body geometry: cross products, contact frames, wrenches and twists.

Everything is written for one datum with leading batch axes. Planar quantities live in the plane's
coordinates (x, y); their rotations and torques are scalars about +z.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .arrays import Array, Float

__all__ = [
    "Components",
    "applied",
    "components",
    "contact_frame",
    "cross",
    "cross_components",
    "frame_components",
    "normalize",
    "normalize_components",
    "safe_root",
    "skew",
    "wrench_dimension",
]

Components = tuple[Array, ...]  # the coordinates of a vector, apart: the batch may lie on any axis


def components(v: Float[Array, "*batch d"]) -> Components:
    """The coordinates of ``v`` as a tuple."""
    return tuple(v[..., i] for i in range(v.shape[-1]))


def wrench_dimension(dimension: int) -> int:
    """m = 3 for planar bodies (dimension 2), m = 6 for spatial ones (dimension 3)."""
    return {2: 3, 3: 6}[dimension]


def applied(matrix: Float[Array, "*batch m n"], v: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
    """``matrix v``, lane by lane."""
    return jnp.sum(matrix * v[..., None, :], axis=-1)


@jax.jit
def skew(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """``[v]_x`` with ``[v]_x u = v x u``. Same units as ``v``."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def cross_components(p: Components, f: Components) -> Components:
    """``p x f`` on tuples of coordinates: three entries in space, one (about +z) in the plane."""
    if len(p) == 2:
        return (p[0] * f[1] - p[1] * f[0],)
    return (p[1] * f[2] - p[2] * f[1], p[2] * f[0] - p[0] * f[2], p[0] * f[1] - p[1] * f[0])


def cross(p: Float[Array, "*batch d"], f: Float[Array, "*batch d"]) -> Float[Array, "*batch t"]:
    """``p x f``: a vector (t = 3) in space, the scalar ``p_x f_y - p_y f_x`` (t = 1) in the plane."""
    return jnp.stack(cross_components(components(p), components(f)), axis=-1)


def safe_root(square: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """``sqrt(square)`` with derivative 0 where it is 0: a length from a sum of squares."""
    there = square > 0
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)


def normalize_components(v: Components) -> Components:
    """``v / |v|`` without overflow or underflow; NaN for a zero or non-finite vector."""
    size = jnp.abs(v[0])
    for x in v[1:]:
        size = jnp.maximum(size, jnp.abs(x))
    scaled = tuple(x / size for x in v)  # 0 / 0 and inf / inf are NaN
    square = scaled[0] * scaled[0]
    for x in scaled[1:]:
        square = square + x * x
    length = jnp.sqrt(square)
    return tuple(x / length for x in scaled)


@jax.jit
def normalize(v: Float[Array, "*batch d"]) -> Float[Array, "*batch d"]:
    """``v / |v|`` without overflow or underflow; NaN for a zero or non-finite vector."""
    return jnp.stack(normalize_components(components(v)), axis=-1)


def frame_components(normal: Components, sign: Array | None = None) -> tuple[Components, ...]:
    """``contact_frame`` on tuples of coordinates; ``sign`` of n_z (1 for 0) where they are no plain arrays."""
    if len(normal) == 2:
        return ((normal[1], -normal[0]),)
    x, y, z = normal
    if sign is None:
        sign = jnp.where(z >= 0, jnp.ones_like(z), -jnp.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@jax.jit
def contact_frame(normal: Float[Array, "*batch d"]) -> tuple[Float[Array, "*batch d"], ...]:
    """Unit tangents ``t_1 (, t_2)`` with ``t_1 x t_2 = n`` (space) or ``t_1 x n = +e_z`` (plane).

    ``normal`` must have unit length. Smooth everywhere except across the plane n_z = 0, where the sign of
    the frame flips; no answer of this library depends on the choice. Source: Duff et al., Building an
    orthonormal basis, revisited, JCGT 6(1), 2017.
    """
    return tuple(jnp.stack(t, axis=-1) for t in frame_components(components(normal)))
