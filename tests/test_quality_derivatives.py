"""Derivatives of every quality measure against central differences of fourth order, input by input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import ball
from smooth_problems import as_arrays, direction, grasp_of, hard_problem, only, planar_problem, soft_problem

import jaxgrasp as jg
from jaxgrasp import Status


def without(problem, *names, **options):
    return {key: value for key, value in problem(**options).items() if key not in names}


def apart(x):
    """Contacts at radii of their own: the largest, L, has a kink where two are equal."""
    return x | {"position": x["position"] * np.linspace(0.8, 1.2, x["position"].shape[1])[:, None]}


def hard():
    return without(hard_problem, "wrench")


def soft():
    return apart(without(soft_problem, "wrench"))


def planar():
    return apart(without(planar_problem, "wrench", "cap", "jacobian", "torque"))


def scattered(k, torsion=None):
    """Resistant ones of tilted fingers scattered over a ball: few ties between weakest directions."""

    def run():
        rng = np.random.default_rng(4)
        position, normal, friction = ball(rng, 60, k)
        x = {"position": position, "normal": normal, "friction": friction}
        if torsion is not None:
            x["torsion"] = rng.uniform(*torsion, friction.shape)
        kept = np.flatnonzero(np.asarray(jg.wrench_resistance(grasp_of(x)).margin) > 0.05)[:12]
        assert len(kept) == 12
        return {key: value[kept] for key, value in x.items()}

    return run


def slippery(problem):
    """The problem's grasps that a twentieth of the friction does not hold."""

    def run():
        x = problem()
        x["friction"] = x["friction"] / 20
        kept = np.asarray(jg.wrench_resistance(grasp_of(x)).margin) < -0.01
        assert kept.sum() >= 6
        return {key: value[kept] for key, value in x.items()}

    return run


