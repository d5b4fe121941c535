import bz2
import gzip
import hashlib
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
from real_data import real_meshes

from jaxgrasp import objects
from jaxgrasp.core.errors import UserError
from jaxgrasp.objects import builtin, mesh_file
from jaxgrasp.surfaces.triangles import Triangles


@pytest.fixture
def box_file(tmp_path):
    path = tmp_path / "box.stl"
    mesh = trimesh.creation.box(extents=(0.1, 0.2, 0.3))
    mesh.apply_translation((1.0, 2.0, 3.0))
    mesh.export(path)
    return path


def write_obj(path, vertices, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_built_in_object():
    body = objects.load_mesh("mug")
    assert body.watertight and body.warnings == () and body.name == "mug" and body.unit == "m"
    assert body.centre_of_mass == pytest.approx(objects.make_object("mug").center_mass, abs=1e-12)
    assert body.sha256 == objects.load_mesh("mug").sha256 != objects.load_mesh("bowl").sha256


def test_a_file(box_file):
    body = objects.load_mesh(box_file)
    assert body.watertight and body.warnings == ()
    assert body.centre_of_mass == pytest.approx([1, 2, 3], abs=1e-7)
    assert body.sha256 == hashlib.sha256(box_file.read_bytes()).hexdigest()


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254)])
def test_units_scale_the_mesh_and_the_centre(box_file, unit, scale):
    body = objects.load_mesh(box_file, unit=unit)
    assert body.mesh.extents == pytest.approx(scale * np.array([0.1, 0.2, 0.3]), rel=1e-6)
    assert body.centre_of_mass == pytest.approx(scale * np.array([1.0, 2.0, 3.0]), rel=1e-6)


def test_gzip(box_file, tmp_path):
    packed = tmp_path / "box.stl.gz"
    packed.write_bytes(gzip.compress(box_file.read_bytes()))
    body = objects.load_mesh(packed)
    assert np.array_equal(body.mesh.triangles, objects.load_mesh(box_file).mesh.triangles)
    assert body.sha256 == hashlib.sha256(packed.read_bytes()).hexdigest()


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6])
def test_bodies_of_any_size(tmp_path, scale):
    """Vertices are merged, and the volume is integrated, in proportion to the size."""
    vertices, faces = builtin.box()
    apart = scale * (vertices[faces].reshape(-1, 3) + np.array([0.3, 0.2, -0.1]))
    body = objects.load_mesh(write_obj(tmp_path / "a.obj", apart, np.arange(36).reshape(-1, 3)))
    assert body.watertight and len(body.mesh.vertices) == 8
    assert body.centre_of_mass / scale == pytest.approx([0.3, 0.2, -0.1], rel=1e-12)
    (warning,) = body.warnings
    assert "--unit" in warning


def test_a_scene_is_merged(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(extents=(0.1, 0.1, 0.1)))
    shift = trimesh.transformations.translation_matrix((0.3, 0, 0))
    scene.add_geometry(trimesh.creation.box(extents=(0.1, 0.1, 0.1)), transform=shift)
    path = tmp_path / "two.glb"
    path.write_bytes(scene.export(file_type="glb"))
    body = objects.load_mesh(path)
    assert body.watertight and len(body.mesh.faces) == 24
    assert body.centre_of_mass == pytest.approx([0.15, 0, 0], abs=1e-7)


def test_not_watertight_names_the_consequence(tmp_path):
    vertices = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)]
    body = objects.load_mesh(write_obj(tmp_path / "leaf.obj", vertices, [(0, 1, 2)]))
    assert not body.watertight
    assert body.centre_of_mass == pytest.approx([0.1 / 3, 0.1 / 3, 0])
    (warning,) = body.warnings
    assert "not watertight" in warning and "centre of mass is the surface's" in warning and "--com" in warning


def test_centre_of_an_open_surface_is_weighted_by_area(tmp_path):
    vertices = [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (1, 0, 0), (1.2, 0, 0), (1, 0.2, 0)]
    body = objects.load_mesh(write_obj(tmp_path / "two.obj", vertices, [(0, 1, 2), (3, 4, 5)]))
    first, second = np.array([0.1 / 3, 0.1 / 3, 0]), np.array([1 + 0.2 / 3, 0.2 / 3, 0])
    assert body.centre_of_mass == pytest.approx((0.005 * first + 0.02 * second) / 0.025)


