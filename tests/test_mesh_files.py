"""Mesh files of every kind, sound, packed, damaged and hostile: a body, or one line."""

import bz2
import gzip
import io
import json
import os
import resource
import tarfile
import zipfile

import numpy as np
import pytest
import trimesh
from damaged_meshes import damaged_files, sound_files

from jaxgrasp import objects
from jaxgrasp.core.errors import UserError
from jaxgrasp.objects import mesh_file


def no_faces(path):
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")


def zero_area(path):
    path.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")


def not_finite(path):
    path.write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")


def directory(path):
    path.mkdir()


def nothing(path):
    pass


def pipe(path):
    os.mkfifo(path)


def device(path):
    path.symlink_to("/dev/zero")


def bytes_of(data):
    return lambda path: path.write_bytes(data)


def text_of(*lines):
    return bytes_of("\n".join(lines).encode())


def archive_of(*members):
    """A zip file of (name, bytes)."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return bytes_of(stream.getvalue())


def scene_of(uri, count=3):
    """A glTF file of one triangle whose numbers lie in ``uri``."""
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": uri, "byteLength": 36}],
    }
    return bytes_of(json.dumps(tree).encode())


def chunked(header):
    """A GLB file of this header and nothing else."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    head = np.array([0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A], "<u4").tobytes()
    return bytes_of(head + text)


ZEROS = bytes(200 << 20)


def most_memory():
    """2 GiB in KiB; a child counts its parent's size until it runs its own program."""
    return max(2 << 20, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss + (1 << 16))


LYING_STL = bytes(80) + (5).to_bytes(4, "little") + b"\x01" * 60
PLY = (
    "ply",
    "format {} 1.0",
    "element vertex {}",
    "property float x",
    "property float y",
    "property float z",
)


def ply_of(encoding, vertices, faces):
    head = [*PLY, "element face {}", "property list uint int vertex_indices", "end_header", "0 0 0"]
    return text_of(*("\n".join(head).format(encoding, vertices, faces),))


