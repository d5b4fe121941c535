import gzip
import hashlib

import numpy as np
import pytest
import trimesh
from real_data import real_meshes

from jaxgrasp import objects
from jaxgrasp.core.errors import UserError
from jaxgrasp.objects import builtin


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


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("a.obj", nothing, "no such file"),
        ("a", nothing, "built-in objects: .*mug"),
        ("a.obj", directory, "is a directory"),
        ("a.obj", no_faces, "no faces"),
        ("a.obj", zero_area, "zero area"),
        ("a.obj", not_finite, "NaN or infinite"),
        ("a.stl", lambda p: p.write_bytes(b"\x00" * 80 + b"\x05\x00\x00\x00" + b"\x01" * 60), "no faces"),
        ("a.ply", lambda p: p.write_bytes(b"garbage"), "cannot be read as ply"),
        ("a.obj", lambda p: p.write_bytes(b""), "no faces"),
        ("a.pkl", lambda p: p.write_bytes(b"cos\nsystem\n(S'false'\ntR."), "no mesh format"),
        ("a.obj.gz", lambda p: p.write_bytes(b"not gzip"), "gzip"),
        ("a.obj.gz", lambda p: p.write_bytes(gzip.compress(bytes(range(256)))[:60]), "gzip"),
    ],
)
def test_bad_files_get_one_clear_line(tmp_path, name, make, message):
    path = tmp_path / name
    make(path)
    with pytest.raises(UserError, match=message) as error:
        objects.load_mesh(path)
    assert "\n" not in str(error.value)


def test_a_unit_for_a_built_in_object_is_refused():
    with pytest.raises(UserError, match="in metres"):
        objects.load_mesh("mug", unit="mm")
    with pytest.raises(UserError, match="unknown unit"):
        objects.load_mesh("mug", unit="furlong")


def test_degenerate_faces_do_not_matter(tmp_path):
    vertices, faces = builtin.box()
    faces = np.concatenate([faces, [[0, 0, 1], [1, 1, 1]]])
    body = objects.load_mesh(write_obj(tmp_path / "box.obj", vertices, faces))
    assert np.isfinite(body.centre_of_mass).all()
    assert body.mesh.area == pytest.approx(2 * (0.12 * 0.08 + 0.12 * 0.06 + 0.08 * 0.06))


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
