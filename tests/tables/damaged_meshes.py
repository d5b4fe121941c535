"""Damaged mesh files of every kind that is read without optional packages, drawn from a seed."""

import gzip
import io
import re
import tarfile
import zipfile
from collections.abc import Iterator

import numpy as np
import trimesh

HUGE = (b"-1", b"999999999", b"4294967295", b"99999999999999999999", b"1e400", b"nan", b"0")


def tarred(name: str, data: bytes) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as archive:
        member = tarfile.TarInfo(name)
        member.size = len(data)
        archive.addfile(member, io.BytesIO(data))
    return stream.getvalue()


def zipped(name: str, data: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return stream.getvalue()


def sound_files() -> dict[str, bytes]:
    """One undamaged file of each kind, by its name: two parts, so that they can come to overlap."""
    first, second = trimesh.creation.icosphere(1, 0.03), trimesh.creation.box((0.02, 0.03, 0.04))
    second.apply_translation((0.1, 0, 0))
    mesh = trimesh.util.concatenate([first, second])
    files = {f"a.{kind}": mesh.export(file_type=kind) for kind in ("stl", "obj", "off", "ply", "glb")}
    files = {name: data.encode() if isinstance(data, str) else data for name, data in files.items()}
    files["text.stl"] = mesh.export(file_type="stl_ascii").encode()
    files["text.ply"] = trimesh.exchange.ply.export_ply(mesh, encoding="ascii")
    files["a.gltf"] = mesh.scene().export(file_type="gltf", embed_buffers=True)["model.gltf"]
    files["a.obj.gz"] = gzip.compress(files["a.obj"], mtime=0)
    files["a.zip"], files["a.tar.gz"] = zipped("a.ply", files["a.ply"]), tarred("a.off", files["a.off"])
    return files


def damaged(generator: np.random.Generator, data: bytes) -> bytes:
    """The file cut off, with flipped bits, with other numbers in it, with a stretch repeated, or with zeros."""
    kind, at = generator.integers(5), int(generator.integers(len(data)))
    if kind == 0:
        return data[:at]
    if kind == 1:
        changed = bytearray(data)
        head = generator.random() < 0.5  # where the counts are
        for place in generator.integers(
            min(len(data), 256) if head else len(data), size=generator.integers(1, 9)
        ):
            changed[place] ^= 1 << int(generator.integers(8))
        return bytes(changed)
    if kind == 2:
        numbers = list(re.finditer(rb"-?\d+(\.\d*)?", data))
        if numbers:
            chosen = numbers[int(min(generator.exponential(8), len(numbers) - 1))]
            return data[: chosen.start()] + HUGE[generator.integers(len(HUGE))] + data[chosen.end() :]
    length = int(generator.integers(1, 200))
    if kind == 3:
        return data[:at] + data[max(0, at - length) :]
    return data[:at] + bytes(length) + data[at + length :]


def damaged_files(seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Names and bytes of ``count`` damaged files, all kinds in turn."""
    sound = list(sound_files().items())
    generator = np.random.default_rng(seed)
    for i in range(count):
        name, data = sound[i % len(sound)]
        yield name, damaged(generator, data)
