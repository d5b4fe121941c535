"""What several rooms rely on, said in one place: tables of codes, values on lanes, what a grasp is, stages."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.backend import is_traced, stage, xla
from jaxgrasp.certificates.rebuilt import rebuild
from jaxgrasp.contacts import contacts_of, fold, is_grasp
from jaxgrasp.core import first_of, largest_of, least_of, spread


def test_the_first_condition_that_holds_gives_the_code():
    a, b = jnp.array([True, False, False, True]), jnp.array([True, True, False, False])
    table = [(a, jg.Status.RESISTANT), (b, jg.Status.MARGINAL)]
    codes = first_of(table, jg.Status.UNDECIDED)
    assert codes.dtype == jnp.int32
    assert codes.tolist() == [1, 3, 4, 1]
    assert first_of(table, jnp.array([7, 7, 8, 7], jnp.int32)).tolist() == [1, 3, 8, 1]


@pytest.mark.parametrize(("pick", "sign"), [(largest_of, 1.0), (least_of, -1.0)])
def test_the_derivative_of_the_largest_is_that_of_one(pick, sign):
    x = sign * jnp.array([[1.0, 3.0, 2.0], [4.0, 4.0, -jnp.inf], [jnp.inf, 0.0, 1.0]])
    value, slope = pick(x), jax.vmap(jax.grad(pick))(x)
    np.testing.assert_array_equal(value, sign * np.array([3.0, 4.0, np.inf]))
    np.testing.assert_array_equal(slope, [[0, 1, 0], [1, 0, 0], [1, 0, 0]])
    found, change = jax.jvp(pick, (x[0],), (jnp.array([5.0, 7.0, jnp.inf]),))
    assert (found, change) == (sign * 3.0, 7.0)


def test_a_value_is_spread_over_grasps_and_loads():
    assert spread(jnp.asarray(2.0), (3,), (4,), "mu").shape == (4, 3)
    one_each = spread(jnp.arange(4.0), (), (4,), "weight", loads=(5,))
    np.testing.assert_array_equal(one_each, np.arange(4.0)[:, None] * np.ones(5))
    full = spread(jnp.arange(3.0), (3,), (4,), "cap", loads=(5, 2))
    assert full.shape == (4, 5, 2, 3)
    np.testing.assert_array_equal(full[1, 2, 0], np.arange(3.0))
    with pytest.raises(ValueError, match=r"cap must broadcast to shape \(4, 3\), got \(2,\)"):
        spread(jnp.ones(2), (3,), (4,), "cap")


@pytest.mark.parametrize("dimension", [2, 3])
def test_solver_and_checker_call_the_same_numbers_a_grasp(dimension):
    rng = np.random.default_rng(dimension)
    lanes, k = 64, 3
    position, normal = rng.normal(size=(2, lanes, k, dimension))
    friction, active = rng.uniform(0.1, 1, size=(lanes, k)), rng.random((lanes, k)) < 0.7
    for lane, bad in enumerate((np.nan, np.inf, -np.inf) * 4):
        position[lane, lane % k, 0] = bad
        friction[12 + lane, lane % k] = (np.nan, np.inf, -1.0)[lane % 3]
        normal[24 + lane, lane % k] = (0.0, np.nan, np.inf)[lane % 3]
    active[40] = False
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction), active)
    ours = np.asarray(is_grasp(grasp))
    folded = fold(contacts_of(grasp), grasp.model.components(dimension))
    np.testing.assert_array_equal(ours, folded.valid)
    np.testing.assert_array_equal(ours, rebuild(grasp).valid)
    assert 10 < ours.sum() < lanes - 10


def test_values_that_are_not_known_yet_are_traced():
    assert not is_traced((1.0, jnp.ones(3)))
    jax.make_jaxpr(lambda x: x if is_traced({"a": (1.0, x)}) else 1 / 0)(1.0)


def test_without_the_attributes_a_stage_is_a_function_behind_a_barrier(monkeypatch):
    double = stage(lambda x: 2 * x)
    assert xla._attributes_known()  # this JAX knows them
    assert "inlineable" in jax.jit(double).lower(1.0).as_text()
    monkeypatch.setitem(sys.modules, "jax.experimental.xla_metadata", None)
    xla._attributes_known.cache_clear()
    try:
        assert not xla._attributes_known()
        text = str(jax.make_jaxpr(lambda x: double(x))(1.0))
        assert "optimization_barrier" in text
        assert double(3.0) == 6.0
    finally:
        monkeypatch.undo()
        xla._attributes_known.cache_clear()
    assert xla._attributes_known()
