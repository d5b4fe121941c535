"""Derivatives of margins, costs and forces: a table of quantities and transformations, against central differences.

Every input is moved by itself. Where the solver says ``smooth``, every lane must agree to 1e-6; elsewhere it must be
finite. Solutions are asked for at a gap of 1e-12, which the solver serves as far as its floor.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smooth_problems import (
    as_arrays,
    direction,
    grasp_of,
    hard_problem,
    moved,
    only,
    planar_problem,
    soft_problem,
)

import jaxgrasp as jg
from jaxgrasp import Status

STEP = 2e-4  # of the central differences of fourth order; no lane below has a kink that near


def margin(x):
    out = jg.wrench_resistance(grasp_of(x), tolerance=1e-12)
    fine = jnp.isfinite(out.margin)
    return {"value": out.margin, "internal": out.internal_force}, fine, fine


def optimum(make, smoothing=0.0):
    def run(x):
        limits = (x["jacobian"], x["torque"]) if "jacobian" in x else None
        out = jg.optimize_forces(
            grasp_of(x),
            x["wrench"],
            criterion=make(x),
            max_normal=x.get("cap"),
            torque_limits=limits,
            tolerance=1e-12,
            smoothing=smoothing,
        )
        values = {"value": out.cost, "bound": out.bound, "force": out.force, "twist": out.load_twist}
        if limits is not None:
            values["rates"] = out.joint_rates
        return values, out.status == Status.OPTIMAL, out.smooth

    return run


def with_weight(problem, name, value):
    """The problem with a weight of its criterion as one more input."""

    def run(**options):
        x = problem(**options)
        return x | {name: np.full(len(x["position"]), value)}

    return run


CASES = {
    "margin, planar": (margin, planar_problem),
    "margin, soft": (margin, soft_problem),
    "gentlest, planar with limits": (optimum(lambda x: jg.Gentlest()), planar_problem),
    "smoothed gentlest, planar with limits": (optimum(lambda x: jg.Gentlest(), 0.05), planar_problem),
    "robust, soft": (optimum(lambda x: jg.Robust(x["weight"])), with_weight(soft_problem, "weight", 0.3)),
    "smallest sum, hard": (optimum(lambda x: jg.SmallestSum()), hard_problem),
    "sum of squares, planar with limits": (optimum(lambda x: jg.SumOfSquares()), planar_problem),
    "least norm, soft": (
        optimum(lambda x: jg.LeastNorm(x["length"])),
        with_weight(soft_problem, "length", 0.4),
    ),
}
FAST = ("margin, planar", "gentlest, planar with limits")
MARKED = [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in CASES]


def without_limits(problem, **options):
    return {k: v for k, v in problem(**options).items() if k not in ("cap", "jacobian", "torque")}


class Case:
    """One compiled program for values, jvp and vjp of a quantity, and what it says at a point and around it."""

    def __init__(self, name):
        self.function, problem = CASES[name]
        self.x = as_arrays(problem())
        self.t = direction(self.x)
        shapes = jax.eval_shape(lambda x: self.function(x)[0], self.x)
        rng = np.random.default_rng(5)
        self.weights = {q: jnp.asarray(rng.normal(size=s.shape)) for q, s in shapes.items()}
        self.everything = jax.jit(self._everything)
        self.values, self.ok, self.smooth, self.gradient, _ = self.everything(self.x, self.t)

    def _everything(self, x, t):
        def total(x):
            values, ok, smooth = self.function(x)

            def counted(v):
                mask = smooth.reshape(-1, *[1] * (v.ndim - 1))
                return jnp.where(mask, v, 0.0)

            parts = [jnp.sum(self.weights[q] * counted(v)) for q, v in values.items()]
            return sum(parts), (values, ok, smooth)

        gradient, (values, ok, smooth) = jax.grad(total, has_aux=True)(x)
        return values, ok, smooth, gradient, jax.jvp(lambda x: self.function(x)[0], (x,), (t,))[1]

    def slope(self, t):
        """The jvp along t, central differences of fourth order, and the lanes that are smooth all along."""
        *_, slope = self.everything(self.x, t)
        samples, fine = {}, np.asarray(self.ok & self.smooth)
        for n in (-2, -1, 1, 2):
            samples[n], ok, smooth, _, _ = self.everything(moved(self.x, t, n * STEP), t)
            fine = fine & np.asarray(ok & smooth)
        differences = {
            q: (8 * (samples[1][q] - samples[-1][q]) - (samples[2][q] - samples[-2][q])) / (12 * STEP)
            for q in self.values
        }
        return slope, differences, fine


@pytest.fixture(scope="module", params=MARKED)
def case(request):
    return Case(request.param)


def relative(a, b, fine):
    a, b = np.asarray(a)[fine], np.asarray(b)[fine]
    a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
    return np.max(np.abs(a - b), -1) / np.maximum(1.0, np.max(np.abs(b), -1))


def test_jvp_against_differences_input_by_input(case):
    for key in case.x:
        slope, differences, fine = case.slope(only(case.t, key))
        assert fine.mean() >= 0.5, (key, fine)
        for quantity in slope:
            assert np.isfinite(np.asarray(slope[quantity])).all()
            if quantity == "bound":  # a lower bound of the cost: its own differences show the gap's noise
                np.testing.assert_array_equal(slope["bound"], slope["value"])
                continue
            error = relative(slope[quantity], differences[quantity], fine)
            # The margin's solver leaves the direction of its internal force open to the root of the gap, 2e-6, which
            # differences divide by their step.
            limit = 2e-6 / STEP if quantity == "internal" else 1e-6
            assert (error < limit).all(), (key, quantity, error)


def test_vjp_is_the_transpose_of_jvp(case):
    assert all(np.isfinite(np.asarray(g)).all() for g in case.gradient.values())
    mask = np.asarray(case.smooth)
    for key in case.x:
        *_, slope = case.everything(case.x, only(case.t, key))
        parts = [(np.asarray(case.weights[q]) * np.asarray(slope[q]))[mask] for q in slope]
        forward, size = (sum(float(np.sum(f(p))) for p in parts) for f in (np.asarray, np.abs))
        backward = float(jnp.sum(case.gradient[key] * case.t[key]))
        assert abs(backward - forward) <= 1e-8 * max(1.0, size), key  # two orders of the same sums


PLAIN = {  # without limits: second derivatives take long enough to compile
    "margin, planar": (margin, planar_problem),
    "smallest sum, planar": (optimum(lambda x: jg.SmallestSum()), planar_problem),
    "smoothed smallest sum, planar": (optimum(lambda x: jg.SmallestSum(), 0.05), planar_problem),
    "least norm, planar": (optimum(lambda x: jg.LeastNorm()), planar_problem),
    "robust, soft": (optimum(lambda x: jg.Robust(0.3)), soft_problem),
}
SECOND = ("margin, planar", "least norm, planar")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in SECOND else pytest.mark.slow) for n in PLAIN]
)
def test_hessian_against_differences_of_the_gradient(name):
    """Of the value, in positions and the load, to 1e-4; every nesting is the same bilinear form."""
    function, problem = PLAIN[name]
    x = as_arrays(without_limits(problem, seed=3, grasps=6))
    keys = ("position", "friction") if name.startswith("margin") else ("position", "wrench")
    free = {k: x[k] for k in keys}
    t, other = direction(free, 2), direction(free, 4)

    def values(part):
        v, ok, smooth = function({**x, **part})
        return jnp.where(ok & smooth, v["value"], 0.0), ok & smooth

    def total(part):
        return jnp.sum(values(part)[0])

    @jax.jit
    def second_order(p):
        gradient, second = jax.jvp(jax.grad(total), (p,), (t,))
        mixed = jax.jvp(lambda p: jax.jvp(total, (p,), (other,))[1], (p,), (t,))[1]
        return gradient, second, mixed, values(p)[1]

    _, second, mixed, fine = second_order(free)
    h = 1e-4
    sides = [second_order(moved(free, t, s * h)) for s in (1, -1)]
    fine = np.asarray(fine & sides[0][3] & sides[1][3])
    assert fine.sum() >= 4
    for key in keys:
        assert np.isfinite(np.asarray(second[key])).all()
        difference = ((np.asarray(sides[0][0][key]) - np.asarray(sides[1][0][key])) / (2 * h))[fine]
        error = np.abs(np.asarray(second[key])[fine] - difference)
        assert np.max(error) < 1e-4 * max(1.0, np.max(np.abs(difference))), (key, error)
    left = sum(float(jnp.sum(second[k] * other[k])) for k in keys)
    assert left == pytest.approx(float(mixed), rel=1e-5, abs=1e-8)


@pytest.mark.slow("test_hessian_against_differences_of_the_gradient")
def test_jax_hessian_is_symmetric_and_equals_the_products():
    """jax.hessian of one grasp's cost in its positions, entry by entry."""
    x = {k: v[0] for k, v in as_arrays(without_limits(planar_problem, seed=3)).items()}
    function = PLAIN["least norm, planar"][0]

    def cost(position):
        return function({**x, "position": position})[0]["value"]

    H = np.asarray(jax.jit(jax.hessian(cost))(x["position"])).reshape(6, 6)
    np.testing.assert_allclose(H, H.T, rtol=1e-6, atol=1e-8)
    t = np.random.default_rng(0).normal(size=(3, 2))
    h = 1e-4
    gradient = jax.jit(jax.grad(cost))
    up, down = (np.asarray(gradient(x["position"] + s * h * t)).ravel() for s in (1, -1))
    np.testing.assert_allclose(H @ t.ravel(), (up - down) / (2 * h), rtol=1e-4, atol=1e-4)


