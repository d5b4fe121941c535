"""Surfaces: nearest points, normals, curvature, edges, samples, of shapes and of meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from real_data import real_meshes
from scipy.spatial import KDTree

from jaxgrasp import objects, surfaces
from jaxgrasp.core.errors import UserError
from jaxgrasp.core.tolerances import unit_roundoff
from jaxgrasp.surfaces.nearest import point_triangle

AT = (0.01, -0.02, 0.005)
SHAPES = {
    "sphere": lambda: surfaces.Sphere(0.04, AT),
    "box": lambda: surfaces.RoundedBox([0.06, 0.04, 0.03], 0.008, AT),
    "cylinder": lambda: surfaces.Cylinder(0.03, 0.06, 0.006, AT),
    "ellipsoid": lambda: surfaces.Ellipsoid([0.03, 0.05, 0.08], AT),
    "superquadric": lambda: surfaces.Superquadric([0.05, 0.04, 0.06], [0.3, 0.5], AT),
}


def rounding(dtype, size=1.0):
    """What an iteration may lose, where curvature is a thousand times that of a ball."""
    return 4096 * unit_roundoff(dtype) * size


NAMES = [pytest.param(name, marks=[pytest.mark.slow] * (name == "superquadric")) for name in SHAPES]


@pytest.fixture(scope="module", params=NAMES)
def shape(request):
    return SHAPES[request.param]()


@pytest.fixture(scope="module")
def mug():
    return surfaces.of("mug", resolution=64)


@pytest.fixture(scope="module")
def ball():
    return surfaces.of("sphere", resolution=40)


@pytest.fixture(scope="module")
def block():
    return surfaces.of("box", resolution=40)


def around(surface, count, seed=0, reach=0.3):
    """Points from ``reach`` radii outside the surface to a tenth inside."""
    point, normal = surface.sample(seed, count)
    step = np.random.default_rng(seed).uniform(-reach, 0.1, (count, 1)) * float(surface.radius)
    return point + step * normal


def by_rows(function):
    """``function(surface, points)`` in NumPy, 512 rows at a time: one compilation a surface."""
    compiled = jax.jit(function)

    def answer(surface, point):
        flat = np.asarray(point, np.float64)
        rows = -(-len(flat) // 512) * 512
        flat = np.concatenate([flat, np.repeat(flat[-1:], rows - len(flat), axis=0)])
        parts = [compiled(surface, flat[i : i + 512]) for i in range(0, rows, 512)]
        return tuple(np.concatenate(part)[: len(point)] for part in zip(*parts, strict=True))

    return answer


@by_rows
def everything(surface, point):
    return (*surface.contact(point), surface.distance(point), surface.edge_distance(point))


@by_rows
def slopes(surface, point):
    return jax.vmap(jax.jacfwd(surface.contact))(point)


@by_rows
def bends(surface, point):
    return surface.curvature(point), jax.vmap(jax.grad(surface.distance))(point)


def differences(function, x, step):
    """Central differences (*shape of the values, *shape of x)."""
    columns = []
    for i in range(x.size):
        move = np.zeros(x.size)
        move[i] = step
        move = move.reshape(x.shape)
        columns.append((np.asarray(function(x + move)) - np.asarray(function(x - move))) / (2 * step))
    return np.moveaxis(np.asarray(columns), 0, -1)


# Shapes ------------------------------------------------------------------------------------------------------------


def test_samples_lie_on_the_surface_with_inward_normals(shape):
    point, normal = shape.sample(3, 500)
    x, n, distance, _ = everything(shape, point)
    dtype = shape.centre.dtype
    assert point.dtype == np.float64 and x.dtype == n.dtype == dtype
    assert np.abs(x - point).max() < rounding(dtype, 0.1)
    assert np.abs(n - normal).max() < rounding(dtype, 10)
    assert np.abs(distance).max() < rounding(dtype, 0.1)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1, abs=rounding(dtype))
    again, other = shape.sample(3, 500), shape.sample(4, 500)
    assert again[0].tobytes() == point.tobytes() and again[1].tobytes() == normal.tobytes()
    assert not np.isclose(other[0], point).all(axis=1).any()


def test_the_radius_is_the_farthest_point(shape):
    reach = np.linalg.norm(shape.sample(0, 20_000)[0] - np.asarray(shape.centre), axis=1).max()
    assert reach <= float(shape.radius) * (1 + 1e-6)
    assert reach == pytest.approx(float(shape.radius), rel=0.01)


def test_samples_are_uniform_over_the_area(shape):
    """On a closed surface ``E[n] = 0`` and ``E[n_i x_j] = -(volume / area) delta_ij`` (divergence theorem)."""
    count = 60_000
    point, normal = shape.sample(5, count)
    local = point - np.asarray(shape.centre)
    products = normal[:, :, None] * local[:, None]
    mean, spread = products.mean(axis=0), products.std(axis=0) / np.sqrt(count)
    assert np.all(np.abs(normal.mean(axis=0)) < 5 * normal.std(axis=0) / np.sqrt(count))
    assert np.all(np.abs(mean - np.eye(3) * np.trace(mean) / 3) < 5 * (spread + spread.max() / 2))
    assert np.trace(mean) < 0


def test_no_point_of_the_surface_is_nearer(shape):
    point = around(shape, 200)
    x, n, distance, _ = everything(shape, point)
    found = np.linalg.norm(point - np.asarray(x), axis=1)
    tried, _ = KDTree(shape.sample(1, 100_000)[0]).query(point)
    assert (found <= tried + rounding(x.dtype, 0.1)).all()
    assert (tried < np.hypot(found, 0.05 * float(shape.radius))).all()  # as densely as it was sampled
    assert np.abs(np.abs(distance) - found).max() < rounding(x.dtype, 0.1)
    assert np.abs((point - x) + np.asarray(n) * np.asarray(distance)[:, None]).max() < rounding(x.dtype, 0.1)


def test_derivatives_are_those_of_differences(shape):
    point = around(shape, 6, seed=2)
    dx, dn = slopes(shape, point)
    wanted = differences(lambda p: everything(shape, p)[0], point, 1e-6)
    normals = differences(lambda p: everything(shape, p)[1], point, 1e-6)
    for i in range(len(point)):
        assert np.abs(dx[i] - wanted[i, :, 3 * i : 3 * i + 3]).max() < 1e-6
        assert np.abs(dn[i] - normals[i, :, 3 * i : 3 * i + 3]).max() < 1e-6 / 0.005
    _, slope = bends(shape, point)
    assert np.abs(slope + everything(shape, point)[1]).max() < 1e-9


def test_on_the_surface_the_derivative_projects_onto_the_tangent_plane(shape):
    point, normal = shape.sample(6, 40)
    dx, dn = slopes(shape, point)
    assert np.abs(dx - (np.eye(3) - normal[:, :, None] * normal[:, None])).max() < 1e-9
    assert np.abs(dn - np.swapaxes(dn, 1, 2)).max() < 1e-7  # the shape operator is symmetric
    assert np.abs(np.einsum("nij,ni->nj", dn, normal)).max() < 1e-7
    curvature, _ = bends(shape, point)
    expected = -np.linalg.eigvalsh(np.asarray(dn))[:, ::-1]
    expected = np.sort(np.take_along_axis(expected, np.argsort(np.abs(expected))[:, 1:], axis=1), axis=1)
    assert np.abs(curvature - expected).max() < 1e-6


def test_curvatures_that_are_known():
    ball = surfaces.Sphere(0.04)
    assert ball.curvature([1.0, 2.0, 3.0]) == pytest.approx(25, rel=1e-9)
    a, b, c = 0.03, 0.05, 0.08
    egg = surfaces.Ellipsoid([a, b, c])
    assert egg.curvature([0, 0, 0.1]) == pytest.approx([c / b**2, c / a**2], rel=1e-6)
    can = surfaces.Cylinder(0.03, 0.06, 0.006)
    assert can.curvature([0.05, 0.01, 0.02]) == pytest.approx([0, 1 / 0.03], abs=1e-9)
    assert can.curvature([0.01, 0.01, 0.07]) == pytest.approx([0, 0], abs=1e-9)
    box = surfaces.RoundedBox([0.06, 0.04, 0.03], 0.008)
    assert box.curvature([0.1, 0.1, 0.0]) == pytest.approx([0, 125], abs=1e-9)
    assert box.curvature([0.1, 0.1, 0.1]) == pytest.approx([125, 125], abs=1e-9)
    assert jnp.isfinite(jax.jacfwd(ball.curvature)(jnp.asarray([0.01, 0.02, 0.03]))).all()


def test_known_nearest_points():
    box = surfaces.RoundedBox([0.06, 0.04, 0.03], 0.01)
    assert box.project([0.1, 0.01, 0.02]) == pytest.approx([0.06, 0.01, 0.02], abs=1e-15)
    assert box.project([0.1, 0.08, 0.0]) == pytest.approx([0.05 + 0.01 / 2**0.5, 0.03 + 0.01 / 2**0.5, 0])
    assert box.project([0.01, 0.0, 0.015]) == pytest.approx([0.01, 0, 0.03], abs=1e-15)
    assert box.distance([[0.07, 0, 0], [0, 0, 0]]) == pytest.approx([0.01, -0.03], abs=1e-15)
    can = surfaces.Cylinder(0.03, 0.06, 0.006)
    assert can.project([0.06, 0.08, 0.01]) == pytest.approx([0.018, 0.024, 0.01], abs=1e-15)
    assert can.project([0.001, 0.002, 0.09]) == pytest.approx([0.001, 0.002, 0.06], abs=1e-15)
    egg = surfaces.Ellipsoid([0.03, 0.05, 0.08])
    assert egg.project([[0.2, 0, 0], [0, 0, -0.3]]) == pytest.approx(
        np.array([[0.03, 0, 0], [0, 0, -0.08]]), abs=1e-15
    )


def test_rounded_edges_are_told_from_flats():
    box = surfaces.RoundedBox([0.06, 0.04, 0.03], 0.01)
    flat, corner = box.edge_distance([[0.1, 0.0, 0.005], [0.1, 0.08, 0.0]])
    assert flat == pytest.approx(0.015) and corner == pytest.approx(-0.01 / 2**0.5)
    can = surfaces.Cylinder(0.03, 0.06, 0.006)
    assert can.edge_distance([[0.05, 0, 0.01], [0.004, 0, 0.07]]) == pytest.approx([0.044, 0.02])
    assert jnp.isinf(surfaces.Sphere(0.04).edge_distance([0.0, 0.0, 1.0]))


def test_a_superquadric_of_exponents_one_is_the_ellipsoid():
    point = around(surfaces.Ellipsoid([0.03, 0.05, 0.08]), 50)
    egg = everything(surfaces.Ellipsoid([0.03, 0.05, 0.08]), point)
    other = everything(surfaces.Superquadric([0.03, 0.05, 0.08], [1.0, 1.0]), point)
    for one, two in zip(egg, other, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-9)


def test_shapes_scale_and_move(shape):
    """``project(s p + t) = s project(p) + t`` for the shape scaled by s and moved by t."""
    point, moved = around(shape, 20), np.array([0.3, 0.1, -0.2])
    lengths = {"radius", "centre", "half_extents", "rounding", "side", "half_height", "semiaxes"}
    larger = jax.tree.map(lambda a: a, shape)
    for name in lengths & set(vars(shape)):
        value = getattr(shape, name) * 1000 + (jnp.asarray(moved) if name == "centre" else 0)
        object.__setattr__(larger, name, value)
    x, n, distance, _ = everything(larger, 1000 * point + moved)
    y, m, length, _ = everything(shape, point)
    assert np.abs((np.asarray(x) - moved) / 1000 - y).max() < 1e-12
    assert np.abs(np.asarray(n) - m).max() < 1e-9
    assert np.abs(np.asarray(distance) / 1000 - length).max() < 1e-12


@pytest.mark.parametrize(
    ("make", "start"),
    [
        (lambda t: surfaces.Sphere(t[0], t[1:4]), [0.04, 0.0, 0.01, 0.0]),
        (lambda t: surfaces.RoundedBox(t[:3], t[3]), [0.06, 0.04, 0.03, 0.01]),
        (lambda t: surfaces.Cylinder(t[0], t[1], t[2]), [0.03, 0.06, 0.01]),
        (lambda t: surfaces.Ellipsoid(t[:3]), [0.03, 0.05, 0.08]),
        pytest.param(
            lambda t: surfaces.Superquadric(t[:3], t[3:5]),
            [0.05, 0.04, 0.06, 0.4, 0.6],
            marks=pytest.mark.slow,
        ),
    ],
    ids=list(SHAPES),
)
def test_derivatives_by_parameters(make, start):
    point = jnp.asarray([[0.052, 0.045, 0.03], [0.03, 0.05, -0.07]])
    value = jax.jit(lambda t: jnp.concatenate([make(t).project(point), make(t).normal(point) / 10]))
    slope = jax.jit(jax.jacrev(value))(jnp.asarray(start))
    wanted = differences(value, np.asarray(start), 1e-7)
    assert np.abs(np.asarray(slope) - wanted).max() < 3e-6


def test_second_derivatives(shape):
    """Of ``|x(p) - q|^2``, forward over reverse, against differences of the gradient."""
    point, goal = jnp.asarray(around(shape, 1, seed=8)[0]), jnp.asarray([0.02, 0.03, 0.04])

    def cost(p):
        return jnp.sum((shape.project(p) - goal) ** 2)

    second = jax.jit(jax.hessian(cost))(point)
    wanted = differences(jax.jit(jax.grad(cost)), np.asarray(point), 1e-6)
    assert np.abs(np.asarray(second) - wanted).max() < 1e-6


def test_a_point_without_numbers_spoils_its_own_lane_only(shape):
    point = around(shape, 4)
    spoilt = point.copy()
    spoilt[1, 2], spoilt[3, 0] = np.nan, np.inf
    good, bad = everything(shape, point), everything(shape, spoilt)
    for one, two in zip(good, bad, strict=True):
        assert np.array_equal(one[::2], two[::2]) and np.isnan(two[1::2]).all()
    dx, dn = slopes(shape, spoilt)
    assert np.isfinite(dx[::2]).all() and np.isfinite(dn[::2]).all()


def test_finite_where_nearest_points_are_many(shape):
    offset = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3], [0, 0, 0.5], [0, 0.5, 0]])
    point = np.asarray(shape.centre) + offset
    x, n, _, _ = everything(shape, point)
    assert np.abs(everything(shape, x)[2]).max() < 1e-9
    assert np.linalg.norm(n, axis=1) == pytest.approx(1, abs=1e-9)
    for slope in slopes(shape, point):
        assert np.isfinite(slope).all()


def test_any_batch_shape():
    shape = SHAPES["ellipsoid"]()
    point = jnp.asarray(around(shape, 6)).reshape(2, 3, 3)
    x = shape.project(point)
    assert x.shape == (2, 3, 3) and shape.distance(point).shape == (2, 3)
    np.testing.assert_allclose(jax.vmap(jax.vmap(shape.project))(point), x, atol=1e-15)
    np.testing.assert_allclose(shape.project(point[1, 2]), x[1, 2], atol=1e-15)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: surfaces.Sphere(0.0), "radius must be positive"),
        (lambda: surfaces.Sphere(1.0, [0.0, 0.0]), "centre must be an array of shape"),
        (lambda: surfaces.Sphere(float("nan")), "radius must be positive and finite"),
        (lambda: surfaces.Ellipsoid([0.1, 0.0, 0.1]), "semiaxes must be positive"),
        (lambda: surfaces.RoundedBox([0.1, 0.2, 0.3], 0.11), "rounding must not exceed"),
        (lambda: surfaces.RoundedBox([0.1, 0.2, 0.3], 0.0), "rounding must be positive"),
        (lambda: surfaces.Cylinder(0.1, 0.05, 0.06), "rounding must not exceed"),
        (lambda: surfaces.Superquadric([0.1, 0.1, 0.1], [0.1, 0.5]), "exponents must lie between"),
        (lambda: surfaces.Superquadric([0.1, 0.1, 0.1], [1.5, 0.5]), "exponents must lie between"),
        (lambda: surfaces.Sphere(1.0).project([1.0, 2.0]), r"points must have shape \(\*batch, 3\)"),
        (lambda: surfaces.Sphere(1.0).sample(-1, 3), "seed must be"),
        (lambda: surfaces.Sphere(1.0).sample(1, -3), "count of points must be"),
    ],
)
def test_wrong_arguments_are_named(build, words):
    with pytest.raises(ValueError, match=words):
        build()


# Triangles, exactly ------------------------------------------------------------------------------------------------


def brute_force(corner, point):
    """Distance to every triangle, the least, in extended precision where NumPy has it."""
    corner, point = corner.astype(np.longdouble), point.astype(np.longdouble)
    least = np.full(len(point), np.inf, np.longdouble)
    for triangle in corner:
        repeated = np.broadcast_to(triangle, (len(point), 3, 3))
        least = np.minimum(least, np.sqrt(point_triangle(point, repeated)[0]))
    return least.astype(float)


def test_a_point_and_a_triangle():
    corner = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0]])
    point = np.array([[1, 0.5, 3], [-1, -1, 0], [2, -3, 4], [5, 0, 0], [2, 2, 0], [0, 0, 0]], float)
    square, weight = point_triangle(point, np.broadcast_to(corner, (6, 3, 3)))
    assert square == pytest.approx([9, 2, 25, 1, 4 / 5, 0], abs=1e-15)
    assert weight[0] == pytest.approx([0.5, 0.25, 0.25]) and weight[1].tolist() == [1, 0, 0]
    assert weight[2].tolist() == [0.5, 0.5, 0] and weight[3].tolist() == [0, 1, 0]
    assert weight[4] == pytest.approx([0, 0.4, 0.6]) and weight[4, 0] == 0


@pytest.mark.parametrize("name", ["mug", "box"])
def test_exact_at_metre_scale(name, mug, block):
    """Scaled to metres and moved by ten, near the surface and far from it."""
    small = {"mug": mug, "box": block}[name]
    mesh = objects.make_object(name)
    mesh.apply_scale(10)
    mesh.apply_translation((10.0, -7.0, 3.0))
    surface = surfaces.MeshSurface(mesh, resolution=16 if name == "box" else 32)
    random = np.random.default_rng(0)
    on, _ = surface.sample(0, 40)
    point = np.concatenate(
        [
            on + random.normal(0, 1e-7, on.shape),
            on + random.normal(0, 1e-2, on.shape),
            10 + random.normal(size=(20, 3)),
            np.asarray(surface.centre)[None],
        ]
    )
    nearest = surface.project_exact(point)
    wanted = brute_force(np.asarray(mesh.triangles), point)
    size = float(surface.radius)
    assert np.abs(nearest.distance - wanted).max() < 1e-9 * size
    assert np.abs(np.linalg.norm(point - nearest.point, axis=1) - nearest.distance).max() < 1e-9 * size
    corner = np.asarray(mesh.triangles)[nearest.face]
    assert np.abs(np.einsum("nc,ncj->nj", nearest.barycentric, corner) - nearest.point).max() < 1e-9 * size
    assert np.abs(nearest.normal + np.asarray(mesh.face_normals)[nearest.face]).max() < 1e-9
    scaled = small.project_exact((point - (10.0, -7.0, 3.0)) / 10)
    assert np.abs(scaled.distance * 10 - nearest.distance).max() < 1e-9 * size


def test_long_triangles_and_faces_without_area():
    """A needle of a box: two triangles a side, a thousand times longer than wide; two faces are degenerate."""
    mesh = trimesh.creation.box(extents=(1.0, 1e-3, 1e-3))
    faces = np.concatenate([[[0, 0, 1]], mesh.faces, [[3, 3, 3]]])
    mesh = trimesh.Trimesh(mesh.vertices, faces, process=False)
    triangles = surfaces.mesh.Triangles(mesh.vertices, mesh.faces, 0.5)
    assert triangles.closed and triangles.number.tolist() == list(range(1, 13))
    search = surfaces.mesh.TriangleSearch(triangles.corner)
    point = np.random.default_rng(0).normal(0, 0.01, (300, 3)) + np.linspace(-0.7, 0.7, 300)[:, None] * [
        1,
        0,
        0,
    ]
    distance, _, _ = search.nearest(point - triangles.middle)
    outside = np.linalg.norm(np.maximum(np.abs(point) - [0.5, 5e-4, 5e-4], 0), axis=1)
    away = outside > 0
    assert np.abs(distance - outside)[away].max() < 1e-15


def test_exact_projection_of_batches_and_of_no_number(block):
    point = np.zeros((2, 3, 3))
    point[..., 0] = 0.07
    point[1, 2, 0] = np.nan
    nearest = block.project_exact(point)
    assert nearest.point.shape == (2, 3, 3) and nearest.face.shape == nearest.distance.shape == (2, 3)
    assert nearest.face[1, 2] == -1 and np.isnan(nearest.point[1, 2]).all()
    assert nearest.point[0] == pytest.approx(np.tile([0.06, 0, 0], (3, 1)), abs=1e-15)
    assert nearest.normal[0] == pytest.approx(np.tile([-1, 0, 0], (3, 1)), abs=1e-15)
    one = block.project_exact([0.07, 0.0, 0.0])
    assert one.point.shape == (3,) and one.face.shape == () and one.distance == pytest.approx(0.01)
    assert block.project_exact(np.zeros((0, 3))).point.shape == (0, 3)
    with pytest.raises(ValueError, match="shape"):
        block.project_exact([1.0, 2.0])


# Meshes, inside jit ------------------------------------------------------------------------------------------------


def test_projected_points_lie_on_the_mesh(mug):
    """Half a cell to either side; away from edges within a tenth of a cell, near them within a third."""
    cell = float(mug.grid.spacing)
    point, normal = mug.sample(1, 2000)
    point = point + np.random.default_rng(1).uniform(-0.5, 0.5, (2000, 1)) * cell * normal
    x, n, distance, edge = (np.asarray(a) for a in everything(mug, point))
    exact = mug.project_exact(x)
    away = edge > 2 * cell
    assert away.mean() > 0.7
    assert exact.distance[away].max() < 0.1 * cell and exact.distance.max() < 0.35 * cell
    assert np.median(exact.distance) < 5e-4 * float(mug.radius)
    angle = np.degrees(np.arccos(np.clip(np.sum(n * exact.smooth_normal, axis=1), -1, 1)))
    assert np.quantile(angle[away], 0.99) < 3 and np.median(angle) < 0.5
    assert np.abs(everything(mug, x)[2]).max() < 1e-5
    assert np.abs(np.abs(distance) - mug.project_exact(point).distance).max() < 0.35 * cell


def test_a_faceted_ball_has_the_normals_and_curvature_of_a_ball(ball):
    point, _ = ball.sample(2, 500)
    x, n, _, edge = (np.asarray(a) for a in everything(ball, point))
    radial = -x / np.linalg.norm(x, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(np.sum(n * radial, axis=1), -1, 1)))
    assert angle.max() < 0.2  # the facets' own are off by 2.7 degrees
    curvature, _ = bends(ball, point)
    assert np.median(curvature) == pytest.approx(25, rel=0.01) and np.abs(curvature - 25).max() < 3
    assert np.isinf(edge).all() and ball.warnings == ()
    assert float(ball.radius) == pytest.approx(0.04, rel=1e-6)
    assert np.asarray(ball.centre) == pytest.approx([0, 0, 0], abs=1e-9)


def test_derivatives_of_a_mesh_are_those_of_differences(mug):
    cell = float(mug.grid.spacing)
    point, normal = mug.sample(5, 12)
    point = point - 0.3 * cell * normal
    dx, dn = slopes(mug, point)
    value = everything(mug, point)
    for i in range(len(point)):

        def near(p, which):
            return everything(mug, p[None])[which][0]

        for slope, which, unit in ((dx, 0, 1.0), (dn, 1, 1 / cell)):
            wanted = differences(lambda p, which=which: near(p, which), point[i], 1e-8)
            assert np.abs(slope[i] - wanted).max() < 1e-5 * unit, (i, which)
    x = np.asarray(value[0])
    dx, _ = slopes(mug, x)
    _, surface_normal = bends(mug, x)
    surface_normal /= np.linalg.norm(surface_normal, axis=1, keepdims=True)
    wanted = np.eye(3) - surface_normal[:, :, None] * surface_normal[:, None]
    assert np.abs(dx - wanted).max() < 1e-6


def test_edges_of_a_box(block):
    """Known distances to the nearest edge, and the centre, radius and sign of a box."""
    cell = float(block.grid.spacing)
    point = np.array([[0.06, 0.0, 0.0], [0.06, 0.03, 0.0], [0.02, 0.01, 0.03], [-0.05, -0.04, 0.01]])
    distance = everything(block, point)[3]
    assert distance == pytest.approx([0.03, 0.01, 0.03, 0.01], abs=0.1 * cell)
    assert float(block.radius) == pytest.approx(np.linalg.norm([0.06, 0.04, 0.03]), rel=1e-6)
    assert everything(block, [[0.0, 0, 0], [0.08, 0, 0], [1.0, 0, 0]])[2] == pytest.approx(
        [-0.03, 0.02, 0.94], abs=0.2 * cell
    )
    slope = jax.grad(block.edge_distance)(jnp.asarray([0.06, 0.03, 0.0]))
    assert slope == pytest.approx([0, -1, 0], abs=1e-2)


def winding(corner, point):
    """Solid angle of all triangles over 4 pi (van Oosterom, Strackee 1983): 1 inside, 0 outside."""
    a, b, c = np.moveaxis(corner[None] - point[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    top = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    bottom = la * lb * lc + sum(
        np.einsum("pfi,pfi->pf", u, v) * w for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb))
    )
    return np.arctan2(top, bottom).sum(axis=1) / (2 * np.pi)


def test_the_sign_is_the_winding_numbers(mug):
    random = np.random.default_rng(3)
    low, high = mug.triangles.vertices.min(axis=0), mug.triangles.vertices.max(axis=0)
    point = random.uniform(low - 0.003, high + 0.003, (150, 3)) + mug.triangles.middle
    distance = everything(mug, point)[2]
    sure = np.abs(distance) > 0.1 * float(mug.grid.spacing)
    inside = winding(mug.triangles.corner + mug.triangles.middle, point) > 0.5
    assert np.array_equal(distance[sure] < 0, inside[sure]) and inside[sure].sum() > 10


def test_mesh_samples_are_uniform_and_repeat(mug):
    point, normal = mug.sample(7, 40_000)
    assert mug.project_exact(point[:500]).distance.max() < 1e-15
    products = normal[:, :, None] * (point - np.asarray(mug.centre))[:, None]
    mean, spread = products.mean(axis=0), products.std(axis=0) / 200
    wanted = -objects.make_object("mug").volume / objects.make_object("mug").area * np.eye(3)
    assert np.all(np.abs(mean - wanted) < 5 * spread)
    assert mug.sample(7, 40_000)[0].tobytes() == point.tobytes()
    assert mug.sample(7, 0)[0].shape == (0, 3)


def test_the_same_mesh_gives_the_same_bytes(block):
    again = surfaces.of("box", resolution=40)
    assert np.asarray(again.grid.coefficients).tobytes() == np.asarray(block.grid.coefficients).tobytes()


def test_points_far_outside_and_without_numbers(block):
    point = np.array([[1.0, 0.3, 0.2], [np.nan, 0, 0], [0.0, 0.0, 0.0], [0.06, 0.01, 0.0]])
    x, n, distance, edge = everything(block, point)
    for value in (x, n, distance, edge):
        assert np.isfinite(value[::2]).all() and np.isnan(value[1]).all() and np.isfinite(value[3]).all()
    assert np.abs(everything(block, x)[2][3]) < 1e-12
    dx, dn = slopes(block, point)
    assert np.isfinite(dx).all() and np.isfinite(dn).all()


def test_an_open_mesh_warns_and_its_rim_is_sharp():
    mesh = objects.make_object("sphere")
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.02)
    surface = surfaces.MeshSurface(mesh, resolution=40)
    assert any("not watertight" in w for w in surface.warnings)
    rim = surface.triangles.sharp.reshape(-1, 3) + surface.triangles.middle
    assert len(rim) and np.abs(rim[:, 2] - 0.02).max() < 0.004
    x, n, distance, edge = everything(surface, [[0.05, 0.0, 0.0], [0.0, 0.0, -0.05], [0.0, 0.0, -0.035]])
    assert np.asarray(x) == pytest.approx(np.array([[0.04, 0, 0], [0, 0, -0.04], [0, 0, -0.04]]), abs=1e-4)
    assert np.asarray(n)[0] == pytest.approx([-1, 0, 0], abs=0.02) and edge[0] == pytest.approx(
        0.0204, abs=3e-3
    )
    assert np.asarray(distance) == pytest.approx([0.01, 0.01, -0.005], abs=3e-4)


def test_meshes_that_are_no_surface():
    box = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)

    def surface(vertices, faces, **options):
        return surfaces.MeshSurface(trimesh.Trimesh(vertices, faces, process=False), resolution=16, **options)

    with pytest.raises(UserError, match="no faces"):
        surface(vertices, np.zeros((0, 3), int))
    with pytest.raises(UserError, match="NaN"):
        surface(np.where(vertices == vertices[0], np.nan, vertices), faces)
    with pytest.raises(UserError, match="zero area"):
        surface(vertices * [1, 0, 0], faces)
    with pytest.raises(UserError, match="flat"):
        surface(vertices * [1, 1, 0], faces)
    with pytest.raises(UserError, match="inwards"):
        surface(vertices, faces[:, ::-1])
    with pytest.raises(UserError, match=r"too thin for the grid.*resolution above 16"):
        surface(vertices * [1, 1, 0.01], faces)
    with pytest.raises(ValueError, match="resolution must be"):
        surfaces.MeshSurface(box, resolution=8)
    with pytest.raises(ValueError, match="crease must be"):
        surface(vertices, faces, crease=0.0)
    with pytest.raises(ValueError, match="centre must be"):
        surface(vertices, faces, centre=[0.0, 0.0])


def test_surfaces_of_names_files_and_bodies(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box(extents=(100, 80, 60)).export(path)
    surface = surfaces.of(path, unit="mm", com=(0, 0, 0.01), resolution=24)
    assert float(surface.radius) == pytest.approx(np.linalg.norm([0.05, 0.04, 0.04]), rel=1e-6)
    assert np.asarray(surface.centre) == pytest.approx([0, 0, 0.01])
    body = objects.load_mesh(path, unit="mm")
    assert np.asarray(surfaces.of(body, resolution=24).centre) == pytest.approx([0, 0, 0], abs=1e-9)
    with pytest.raises(ValueError, match="a Body has its unit"):
        surfaces.of(body, unit="mm")
    with pytest.raises(UserError, match="no such file"):
        surfaces.of(tmp_path / "none.stl")


# Real meshes -------------------------------------------------------------------------------------------------------


@pytest.mark.slow("test_exact_at_metre_scale")
@pytest.mark.realdata
@pytest.mark.parametrize(
    ("file", "unit"),
    [
        ("ycb/011_banana.obj.gz", "m"),
        ("ycb/048_hammer.obj.gz", "m"),
        ("models/bunny.ply", "m"),
        ("robosuite/can.stl", "m"),
    ],
)
def test_real_meshes(file, unit):
    surface = surfaces.of(real_meshes() / file, unit=unit)
    cell, size = float(surface.grid.spacing), float(surface.radius)
    point, _ = surface.sample(0, 5000)
    point = point + np.random.default_rng(0).normal(0, 0.3 * cell, point.shape)
    x, n, _, edge = (np.asarray(a) for a in everything(surface, point))
    exact = surface.project_exact(x)
    away = edge > 2 * cell
    assert exact.distance[away].max() < 3e-3 * size and np.median(exact.distance) < 3e-4 * size
    angle = np.degrees(np.arccos(np.clip(np.sum(n * exact.smooth_normal, axis=1), -1, 1)))
    assert np.median(angle[away]) < 1 and np.quantile(angle[away], 0.99) < 6
    some = np.random.default_rng(1).choice(len(point), 20, replace=False)
    corner = surface.triangles.corner
    for i in some:
        repeated = np.broadcast_to(point[i] - surface.triangles.middle, (len(corner), 3))
        wanted = np.sqrt(point_triangle(repeated, corner)[0].min())
        assert surface.project_exact(point[i]).distance == pytest.approx(wanted, abs=1e-9 * size)
