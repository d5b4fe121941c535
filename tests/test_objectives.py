"""What placement climbs: epsilon from its weakest directions, and the bound that guides it there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.placement.objectives import Epsilon, EpsilonFloor, Margin, Measure, _floor, objective
from jaxgrasp.quality.boundary_along import facet_normal
from jaxgrasp.quality.unit_wrench_space import effort_map, signed_supports, torque_lengths

pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="compares to 1e-9")
SCALE = 0.07


def random_grasps(count, k, seed, model=None):
    """Contacts on a sphere of 5 cm with tilted normals; most of four hard fingers hold."""
    random = np.random.default_rng(seed)
    position = random.normal(size=(count, k, 3))
    position *= 0.05 / np.linalg.norm(position, axis=-1, keepdims=True)
    normal = -position + 0.015 * random.normal(size=position.shape)
    return jg.Grasp(position, normal, jg.HardFinger(0.6) if model is None else model)


@pytest.fixture(scope="module")
def grasps():
    return random_grasps(64, 4, 5)


def smallest_of_bank(grasp, norm, lessons):
    climbed = Epsilon(norm, SCALE)
    memory = climbed.begin(grasp)
    learn = jax.jit(climbed.learn)
    for _ in range(lessons):
        memory = learn(grasp, memory)
    return np.asarray(climbed.value(grasp, memory)), memory


@pytest.mark.parametrize("norm", ["L1", pytest.param("Linf", marks=pytest.mark.slow)])
def test_the_bank_finds_the_weakest_direction(grasps, norm):
    """h of any direction is at least epsilon; after a few lessons the bank's smallest is epsilon, nearly always."""
    found = jg.epsilon_quality(grasps, norm=norm, torque_scale=SCALE)
    held = np.asarray(found.status) == jg.Status.RESISTANT
    assert held.sum() > 20
    value, _ = smallest_of_bank(grasps, norm, 4)
    assert (value[held] >= np.asarray(found.lower)[held] * (1 - 1e-9)).all()
    assert np.mean(value[held] <= np.asarray(found.upper)[held] * 1.001) > 0.9
    refuted = np.asarray(found.status) == jg.Status.NOT_RESISTANT
    assert refuted.sum() > 5
    assert (value[refuted] < 0).all()


def test_a_shot_never_goes_uphill(grasps):
    random = np.random.default_rng(0).normal(size=(64, 4, 6))
    direction = jnp.asarray(random / np.linalg.norm(random, axis=-1, keepdims=True))
    length = torque_lengths(grasps, SCALE)
    A = effort_map(grasps, length)
    before = np.asarray(signed_supports(A, grasps.active, "L1", direction))
    normal = facet_normal(grasps, "L1", length, direction)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-12)
    after = np.asarray(signed_supports(A, grasps.active, "L1", normal))
    assert (after <= before * (1 + 1e-7) + 1e-12).all()
    assert np.mean(after < 0.9 * before) > 0.8


def test_the_floor_is_below_epsilon_and_ranks_like_it(grasps):
    floor = np.asarray(EpsilonFloor(SCALE).value(grasps, ()))
    found = jg.epsilon_quality(grasps, norm="L1", torque_scale=SCALE)
    held = np.asarray(found.status) == jg.Status.RESISTANT
    assert (floor[held] <= np.asarray(found.upper)[held]).all()
    assert (floor[held] > 0).all()
    margin = np.asarray(jg.wrench_resistance(grasps).margin)
    np.testing.assert_array_equal(floor[margin <= 0], np.maximum(margin[margin <= 0], -10.0))
    ranks = [np.argsort(np.argsort(x[held])) for x in (floor, np.asarray(found.upper))]
    assert np.corrcoef(ranks)[0, 1] > 0.85


def test_derivatives_of_the_floor_are_those_of_differences(grasps):
    """By positions and by the margin, whose own derivative is tested elsewhere; smooth, so to rounding."""
    held = np.flatnonzero(np.asarray(jg.wrench_resistance(grasps).margin) > 0.05)[:8]
    grasp, random = grasps[held], np.random.default_rng(1)
    margin = jg.wrench_resistance(grasp).margin
    move, rise = jnp.asarray(random.normal(size=grasp.position.shape)), jnp.asarray(random.normal(size=8))
    length = torque_lengths(grasp, SCALE)

    def value(s):
        moved = jg.Grasp(grasp.position + s * move, grasp.normal, grasp.model)
        return _floor(moved, length, margin + s * rise)

    _, slope = jax.jvp(value, (jnp.zeros(()),), (jnp.ones(()),))
    h = 1e-4
    wanted = (8 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12 * h)
    np.testing.assert_allclose(slope, wanted, rtol=1e-7)


def test_the_bank_gives_a_mean_of_slopes_but_its_smallest_value(grasps):
    held = np.flatnonzero(np.asarray(jg.wrench_resistance(grasps).margin) > 0.05)
    _, memory = smallest_of_bank(grasps, "L1", 2)
    grasp, memory = grasps[held], jax.tree.map(lambda x: x[held], memory)
    climbed = Epsilon("L1", SCALE)
    h = np.asarray(
        signed_supports(effort_map(grasp, torque_lengths(grasp, SCALE)), grasp.active, "L1", memory.direction)
    )
    least = np.min(h[:, : int(memory.seen[0])], axis=1)
    np.testing.assert_allclose(climbed.value(grasp, memory), least, rtol=1e-12)
    # A small step along the gradient raises what was weakest.
    slope = jax.grad(lambda p: jnp.sum(climbed.value(jg.Grasp(p, grasp.normal, grasp.model), memory)))(
        grasp.position
    )
    size = np.linalg.norm(slope, axis=(1, 2), keepdims=True)
    moved = jg.Grasp(grasp.position + 1e-6 * slope / size, grasp.normal, grasp.model)
    assert np.mean(np.asarray(climbed.value(moved, memory)) > least) > 0.9


def test_what_may_be_an_objective():
    assert isinstance(objective(lambda grasp: grasp.position[:, 0, 0]), Measure)
    assert isinstance(objective(Margin()), Margin)
    assert isinstance(Epsilon("Linf", 0.1).guide(), EpsilonFloor) and isinstance(
        objective(len).guide(), Margin
    )
    for wrong in (3, "margin", Margin):
        with pytest.raises(ValueError, match=r"objective must be a jaxgrasp\.placement\.Objective"):
            objective(wrong)
    with pytest.raises(ValueError, match="norm must be one of L1, Linf"):
        Epsilon("L2")
