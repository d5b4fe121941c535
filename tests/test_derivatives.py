"""Derivatives of margins, costs and forces: a table of quantities and transformations, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp import Status

STEP = 1e-4


def planar_problem(seed=0, grasps=12):
    """Three planar hard fingers around the origin, a load, caps and joint limits."""
    rng = np.random.default_rng(seed)
    angle = np.array([0.3, 2.4, 4.4]) + 0.2 * rng.normal(size=(grasps, 3))
    position = np.stack([np.cos(angle), np.sin(angle)], -1)
    return {
        "position": position,
        "normal": -position + 0.1 * rng.normal(size=position.shape),
        "friction": rng.uniform(0.5, 0.9, (grasps, 3)),
        "wrench": rng.normal(size=(grasps, 3)),
        "cap": rng.uniform(2.0, 4.0, (grasps, 3)),
        "jacobian": rng.normal(size=(grasps, 6, 2)),
        "torque": rng.uniform(3.0, 5.0, (grasps, 2)),
    }


def soft_problem(seed=1, grasps=10):
    """Three soft fingers in space."""
    rng = np.random.default_rng(seed)
    angle = np.array([0.0, 2.1, 4.2]) + 0.2 * rng.normal(size=(grasps, 3))
    position = np.stack([np.cos(angle), np.sin(angle), 0.2 * rng.normal(size=angle.shape)], -1)
    return {
        "position": position,
        "normal": -position + 0.1 * rng.normal(size=position.shape),
        "friction": rng.uniform(0.5, 0.9, (grasps, 3)),
        "torsion": rng.uniform(0.1, 0.3, (grasps, 3)),
        "wrench": rng.normal(size=(grasps, 6)),
    }


def grasp_of(x):
    if "torsion" in x:
        return jg.Grasp(x["position"], x["normal"], jg.SoftFinger(x["friction"], x["torsion"]))
    return jg.Grasp(x["position"], x["normal"], jg.HardFinger(x["friction"]))


def margin(x):
    out = jg.wrench_resistance(grasp_of(x), tolerance=1e-11)
    return {"value": out.margin, "internal": out.internal_force}, jnp.isfinite(out.margin)


def optimum(criterion, smoothing=0.0):
    def run(x):
        limits = (x["jacobian"], x["torque"]) if "jacobian" in x else None
        out = jg.optimize_forces(
            grasp_of(x), x["wrench"], criterion, x.get("cap"), limits, tolerance=1e-11, smoothing=smoothing
        )
        ok = out.status == Status.OPTIMAL
        return {"value": out.cost, "bound": out.bound, "force": out.force, "twist": out.load_twist}, ok

    return run


PLAIN = {  # without limits: the second derivatives take long enough to compile
    "margin, planar": (margin, planar_problem),
    "smoothed smallest sum": (optimum(jg.SmallestSum(), 0.05), planar_problem),
}
CASES = {
    "margin, planar": (margin, planar_problem),
    "gentlest with limits": (optimum(jg.Gentlest()), planar_problem),
    "smoothed gentlest with limits": (optimum(jg.Gentlest(), 0.05), planar_problem),
    "robust, soft": (optimum(jg.Robust(0.3)), soft_problem),
    "least norm, soft": (optimum(jg.LeastNorm(0.4)), soft_problem),
}


def as_arrays(x):
    return {name: jnp.asarray(value) for name, value in x.items()}


def direction(x, seed=9):
    rng = np.random.default_rng(seed)
    return {name: jnp.asarray(rng.normal(size=value.shape)) for name, value in x.items()}


def moved(x, t, length):
    return {name: x[name] + length * t[name] for name in x}


def weights_of(values, seed=5):
    rng = np.random.default_rng(seed)
    return {name: jnp.asarray(rng.normal(size=np.shape(v))) for name, v in values.items()}


FAST = ("margin, planar", "smoothed gentlest with limits")
MARKED = [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in CASES]


@pytest.fixture(scope="module", params=MARKED)
def case(request):
    """Values, jvp and vjp from one compiled program, and its central differences of fourth order."""
    function, problem = CASES[request.param]
    x = as_arrays(problem())
    t = direction(x)
    shapes = jax.eval_shape(lambda x: function(x)[0], x)
    weights = weights_of({name: np.zeros(s.shape) for name, s in shapes.items()})

    def total(x):
        values, ok = function(x)
        parts = [jnp.sum(weights[q] * jnp.where(jnp.isfinite(v), v, 0.0)) for q, v in values.items()]
        return sum(parts), (values, ok)

    @jax.jit
    def everything(x, t):
        gradient, (values, ok) = jax.grad(total, has_aux=True)(x)
        return values, ok, gradient, jax.jvp(lambda x: function(x)[0], (x,), (t,))[1]

    values, ok, gradient, slope = everything(x, t)
    samples, fine = {}, np.asarray(ok)
    for n in (-2, -1, 1, 2):
        samples[n], ok, _, _ = everything(moved(x, t, n * STEP), t)
        fine = fine & np.asarray(ok)
    differences = {
        name: (8 * (samples[1][name] - samples[-1][name]) - (samples[2][name] - samples[-2][name]))
        / (12 * STEP)
        for name in values
    }
    backward = sum(float(jnp.sum(gradient[n] * t[n])) for n in x)
    forward = sum(float(jnp.sum(weights[q] * slope[q])) for q in slope)
    return request.param, gradient, slope, differences, fine, forward, backward


def relative(a, b, fine):
    a, b = np.asarray(a)[fine], np.asarray(b)[fine]
    a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
    return np.max(np.abs(a - b), -1) / np.maximum(1.0, np.max(np.abs(b), -1))


def test_jvp_against_differences(case):
    name, _, slope, differences, fine, _, _ = case
    assert fine.sum() >= 4, name
    for quantity in slope:
        assert np.isfinite(np.asarray(slope[quantity])).all()
        if quantity == "bound":  # a lower bound of the cost: its own differences show the gap's noise
            np.testing.assert_array_equal(slope["bound"], slope["value"])
            continue
        error = relative(slope[quantity], differences[quantity], fine)
        # Differences of numbers known to 1e-11 over 1e-4; kinks are counted, not averaged away.
        assert np.median(error) < 1e-6, (name, quantity, error)
        assert np.mean(error > 1e-4) <= 0.2, (name, quantity, error)


def test_vjp_is_the_transpose(case):
    _, gradient, _, _, _, forward, backward = case
    assert all(np.isfinite(np.asarray(g)).all() for g in gradient.values())
    # Two orders of the same sums, through a Newton matrix of condition up to 1e7 squared, refined twice.
    assert backward == pytest.approx(forward, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(
    "name", ["margin, planar", pytest.param("smoothed smallest sum", marks=pytest.mark.slow)]
)
def test_hessian_against_differences_of_the_gradient(name):
    function, problem = PLAIN[name]
    x = {
        k: v
        for k, v in as_arrays(problem(seed=3, grasps=4)).items()
        if k not in ("cap", "jacobian", "torque")
    }
    keys = ("position", "friction") if name.startswith("margin") else ("position", "wrench")
    free = {k: x[k] for k in keys}
    t = direction(free, 2)

    def value(part):
        values, ok = function({**x, **part})
        return jnp.sum(jnp.where(ok, values["value"], 0.0))

    other = direction(free, 4)

    @jax.jit
    def second_order(p):
        gradient, second = jax.jvp(jax.grad(value), (p,), (t,))
        return gradient, second, jax.jvp(lambda p: jax.jvp(value, (p,), (other,))[1], (p,), (t,))[1]

    _, second, mixed = second_order(free)
    h = 1e-4
    up, down = (second_order(moved(free, t, s * h))[0] for s in (1, -1))
    for key in keys:
        difference = (np.asarray(up[key]) - np.asarray(down[key])) / (2 * h)
        scale = np.max(np.abs(difference))
        np.testing.assert_allclose(second[key], difference, atol=1e-4 * scale, rtol=1e-4)
    # The other nesting, forward over forward, is the same bilinear form.
    left = sum(float(jnp.sum(second[k] * other[k])) for k in keys)
    assert left == pytest.approx(float(mixed), rel=1e-5)


@pytest.mark.slow
def test_vmap_of_grad_equals_the_batch():
    x = {k: v for k, v in as_arrays(planar_problem()).items() if k not in ("cap", "jacobian", "torque")}
    function = PLAIN["smoothed smallest sum"][0]

    def single(x):
        values, ok = function(x)
        return jnp.where(ok, values["value"], 0.0)

    lanes = jax.jit(jax.vmap(jax.grad(single)))(x)
    together = jax.jit(jax.grad(lambda x: jnp.sum(single(x))))(x)
    for name in x:
        np.testing.assert_allclose(lanes[name], together[name], rtol=1e-9, atol=1e-12)


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
                grasp_of(x), x["wrench"], jg.Gentlest(), x["cap"], (x["jacobian"], x["torque"])
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
