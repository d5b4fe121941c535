"""Built-in objects: closed surfaces of everyday size in metres, made here and the same on every machine.

Most are surfaces of revolution about z, ``(r(s) cos phi, r(s) sin phi, z(s))``. The mug is one as well,
with two windows cut into its outer wall and a tube swept from one to the other: a single surface with a
cavity and a handle.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import trimesh

from ..core import UserError

__all__ = ["OBJECTS", "make_object"]

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (n, 3) in m, faces (f, 3)


def _refine(profile: list[tuple[float, float]], step: float) -> np.ndarray:
    """The polyline through ``profile`` with no segment longer than ``step``; its corners stay."""
    points = np.asarray(profile, float)
    pieces = [points[:1]]
    for start, end in pairwise(points):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / step - 1e-9)))
        pieces.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def _rings(profile: np.ndarray, sections: int) -> np.ndarray:
    """Points (len(profile), sections, 3) of the profile (r, z) turned about z."""
    phi = 2 * np.pi * np.arange(sections) / sections
    r, z = profile[:, :1], np.broadcast_to(profile[:, 1:], (len(profile), sections))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def _bands(index: np.ndarray, kept: np.ndarray | None = None) -> np.ndarray:
    """Two triangles for each cell of a grid of vertex numbers whose second axis is closed.

    The normal points to the right of the profile's direction of travel: up the outside is outwards.
    """
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    cells = np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)], axis=-2)
    return (cells if kept is None else cells[kept]).reshape(-1, 3)


def _revolve(profile: np.ndarray, sections: int, kept: np.ndarray | None = None) -> Mesh:
    """Surface of revolution whose profile begins and ends on the axis, below the rest and above it."""
    rings = _rings(profile[1:-1], sections)
    index = np.arange(rings.shape[0] * sections).reshape(-1, sections)
    bottom, top = index.size, index.size + 1
    following = np.roll(index, -1, axis=1)
    first = np.stack([np.full(sections, bottom), following[0], index[0]], -1)
    last = np.stack([np.full(sections, top), index[-1], following[-1]], -1)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]]])
    return vertices, np.concatenate([_bands(index, kept), first, last])


def box() -> Mesh:
    """A 12 x 8 x 6 cm box."""
    mesh = trimesh.creation.box(extents=(0.12, 0.08, 0.06))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def sphere() -> Mesh:
    """A ball of 4 cm radius."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def cylinder() -> Mesh:
    """A can of 3.3 cm radius and 12 cm height."""
    return _revolve(_refine([(0, -0.06), (0.033, -0.06), (0.033, 0.06), (0, 0.06)], 0.011), 64)


def torus() -> Mesh:
    """A ring: 5 cm from the axis to the middle of the tube, tube radius 1.5 cm."""
    turn = 2 * np.pi * np.arange(33) / 32
    profile = np.stack([0.05 + 0.015 * np.cos(turn), 0.015 * np.sin(turn)], -1)
    rings = _rings(profile[:-1], 96)
    index = np.arange(rings.shape[0] * 96).reshape(-1, 96)
    return rings.reshape(-1, 3), _bands(np.concatenate([index, index[:1]]))


def bottle() -> Mesh:
    """A full bottle, 20 cm tall: body radius 3.2 cm, shoulder, neck radius 1.2 cm, cap."""
    turn = np.linspace(0, np.pi / 2, 9)
    shoulder = [(0.012 + 0.020 * float(np.cos(t)), 0.120 + 0.040 * float(np.sin(t))) for t in turn]
    body = [(0, 0), (0.029, 0), (0.032, 0.003), *shoulder]
    cap = [(0.012, 0.180), (0.0145, 0.180), (0.0145, 0.200), (0, 0.200)]
    return _revolve(_refine(body + cap, 0.008), 64)


