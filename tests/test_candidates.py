import numpy as np
import pytest
import trimesh

from jaxgrasp import objects
from jaxgrasp.core.errors import UserError
from jaxgrasp.objects import builtin
from jaxgrasp.objects.raycast import RayCaster
from jaxgrasp.objects.sampling import BLOCK, AntipodalSampler, SurfaceSampler, geometric_filter, slide_escapes


@pytest.fixture(scope="module")
def mug():
    return objects.make_object("mug")


def on_faces(mesh, points, normals):
    """Distance of each point to the nearest plane of a face whose inward normal is the given one."""
    inward = -np.asarray(mesh.face_normals)
    offset = np.einsum("fj,fj->f", inward, mesh.triangles[:, 0])
    same = normals @ inward.T > 1 - 1e-9
    distance = np.abs(points @ inward.T - offset)
    return np.where(same, distance, np.inf).min(axis=1)


@pytest.mark.parametrize("name", ["mug", "box"])
def test_points_lie_on_the_surface_with_inward_normals(name):
    mesh = objects.make_object(name)
    position, normal = SurfaceSampler(mesh, fingers=3, seed=1).rows(0, 100)
    assert position.shape == normal.shape == (100, 3, 3)
    assert on_faces(mesh, position.reshape(-1, 3), normal.reshape(-1, 3)).max() < 1e-12
    assert np.linalg.norm(normal, axis=-1) == pytest.approx(1, abs=1e-12)


def test_uniform_over_the_area():
    mesh = objects.make_object("box")
    position, normal = SurfaceSampler(mesh, fingers=1, seed=0).rows(0, 60_000)
    areas = {0: 0.08 * 0.06, 1: 0.12 * 0.06, 2: 0.12 * 0.08}
    for axis, area in areas.items():
        for sign in (-1, 1):
            chosen = normal[:, 0, axis] * sign > 0.5
            expected = 60_000 * area / (2 * sum(areas.values()))
            assert abs(chosen.sum() - expected) < 5 * np.sqrt(expected)
            inside = position[chosen, 0] / (mesh.extents / 2)
            across = np.delete(inside, axis, axis=1)
            assert np.abs(across.mean(axis=0)).max() < 5 * np.sqrt(1 / 3 / expected)
            assert np.abs((across**2).mean(axis=0) - 1 / 3).max() < 5 * np.sqrt(4 / 45 / expected)


def test_any_range_in_any_order_gives_the_same_rows(mug):
    for sampler in (SurfaceSampler(mug, fingers=3, seed=7), AntipodalSampler(mug, friction=0.5, seed=7)):
        position, normal = sampler.rows(0, 2 * BLOCK + 10)
        low, high = BLOCK - 5, BLOCK + 6
        p, n = sampler.rows(low, high)
        assert np.array_equal(p, position[low:high]) and np.array_equal(n, normal[low:high])
        option = {"fingers": 3} if sampler.fingers == 3 else {"friction": 0.5}
        other, _ = type(sampler)(mug, **option, seed=8).rows(0, 10)
        assert not np.isclose(other, position[:10]).any()
        assert len(np.unique(position.reshape(-1, 3), axis=0)) == position.size // 3  # blocks do not repeat


def test_the_guide_table_is_the_search(mug):
    uneven = trimesh.Trimesh(mug.vertices * (1.0, 1e-4, 1.0), mug.faces, process=False)
    for mesh in (mug, uneven):
        sampler = SurfaceSampler(mesh, fingers=1, seed=0)
        u = np.random.default_rng(0).random(20_000)
        u[:3] = 0.0, np.nextafter(1.0, 0.0), sampler.cumulative[10]
        assert np.array_equal(sampler.choose(u), np.searchsorted(sampler.cumulative, u, side="right"))


def test_degenerate_faces_are_never_chosen():
    vertices, faces = builtin.box()
    mesh = trimesh.Trimesh(vertices, np.concatenate([[[0, 0, 1]], faces, [[2, 2, 2]]]), process=False)
    position, normal = SurfaceSampler(mesh, fingers=2, seed=0).rows(0, BLOCK)
    assert np.isfinite(position).all()
    assert np.linalg.norm(normal, axis=-1) == pytest.approx(1, abs=1e-12)
    with pytest.raises(UserError, match="zero area"):
        SurfaceSampler(trimesh.Trimesh(vertices, [[0, 0, 1]], process=False), fingers=2, seed=0)