BAD_FILES = [
    ("a.obj", nothing, "no such file"),
    ("a", nothing, "built-in objects: .*mug"),
    ("a.obj", directory, "is a directory"),
    ("a.obj", pipe, "is a pipe"),
    ("a.stl", device, "is a device"),
    ("a.obj", no_faces, "no faces"),
    ("a.obj", zero_area, "zero area"),
    ("a.obj", not_finite, "NaN or infinite"),
    ("a.obj", text_of("v 1e31 0 0", "v 0 0 0", "v 0 1 0", "f 1 2 3"), "above 1e.30"),
    ("a.obj", text_of("v 1 0", "v 0 0", "v 0 1", "f 1 2 3"), "three coordinates"),
    ("a.obj", text_of("v 1 0 0", "v 0 0 0", "v 0 1 0", "f 1 2 9"), "not there"),
    ("a.obj", bytes_of(b""), "is empty"),
    ("a.obj", bytes_of(bytes(range(256)) * 40), "damaged, or it is a file of another kind"),
    ("a.obj", lambda p: p.write_bytes(sound_files()["a.stl"]), "damaged, or it is a file of another kind"),
    ("a.stl", bytes_of(LYING_STL), "counts 5 faces, its 144 bytes hold 1"),
    ("a.stl", bytes_of(LYING_STL[:80] + b"\xff" * 4 + LYING_STL[84:]), "counts 4294967295 faces"),
    ("a.ply", bytes_of(b"garbage"), "cannot be read as ply"),
    ("a.ply", ply_of("ascii", 10**12, 1), "cannot be read as ply"),
    ("a.ply", ply_of("binary_little_endian", 10**12, 1), "cannot be read as ply"),
    ("a.ply", ply_of("binary_little_endian", 0, 10**18), "cannot be read as ply"),
    ("a.off", text_of("OFF", "999999999999 1 0", "0 0 0"), "cannot be read as off"),
    ("a.gltf", bytes_of(b"{" * 100_000), "cannot be read as gltf"),
    ("a.gltf", bytes_of(b'{"a":' * 100_000), "cannot be read as gltf"),
    (
        "a.gltf",
        scene_of("https://localhost/a.bin"),
        "refers to 'https://localhost/a.bin', which is no file beside",
    ),
    ("a.gltf", scene_of("file:///etc/hostname"), "refers to 'file:///etc/hostname'"),
    ("a.gltf", scene_of("/etc/hostname"), "cannot be read as gltf"),
    ("a.gltf", scene_of("../a.gltf"), "cannot be read as gltf"),
    ("a.gltf", scene_of("data:application/octet-stream;base64,AAAA", 10**12), "cannot be read as gltf"),
    (
        "a.glb",
        chunked(
            {
                "asset": {"version": "2.0"},
                "bufferViews": [],
                "accessors": [{"componentType": 5126, "count": 10**11, "type": "VEC3", "sparse": {}}],
            }
        ),
        "GiB of memory",
    ),
    ("a.obj.gz", bytes_of(b"not gzip"), "gzip"),
    ("a.obj.gz", bytes_of(gzip.compress(bytes(range(256)))[:60]), "gzip"),
    ("a.obj.bz2", bytes_of(b"not bzip"), "not a complete bz"),
    ("a.obj.gz", lambda p: p.write_bytes(gzip.compress(ZEROS)), "unpacks to more than 128 MiB"),
    ("a.stl.bz2", lambda p: p.write_bytes(bz2.compress(ZEROS)), "unpacks to more than 128 MiB"),
    ("a.tgz", lambda p: p.write_bytes(gzip.compress(ZEROS)), "unpacks to more than 128 MiB"),
    ("a.zip", lambda p: archive_of(("a.stl", ZEROS))(p), "unpacks to 200 MiB"),
    ("a.zip", lambda p: archive_of(("a.zip", b""))(p), "holds no mesh"),
    ("a.zip", archive_of(("a.obj", b"v 0 0 0\n"), ("b.stl", LYING_STL)), "counts 5 faces"),
    ("a.zip", bytes_of(b"PK\x03\x04"), "not a complete zip"),
]


@pytest.mark.parametrize(("name", "make", "message"), BAD_FILES)
def test_bad_files_get_one_clear_line(tmp_path, name, make, message):
    path = tmp_path / name
    make(path)
    with pytest.raises(UserError, match=message) as error:
        objects.load_mesh(path)
    assert "\n" not in str(error.value)
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < most_memory()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.pkl", "pkl is no mesh format"),
        ("a.stll", "no mesh format; did you mean .stl?"),
        ("a.ojb", "no mesh format; did you mean .obj?"),
        ("a.PLU", "no mesh format; did you mean .ply?"),
        ("a", "a file without a suffix is of no known kind; add one"),
        ("a.gz", "a file without a suffix"),
        ("a.xyz", "points have no surface to grasp"),
        ("a.PCD", "points have no surface to grasp"),
        ("a.svg", "is a drawing in the plane"),
        ("a.dxf.gz", "is a drawing in the plane"),
    ],
)
def test_what_a_suffix_says(tmp_path, name, message):
    (tmp_path / name).write_bytes(gzip.compress(b"x") if name.endswith("gz") else b"x")
    with pytest.raises(UserError) as error:
        objects.load_mesh(tmp_path / name)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "packages"), [("3mf", "lxml networkx"), ("dae", "pycollada"), ("STEP", "cascadio")]
)
def test_packages_that_a_kind_needs_are_named(tmp_path, monkeypatch, kind, packages):
    monkeypatch.setattr(mesh_file.importlib.util, "find_spec", lambda name: None)
    path = tmp_path / f"a.{kind}"
    path.write_bytes(b"x")
    with pytest.raises(UserError, match=f"pip install {packages}$"):
        objects.load_mesh(path)


@pytest.mark.parametrize("kind", ["3mf", "dae"])
def test_kinds_that_need_packages(tmp_path, kind):
    for module in mesh_file.OPTIONAL[kind]:
        pytest.importorskip(module)
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    path = tmp_path / f"a.{kind}"
    path.write_bytes(box.export(file_type=kind))
    assert objects.load_mesh(path).mesh.volume == pytest.approx(0.006)


