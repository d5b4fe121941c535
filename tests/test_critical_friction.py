"""Critical friction: Nguyen's planar fingers, symmetric families, Clarabel's bisection, derivatives, proofs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clarabel_oracle import clarabel_margin
from grasps import ball

import jaxgrasp as jg
from jaxgrasp import Status


def planar_pair(angle_1, angle_2, mu):
    """Two fingers at (-1, 0) and (1, 0) whose normals are turned from the line between them."""
    position = np.zeros((*angle_1.shape, 2, 2))
    position[..., 0, 0], position[..., 1, 0] = -1.0, 1.0
    first = np.stack([np.cos(angle_1), np.sin(angle_1)], -1)
    second = np.stack([-np.cos(angle_2), np.sin(angle_2)], -1)
    return jg.Grasp(position, np.stack([first, second], -2), jg.HardFinger(mu))


def test_two_planar_fingers_need_the_tangent_of_the_larger_angle():
    angle = np.linspace(0.05, 1.5, 24)
    for mu in (0.5, 2.0):
        out = jg.critical_friction(planar_pair(angle, -0.3 * angle, mu))
        np.testing.assert_allclose(out.factor, np.tan(angle) / mu, rtol=1e-6)
        assert (np.asarray(out.upper) / np.asarray(out.lower) <= 1 + 1e-6).all()


def test_both_ends_carry_their_verdicts():
    angle = np.linspace(0.05, 1.5, 24)
    grasp = planar_pair(angle, -0.3 * angle, 0.5)
    out = jg.critical_friction(grasp)
    for factor, status in ((out.lower, Status.NOT_RESISTANT), (out.upper, Status.RESISTANT)):
        ends = jg.quality.with_friction_factor(grasp, factor)
        verdict = jg.wrench_resistance(ends)
        assert jg.check(ends, verdict).all()
        assert (np.asarray(verdict.status) == status).mean() > 0.9
        assert not (np.asarray(verdict.status) == (3 - status)).any()  # never the other one


def test_no_friction_at_all_and_never_enough():
    """Three planar fingers at 120 degrees hold with any friction; two with parallel normals with none."""
    angle = np.radians([90.0, 210.0, 330.0])
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    assert float(jg.critical_friction(jg.Grasp(ring, -ring, jg.HardFinger(0.3))).factor) == 0
    shelf = np.array([[-1.0, 0.0], [1.0, 0.0]])
    up = np.array([[0.0, 1.0], [0.0, 1.0]])
    assert np.isinf(float(jg.critical_friction(jg.Grasp(shelf, up, jg.HardFinger(0.3))).factor))
    smooth = jg.Grasp(shelf, np.array([[1.0, 0.1], [-1.0, 0.1]]), jg.HardFinger(0.0))
    assert np.isinf(float(jg.critical_friction(smooth).factor))
    broken = jg.Grasp(shelf * np.nan, up, jg.HardFinger(0.3))
    assert np.isnan(float(jg.critical_friction(broken).factor))


def test_derivatives_of_the_planar_pair():
    """alpha = tan(theta) / mu: d/dtheta = (1 + tan^2) / mu, d/dmu = -tan / mu^2, and their second derivatives."""

    def factor(x):
        theta, mu = x
        normal = jnp.stack([jnp.stack([jnp.cos(theta), jnp.sin(theta)]), jnp.array([-1.0, 0.0])])
        grasp = jg.Grasp(jnp.array([[-1.0, 0.0], [1.0, 0.0]]), normal, jg.HardFinger(mu))
        return jg.critical_friction(grasp).factor

    x = jnp.array([0.6, 0.5])
    t, mu = np.tan(0.6), 0.5
    np.testing.assert_allclose(jax.grad(factor)(x), [(1 + t * t) / mu, -t / mu**2], rtol=1e-6)


def test_a_sweep_of_factors():
    angle = np.linspace(0.1, 1.2, 6)
    grasp = planar_pair(angle, 0.0 * angle, 0.5)
    factors = np.array([0.1, 1.0, 2.0, 8.0])
    out = jg.quality.friction_sweep(grasp, factors)
    assert out.status.shape == (6, 4)
    expected = np.tan(angle)[:, None] / 0.5 < factors
    np.testing.assert_array_equal(np.asarray(out.status) == Status.RESISTANT, expected)
    with pytest.raises(ValueError, match="factors must be a list of numbers"):
        jg.quality.friction_sweep(grasp, factors[None])


def test_spatial_grasps_against_bisection_with_clarabel():
    position, normal, friction = ball(np.random.default_rng(8), 500, 4)
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    out = jg.critical_friction(grasp)
    factor = np.asarray(out.factor)
    inside = np.flatnonzero(np.isfinite(factor) & (factor > 0))
    assert len(inside) > 450
    names, active = ["f_x", "f_y", "f_n"], np.ones(4, bool)
    for i in inside:
        for share, sign in ((1 - 1e-5, -1), (1 + 1e-5, 1)):
            mu = share * factor[i] * friction[i]
            margin, _ = clarabel_margin(position[i], normal[i], mu, np.zeros(4), active, names)
            assert sign * margin > -1e-8, (i, share, margin)


@pytest.mark.slow("test_derivatives_of_the_planar_pair")
def test_spatial_derivatives_against_differences():
    position, normal, friction = ball(np.random.default_rng(9), 24, 4)

    def factor(position, normal, friction):
        return jg.critical_friction(jg.Grasp(position, normal, jg.HardFinger(friction))).factor

    x = (position, normal, friction)
    gradient = jax.grad(lambda *a: jnp.sum(factor(*a)), argnums=(0, 1, 2))(*x)
    rng, h = np.random.default_rng(10), 4e-3
    close = []
    for w in range(3):
        d = rng.normal(size=x[w].shape)
        a, b, c, e = (
            np.asarray(factor(*[y + t * h * d if i == w else y for i, y in enumerate(x)]))
            for t in (-2, -1, 1, 2)
        )
        difference = (8 * (c - b) - (e - a)) / (12 * h)
        slope = np.sum(np.asarray(gradient[w]) * d, axis=tuple(range(1, d.ndim)))
        # The factor itself is known to 5e-7, which differences divide by their step; kinks lie where contacts swap.
        close.append(np.abs(slope - difference) < 1e-3 * (1 + np.abs(difference)))
    assert np.mean(close) > 0.9
