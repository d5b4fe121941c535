"""The guaranteed radius: never violated by random or gradient attacks, and not vacuous."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import ball

import jaxgrasp as jg
from jaxgrasp import Status

INSIDE = 0.999  # attacks stay a little inside the radius


def unit(x):
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-300)


def attacked(grasp, radius, length, move, turn, rub):
    """The grasp with p + r L move, n + r turn, mu (1 + r rub)."""
    r = np.asarray(radius)[:, None, None]
    normal = unit(np.asarray(grasp.normal))
    friction = np.asarray(grasp.model.friction_coefficient)
    model = grasp.model.with_coefficients(
        jnp.asarray(np.maximum(friction * (1 + r[..., 0] * rub), 0.0)), grasp.model.torsion_coefficient
    )
    position = np.asarray(grasp.position) + r * np.asarray(length)[:, None, None] * move
    return jg.Grasp(position, normal + r * turn, model)


def gradient_attack(grasp, status):
    """Unit changes of each contact along the margin's gradient, towards the other verdict."""

    def margin(position, normal, friction):
        model = grasp.model.with_coefficients(friction, grasp.model.torsion_coefficient)
        return jnp.sum(jg.wrench_resistance(jg.Grasp(position, normal, model)).margin)

    x = (grasp.position, jnp.asarray(unit(np.asarray(grasp.normal))), grasp.model.friction_coefficient)
    move, turn, rub = (np.asarray(g) for g in jax.grad(margin, argnums=(0, 1, 2))(*x))
    sign = np.where(status == Status.RESISTANT, -1.0, 1.0)[:, None]
    return sign[..., None] * unit(move), sign[..., None] * unit(turn), sign * np.sign(rub)


def nearest_violation(grasp, out):
    """How many radii out the gradient attack changes the verdict (infinite where it does not), one a grasp."""
    status, radius, length = np.asarray(out.status), np.asarray(out.radius), np.asarray(out.length)
    attack = gradient_attack(grasp, status)
    nearest = np.full(len(status), np.inf)
    for factor in (INSIDE, 1.5, 2, 3, 4, 5, 6, 8, 10, 15, 20, 40):
        now = np.asarray(jg.wrench_resistance(attacked(grasp, factor * radius, length, *attack)).status)
        nearest = np.where((now != status) & np.isinf(nearest), factor, nearest)
    return nearest


def check_random_attacks(grasp, rng, attacks):
    """The radius of each grasp, and which count, after random attacks just inside it."""
    out = jg.guaranteed_radius(grasp)
    status, radius, length = np.asarray(out.status), np.asarray(out.radius), np.asarray(out.length)
    counted = radius > 0
    assert counted.mean() > 0.8
    shape = grasp.position.shape
    for _ in range(attacks):
        move, turn = unit(rng.normal(size=shape)), unit(rng.normal(size=shape))
        rub = rng.choice([-1.0, 1.0], size=shape[:2])
        now = jg.wrench_resistance(attacked(grasp, INSIDE * radius, length, move, turn, rub)).status
        assert (np.asarray(now)[counted] == status[counted]).all()
    return out, counted


def check(grasp, rng, attacks):
    """Nor do attacks along the gradient, and the nearest that does is near: the radius is not vacuous."""
    out, counted = check_random_attacks(grasp, rng, attacks)
    nearest = nearest_violation(grasp, out)[counted]
    assert (nearest > INSIDE).all()
    assert np.median(nearest) <= 10
    return nearest


def planar(rng, count):
    """Three planar hard fingers."""
    angle = rng.uniform(0, 2 * np.pi, (count, 3))
    position = np.stack([np.cos(angle), np.sin(angle)], -1) * rng.uniform(0.3, 1, (count, 3, 1))
    return jg.Grasp(position, -position + 0.3 * rng.normal(size=position.shape), jg.HardFinger(0.5))


def test_no_random_attack_succeeds():
    rng = np.random.default_rng(0)
    position, normal, friction = ball(rng, 200, 4)
    check_random_attacks(jg.Grasp(position, normal, jg.HardFinger(friction)), rng, attacks=10)


@pytest.mark.slow("test_no_random_attack_succeeds")
@pytest.mark.parametrize("name", ["hard 3", "hard 4", "hard 6", "soft", "planar"])
def test_a_hundred_thousand_attacks(name):
    """25 000 for each kind."""
    rng = np.random.default_rng(1)
    if name == "planar":
        grasp = planar(rng, 500)
    else:
        k = {"hard 3": 3, "hard 4": 4, "hard 6": 6, "soft": 3}[name]
        position, normal, friction = ball(rng, 500, k)
        model = jg.SoftFinger(friction, 0.2) if name == "soft" else jg.HardFinger(friction)
        grasp = jg.Grasp(position, normal, model)
    nearest = check(grasp, rng, attacks=50)
    print(f"\n{name}: nearest violation {np.median(nearest):.1f} radii out in the median")


def test_nothing_is_guaranteed_where_the_verdict_rests_on_rank():
    """Two hard fingers, and two places left empty."""
    position = np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    two = np.array([True, True, False, False])
    out = jg.guaranteed_radius(jg.Grasp(position, -position, jg.HardFinger(0.5), two))
    assert int(out.status) == Status.NOT_RESISTANT
    assert float(out.radius) == 0
    broken = jg.guaranteed_radius(jg.Grasp(position * np.nan, -position, jg.HardFinger(0.5), two))
    assert np.isnan(float(broken.radius))


def test_units_do_not_matter():
    position, normal, friction = ball(np.random.default_rng(2), 16, 4)
    one = jg.guaranteed_radius(jg.Grasp(position, normal, jg.HardFinger(friction)))
    other = jg.guaranteed_radius(jg.Grasp(1e-3 * position, 5 * normal, jg.HardFinger(friction)))
    np.testing.assert_allclose(other.radius, one.radius, rtol=1e-6)