def single_value(name):
    function = PLAIN[name][0]

    def value(x):
        values, ok, _ = function(x)
        other = values["internal"] if "internal" in values else values["force"]
        return jnp.where(ok, values["value"] + other[..., 0], 0.0)

    return value


@pytest.mark.parametrize(
    "name", ["margin, planar", pytest.param("least norm, planar", marks=pytest.mark.slow)]
)
def test_eager_jit_vmap_and_loop_agree(name):
    """Values and gradients of a value and a force, four ways."""
    x = as_arrays(without_limits(PLAIN[name][1], grasps=3))
    if name.startswith("margin"):
        del x["wrench"]
    single = single_value(name)
    lanes = jax.jit(jax.vmap(jax.value_and_grad(single)))(x)
    alone = jax.jit(jax.value_and_grad(single))
    loop = [alone({k: v[i] for k, v in x.items()}) for i in range(3)]
    together = jax.jit(jax.grad(lambda x: jnp.sum(single(x))))(x)
    np.testing.assert_allclose(lanes[0], [float(v) for v, _ in loop], rtol=1e-12)
    np.testing.assert_allclose(lanes[0], single(x), rtol=1e-12)
    for key in x:
        np.testing.assert_allclose(lanes[1][key], together[key], rtol=1e-9, atol=1e-12)
        for i, (_, gradient) in enumerate(loop):
            np.testing.assert_allclose(lanes[1][key][i], gradient[key], rtol=1e-9, atol=1e-12)