def test_no_fingers_and_negative_seeds_are_refused(mug):
    with pytest.raises(UserError, match="at least one finger"):
        SurfaceSampler(mug, fingers=0, seed=0)
    with pytest.raises(UserError, match="seed"):
        SurfaceSampler(mug, fingers=1, seed=-1)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_antipodal_pairs(mug, friction):
    position, normal = AntipodalSampler(mug, friction=friction, seed=2).rows(0, 300)
    line = position[:, 1] - position[:, 0]
    length = np.linalg.norm(line, axis=1)
    cosine = np.einsum("ij,ij->i", line, normal[:, 0]) / length
    tangent = np.sqrt(np.maximum(0, 1 - cosine**2)) / cosine
    assert (cosine > 0).all() and tangent.max() <= friction + 1e-7
    assert (np.einsum("ij,ij->i", line, normal[:, 1]) < 0).all()  # the second finger pushes back
    assert on_faces(mug, position[:, 1], normal[:, 1]).max() < 1e-9
    assert length.min() > 1e-7 and length.max() < np.linalg.norm(mug.extents)
    if friction:
        # Uniform over the cone's base: tangent^2 has mean mu^2 / 2.
        assert (tangent**2).mean() == pytest.approx(friction**2 / 2, rel=0.15)


def test_antipodal_pairs_of_a_box_are_across_it():
    position, normal = AntipodalSampler(objects.make_object("box"), friction=0.0, seed=0).rows(0, 500)
    line = position[:, 1] - position[:, 0]
    axis = np.argmax(np.abs(line), axis=1)
    assert np.linalg.norm(line, axis=1) == pytest.approx(np.array([0.12, 0.08, 0.06])[axis], abs=1e-12)
    assert normal[:, 1] == pytest.approx(-normal[:, 0], abs=1e-12)


def test_an_open_sheet_has_no_antipodal_pairs():
    sheet = trimesh.Trimesh([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)], [(0, 1, 2)], process=False)
    with pytest.raises(UserError, match="--sampler surface"):
        AntipodalSampler(sheet, friction=0.5, seed=0).rows(0, 10)


@pytest.mark.parametrize("name", ["mug", "box", "torus"])
def test_ray_casts_against_every_triangle_in_turn(name):
    mesh = objects.make_object(name)
    random = np.random.default_rng(3)
    points, faces = trimesh.sample.sample_surface(mesh, 200, seed=3)
    points = np.asarray(points)
    direction = -mesh.face_normals[faces] + 0.7 * random.normal(size=points.shape)
    direction[:3] = np.eye(3)  # parallel to walls
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    t, face = RayCaster(mesh.triangles).nearest(points, direction, 1e-7, faces)
    a, b, c = np.moveaxis(np.asarray(mesh.triangles), 1, 0)
    for i in range(len(points)):
        system = np.stack([b - a, c - a, np.broadcast_to(-direction[i], a.shape)], axis=-1)
        solvable = np.abs(np.linalg.det(system)) > 1e-14
        u, v, s = np.full((3, len(a)), np.nan)
        u[solvable], v[solvable], s[solvable] = np.linalg.solve(
            system[solvable], (points[i] - a)[solvable][..., None]
        )[..., 0].T
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (s > 1e-7) & (np.arange(len(a)) != faces[i])
        nearest = s[hit].min() if hit.any() else np.inf
        assert t[i] == pytest.approx(nearest, abs=1e-9)
        assert (face[i] >= 0) == hit.any()


def test_the_filter_only_drops_what_a_slide_refutes():
    e = np.eye(3)
    normal = np.stack([[e[0], e[0]], [e[0], -e[0]], [e[0], e[1]], [e[0], 5 * e[0]], [e[0], 0 * e[0]]])
    friction, active = np.full((5, 2), 0.5), np.ones((5, 2), bool)
    assert slide_escapes(normal, friction, active).tolist() == [True, False, True, True, False]
    # Two normals at 90 degrees meet the mean normal at 45 degrees: refuted below mu = 1 only.
    assert slide_escapes(normal[2:3], np.full((1, 2), 0.98), active[:1])[0]
    assert not slide_escapes(normal[2:3], np.full((1, 2), 1.01), active[:1])[0]
    active[1] = (True, False)
    assert slide_escapes(normal[1:2], friction[1:2], active[1:2])[0]  # one finger alone never holds
    assert not slide_escapes(normal[:1], friction[:1], np.zeros((1, 2), bool))[0]


def test_the_filter_says_why():
    position = np.array([[[0, 0, 0], [0, 0, 5e-4]], [[0, 0, 0], [0, 0, 1.0]], [[0, 0, 0], [0, 0, 5e-4]]])
    normal = np.array([[[0, 0, 1], [0, 0, -1]], [[0, 0, 1], [0, 0, 1]], [[0, 0, 1], [0, 0, 1.0]]])
    slide, close = geometric_filter(
        position, normal, friction=np.full((3, 2), 0.5), active=np.ones((3, 2), bool)
    ).values()
    assert slide.tolist() == [False, True, True] and close.tolist() == [True, False, False]


def test_a_body_from_a_file_can_be_sampled(tmp_path, mug):
    mug.export(tmp_path / "mug.ply")
    position, _ = SurfaceSampler(objects.load_mesh(tmp_path / "mug.ply").mesh, fingers=2, seed=0).rows(0, 10)
    assert np.isfinite(position).all()
