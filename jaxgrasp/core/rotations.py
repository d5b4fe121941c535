"""Rotations: unit quaternions (w, x, y, z) in space, angles in the plane; their exponential, logarithm, Jacobian.

An orientation takes body axes to world axes. It has 4 entries in space and 1 (an angle in rad) in the plane; rotation
vectors have 3 and 1, in world axes. Everything has leading batch axes and is smooth at the zero rotation.
Source: Solà, Deray, Atchuthan, A micro Lie theory for state estimation in robotics, 2018.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from .arrays import Array, Float
from .geometry import cross

__all__ = [
    "identity_orientation",
    "jacobian_product",
    "jacobian_solve",
    "orientation_matrix",
    "quaternion_product",
    "rotate",
    "rotate_wrench",
    "rotation_between",
    "turned",
]

SMALL = 0.05  # squared angles below which a series is used; its first dropped term is below 1e-16


def identity_orientation(dimension: int, dtype) -> Array:
    """The orientation that turns nothing: (1, 0, 0, 0) in space, (0) in the plane."""
    return jnp.zeros(1, dtype) if dimension == 2 else jnp.asarray([1.0, 0.0, 0.0, 0.0], dtype)


def quaternion_product(a: Float[Array, "*batch 4"], b: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """``a b``: the rotation b, then the rotation a."""
    w, x, y, z = (a[..., i] for i in range(4))
    s, p, q, r = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            w * s - x * p - y * q - z * r,
            w * p + x * s + y * r - z * q,
            w * q - x * r + y * s + z * p,
            w * r + x * q - y * p + z * s,
        ],
        axis=-1,
    )


@jax.jit
def orientation_matrix(orientation: Float[Array, "*batch o"]) -> Float[Array, "*batch d d"]:
    """R_WB of an orientation: 3 x 3 for a unit quaternion, 2 x 2 for an angle."""
    if orientation.shape[-1] == 1:
        c, s = jnp.cos(orientation[..., 0]), jnp.sin(orientation[..., 0])
        rows = [[c, -s], [s, c]]
    else:
        w, x, y, z = (orientation[..., i] for i in range(4))
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@functools.partial(jax.jit, static_argnames="inverse")
def rotate(
    orientation: Float[Array, "*batch o"], v: Float[Array, "*batch d"], inverse: bool = False
) -> Float[Array, "*batch d"]:
    """``R v``: body axes to world axes; ``R^T v`` where ``inverse``. Scalars about the plane's normal stay."""
    if v.shape[-1] == 1:
        return v
    if orientation.shape[-1] == 1:
        c, s = jnp.cos(orientation[..., 0]), jnp.sin(orientation[..., 0])
        s = -s if inverse else s
        return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)
    w, u = orientation[..., :1], orientation[..., 1:]
    t = 2 * cross(u, v)
    return v + (-w if inverse else w) * t + cross(u, t)


@functools.partial(jax.jit, static_argnames="inverse")
def rotate_wrench(
    orientation: Float[Array, "*batch o"], wrench: Float[Array, "*batch m"], inverse: bool = False
) -> Float[Array, "*batch m"]:
    """``diag(R, R) w``, or its inverse: force and torque both change axes."""
    d = 2 if orientation.shape[-1] == 1 else 3
    parts = (rotate(orientation, x, inverse) for x in (wrench[..., :d], wrench[..., d:]))
    return jnp.concatenate(list(parts), axis=-1)


