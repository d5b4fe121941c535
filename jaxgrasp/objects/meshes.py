"""A body: a triangle mesh in metres, its centre of mass, and what is doubtful about it.

The centre of mass of a watertight mesh is that of the volume inside, at uniform density; otherwise the
surface's, ``sum_j A_j c_j / sum_j A_j`` over triangles of area A_j and centroid c_j. Reading a file runs no
code from it and opens no network connection.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from trimesh.resolvers import FilePathResolver

from ..core import Float, UserError
from .builtin import OBJECTS, make_object

__all__ = ["METRES_PER", "Body", "load_mesh"]

METRES_PER = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
LARGEST, SMALLEST = 2.0, 1e-3  # extents in m outside of which the unit is suspect
MOST_BYTES = 4 << 30  # a compressed file may not unpack to more


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
    """The body ``source`` names: a built-in object, or a mesh file of any kind trimesh reads (also ``.gz``).

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
    data = _read(path)
    mesh = _parse(path, data)
    warnings = _orient(mesh)
    mesh.apply_scale(METRES_PER[unit])
    warnings += _suspect_unit(mesh, unit)
    return _body(mesh, name, hashlib.sha256(data).hexdigest(), unit, com, warnings)


def _read(path: Path) -> bytes:
    if not path.exists():
        known = "" if path.suffix else f"; built-in objects: {', '.join(OBJECTS)}"
        raise UserError(f"{path}: no such file{known}")
    if path.is_dir():
        raise UserError(f"{path} is a directory; name a mesh file in it")
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from error


def _unpack(path: Path, data: bytes) -> bytes:
    try:
        with gzip.open(io.BytesIO(data)) as stream:
            unpacked = stream.read(MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path} is not a complete gzip file: {error}") from error
    if len(unpacked) > MOST_BYTES:
        raise UserError(f"{path} unpacks to more than {MOST_BYTES >> 30} GiB; unpack and simplify it first")
    return unpacked


def _parse(path: Path, data: bytes) -> trimesh.Trimesh:
    """All triangles of the file in one mesh, equal points merged, in the file's own numbers."""
    inner = path
    if path.suffix.lower() == ".gz" and not path.name.lower().endswith(".tar.gz"):
        inner, data = path.with_suffix(""), _unpack(path, data)
    readable = sorted(f for f in trimesh.available_formats() if f not in ("dxf", "svg"))
    kind = next((f for f in readable if inner.name.lower().endswith(f".{f}")), None)
    if kind is None:
        what = inner.suffix or "a file without a suffix"
        raise UserError(f"{path}: {what} is no mesh format; readable: {', '.join(readable)}")
    resolver = FilePathResolver(str(path))
    try:
        scene = trimesh.load_scene(
            io.BytesIO(data),
            file_type=kind,
            resolver=resolver,
            allow_remote=False,
            skip_materials=True,
            process=False,
        )
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # parsers of foreign bytes raise anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path} cannot be read as {kind}: {reason}") from error
    if not parts:
        raise UserError(f"{path} holds no faces, so it has no surface to grasp; export triangles, undamaged")
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    faces = np.concatenate([np.asarray(part.faces) + o for part, o in zip(parts, offsets, strict=True)])
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{path} is damaged: a face refers to a vertex that is not there")
    if not np.isfinite(vertices[faces]).all():
        raise UserError(f"{path} holds NaN or infinite vertex coordinates; repair the mesh first")
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    if not np.any(mesh.area_faces > 0):
        raise UserError(f"{path} has a surface of zero area: every face is degenerate")
    return mesh


def _orient(mesh: trimesh.Trimesh) -> list[str]:
    """Turn the faces of a closed mesh outwards; say so where anything had to be turned."""
    if not mesh.is_watertight:
        outside_in = _signed_volume(mesh.triangles) < 0
        return ["the faces seem to point inwards: contact normals may be reversed; check the mesh"] * bool(
            outside_in
        )
    turned = False
    if not mesh.is_winding_consistent:
        mesh.faces = _consistent_winding(mesh)
        turned = True
    if mesh.volume < 0:
        mesh.invert()
        turned = True
    return [
        "some faces pointed inwards; they were turned so that all normals point out of the volume"
    ] * turned


def _signed_volume(triangles: np.ndarray) -> float:
    """Six times the volume inside the triangles, about their middle; positive where they face outwards."""
    a, b, c = np.moveaxis(triangles - triangles.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)))


def _consistent_winding(mesh: trimesh.Trimesh) -> np.ndarray:
    """Faces with neighbours turned to agree, and each connected part turned to face outwards."""
    faces, count = np.asarray(mesh.faces).copy(), len(mesh.faces)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    owner = np.repeat(np.arange(count), 3)
    forward = edges[:, 0] < edges[:, 1]
    order = np.lexsort(np.sort(edges, axis=1).T)
    first, second = order[0::2], order[1::2]  # watertight: every edge belongs to two faces
    pair = np.stack([owner[first], owner[second]])
    disagree = forward[first] == forward[second]

    both = np.concatenate([pair, pair[::-1]], axis=1)
    graph = csr_matrix((np.tile(disagree + 1, 2), both), shape=(count, count))  # 2 marks disagreement
    parts, label = connected_components(graph, directed=False)
    for part in range(parts):
        member = np.flatnonzero(label == part)
        visited, parent = breadth_first_order(graph, member[0], directed=False)
        flip = np.zeros(count, bool)
        step = np.asarray(graph[parent[visited[1:]], visited[1:]]).ravel() == 2
        for face, differs in zip(visited[1:], step, strict=True):
            flip[face] = flip[parent[face]] ^ differs
        faces[flip] = faces[flip, ::-1]
        if _signed_volume(np.asarray(mesh.vertices)[faces[member]]) < 0:
            faces[member] = faces[member, ::-1]
    return faces


def _suspect_unit(mesh: trimesh.Trimesh, unit: str) -> list[str]:
    largest = float(mesh.extents.max())
    if SMALLEST <= largest <= LARGEST:
        return []
    size = " x ".join(f"{e:.4g}" for e in mesh.extents)
    what = "larger than 2 m" if largest > LARGEST else "smaller than 1 mm"
    return [
        f"the object measures {size} m, {what}, read in {unit}; if that is wrong, take --unit m, cm, mm or in"
    ]


def _centre_of_mass(mesh: trimesh.Trimesh, watertight: bool) -> tuple[np.ndarray, bool]:
    """Centre of mass in m, and whether it is the volume's. Integrated about the middle: least rounding."""
    middle = mesh.bounds.mean(axis=0)
    triangles = np.asarray(mesh.triangles) - middle
    if watertight:
        properties = trimesh.triangles.mass_properties(triangles, skip_inertia=True)
        if properties.volume > 1e-9 * float(np.prod(np.maximum(mesh.extents, 1e-12))):
            return np.asarray(properties.center_mass) + middle, True
    areas = mesh.area_faces
    return np.average(triangles.mean(axis=1), axis=0, weights=areas) + middle, False


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