def with_task(problem):
    """The problem with three wrenches of a task."""

    def run():
        x = problem()
        count, d = len(x["position"]), x["position"].shape[-1]
        load = np.random.default_rng(8).normal(size=(count, 3, d * (d + 1) // 2))
        return x | {"load": load}

    return run


def epsilon(norm):
    """The upper bound, closely enough that it rarely jumps from one weak direction to another a percent weaker."""

    def measure(x):
        q = jg.epsilon_quality(grasp_of(x), norm=norm, torque_scale=1.0, tolerance=1e-3)
        return q.upper, q.smooth

    return measure


def radius(status):
    def measure(x):
        out = jg.guaranteed_radius(grasp_of(x))
        return out.radius, out.status == status

    return measure


def critical(x):
    factor = jg.critical_friction(grasp_of(x)).factor
    return factor, jnp.isfinite(factor) & (factor > 0)


def sharp_critical(x):
    """The critical factor to rounding: the zero of the margin between the two proven ends, 5e-7 apart."""
    grasp = grasp_of(x)
    out = jg.critical_friction(grasp)
    below, above = (
        jg.wrench_resistance(jg.quality.with_friction_factor(grasp, end), tolerance=1e-12).margin
        for end in (out.lower, out.upper)
    )
    return out.lower - (out.upper - out.lower) * below / (above - below), critical(x)[1]


def task(norm):
    def measure(x):
        out = jg.task_quality(grasp_of(x), x["load"], norm=norm, tolerance=1e-12)
        return out.multiple, out.multiple > 0

    return measure


def known(function):
    def measure(x):
        value = function(grasp_of(x), torque_scale=1.0)
        return value, value > 0

    return measure


RESISTANT, REFUTED = Status.RESISTANT, Status.NOT_RESISTANT
STEP = 1e-4
# The differences must agree to so much of the sum of |gradient entry * change| and |value|. The margin's solver leaves
# forces and twists open to the root of its gap, 1e-6, times what the second derivative makes of it: up to 3e-5 here,
# whatever the step. In the plane they are sharp.
CLOSED, OPEN = 1e-6, 5e-5
CASES = {
    "epsilon L1, planar": (epsilon("L1"), planar, CLOSED),
    "epsilon Linf, planar": (epsilon("Linf"), planar, CLOSED),
    "epsilon L1, hard": (epsilon("L1"), scattered(4), CLOSED),
    "epsilon Linf, hard": (epsilon("Linf"), scattered(4), CLOSED),
    "epsilon L1, soft": (epsilon("L1"), scattered(3, (0.2, 0.5)), CLOSED),
    "epsilon Linf, soft": (epsilon("Linf"), scattered(3, (0.2, 0.5)), CLOSED),
    "critical friction, planar": (critical, planar, CLOSED),
    "critical friction, hard": (critical, hard, OPEN),
    "critical friction, soft": (critical, soft, OPEN),
    "radius, planar": (radius(RESISTANT), planar, CLOSED),
    "radius, hard": (radius(RESISTANT), hard, OPEN),
    "radius, soft": (radius(RESISTANT), lambda: apart(scattered(3, (0.2, 0.5))()), OPEN),
    "radius of a refuted grasp, planar": (radius(REFUTED), slippery(planar), CLOSED),
    "radius of a refuted grasp, hard": (radius(REFUTED), slippery(hard), OPEN),
    "radius of a refuted grasp, soft": (radius(REFUTED), slippery(soft), OPEN),
    "task L1, planar": (task("L1"), with_task(planar), CLOSED),
    "task Linf, planar": (task("Linf"), with_task(planar), CLOSED),
    "task L1, hard": (task("L1"), with_task(hard), CLOSED),
    "task Linf, soft": (task("Linf"), with_task(soft), CLOSED),
    "isotropy, hard": (known(jg.quality.grasp_isotropy), hard, CLOSED),
    "isotropy, soft": (known(jg.quality.grasp_isotropy), soft, CLOSED),
    "volume, planar": (known(jg.quality.grasp_volume), planar, CLOSED),
    "volume, hard": (known(jg.quality.grasp_volume), hard, CLOSED),
}
FAST = (
    "epsilon L1, planar",
    "epsilon Linf, planar",
    "critical friction, planar",
    "radius, planar",
    "task L1, planar",
    "isotropy, hard",
    "volume, hard",
)
SHARPER = {critical: sharp_critical}  # for the differences


def differences(measure, x, t, step):
    """(N,) slopes along t by central differences of fourth order, and the lanes that are smooth all along."""
    near = {key: jnp.concatenate([x[key] + n * step * t[key] for n in (-2, -1, 1, 2)]) for key in x}
    values, smooth = (np.asarray(v).reshape(4, -1) for v in measure(near))
    a, b, c, e = values
    return (8 * (c - b) - (e - a)) / (12 * step), smooth.all(axis=0)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in CASES]
)
def test_gradient_against_differences(name):
    """A lane is left out where the measure says so, or where differences of two steps show a kink between them."""
    measure, problem, limit = CASES[name]
    x = as_arrays(problem())
    change = direction(x)
    value, smooth = (np.asarray(v) for v in measure(x))
    gradient = jax.grad(lambda x: jnp.sum(measure(x)[0]))(x)
    for key in x:
        t = only(change, key)
        difference, fine = differences(SHARPER.get(measure, measure), x, t, STEP)
        wider, _ = differences(SHARPER.get(measure, measure), x, t, 2 * STEP)
        terms = np.asarray(gradient[key] * t[key]).reshape(len(value), -1)
        assert np.isfinite(terms).all()
        size = np.abs(terms).sum(axis=-1) + np.abs(value)
        fine = fine & smooth & (np.abs(wider - difference) < 1e-5 * size)
        assert fine.mean() >= 0.75, (key, fine)
        error = np.abs(terms.sum(axis=-1) - difference) / size
        assert (error[fine] < limit).all(), (key, error)