@jax.jit
def turned(
    orientation: Float[Array, "*batch o"], rotation: Float[Array, "*batch t"]
) -> Float[Array, "*batch o"]:
    """``exp([rotation]_x) R``: ``orientation`` turned by a rotation vector in world axes (rad), unit length again."""
    if orientation.shape[-1] == 1:
        return orientation + rotation
    square = jnp.sum(rotation * rotation, axis=-1, keepdims=True)
    small = square < SMALL
    half = 0.5 * jnp.sqrt(jnp.where(small, 1.0, square))
    quarter = square / 4
    ratio = 0.5 * (1 - quarter / 6 * (1 - quarter / 20 * (1 - quarter / 42 * (1 - quarter / 72))))
    ratio = jnp.where(small, ratio, 0.5 * jnp.sin(half) / half)
    whole = 1 - quarter / 2 * (1 - quarter / 12 * (1 - quarter / 30 * (1 - quarter / 56)))
    real = jnp.where(small, whole, jnp.cos(half))
    product = quaternion_product(jnp.concatenate([real, ratio * rotation], axis=-1), orientation)
    return product / jnp.sqrt(jnp.sum(product * product, axis=-1, keepdims=True))


@jax.jit
def rotation_between(
    orientation: Float[Array, "*batch o"], reference: Float[Array, "*batch o"]
) -> Float[Array, "*batch t"]:
    """``log(R R_d^T)``: the rotation vector in world axes, at most pi long, that turns ``reference`` into
    ``orientation``; in the plane the difference of the angles, unwrapped."""
    if orientation.shape[-1] == 1:
        return orientation - reference
    conjugate = reference * jnp.asarray([1.0, -1.0, -1.0, -1.0], reference.dtype)
    q = quaternion_product(orientation, conjugate)
    q = jnp.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    small = square < 1e-3
    size = jnp.sqrt(jnp.where(small, 1.0, square))
    tangent = jnp.where(small, square, 0.0) / jnp.where(small, w * w, 1.0)
    series = 2 / jnp.where(small, w, 1.0)
    series = series * (1 - tangent * (1 / 3 - tangent * (1 / 5 - tangent * (1 / 7 - tangent / 9))))
    return v * jnp.where(small, series, 2 * jnp.arctan2(size, w) / size)


@jax.jit
def jacobian_product(
    rotation: Float[Array, "*batch t"], rate: Float[Array, "*batch t"]
) -> Float[Array, "*batch t"]:
    """``J_l(e) e'``: the angular velocity, world axes, of ``exp([e]_x)`` where e changes at ``rate``.

    J_l = I + (1 - cos a) / a^2 [e]_x + (a - sin a) / a^3 [e]_x^2, a = |e|.
    """
    if rotation.shape[-1] == 1:
        return rate
    square = jnp.sum(rotation * rotation, axis=-1, keepdims=True)
    small = square < SMALL
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    first = 0.5 * (1 - square / 12 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90))))
    first = jnp.where(small, first, (1 - jnp.cos(angle)) / safe)
    second = (1 - square / 20 * (1 - square / 42 * (1 - square / 72 * (1 - square / 110)))) / 6
    second = jnp.where(small, second, (angle - jnp.sin(angle)) / (safe * angle))
    once = cross(rotation, rate)
    return rate + first * once + second * cross(rotation, once)


@jax.jit
def jacobian_solve(
    rotation: Float[Array, "*batch t"], angular: Float[Array, "*batch t"]
) -> Float[Array, "*batch t"]:
    """``J_l(e)^-1 omega``: how fast e changes while ``exp([e]_x)`` turns at ``angular``, world axes; |e| < 2 pi.

    J_l^-1 = I - [e]_x / 2 + (1 - (a / 2) cot(a / 2)) / a^2 [e]_x^2.
    """
    if rotation.shape[-1] == 1:
        return angular
    square = jnp.sum(rotation * rotation, axis=-1, keepdims=True)
    small = square < SMALL
    safe = jnp.where(small, 1.0, square)
    half = 0.5 * jnp.sqrt(safe)
    series = (1 + square / 60 * (1 + square / 42 * (1 + square / 40 * (1 + square * 10 / 396)))) / 12
    factor = jnp.where(small, series, (1 - half * jnp.cos(half) / jnp.sin(half)) / safe)
    once = cross(rotation, angular)
    return angular - 0.5 * once + factor * cross(rotation, once)
