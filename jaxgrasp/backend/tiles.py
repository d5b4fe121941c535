"""Lanes: many grasps worked in tiles of a fixed width, so that cost per grasp is flat and bits never move.

Inside, arrays carry the lanes on the last axis, a tile at a time; outside, one grasp is one row. Every tile runs the
same compiled kernel on the same number of lanes, whatever the batch, so a lane's bits depend on nothing but its own
numbers. Stragglers are gathered into fresh tiles instead of keeping a whole tile busy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from ..core import Array, placed
from .xla import kernel, while_loop

__all__ = [
    "Sweeps",
    "batched",
    "in_chunks",
    "in_sweeps",
    "map_selected",
    "map_tiles",
    "padded_rows",
    "tile_width",
    "to_lanes",
    "to_rows",
]

Rows = TypeVar("Rows")  # a pytree of arrays (N, ..)

CPU_TILE = 64  # lanes; a tile of data then fits the first-level cache for up to CACHE_FLOATS numbers a lane
CACHE_FLOATS = 256
ACCELERATOR_TILE = 16384


def tile_width(floats: int) -> int:
    """Lanes a tile, for problems of ``floats`` matrix entries: cache-sized on the CPU, large on an accelerator."""
    if jax.default_backend() != "cpu":
        return ACCELERATOR_TILE
    width = CPU_TILE
    while width > 8 and floats * width > CACHE_FLOATS * CPU_TILE:
        width //= 2
    return width


def to_lanes(rows: Array) -> Array:
    """(L, ..) to (.., L)."""
    return jnp.moveaxis(rows, 0, -1)


def to_rows(lanes: Array) -> Array:
    """(.., L) to (L, ..)."""
    return jnp.moveaxis(lanes, -1, 0)


def _count(rows: Any) -> int:
    return jax.tree.leaves(rows)[0].shape[0]


def padded_rows(rows: Rows, width: int) -> Rows:
    """``rows`` up to the next multiple of ``width``, at least one tile: the last is repeated, which costs no iteration
    and is a problem as sound as its own; zeros where there is none."""
    extra = max(1, -(-_count(rows) // width)) * width - _count(rows)
    if not extra:
        return rows

    def pad(x: Array) -> Array:
        last = x[-1:] if len(x) else jnp.zeros((1, *x.shape[1:]), x.dtype)
        return jnp.concatenate([x, jnp.broadcast_to(last, (extra, *x.shape[1:]))])

    return jax.tree.map(pad, rows)


def map_tiles(kernel: Callable[[Any], Any], rows: Any, count: Array, width: int) -> Any:
    """``kernel`` on the first ``count`` rows, a tile of ``width`` at a time; zeros for the rows beyond.

    The number of rows is a multiple of ``width``. The cost follows ``count``, not the number of rows.
    """
    n = _count(rows)

    def tile_at(start: Array) -> Any:
        return jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, start, width), rows)

    shapes = jax.eval_shape(lambda: kernel(tile_at(jnp.int32(0))))
    out = jax.tree.map(lambda s: jnp.zeros((n, *s.shape[1:]), s.dtype), shapes)

    def one_tile(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        tile, current = carry
        start = tile * jnp.int32(width)
        result = kernel(tile_at(start))
        updated = jax.tree.map(lambda x, r: lax.dynamic_update_slice_in_dim(x, r, start, 0), current, result)
        return tile + jnp.int32(1), updated

    tiles = _tiles(count, width)
    return while_loop(lambda carry: carry[0] < tiles, one_tile, (jnp.int32(0), out), (rows, count))[1]


def _tiles(count: Array, width: int) -> Array:
    """Tiles that hold ``count`` rows. Loops count tiles: XLA drops a loop from 0 to 1 in steps of ``width``."""
    return (count + jnp.int32(width - 1)) // jnp.int32(width)


def map_selected(kernel: Callable[[Any], Any], selected: Array, rows: Any, out: Rows, width: int) -> Rows:
    """``out`` with the rows in ``selected`` (N,) replaced by what ``kernel`` makes of ``rows``; others untouched.

    The number of rows is a multiple of ``width``. The selected ones are gathered into tiles, so the cost follows their
    number.
    """
    n = _count(rows)
    index = jnp.nonzero(selected, size=n, fill_value=n)[0].astype(jnp.int32)
    count = jnp.sum(selected, dtype=jnp.int32)

    tiles = _tiles(count, width)

    def pending(carry: tuple[Array, Rows]) -> Array:
        return carry[0] < tiles

    def one_tile(carry: tuple[Array, Rows]) -> tuple[Array, Rows]:
        tile_number, current = carry
        chosen = lax.dynamic_slice(index, (tile_number * jnp.int32(width),), (width,))
        tile = jax.tree.map(lambda x: jnp.take(x, chosen, axis=0, mode="clip"), rows)
        result = kernel(tile)
        updated = jax.tree.map(lambda x, r: x.at[chosen].set(r, mode="drop"), current, result)
        return tile_number + jnp.int32(1), updated

    return while_loop(pending, one_tile, (jnp.int32(0), out), (rows, selected))[1]


class Packing:
    """A pytree of rows as one matrix (N, F) for each dtype: rows are then gathered and written in one piece.

    On the CPU a gather or scatter of rows costs about as much for one array as for another, whatever their width.
    """

    def __init__(self, like: Any):
        leaves, self._structure = jax.tree.flatten(like)
        self._shapes = [x.shape[1:] for x in leaves]
        self._dtypes = [jnp.dtype(x.dtype).name for x in leaves]

    def pack(self, tree: Any) -> dict[str, Array]:
        groups: dict[str, list[Array]] = {}
        for x, name in zip(jax.tree.leaves(tree), self._dtypes, strict=True):
            groups.setdefault(name, []).append(x.reshape(x.shape[0], math.prod(x.shape[1:])))
        return {name: jnp.concatenate(parts, axis=1) for name, parts in groups.items()}

    def unpack(self, packed: dict[str, Array]) -> Any:
        start = dict.fromkeys(packed, 0)
        leaves = []
        for shape, name in zip(self._shapes, self._dtypes, strict=True):
            size, at = math.prod(shape), start[name]
            block = packed[name][:, at : at + size]
            leaves.append(block.reshape(block.shape[0], *shape))
            start[name] = at + size
        return jax.tree.unflatten(self._structure, leaves)


class Sweeps(NamedTuple):
    """What is done to rows again and again: all of them once, then those that are still unfinished.

    step        ``out = step(rows, aside, out, sweep)`` on one tile: compiled once, as a kernel
    unfinished  ``unfinished(out)`` (N,) bool
    count       how many sweeps at most
    between     ``aside = between(aside, out)`` before each sweep, on all rows: what the last one made necessary
    """

    step: Callable[[Any, Any, Any, Array], Any]
    unfinished: Callable[[Any], Array]
    count: int
    between: Callable[[Any, Any], Any] = lambda aside, out: aside


def in_sweeps(sweeps: Sweeps, rows: Any, aside: Any, like: Any, count: Array, width: int) -> Any:
    """``out`` after all sweeps over the first ``count`` rows. Each gathers its rows into full tiles: cost follows them.

    ``like`` gives the shapes of ``out``, which begins as zeros. ``aside`` is a pytree of rows, or None.
    """
    n = _count(rows)
    given, known, made = Packing(rows), Packing(aside), Packing(like)
    source, everything = given.pack(rows), (rows, aside, count)
    shapes = jax.eval_shape(made.pack, like)
    out = jax.tree.map(lambda s: jnp.zeros((n, *s.shape[1:]), s.dtype), shapes)
    live = jnp.arange(n, dtype=jnp.int32) < count

    @kernel
    def step(rows: Any, aside: Any, before: Any, number: Array) -> Any:
        return made.pack(sweeps.step(given.unpack(rows), known.unpack(aside), made.unpack(before), number))

    def sweep(carry: tuple[Array, Any, Any]) -> tuple[Array, Any, Any]:
        number, aside, out = carry
        before = made.unpack(out)
        aside = known.pack(sweeps.between(known.unpack(aside), before))
        selected = live & ((number == 0) | sweeps.unfinished(before))
        index = jnp.nonzero(selected, size=n, fill_value=n)[0].astype(jnp.int32)
        tiles = _tiles(jnp.sum(selected, dtype=jnp.int32), width)

        def one_tile(carry: tuple[Array, Any]) -> tuple[Array, Any]:
            tile, current = carry
            chosen = lax.dynamic_slice(index, (tile * jnp.int32(width),), (width,))
            here = jax.tree.map(lambda x: jnp.take(x, chosen, axis=0, mode="clip"), (source, aside, current))
            result = step(*here, number)
            updated = jax.tree.map(lambda x, r: x.at[chosen].set(r, mode="drop"), current, result)
            return tile + jnp.int32(1), updated

        out = while_loop(lambda carry: carry[0] < tiles, one_tile, (jnp.int32(0), out), everything)[1]
        return number + 1, aside, out

    start = (jnp.int32(0), known.pack(aside), out)
    return made.unpack(while_loop(lambda carry: carry[0] < sweeps.count, sweep, start, everything)[2])


def in_chunks(solve: Callable[[Any, Array], Any], rows: Any, batch: tuple[int, ...], chunk: int) -> Any:
    """``solve(rows, count)`` on chunks of one shape, so that every batch size runs one executable; batch axes restored.

    ``rows`` is a pytree of concrete arrays with the batch axes in front; the last chunk repeats its last row.
    """
    flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[len(batch) :]), rows)
    n = _count(flat)
    results = []
    for start in range(0, max(n, 1), chunk):
        count = min(chunk, n - start)

        def part(x: np.ndarray, start: int = start, count: int = count) -> np.ndarray:
            piece = x[start : start + count]
            if count == chunk:
                return piece
            last = piece[-1:] if count else np.zeros((1, *x.shape[1:]), x.dtype)
            return np.concatenate([piece, np.broadcast_to(last, (chunk - count, *x.shape[1:]))])

        result = solve(jax.tree.map(part, flat), placed(np.asarray(count, np.int32)))
        results.append(jax.tree.map(lambda x, c=count: np.asarray(x)[:c], result))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts) if parts[1:] else parts[0], *results)
    return jax.tree.map(lambda x: placed(x.reshape((*batch, *x.shape[1:]))), joined)


def batched(
    solve: Callable[[Any, Array, Array], Any], batch_of: Callable[[Any], tuple[int, ...]], width: int
) -> Callable[[Any, Array], Any]:
    """``solve(rows, count, tolerance)`` with any leading batch axes, folded into rows; ``vmap`` adds another."""

    @custom_vmap
    def run(rows: Any, tolerance: Array) -> Any:
        batch = batch_of(rows)
        n = math.prod(batch)
        flat = jax.tree.map(lambda x: x.reshape(n, *x.shape[len(batch) :]), rows)
        result = solve(padded_rows(flat, width), jnp.int32(n), tolerance)
        return jax.tree.map(lambda x: x[:n].reshape(*batch, *x.shape[1:]), result)

    @run.def_vmap
    def rule(axis_size, in_batched, rows, tolerance):  # pyright: ignore[reportUnusedFunction]
        spread, tolerance_batched = in_batched
        if tolerance_batched:
            raise ValueError("tolerance must be one number for the whole batch, not one per grasp")
        full = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x[None], (axis_size, *x.shape)), rows, spread
        )
        result = run(full, tolerance)
        return result, jax.tree.map(lambda _: True, result)

    return run
