"""Cross products, frames and units of jaxgrasp.geometry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgrasp.core.geometry import contact_frame, cross, normalize, skew, wrench_dimension


def tolerance(dtype):
    return 1e-12 if dtype == "float64" else 2e-5


def directions(rng, count, dimension, dtype):
    """Random unit vectors and the ones where frames are delicate: axes, nearly axes, the plane n_z = 0."""
    v = rng.normal(size=(count, dimension))
    axes = np.concatenate([np.eye(dimension), -np.eye(dimension)])
    near = axes + 1e-7 * rng.normal(size=axes.shape)
    flat = rng.normal(size=(4, dimension)) * np.array([1, 1, 0])[:dimension]
    v = np.concatenate([v, axes, near, flat])
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(dtype)


def test_wrench_dimension():
    assert wrench_dimension(2) == 3
    assert wrench_dimension(3) == 6


def test_skew_is_the_matrix_of_the_cross_product(dtype):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 5, 4, 3)).astype(dtype)
    S = skew(jnp.asarray(a))
    assert S.shape == (5, 4, 3, 3)
    assert S.dtype == jnp.dtype(dtype)
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", S, b), np.cross(a, b), atol=tolerance(dtype))
    np.testing.assert_array_equal(S, -np.swapaxes(S, -1, -2))
    np.testing.assert_array_equal(skew(jnp.asarray([1.0, 2.0, 3.0])), [[0, -3, 2], [3, 0, -1], [-2, 1, 0]])


def test_cross_in_space_and_in_the_plane(dtype):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 7, 3)).astype(dtype)
    np.testing.assert_allclose(cross(jnp.asarray(a), jnp.asarray(b)), np.cross(a, b), atol=tolerance(dtype))
    planar = cross(jnp.asarray([2.0, 3.0]), jnp.asarray([5.0, 7.0]))
    np.testing.assert_array_equal(planar, [2 * 7 - 3 * 5])


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e30])
def test_normalize_neither_overflows_nor_underflows(dtype, scale):
    v = jnp.asarray(np.array([3.0, 0.0, 4.0]) * scale, dtype)
    np.testing.assert_allclose(normalize(v), [0.6, 0.0, 0.8], atol=tolerance(dtype))
    assert normalize(v).dtype == jnp.dtype(dtype)


def test_normalize_marks_vectors_without_direction():
    v = jnp.asarray([[0.0, 0.0, 0.0], [jnp.nan, 0.0, 1.0], [jnp.inf, 0.0, 1.0], [0.0, 0.0, 2.0]])
    result = np.asarray(normalize(v))
    assert np.isnan(result[:3]).any(-1).all()
    np.testing.assert_array_equal(result[3], [0, 0, 1])


def test_spatial_frame_is_right_handed_and_orthonormal(dtype):
    n = directions(np.random.default_rng(2), 200, 3, dtype)
    first, second = (np.asarray(t) for t in contact_frame(jnp.asarray(n)))
    frame = np.stack([first, second, n], axis=-1)
    np.testing.assert_allclose(
        np.swapaxes(frame, -1, -2) @ frame, np.broadcast_to(np.eye(3), frame.shape), atol=1e-6
    )
    np.testing.assert_allclose(np.cross(first, second), n, atol=tolerance(dtype))


def test_planar_frame_turns_the_tangent_onto_the_normal(dtype):
    n = directions(np.random.default_rng(3), 50, 2, dtype)
    (tangent,) = contact_frame(jnp.asarray(n))
    np.testing.assert_allclose(cross(tangent, jnp.asarray(n))[..., 0], 1.0, atol=tolerance(dtype))
    np.testing.assert_allclose(np.sum(np.asarray(tangent) * n, -1), 0.0, atol=tolerance(dtype))


def test_jit_and_vmap_agree_with_the_batch(dtype):
    n = jnp.asarray(directions(np.random.default_rng(4), 20, 3, dtype))
    p = jnp.roll(n, 1, axis=0)
    for one, batch in (
        (lambda a, b: jnp.stack(contact_frame(a), -2), jnp.stack(contact_frame(n), -2)),
        (cross, cross(n, p)),
        (lambda a, b: skew(a), skew(n)),
        (lambda a, b: normalize(a + b), normalize(n + p)),
    ):
        np.testing.assert_allclose(jax.jit(jax.vmap(one))(n, p), batch, atol=tolerance(dtype))
