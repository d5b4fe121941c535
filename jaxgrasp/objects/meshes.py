"""A body: a triangle mesh in metres, its centre of mass, and what is doubtful about it.

The centre of mass of a watertight mesh is that of the volume inside, at uniform density; otherwise the
surface's, ``sum_j A_j c_j / sum_j A_j`` over triangles of area A_j and centroid c_j. Reading a file runs no
code from it and opens no network connection.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from ..core import Float, UserError
from .builtin import OBJECTS, make_object
from .cleaning import clean, double_areas
from .mesh_file import mesh_bytes, mesh_triangles
from .parts import signed_volumes
from .solids import solid

__all__ = ["METRES_PER", "Body", "load_mesh"]

METRES_PER = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
LARGEST, SMALLEST = 2.0, 1e-3  # extents in m outside of which the unit is suspect


@dataclass(frozen=True)
class Body:
    """An object to grasp.

    mesh            triangles in m, in the file's frame, outward normals
    name            as the user gave it
    sha256          of the file's bytes, or of a built-in object's vertices and faces
    unit            the unit the file was read in
    centre_of_mass  (3,) in m, mesh frame
    watertight      whether the surface encloses a volume
    warnings        sentences for the user, each naming its consequence
    """

    mesh: trimesh.Trimesh
    name: str
    sha256: str
    unit: str
    centre_of_mass: np.ndarray
    watertight: bool
    warnings: tuple[str, ...] = ()


def load_mesh(
    source: str | Path, *, unit: str = "m", com: Float[np.ndarray, " 3"] | Sequence[float] | None = None
) -> Body:
    """The body ``source`` names: a built-in object, or a mesh file (also packed), see ``docs/screening.md``.

    unit  m, cm, mm or in: what one unit of the file's numbers is. Never guessed.
    com   (3,) centre of mass in m, mesh frame; by default computed from the mesh

    Raises UserError for an unknown unit or object, an unreadable file, and a mesh without a surface.
    """
    if unit not in METRES_PER:
        raise UserError(f"unknown unit {unit!r}; take one of {', '.join(METRES_PER)}")
    name = str(source)
    if name in OBJECTS:
        if unit != "m":
            raise UserError(f"the built-in object {name!r} is in metres; leave --unit {unit} out")
        mesh = make_object(name)
        digest = hashlib.sha256(np.asarray(mesh.vertices, "<f8").tobytes())
        digest.update(np.asarray(mesh.faces, "<i8").tobytes())
        return _body(mesh, name, digest.hexdigest(), unit, com, [])
    path = Path(source)
    data = mesh_bytes(path)
    vertices, faces = mesh_triangles(path, data)
    vertices, faces, dropped = clean(vertices, faces)
    if not double_areas(vertices[faces]).any():
        raise UserError(f"{path} has a surface of zero area: every face is degenerate")
    vertices, faces, changed = solid(vertices, faces)
    mesh = trimesh.Trimesh(METRES_PER[unit] * vertices, faces, process=False)
    warnings = dropped + changed
    if not mesh.is_watertight and _volume(vertices[faces]) < 0:
        warnings.append("the faces seem to point inwards: contact normals may be reversed; check the mesh")
    warnings += _suspect_unit(mesh, unit)
    return _body(mesh, name, hashlib.sha256(data).hexdigest(), unit, com, warnings)


def _suspect_unit(mesh: trimesh.Trimesh, unit: str) -> list[str]:
    largest = float(mesh.extents.max())
    if SMALLEST <= largest <= LARGEST:
        return []
    size = " x ".join(f"{e:.4g}" for e in mesh.extents)
    what = "larger than 2 m" if largest > LARGEST else "smaller than 1 mm"
    return [
        f"the object measures {size} m, {what}, read in {unit}; if that is wrong, take --unit m, cm, mm or in"
    ]


def _volume(triangles: np.ndarray) -> float:
    return float(signed_volumes(triangles, np.zeros(len(triangles), np.intp))[0])


def _centre_of_mass(mesh: trimesh.Trimesh, watertight: bool) -> tuple[np.ndarray, bool]:
    """Centre of mass in m, and whether it is the volume's. Integrated about the middle in units of the size."""
    middle, size = mesh.bounds.mean(axis=0), float(mesh.extents.max())
    triangles = (np.asarray(mesh.triangles) - middle) / size
    if watertight and _volume(triangles) > 1e-9 * float(np.prod(np.maximum(mesh.extents / size, 1e-12))):
        properties = trimesh.triangles.mass_properties(triangles, skip_inertia=True)
        return size * np.asarray(properties.center_mass) + middle, True
    return size * np.average(triangles.mean(axis=1), axis=0, weights=double_areas(triangles)) + middle, False


def _body(mesh, name: str, sha256: str, unit: str, com, warnings: list[str]) -> Body:
    watertight = bool(mesh.is_watertight and mesh.is_winding_consistent)
    if com is None:
        centre, of_volume = _centre_of_mass(mesh, watertight)
    else:
        centre, of_volume = np.asarray(com, np.float64), True
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise UserError(f"the centre of mass must be three finite numbers x, y, z in m, got {com}")
    if not watertight:
        consequence = "the centre of mass is the surface's, not the volume's (--com sets it), and " * (
            not of_volume
        )
        warnings = [*warnings, f"the mesh is not watertight: {consequence}normals are the file's own"]
    elif not of_volume:
        warnings = [
            *warnings,
            "the mesh encloses no volume: the centre of mass is the surface's (--com sets it)",
        ]
    return Body(mesh, name, sha256, unit, centre, watertight, tuple(warnings))
