"""Triangles of a mesh file, found in a process of their own: foreign bytes cannot hang the caller nor eat its memory.

Run as a script, ``python mesh_parser.py KIND PATH SECONDS`` with the file's bytes on standard input: it limits itself
to ``MOST_MEMORY`` and SECONDS of processor time, and writes the vertices (v, 3) and faces (f, 3) to standard output in
NumPy's format. Exit code 3 with one line on standard error: the file cannot be read, and why. It loads neither this
package nor JAX, opens no file but those that lie beside PATH, and no connection.
"""

from __future__ import annotations

import io
import json
import sys
import tarfile
import warnings
import zipfile
from contextlib import suppress
from pathlib import Path

MOST_MEMORY = 3 << 29  # bytes of address space: 1.5 GiB
MOST_BYTES = 128 << 20  # of a mesh, unpacked
ARCHIVES = ("zip", "tar")


class Unreadable(Exception):
    """Why a file holds no mesh; the message ends a sentence that begins with the file's name."""


def members(kind: str, data: bytes) -> dict[str, bytes]:
    """The files in an archive by name."""
    if kind == "zip":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {info.filename: archive.read(info) for info in archive.infolist() if not info.is_dir()}
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
        inside = [(info.name, archive.extractfile(info)) for info in archive.getmembers() if info.isfile()]
        return {name: stream.read() for name, stream in inside if stream is not None}


def refuse_damaged(kind: str, data: bytes) -> None:
    """Damage of which trimesh says something else: a count of faces that the file cannot hold, JSON that is none."""
    if kind == "gltf":
        json.loads(data)
    if kind == "stl" and b"\0" in data:
        count, room = int.from_bytes(data[80:84], "little"), (len(data) - 84) // 50
        if len(data) < 84 or len(data) != 84 + 50 * count:
            raise Unreadable(f"its header counts {count} faces, its {len(data)} bytes hold {max(room, 0)}")


def meshes(kind: str, data: bytes, resolver) -> list:
    """All triangle meshes of the file, placed as its scene says."""
    import trimesh

    refuse_damaged(kind, data)
    scene = trimesh.load_scene(
        io.BytesIO(data),
        file_type=kind,
        resolver=resolver,
        allow_remote=False,
        skip_materials=True,
        process=False,
    )
    found = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if any(part.vertices.shape[1:] != (3,) or part.faces.shape[1:] != (3,) for part in found):
        raise Unreadable("it is damaged: a vertex has three coordinates, and a face three corners or more")
    return found


def triangles(kind: str, data: bytes, path: str, kinds: tuple[str, ...] = ()):
    """Vertices (v, 3) and faces (f, 3) of a file of this kind, or of all meshes of ``kinds`` in an archive."""
    import numpy as np
    from trimesh.resolvers import FilePathResolver, ZipResolver

    class Beside(FilePathResolver):
        """Files in the mesh's own folder."""

        def get(self, name: str) -> bytes:
            found = self.absolute(name) if "://" not in name else None
            if found is None or not found.is_file() or found.stat().st_size > MOST_BYTES:
                raise Unreadable(
                    f"it refers to {name[:80]!r}, which is no file beside it; nothing else is opened"
                )
            return found.read_bytes()

    if kind in ARCHIVES:
        files = members(kind, data)
        inside = {name: Path(name).suffix.lower()[1:] for name in files}
        wanted = [name for name, suffix in inside.items() if suffix in kinds]
        if not wanted:
            raise Unreadable(f"it holds no mesh; readable: {', '.join(kinds)}")
        resolver = ZipResolver({name: io.BytesIO(content) for name, content in files.items()})
        found = [mesh for name in wanted for mesh in meshes(inside[name], files[name], resolver)]
    else:
        found = meshes(kind, data, Beside(path))
    if not found:
        raise Unreadable("it holds no faces, so it has no surface to grasp; export triangles, undamaged")
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in found[:-1]])
    vertices = np.concatenate([np.asarray(mesh.vertices, np.float64) for mesh in found])
    faces = np.concatenate(
        [np.asarray(mesh.faces, np.int64) + o for mesh, o in zip(found, offsets, strict=True)]
    )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise IndexError
    return vertices, faces


def reason(error: BaseException) -> str:
    """One line."""
    if isinstance(error, Unreadable):
        return str(error)
    if isinstance(error, MemoryError):
        return f"it takes more than {MOST_MEMORY / 2**30:.1f} GiB of memory to read; simplify it, if it is not damaged"
    if isinstance(error, IndexError):
        return "it is damaged: a face refers to a vertex that is not there"
    if isinstance(error, ImportError | UnicodeError):  # trimesh asks for a package that guesses encodings
        return "it is damaged, or it is a file of another kind under this name"
    text = " ".join(str(error).split()) or type(error).__name__
    shown = "".join(character if character.isprintable() else "?" for character in text[:160])
    return f"it is damaged, or it is a file of another kind under this name ({shown})"


def limit(seconds: int) -> None:
    """Of memory and processor time, where the system has limits; none is raised that is lower already."""
    with suppress(ImportError):
        import resource

        for which, most in (
            (resource.RLIMIT_CORE, 0),
            (resource.RLIMIT_AS, MOST_MEMORY),
            (resource.RLIMIT_CPU, seconds),
        ):
            with suppress(ValueError, OSError):
                resource.setrlimit(which, (most, most))


def main(kind: str, path: str, seconds: str, *kinds: str) -> int:
    """Read standard input, write standard output."""
    limit(int(seconds))
    warnings.filterwarnings(
        "error", message="string or file could not be read"
    )  # NumPy's, of text that is no number
    try:
        import numpy as np

        for array in triangles(kind, sys.stdin.buffer.read(), path, kinds):
            np.save(sys.stdout.buffer, array, allow_pickle=False)
        sys.stdout.buffer.flush()
    except Exception as error:  # parsers of foreign bytes raise anything
        print(reason(error), file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
