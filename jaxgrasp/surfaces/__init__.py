"""Surfaces on which contacts are moved by gradients: nearest point, inward normal, curvature, sharp edges, samples.

``x = surface.project(p)`` is differentiable, with ``dx/dp = T T^T`` on the surface; ``surface.normal`` turns with the
shape operator. Shapes in closed form or by Newton's method; meshes by a spline through their signed distance inside
``jit`` and by their triangles outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core import Float
from .gauge import Ellipsoid, Superquadric
from .mesh import MeshSurface, NearestPoint
from .rounded import Cylinder, RoundedBox, Sphere
from .surface import SmoothSurface, Surface

if TYPE_CHECKING:
    from ..objects import Body

__all__ = [
    "Surface",
    "SmoothSurface",
    "Sphere",
    "Ellipsoid",
    "Superquadric",
    "RoundedBox",
    "Cylinder",
    "MeshSurface",
    "NearestPoint",
    "of",
]


def of(
    source: str | Path | Body,
    *,
    unit: str = "m",
    com: Float[np.ndarray, " 3"] | Sequence[float] | None = None,
    resolution: int = 96,
) -> MeshSurface:
    """The surface of a built-in object, a mesh file or a ``Body``, in m and in the file's frame.

    unit        m, cm, mm or in: what one unit of the file's numbers is; a body is in metres already
    com         (3,) centre of mass in m, by default computed from the mesh
    resolution  nodes of the distance grid along the longest side

    What ``jaxgrasp.objects.load_mesh`` found doubtful is in ``warnings`` too. UserError as there and in
    ``MeshSurface``.
    """
    from ..objects import Body, load_mesh

    if isinstance(source, Body):
        if unit != "m" or com is not None:
            raise ValueError(
                "a Body has its unit and its centre of mass: give those to jaxgrasp.objects.load_mesh"
            )
        return MeshSurface.from_body(source, resolution=resolution)
    return MeshSurface.from_body(load_mesh(source, unit=unit, com=com), resolution=resolution)