def test_a_degenerate_optimum_says_so():
    """Four fingers at even angles hold a weight: the gentlest forces are many, the least-norm ones are one."""
    angle = 2 * np.pi * np.arange(4) / 4
    position = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    grasp = jg.Grasp(position, -position, jg.HardFinger(0.5))
    load = np.array([0, 0, -1.0, 0, 0, 0])
    for criterion, unique in ((jg.Gentlest(), False), (jg.LeastNorm(), True)):
        out = jg.optimize_forces(grasp, load, criterion=criterion)
        np.testing.assert_allclose(np.asarray(out.force).reshape(4, 3)[:, 2], 0.5, rtol=1e-6)
        assert bool(out.smooth) == unique
    pull = jg.optimize_forces(grasp, np.array([0.3, 0.1, -1.0, 0, 0, 0]), criterion=jg.LeastNorm())
    assert bool(pull.smooth)


def test_lanes_without_an_optimum_have_derivative_zero_and_harm_no_other():
    x = as_arrays(planar_problem())
    bad = dict(x)
    bad["wrench"] = x["wrench"].at[1].set(jnp.nan)  # INVALID
    bad["wrench"] = bad["wrench"].at[2].multiply(100.0)  # INFEASIBLE: beyond the caps
    bad["wrench"] = bad["wrench"].at[3].set(0.0)  # no load

    @jax.jit
    def gradient(x):
        def total(x):
            out = jg.optimize_forces(
                grasp_of(x),
                x["wrench"],
                criterion=jg.Gentlest(),
                max_normal=x["cap"],
                torque_limits=(x["jacobian"], x["torque"]),
            )
            return jnp.sum(jnp.where(out.status == Status.OPTIMAL, out.cost, 0.0)), out.status

        return jax.grad(total, has_aux=True)(x)

    clean, _ = gradient(x)
    dirty, status = gradient(bad)
    assert [int(s) for s in status[1:4]] == [Status.INVALID, Status.INFEASIBLE, Status.OPTIMAL]
    others = np.array([0, 4, 5, 6, 7, 8, 9, 10, 11])
    for name in x:
        g = np.asarray(dirty[name])
        assert np.isfinite(g).all()
        assert (g[1:4] == 0).all()
        np.testing.assert_array_equal(g[others], np.asarray(clean[name])[others])
