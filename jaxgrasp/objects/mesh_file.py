"""What lies in a mesh file: its bytes, and its triangles as the parser in another process finds them.

A file is opened only if it is an ordinary one, is unpacked to ``MOST_BYTES`` at most, and is known by its suffix.
"""

from __future__ import annotations

import bz2
import difflib
import gzip
import importlib.util
import io
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np

from ..core import UserError, open_archive, read_file
from . import mesh_parser
from .mesh_parser import ARCHIVES, MOST_BYTES

__all__ = ["mesh_bytes", "mesh_triangles"]

KINDS = ("stl", "obj", "ply", "off", "glb", "gltf")
# Kinds that trimesh reads with the help of others: modules, and what to install.
OPTIONAL: dict[str, tuple[str, ...]] = {
    "3mf": ("lxml", "networkx"),
    "3dxml": ("lxml", "networkx", "PIL"),
    "ctm": ("openctm",),
    "dae": ("collada",),
    "step": ("cascadio",),
    "stp": ("cascadio",),
    "xaml": ("lxml",),
    "zae": ("collada",),
}
PACKAGES = {"PIL": "pillow", "openctm": "python-openctm", "collada": "pycollada"}
ZIPPED = ("zip", "3mf", "3dxml", "zae")
MOST_MEMBERS = 10_000
POINTS = ("xyz", "pcd", "pts", "asc", "las", "laz", "e57")
DRAWINGS = ("dxf", "svg")
PACKED = {"gz": gzip.open, "bz2": bz2.open}
SHORT = {"tgz": "tar.gz", "tbz2": "tar.bz2"}
FARTHEST = 1e30  # of coordinates in the file's unit: their fifth powers are numbers
SECONDS = 4  # of processor time for the parser,
BYTES_A_SECOND = 32 << 20  # and one more for so many bytes
PATIENCE = 15  # seconds of the clock for one of these, where others work on the machine


def mesh_bytes(path: Path) -> bytes:
    """The file's bytes. UserError for what is not there, no ordinary file, or too large."""
    try:
        return read_file(path, MOST_BYTES)
    except UserError as error:
        meant = _meant(path) if str(error).endswith("no such file") else ""
        raise UserError(f"{error}{meant}") from error


def mesh_triangles(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of the file in its own numbers. UserError, one line, for what is no mesh."""
    names = path.name.lower().split(".")[1:]
    names[-1:] = SHORT.get("".join(names[-1:]), "".join(names[-1:])).split(".")
    if names[-1] in PACKED:
        data = _unpack(path, data, names.pop())
    kind = names[-1] if names else ""
    _known(path, kind)
    if kind in ZIPPED:
        open_archive(path, io.BytesIO(data), MOST_BYTES, MOST_MEMBERS)
    found = _plain_stl(data) if kind == "stl" else None
    vertices, faces = found or _parse(path, data, kind)
    if not (np.abs(vertices[faces]) <= FARTHEST).all():
        raise UserError(
            f"{path} holds NaN or infinite vertex coordinates, or some above {FARTHEST:g}; repair it first"
        )
    return vertices, faces


def _plain_stl(data: bytes) -> tuple[np.ndarray, np.ndarray] | None:
    """The triangles of a binary STL whose header tells its length: a table that needs no parser."""
    count = int.from_bytes(data[80:84], "little")
    if not count or len(data) != 84 + 50 * count:
        return None
    table = np.frombuffer(
        data, [("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")], offset=84
    )
    return table["corner"].reshape(-1, 3).astype(np.float64), np.arange(3 * count).reshape(-1, 3)


def _meant(path: Path) -> str:
    from .builtin import OBJECTS

    close = difflib.get_close_matches(path.name.lower(), OBJECTS, 1)
    if close and path.parent == Path():
        return f"; did you mean the built-in object {close[0]}?"
    return "" if path.suffix else f"; built-in objects: {', '.join(OBJECTS)}"


def _unpack(path: Path, data: bytes, packing: str) -> bytes:
    try:
        with PACKED[packing](io.BytesIO(data)) as stream:
            unpacked = stream.read(MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path} is not a complete {packing[:2]}ip file: {error}") from error
    if len(unpacked) > MOST_BYTES:
        raise UserError(
            f"{path} unpacks to more than {MOST_BYTES >> 20} MiB; unpack and simplify the mesh first"
        )
    return unpacked


def _readable() -> tuple[str, ...]:
    return tuple(sorted({*KINDS, *(kind for kind in OPTIONAL if not _missing(kind))}))


def _missing(kind: str) -> list[str]:
    """Packages to install before this kind can be read."""
    modules = OPTIONAL.get(kind, ())
    return [PACKAGES.get(name, name) for name in modules if importlib.util.find_spec(name) is None]


def _known(path: Path, kind: str) -> None:
    if kind in POINTS:
        raise UserError(
            f"{path}: .{kind} holds points without faces, and points have no surface to grasp; mesh them"
        )
    if kind in DRAWINGS:
        raise UserError(
            f"{path}: .{kind} is a drawing in the plane, no surface to grasp; export a solid as STL"
        )
    if kind in OPTIONAL:
        if missing := _missing(kind):
            raise UserError(
                f"{path}: reading .{kind} takes {' and '.join(missing)}: pip install {' '.join(missing)}"
            )
        return
    if kind in (*KINDS, *ARCHIVES):
        return
    what = f".{kind} is no mesh format" if kind else "a file without a suffix is of no known kind; add one"
    close = difflib.get_close_matches(kind, (*KINDS, *OPTIONAL, *ARCHIVES), 1)
    meant = f"; did you mean .{close[0]}?" if close else ""
    kinds = ", ".join((*_readable(), *ARCHIVES, *PACKED))
    raise UserError(f"{path}: {what}{meant}; readable: {kinds}")


def _parse(path: Path, data: bytes, kind: str) -> tuple[np.ndarray, np.ndarray]:
    seconds = SECONDS + len(data) // BYTES_A_SECOND
    command = [sys.executable, "-P", mesh_parser.__file__, kind, str(path.absolute()), str(seconds)]
    # The same packages as here; one thread, since each one more reserves memory.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    try:
        done = subprocess.run(
            [*command, *_readable()],
            input=data,
            capture_output=True,
            env=environment,
            timeout=PATIENCE * seconds,
        )
    except subprocess.TimeoutExpired as error:
        raise UserError(_too_long(path)) from error
    if done.returncode == 3:
        raise UserError(
            f"{path} cannot be read as {kind}: {done.stderr.decode(errors='replace').splitlines()[-1]}"
        )
    if done.returncode < 0:
        raise UserError(_too_long(path))
    if done.returncode:
        raise RuntimeError(f"the parser of meshes does not run: {done.stderr.decode(errors='replace')}")
    stream = io.BytesIO(done.stdout)
    return np.load(stream, allow_pickle=False), np.load(stream, allow_pickle=False)


def _too_long(path: Path) -> str:
    return (
        f"{path} cannot be read: reading it takes too long or breaks down; simplify it, if it is not damaged"
    )
