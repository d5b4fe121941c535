"""The machine under the numbers: tiles of grasps, devices and precision, and what XLA is asked for."""

from .device import precision, remember_compilations, usable_backend
from .tiles import (
    Sweeps,
    batched,
    in_chunks,
    in_sweeps,
    map_selected,
    map_tiles,
    tile_width,
    to_lanes,
    to_rows,
)
from .xla import fori_loop, inlined, is_traced, kernel, stage, varying_like, while_loop

__all__ = [
    "Sweeps",
    "batched",
    "fori_loop",
    "in_chunks",
    "in_sweeps",
    "inlined",
    "is_traced",
    "kernel",
    "map_selected",
    "map_tiles",
    "precision",
    "remember_compilations",
    "stage",
    "tile_width",
    "to_lanes",
    "to_rows",
    "usable_backend",
    "varying_like",
    "while_loop",
]