def test_a_misspelt_object_is_guessed():
    with pytest.raises(UserError, match=r"did you mean the built-in object mug\?"):
        objects.load_mesh("mugg")


@pytest.mark.parametrize("name", list(sound_files()))
def test_every_kind_of_file(tmp_path, name):
    """In upper case as well; the same parts in each."""
    path = tmp_path / name.upper()
    path.write_bytes(sound_files()[name])
    body = objects.load_mesh(path)
    assert body.watertight and body.warnings == () and len(body.mesh.faces) == 92
    assert body.mesh.volume == pytest.approx(2.4e-5 + trimesh.creation.icosphere(1, 0.03).volume, rel=1e-6)


def test_archives_are_read_whole(tmp_path):
    """All meshes of a zip or tar file; what they refer to lies in the archive."""
    box, ball = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.icosphere(1, 0.01)
    ball.apply_translation((0.2, 0, 0))
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:bz2") as archive:
        for name, data in (
            ("x/a.STL", box.export(file_type="stl")),
            ("b.ply", ball.export(file_type="ply")),
            ("t", b""),
        ):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    path = tmp_path / "a.tar.bz2"
    path.write_bytes(stream.getvalue())
    assert objects.load_mesh(path).mesh.volume == pytest.approx(0.001 + ball.volume, rel=1e-6)
    path = tmp_path / "b.zip"
    archive_of(*box.scene().export(file_type="gltf").items())(path)
    assert objects.load_mesh(path).mesh.volume == pytest.approx(0.001, rel=1e-6)


def test_files_beside_the_mesh(tmp_path):
    """glTF may have its numbers in a file beside it; a pipe is none, and materials are not looked for."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], "<f4")
    scene_of("a.bin")(tmp_path / "a.gltf")
    (tmp_path / "a.bin").write_bytes(corners.tobytes())
    assert np.array_equal(objects.load_mesh(tmp_path / "a.gltf").mesh.triangles[0], corners)
    (tmp_path / "a.bin").unlink()
    os.mkfifo(tmp_path / "a.bin")
    with pytest.raises(UserError, match=r"'a\.bin', which is no file beside it"):
        objects.load_mesh(tmp_path / "a.gltf")
    lines = ("mtllib ../../../../dev/zero", "usemtl a", "v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 3")
    text_of(*lines)(tmp_path / "a.obj")
    assert len(objects.load_mesh(tmp_path / "a.obj").mesh.faces) == 1


def test_a_parser_that_takes_too_long_is_stopped(tmp_path, monkeypatch):
    """A text file of many solids of one name, which trimesh reads in quadratic time."""
    monkeypatch.setattr(mesh_file, "SECONDS", 1)
    solid = "solid a\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendsolid\n"
    (tmp_path / "a.stl").write_text(solid * 40_000)
    with pytest.raises(UserError, match="takes too long"):
        objects.load_mesh(tmp_path / "a.stl")


def check_damaged(folder, seed, count):
    """A body with finite numbers, or one line; returns how many had one."""
    refused = 0
    for number, (name, data) in enumerate(damaged_files(seed, count)):
        path = folder / name
        path.write_bytes(data)
        try:
            body = objects.load_mesh(path)
            assert np.isfinite(body.centre_of_mass).all(), number
            no_volume = not body.watertight or any("no volume" in warning for warning in body.warnings)
            assert no_volume or body.mesh.volume > 0, number
        except UserError as error:
            refused += 1
            assert len(str(error).splitlines()) == 1 and name in str(error), number
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < most_memory()
    return refused


def test_damaged_files(tmp_path):
    assert 11 <= check_damaged(tmp_path, 0, 22) <= 22


@pytest.mark.slow("test_damaged_files")
def test_many_damaged_files(tmp_path):
    assert 600 <= check_damaged(tmp_path, 1, 1100) <= 1000