def bowl() -> Mesh:
    """An open bowl: 7 cm outer radius, 5.5 cm tall, wall 4 mm."""
    turn = np.linspace(0, np.pi / 2, 17)
    outer = [(0.030 + 0.040 * float(np.sin(t)), 0.055 - 0.055 * float(np.cos(t))) for t in turn]
    inner = [(0.030 + 0.036 * float(np.sin(t)), 0.055 - 0.051 * float(np.cos(t))) for t in turn[::-1]]
    return _revolve(_refine([(0, 0), *outer, *inner, (0, 0.004)], 0.008), 96)


def mug() -> Mesh:
    """An open mug: 4 cm radius, 9.5 cm tall, wall 4 mm, bottom 6 mm, a handle on the +x side."""
    sections, rows, half_width, window = 64, 24, 2, 3
    radius, height = 0.040, 0.095
    centre, reach, rise = 0.0475, 0.034, 0.02573  # the handle's path: half an ellipse in the plane y = 0
    outer = [(0, 0), (0.020, 0), (radius, 0)]
    wall = [(radius, height * (j + 1) / rows) for j in range(rows)]
    inner = [(radius - 0.004, height - 0.0225 * j) for j in range(4)]
    floor = [(radius - 0.004, 0.006), (0.018, 0.006), (0, 0.006)]
    profile = np.asarray(outer + wall + inner + floor)
    wall_start = 1  # ring at (radius, 0); ring wall_start + j is at height j / rows

    # The windows: `window` rows of cells, 2 * half_width columns about phi = 0, mirrored about mid-height.
    upper = wall_start + 17
    lower = wall_start + rows - 17 - window
    kept = np.ones((len(profile) - 3, sections), bool)
    for first in (upper, lower):
        kept[first : first + window, np.arange(-half_width, half_width)] = False
    vertices, faces = _revolve(profile, sections, kept)

    # The window's edge, anticlockwise from +x, as (column, row) steps; one vertex of every tube section each.
    right, top = [(i, 0) for i in range(-half_width, half_width)], [(half_width, j) for j in range(window)]
    left = [(i, window) for i in range(half_width, -half_width, -1)]
    edge = np.asarray(right + top + left + [(-half_width, j) for j in range(window, 0, -1)])
    column, row = edge[:, 0] % sections, edge[:, 1]
    begin, end = (upper + row) * sections + column, (lower + window - row) * sections + column

    angle = np.arctan2(row / window - 0.5, edge[:, 0] / (2 * half_width))
    across, along = 0.0075 * np.cos(angle), 0.0050 * np.sin(angle)
    theta = np.radians(np.linspace(76, -76, 33))[:, None]
    slope = np.hypot(rise * np.cos(theta), reach * np.sin(theta))
    x = radius + reach * np.cos(theta) + along * rise * np.cos(theta) / slope
    z = centre + rise * np.sin(theta) + along * reach * np.sin(theta) / slope
    tube = np.stack([x, np.broadcast_to(across, x.shape), z], -1)

    index = len(vertices) + np.arange(tube.shape[0] * tube.shape[1]).reshape(tube.shape[:2])
    index = np.concatenate([begin[None], index, end[None]])
    return np.concatenate([vertices, tube.reshape(-1, 3)]), np.concatenate([faces, _bands(index)])


OBJECTS: dict[str, Callable[[], Mesh]] = {
    f.__name__: f for f in (bottle, bowl, box, cylinder, mug, sphere, torus)
}


def make_object(name: str) -> trimesh.Trimesh:
    """The built-in object ``name``, one of ``OBJECTS``, as a watertight mesh in metres.

    Vertices are rounded to a nanometre, so that the last bits of a sine do not change the object's hash.
    """
    if name not in OBJECTS:
        raise UserError(f"no built-in object {name!r}; there are: {', '.join(OBJECTS)}")
    vertices, faces = OBJECTS[name]()
    return trimesh.Trimesh(np.round(vertices, 9), faces, process=False)