def test_given_centre_of_mass_wins(box_file):
    assert objects.load_mesh(box_file, com=(0.1, 0.2, 0.3)).centre_of_mass == pytest.approx([0.1, 0.2, 0.3])
    with pytest.raises(UserError, match="three finite numbers"):
        objects.load_mesh(box_file, com=(0.1, 0.2))
    with pytest.raises(UserError, match="three finite numbers"):
        objects.load_mesh(box_file, com=(0.1, 0.2, float("nan")))


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_suspect_units_warn_with_the_extents(tmp_path, unit):
    path = tmp_path / "part.stl"
    trimesh.creation.box(extents=(20, 30, 40) if unit == "m" else (0.2, 0.3, 0.4)).export(path)
    (warning,) = objects.load_mesh(path, unit=unit).warnings
    assert "--unit" in warning
    assert ("20 x 30 x 40" if unit == "m" else "0.0002 x 0.0003 x 0.0004") in warning


@pytest.mark.parametrize("flipped", ["all", "some"])
def test_faces_that_point_inwards_are_turned(tmp_path, flipped):
    vertices, faces = builtin.torus()
    faces = faces.copy()
    chosen = slice(None) if flipped == "all" else slice(None, None, 3)
    faces[chosen] = faces[chosen, ::-1]
    body = objects.load_mesh(write_obj(tmp_path / "torus.obj", vertices, faces))
    assert body.watertight and body.mesh.volume == pytest.approx(objects.make_object("torus").volume)
    assert any("pointed inwards" in warning for warning in body.warnings)


def test_an_open_mesh_that_points_inwards_warns(tmp_path):
    vertices, faces = builtin.sphere()
    path = write_obj(tmp_path / "shell.obj", vertices, faces[1:, ::-1])
    assert any("seem to point inwards" in warning for warning in objects.load_mesh(path).warnings)
    path = write_obj(tmp_path / "shell.obj", vertices, faces[1:])
    assert not any("seem to point inwards" in warning for warning in objects.load_mesh(path).warnings)


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
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 2 << 20  # in KiB


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
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 2 << 20
    return refused


def test_damaged_files(tmp_path):
    assert 11 <= check_damaged(tmp_path, 0, 22) <= 22


@pytest.mark.slow("test_damaged_files")
def test_many_damaged_files(tmp_path):
    assert 600 <= check_damaged(tmp_path, 1, 1100) <= 1000


def test_a_unit_for_a_built_in_object_is_refused():
    with pytest.raises(UserError, match="in metres"):
        objects.load_mesh("mug", unit="mm")
    with pytest.raises(UserError, match="unknown unit"):
        objects.load_mesh("mug", unit="furlong")


def test_faces_that_say_nothing_are_dropped(tmp_path):
    vertices, faces = builtin.box()
    a, b = faces[0, :2]
    middle = (vertices[a] + vertices[b]) / 2
    again = [faces[1], faces[2, [1, 2, 0]], faces[3, ::-1], (0, 0, 1), (1, 1, 1), (a, 8, b)]
    vertices = np.concatenate([vertices, [middle], vertices[:1]])
    faces = np.concatenate([faces, again])
    faces[5] = np.where(faces[5] == 0, 9, faces[5])  # a vertex that is there twice
    body = objects.load_mesh(write_obj(tmp_path / "box.obj", vertices, faces))
    assert body.watertight and len(body.mesh.faces) == 12 and len(body.mesh.vertices) == 8
    assert body.centre_of_mass == pytest.approx(np.zeros(3), abs=1e-15)
    assert body.warnings == ("the mesh lost 3 faces that were there twice, 3 faces without area",)


def test_vertices_without_a_face_are_dropped(tmp_path):
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    loose = trimesh.Trimesh(np.concatenate([[[9, 9, 9]], mesh.vertices]), mesh.faces + 1, process=False)
    loose.export(tmp_path / "a.off")
    body = objects.load_mesh(tmp_path / "a.off")
    assert body.mesh.extents == pytest.approx([0.1, 0.1, 0.1])
    assert body.warnings == ("the mesh lost 1 vertices without a face",)


