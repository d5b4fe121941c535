import gzip
import hashlib

import numpy as np
import pytest
import trimesh
from real_data import real_meshes

from jaxgrasp import objects
from jaxgrasp.core.errors import UserError
from jaxgrasp.objects import builtin
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
