"""What both derivative rules need: rows made harmless where there is no derivative, and solves tile by tile."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..backend import batched, inlined, kernel, map_tiles, to_lanes, to_rows
from ..conic import ConvexConeProgram, ConvexPoint, KKTVector, kkt_solve
from ..core import Array
from .folded import Contacts

__all__ = ["BatchAxes", "filled", "masked", "safe_contacts", "tiled", "tiled_solver", "zero_tangent"]


def zero_tangent(x: Array) -> Any:
    """The tangent of a result that has none."""
    if jnp.issubdtype(x.dtype, jnp.floating):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)


class BatchAxes(NamedTuple):
    """The batch axes of a result, in front of its own."""

    axes: tuple[int, ...]

    def flat(self, x: Array) -> Array:
        """(*batch, ..) to rows (N, ..)."""
        return x.reshape(math.prod(self.axes), *x.shape[len(self.axes) :])

    def back(self, ok: Array, lanes: Array) -> Array:
        """(.., N), lanes last, to (*batch, ..); zeros in the lanes that are not ``ok``."""
        lanes = jnp.where(ok, lanes, jnp.zeros_like(lanes))
        return to_rows(lanes).reshape(*self.axes, *lanes.shape[:-1])


def filled(ok: Array, x: Array, value: Any) -> Array:
    """Row arrays x, filled with ``value`` in the lanes that are not ``ok``."""
    mask = ok.reshape(*ok.shape, *([1] * (x.ndim - 1)))
    return jnp.where(mask, x, jnp.asarray(value, x.dtype))


def masked(ok: Array, x: Array, dx: Any) -> Any:
    """Tangent rows dx of x, zero in the lanes that are not ``ok``."""
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return dx
    return filled(ok, dx, 0.0)


def safe_contacts(ok: Array, contacts: Contacts) -> Contacts:
    """Harmless numbers in lanes without a derivative and in padding, so that no NaN enters, forwards or backwards."""
    axis = np.eye(contacts.position.shape[-1])[-1]
    live = filled(ok, contacts.active, True)
    used = live & ok[:, None]
    point = used[..., None]
    return Contacts(
        jnp.where(point, contacts.position, jnp.asarray(axis, contacts.position.dtype)),
        jnp.where(point, contacts.normal, jnp.asarray(axis, contacts.normal.dtype)),
        jnp.where(used, contacts.friction, jnp.ones_like(contacts.friction)),
        jnp.where(used, contacts.torsion, jnp.ones_like(contacts.torsion)),
        live,
    )


def tiled(function: Callable[..., Any], rows: Any, lanes: Any, width: int) -> Any:
    """``function(rows, *lanes)`` in stages, a tile of ``width`` at a time; ``vmap`` adds rows. Lanes last outside.

    The first leaf of ``rows`` is (N, k, .). Nothing differentiates what is inside.
    """

    @kernel
    def run(rows: Any, lanes: Any) -> Any:
        return jax.tree.map(to_rows, function(rows, *jax.tree.map(to_lanes, lanes)))

    def in_tiles(given: Any, count: Array, _: Array) -> Any:
        return map_tiles(lambda tile: run(*tile), given, count, width)

    solve = batched(in_tiles, lambda given: jax.tree.leaves(given)[0].shape[:-2], width)
    with inlined(False):
        return jax.tree.map(to_lanes, solve((rows, jax.tree.map(to_rows, lanes)), jnp.zeros((), jnp.int32)))


def tiled_solver(
    program_of: Callable[[Any, Any], ConvexConeProgram],
    rows: Any,
    scales: Any,
    point: ConvexPoint,
    width: int,
) -> Callable[[KKTVector], KKTVector]:
    """``kkt_solve`` at these points, ``tiled``.

    ``program_of(rows, scales)`` is the program of A itself; ``scales.factor`` is the factor of A.
    """

    def solve(rows: Any, scales: Any, point: ConvexPoint, rhs: KKTVector) -> KKTVector:
        return kkt_solve(program_of(rows, scales), point, scales.factor, rhs)

    return lambda rhs: tiled(solve, rows, (scales, point, rhs), width)