def test_a_sliver_that_closes_the_surface_stays(tmp_path):
    """A vertex on an edge of one face only: without the face of no area the box would be open."""
    vertices, faces = builtin.box()
    a, b, c = faces[0]
    vertices = np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]])
    faces = np.concatenate([faces[1:], [(a, 8, c), (8, b, c), (a, b, 8)]])
    body = objects.load_mesh(write_obj(tmp_path / "box.obj", vertices, faces))
    assert body.watertight and body.warnings == () and len(body.mesh.faces) == 14


def test_a_surface_with_two_sides_is_one(tmp_path):
    vertices, faces = builtin.torus()
    body = objects.load_mesh(write_obj(tmp_path / "a.obj", vertices, np.concatenate([faces, faces[:, ::-1]])))
    assert body.watertight and body.mesh.volume == pytest.approx(objects.make_object("torus").volume)
    assert body.warnings == (f"the mesh lost {len(faces)} faces that were there twice",)


def block(side, x=0.0, y=0.0, z=0.0):
    mesh = trimesh.creation.box(np.broadcast_to(side, 3))
    mesh.apply_translation((x, y, z))
    return mesh


INWARDS, MET, WALL = (
    "pointed inwards",
    "they were joined, and the surface inside was dropped",
    "walls between parts",
)
A, B, INNER, CORE = block(4), block(4, 2), block(2, 0.5), block(1, 0.5)
PARTS = {
    # blocks, which are turned inside out and which are cavities; volume in cm^3, centre of mass in cm; what is said
    "apart": ([A, block(2, 10)], "++", "++", 72, (10 / 9, 0, 0), []),
    "the second reversed": ([A, block(2, 10)], "+-", "++", 72, (10 / 9, 0, 0), [f"of part 2 {INWARDS}"]),
    "both reversed": ([A, block(2, 10)], "--", "++", 72, (10 / 9, 0, 0), [f"of parts 1, 2 {INWARDS}"]),
    "a cavity": ([A, INNER], "+-", "+-", 56, (-1 / 14, 0, 0), []),
    "a cavity told first": ([INNER, A], "-+", "-+", 56, (-1 / 14, 0, 0), []),
    "a cavity, all reversed": (
        [A, INNER],
        "-+",
        "+-",
        56,
        (-1 / 14, 0, 0),
        ["the volume; part 2 stayed hollow"],
    ),
    "two cavities": ([block(8), block(2, 2), block(2, -2)], "+--", "+--", 496, (0, 0, 0), []),
    "two that overlap": (
        [block(8), block(2, 1), block(2)],
        "+--",
        "+--",
        500,
        (-6 / 500, 0, 0),
        ["parts 2 and 3 overlap"],
    ),
    "a core in a cavity": ([A, INNER, CORE], "+-+", "+-+", 57, (-3.5 / 57, 0, 0), []),
    "a reversed core": ([A, INNER, CORE], "+--", "+-+", 57, (-3.5 / 57, 0, 0), [f"of part 3 {INWARDS}"]),
    "four levels": ([block(8), block(6), A, INNER], "+-+-", "+-+-", 352, (-4 / 352, 0, 0), []),
    "beside a cavity": (
        [A, INNER, block(2, 10)],
        "+--",
        "+-+",
        64,
        (76 / 64, 0, 0),
        [f"of part 3 {INWARDS}"],
    ),
    "inside": ([A, INNER], "++", "++", 64, (0, 0, 0), [f"part 2 lies in part 1 and is no cavity; {MET}"]),
    "overlapping": (
        *([block((10, 2, 2), 5), block((1.8, 8, 1.8), 2, 4)], "++", "++", 62.68),
        *((3.9144862795, 1.6282705807, 0), [f"parts 1 and 2 overlap; {MET}"]),
    ),
    "one overlapping reversed": (
        [A, B],
        "+-",
        "++",
        96,
        (1, 0, 0),
        [INWARDS, f"parts 1 and 2 overlap; {MET}"],
    ),
    "a cavity in one": ([A, block(4, 3), block(1, -1)], "++-", "++-", 111, (169 / 111, 0, 0), [MET]),
    "side by side": ([A, block(4, 4)], "++", "++", 128, (2, 0, 0), [WALL]),
    "one beside reversed": ([A, block(4, 4)], "+-", "++", 128, (2, 0, 0), [WALL, INWARDS]),
    "unlike side by side": ([A, block(2, 3)], "++", "++", 72, (1 / 3, 0, 0), [f"parts 1 and 2 touch; {MET}"]),
    "four": ([A, block(4, 4), block(4, 0, 4), block(4, 4, 4)], "++++", "++++", 256, (2, 2, 0), [WALL]),
    "at an edge": ([A, block(4, 4, 4)], "++", "++", 128, (2, 2, 0), []),
    "reversed at an edge": ([A, block(4, 4, 4)], "+-", "++", 128, (2, 2, 0), [f"of part 2 {INWARDS}"]),
    "at a corner": ([A, block(4, 4, 4, 4)], "++", "++", 128, (2, 2, 2), []),
    "twice": ([A, A], "++", "++", 64, (0, 0, 0), ["12 faces that were there twice"]),
    "twice, once reversed": ([A, A], "+-", "++", 64, (0, 0, 0), ["12 faces that were there twice"]),
}


