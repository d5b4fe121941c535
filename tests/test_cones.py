"""Second-order cone algebra against dense matrices."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgrasp.conic import cone as cones
from jaxgrasp.conic.nesterov_todd import nesterov_todd

K, LANES = 3, 40
DIMENSIONS = [1, 2, 3, 4]


def interior(rng, d, depth=1.0):
    """Cone vectors (d, K, LANES) strictly inside, some of them close to the boundary."""
    tail = rng.normal(size=(d - 1, K, LANES))
    distance = depth * 10.0 ** rng.uniform(-6, 1, (K, LANES))
    return np.concatenate([np.linalg.norm(tail, axis=0, keepdims=True) + distance, tail])


def cone(x):
    return tuple(jnp.asarray(part) for part in x)


def dense(parts):
    """(d, K, LANES) of a cone tuple."""
    return np.stack([np.asarray(p) for p in parts])


def arrow(x):
    """The matrix of ``y -> x o y``."""
    d = len(x)
    matrix = x[0] * np.eye(d)
    matrix[0, 1:] = matrix[1:, 0] = x[1:]
    return matrix


def each():
    return [(i, j) for i in range(K) for j in range(LANES)]


@pytest.mark.parametrize("d", DIMENSIONS)
def test_inner_determinant_and_distance(d):
    rng = np.random.default_rng(d)
    x, y = rng.normal(size=(2, d, K, LANES))
    np.testing.assert_allclose(cones.inner(cone(x), cone(y)), np.sum(x * y, 0), rtol=1e-12, atol=1e-12)
    norm = np.linalg.norm(x[1:], axis=0)
    np.testing.assert_allclose(cones.tail_norm(cone(x)), norm, rtol=1e-14)
    np.testing.assert_allclose(cones.interior_distance(cone(x)), x[0] - norm, atol=1e-14)
    np.testing.assert_allclose(cones.determinant(cone(x)), x[0] ** 2 - norm**2, rtol=1e-12, atol=1e-13)


def test_the_determinant_keeps_its_digits_near_the_boundary():
    tail, distance = np.array([3.0, 4.0]), 2.0**-40
    x = cone(np.array([5.0 + distance, *tail])[:, None, None])
    np.testing.assert_allclose(cones.determinant(x)[0, 0], distance * (10 + distance), rtol=1e-14)


def test_reductions_over_cones():
    x = np.random.default_rng(0).normal(size=(K, LANES))
    np.testing.assert_allclose(cones.cone_sum(jnp.asarray(x)), x.sum(0), rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(cones.cone_max(jnp.asarray(x)), x.max(0))
    np.testing.assert_array_equal(cones.cone_min(jnp.asarray(x)), x.min(0))


@pytest.mark.parametrize("d", DIMENSIONS)
def test_jordan_product_is_the_arrow_matrix(d):
    rng = np.random.default_rng(d)
    x, y = rng.normal(size=(2, d, K, LANES))
    product = dense(cones.jordan_product(cone(x), cone(y)))
    for i, j in each():
        np.testing.assert_allclose(product[:, i, j], arrow(x[:, i, j]) @ y[:, i, j], rtol=1e-12, atol=1e-13)


def scaling_matrices(scaling, d):
    """W of every cone as a dense matrix, column by column."""
    columns = []
    for i in range(d):
        unit = np.zeros((d, K, LANES))
        unit[i] = 1.0
        columns.append(dense(scaling.apply(cone(unit))))
    return np.moveaxis(np.stack(columns, 1), (0, 1), (-2, -1))  # (K, LANES, d, d)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_nesterov_todd_scaling_maps_z_and_u_to_one_point(d):
    """W z = W^-1 u; W symmetric; det W = (det u / det z)^(d/4): W stretches each cone as a whole."""
    rng = np.random.default_rng(10 + d)
    u, z = interior(rng, d), interior(rng, d)
    scaling = nesterov_todd(cone(u), cone(z))
    W = scaling_matrices(scaling, d)
    determinants = [dense([cones.determinant(cone(x))])[0] for x in (u, z)]
    for i, j in each():
        w, size = W[i, j], np.linalg.norm(W[i, j])
        np.testing.assert_allclose(w, w.T, atol=1e-10 * size)
        lam = w @ z[:, i, j]
        np.testing.assert_allclose(w @ lam, u[:, i, j], rtol=1e-7, atol=1e-8 * np.linalg.norm(u[:, i, j]))
        expected = (determinants[0][i, j] / determinants[1][i, j]) ** (d / 4)
        np.testing.assert_allclose(np.linalg.det(w), expected, rtol=1e-5)
        assert lam[0] > np.linalg.norm(lam[1:])
        lengths = determinants[0][i, j] * determinants[1][i, j]
        np.testing.assert_allclose(scaling.root[i, j], lengths**-0.25, rtol=1e-7)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_scaling_maps_the_cone_onto_itself(d):
    rng = np.random.default_rng(20 + d)
    scaling = nesterov_todd(cone(interior(rng, d)), cone(interior(rng, d)))
    tail = rng.normal(size=(d - 1, K, LANES))
    boundary = np.concatenate([np.linalg.norm(tail, axis=0, keepdims=True), tail])
    image = dense(scaling.apply(cone(boundary)))
    size = np.maximum(np.linalg.norm(image, axis=0), 1e-300)
    assert (np.abs(image[0] - np.linalg.norm(image[1:], axis=0)) <= 1e-7 * size).all()
    assert (image[0] >= 0).all()


def steps_to_the_boundary(x, direction):
    """Longest t with x + t direction in the cone, by bisection on the definition."""

    def inside(t):
        y = x + t * direction
        return y[0] >= np.linalg.norm(y[1:])

    low, high = 0.0, 1e9
    if inside(high):
        return np.inf
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if inside(middle) else (low, middle)
    return low


@pytest.mark.parametrize("d", DIMENSIONS)
def test_step_reach_against_bisection(d):
    """The step 1 / max(reach, 0) from lambda = W z ends on the boundary."""
    rng = np.random.default_rng(30 + d)
    scaling = nesterov_todd(cone(interior(rng, d, 10.0)), cone(interior(rng, d, 10.0)))
    lam = scaling.apply(cone(np.zeros((d, K, LANES)) + np.eye(d)[0][:, None, None]))
    lam = nesterov_todd(lam, lam).apply(lam)  # any interior point serves as lambda of its own scaling
    scaling = nesterov_todd(lam, lam)
    direction = rng.normal(size=(d, K, LANES)) * dense(lam)[0]
    reach = np.asarray(scaling.step_reach(lam, cone(direction)))
    point = dense(lam)
    for i, j in each():
        expected = steps_to_the_boundary(point[:, i, j], direction[:, i, j])
        if np.isinf(expected):
            assert reach[i, j] <= 1e-6
        else:
            np.testing.assert_allclose(1 / reach[i, j], expected, rtol=1e-6)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_the_automorphism_sends_its_point_to_the_identity(d):
    rng = np.random.default_rng(40 + d)
    lam = cone(interior(rng, d, 10.0))
    image = dense(nesterov_todd(lam, lam).to_identity(lam, lam))
    expected = np.zeros((d, K, LANES))
    expected[0] = 1.0
    np.testing.assert_allclose(image, expected, atol=1e-8)
