"""Whether a solved ``ConvexConeProgram`` has one solution that moves smoothly with its data.

    strictly complementary: of each pair of eigenvalues of u and z, and of each slack and its price, one is positive
    unique:                 the reduced KKT matrix is regular at the solution, for u and for multipliers

Then solution and multipliers are differentiable (Fiacco 1983, theorem 2.4.1). On the central path a pair that
should be (positive, 0) is (a, mu / a), and one that is (0, 0) has two members of size sqrt(mu): the ratio tells. A
singular matrix shows in the response to a right-hand side without structure: 1 / mu instead of 1.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..backend import stage
from ..core import Array, complementary_ratio, largest_response
from .cone import Cone, cone_all, cone_max, cone_sum
from .convex_cone_program import Bounds, ConvexConeProgram, ConvexPoint
from .jordan_frame import JordanFrame
from .products import vector_norm
from .reduced_kkt import ReducedKKT, reduced_kkt
from .scaled_kkt import ScaledDirection, ScaledSides, factor_scaled_kkt

__all__ = ["regular"]


def regular(program: ConvexConeProgram, point: ConvexPoint) -> Array:
    """(L,) bool, for a program of orthonormal rows B near its solution."""
    kkt, effective = _stored(program, point), _effective(program)
    factored = factor_scaled_kkt(program, kkt.frame, kkt.rates)
    return _strict_and_unique(
        program, point, kkt, effective, factored.solve(_probe(program, kkt.frame, effective))
    )


_stored = stage(reduced_kkt)


@stage
def _effective(program: ConvexConeProgram) -> Cone:
    """Ones where a component of u has any effect; a contact without friction has tails that have none."""
    out = []
    for j, c in enumerate(program.columns):
        effect = cone_sum(jnp.abs(c))
        if program.curvature is not None:
            effect = effect + jnp.abs(
                program.curvature.apply(tuple(program.exists for _ in program.columns))[j]
            )
        out.append(jnp.where(effect > 0, program.exists, jnp.zeros_like(effect)))
    return tuple(out)


@stage
def _probe(program: ConvexConeProgram, frame: JordanFrame, effective: Cone) -> ScaledSides:
    """Numbers of size 1 without structure: a fixed sequence of multiples of the golden ratio."""
    exists, count = program.exists, 0

    def next_like(x: Array) -> Array:
        nonlocal count
        rows = []
        for _ in range(x.shape[0]):
            count += 1
            rows.append(jnp.full_like(x[0], 2 * ((0.6180339887498949 * count) % 1) - 1))
        return jnp.stack(rows)

    u = tuple(a * next_like(exists) for a in effective)
    total = jnp.zeros((program.columns[0].shape[0], *exists.shape[1:]), exists.dtype)
    rows = next_like(total)
    level = None if program.level is None else jnp.full_like(exists[0], 0.5)
    return ScaledSides(frame.scale(frame.to_frame(u)), jnp.zeros_like(exists), level, rows)


@stage
def _strict_and_unique(
    program: ConvexConeProgram,
    point: ConvexPoint,
    kkt: ReducedKKT,
    effective: Cone,
    response: ScaledDirection,
) -> Array:
    dtype = program.exists.dtype
    ratio = jnp.asarray(complementary_ratio(dtype), dtype)
    strict = jnp.ones_like(program.exists[0]) > 0

    def separated(a: Array, b: Array, exists: Array) -> None:
        nonlocal strict
        apart = (a > ratio * b) | (b > ratio * a) | (exists == 0)
        strict = strict & cone_all(apart)

    if program.cone_floor is None:
        for h in kkt.stiffness[:2]:  # eigenvalues of z over those of u
            separated(h, jnp.ones_like(h), program.exists)
    masks: Bounds = program.masks()
    if program.head_floor is not None:
        masks = masks._replace(head=None)
    for mask, slack, price in zip(masks, point.slack, point.price, strict=True):
        if mask is not None:
            separated(slack, price, mask)

    du = kkt.frame.from_frame(kkt.frame.scale(response.p))
    size = vector_norm(response.rows)
    for a, x in zip(effective, du, strict=True):
        size = jnp.maximum(size, cone_max(a * jnp.abs(x)))
    if response.xi is not None:
        size = jnp.maximum(size, jnp.abs(response.xi))
    return strict & (size <= jnp.asarray(largest_response(dtype), dtype))  # NaN compares false