@pytest.mark.parametrize("name", list(PARTS))
def test_parts(tmp_path, name):
    """Volume and centre of mass; no contact inside another part, and all forces into the body."""
    blocks, turned, meant, volume, centre, words = PARTS[name]
    files = [b.copy() for b in blocks]
    for mesh, sign in zip(files, turned, strict=True):
        if sign == "-":
            mesh.invert()
    trimesh.util.concatenate(files).export(tmp_path / "a.stl")
    body = objects.load_mesh(tmp_path / "a.stl", unit="cm")
    assert np.array_equal(
        body.mesh.triangles, objects.load_mesh(tmp_path / "a.stl", unit="cm").mesh.triangles
    )
    assert body.watertight and Triangles(body.mesh.vertices, body.mesh.faces, 0.5).closed
    assert body.mesh.volume == pytest.approx(volume * 1e-6, rel=1e-6)
    assert body.centre_of_mass == pytest.approx(np.multiply(centre, 0.01), abs=1e-8)
    assert len(body.warnings) == len(words)
    assert all(word in warning for word, warning in zip(words, body.warnings, strict=True))
    for sampler in (
        objects.SurfaceSampler(body.mesh, fingers=2, seed=0),
        objects.AntipodalSampler(body.mesh, friction=0.3, seed=0),
    ):
        position, normal = (x.reshape(-1, 3) for x in sampler.rows(0, 1000))
        assert filled(blocks, meant, 100 * position + 1e-4 * normal).all()
        assert not filled(blocks, meant, 100 * position - 1e-4 * normal).any()


def filled(blocks, meant, points):
    """Whether points (n, 3) lie in a solid block, "+", and in no cavity, "-", in that block."""
    inside = [((points > b.bounds[0]) & (points < b.bounds[1])).all(axis=1) for b in blocks]
    solid = np.zeros(len(points), bool)
    for a, in_a, sign in zip(blocks, inside, meant, strict=True):
        cavities = np.zeros(len(points), bool)
        for b, in_b, other in zip(blocks, inside, meant, strict=True):
            if other == "-" and (b.bounds[0] >= a.bounds[0]).all() and (b.bounds[1] <= a.bounds[1]).all():
                cavities |= in_b
        solid |= in_a & ~cavities & (sign == "+")
    return solid


@pytest.mark.realdata
def test_every_real_mesh_loads_or_says_why_not():
    files = [f for f in sorted(real_meshes().glob("*/*")) if f.is_file() and f.suffix not in (".md", ".txt")]
    watertight = 0
    for file in files:
        body = objects.load_mesh(file)
        assert np.isfinite(body.centre_of_mass).all(), file
        low, high = body.mesh.bounds
        assert (low <= body.centre_of_mass).all() and (body.centre_of_mass <= high).all(), file
        if body.watertight:
            watertight += 1
            assert body.mesh.volume > 0, file
        else:
            assert any("not watertight" in warning for warning in body.warnings), file
        suspect = not 1e-3 <= body.mesh.extents.max() <= 2
        assert suspect == any("--unit" in warning for warning in body.warnings), file
    assert watertight >= 20
