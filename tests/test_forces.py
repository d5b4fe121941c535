"""``optimize_forces``: closed forms of every criterion, limits at their bound, statuses, bits, wrong arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import ball
from scipy.optimize import brentq

import jaxgrasp as jg
from jaxgrasp import Status

W, MU = 6.0, 0.4  # N
LIFT = np.array([0, 0, -W, 0, 0, 0])
CRITERIA = [jg.Gentlest(), jg.Robust(0.3), jg.SmallestSum(), jg.SumOfSquares(), jg.LeastNorm()]


def solved_to(dtype):
    """What a solve to the default tolerance reaches, relative."""
    return 2e-8 if dtype == "float64" else 1e-3


def ring(fingers, dtype, mu=MU, radius=0.05):
    """2 to 4 fingers round a vertical axis, normals to the axis, padded to 4 contacts; batch axis first."""
    fingers = np.atleast_1d(fingers)
    angle = 2 * np.pi * np.arange(4) / fingers[:, None]
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1).astype(dtype)
    active = np.arange(4) < fingers[:, None]
    return jg.Grasp(radius * out, -out, jg.HardFinger(np.full((len(fingers), 4), mu, dtype)), active)


def closed_form(criterion, k):
    """Each of k fingers carries W / k along its tangent and presses with W / (k mu); Robust with x more."""
    f_t, f_n = W / k, W / (k * MU)
    if isinstance(criterion, jg.Robust):
        w = float(criterion.weight)
        x = brentq(
            lambda x: 1 - w * k * (1 / x + 2 * MU**2 * x / (MU**2 * x**2 - f_t**2)), f_n * (1 + 1e-12), 1e3
        )
        return x - w * k * np.log(MU * x * (MU**2 * x**2 - f_t**2)), x
    costs = {
        jg.Gentlest: f_n,
        jg.SmallestSum: k * f_n,
        jg.SumOfSquares: k * f_n**2,
        jg.LeastNorm: k * (f_n**2 + f_t**2),
    }
    return costs[type(criterion)], f_n


LIFTED = [
    pytest.param(c, id=type(c).__name__, marks=pytest.mark.f32 if i in (0, 4) else pytest.mark.slow)
    for i, c in enumerate(CRITERIA)
]


@pytest.mark.parametrize("criterion", LIFTED)
def test_symmetric_lifts(criterion, dtype):
    grasp = ring([2, 3, 4], dtype)
    out = jg.optimize_forces(grasp, LIFT.astype(dtype), criterion=criterion)
    np.testing.assert_array_equal(out.status, Status.OPTIMAL)
    known = np.array([closed_form(criterion, k) for k in (2, 3, 4)])
    np.testing.assert_allclose(out.cost, known[:, 0], rtol=solved_to(dtype), atol=solved_to(dtype))
    assert np.all(
        np.asarray(out.lower) <= known[:, 0] + solved_to(dtype) * np.maximum(1, np.abs(known[:, 0]))
    )
    force = np.asarray(out.force).reshape(3, 4, 3)
    wrench = np.einsum("bij,bj->bi", np.asarray(jg.grasp_map(grasp), float), np.asarray(out.force, float))
    np.testing.assert_allclose(
        wrench, np.broadcast_to(-LIFT, (3, 6)), atol=1e-12 if dtype == "float64" else 1e-4
    )
    for i, k in enumerate((2, 3, 4)):
        near = 1e-6 if dtype == "float64" else 3e-2
        np.testing.assert_allclose(force[i, :k, 2], known[i, 1], rtol=near)
        np.testing.assert_allclose(np.linalg.norm(force[i, :k, :2], axis=-1), W / k, rtol=near)
        np.testing.assert_array_equal(force[i, k:], 0.0)
    assert jg.check(grasp, out, wrench=LIFT, criterion=criterion).all()


def test_limits_bind_at_their_bound_and_forbid_beyond_it(dtype):
    """Three fingers need W / (3 mu) = 5 N each; a cap, or the motor of finger 0, gives 0.1 % more or less."""
    need, lever = W / (3 * MU), 0.07
    grasp = ring([3, 3, 3, 3], dtype)
    share = np.array([1.001, 0.999, 1.001, 0.999], dtype)
    cap = np.full((4, 4), np.inf, dtype)
    cap[:2] = need * share[:2, None]
    J = np.zeros((12, 1), dtype)
    J[2] = lever
    torque = np.array([1e3, 1e3, need * lever * share[2], need * lever * share[3]], dtype)[:, None]
    out = jg.optimize_forces(
        grasp, LIFT.astype(dtype), criterion=jg.LeastNorm(), max_normal=cap, torque_limits=(J, torque)
    )
    np.testing.assert_array_equal(out.status, [Status.OPTIMAL, Status.INFEASIBLE] * 2)
    np.testing.assert_allclose(
        np.asarray(out.cost)[::2], closed_form(jg.LeastNorm(), 3)[0], rtol=solved_to(dtype)
    )
    np.testing.assert_array_equal(np.asarray(out.cost)[1::2], np.inf)
    asked = {"wrench": LIFT, "criterion": jg.LeastNorm(), "max_normal": cap, "torque_limits": (J, torque)}
    assert jg.check(grasp, out, **asked).all()


def soft_or_hard(kind, k, dtype):
    """Random contacts of 40 grasps."""
    rng = np.random.default_rng(6)
    position = rng.normal(size=(40, k, 3)).astype(dtype)
    mu = rng.uniform(0.3, 1, (40, k)).astype(dtype)
    return jg.Grasp(position, -position, jg.SoftFinger(mu, 0.1 * mu) if kind == "soft" else jg.HardFinger(mu))


LARGE = [
    pytest.param("soft", 6, "float32", jg.Robust(0.7), 0),
    *(
        pytest.param(*kind, marks=pytest.mark.slow)
        for kind in (
            ("soft", 12, "float32", jg.Robust(0.7), 7),
            ("soft", 16, "float64", jg.Robust(0.7), 7),
            ("soft", 24, "float32", jg.LeastNorm(0.2), 14),
            ("hard", 24, "float64", jg.Gentlest(), 16),
            ("hard", 4, "float32", jg.SmallestSum(), 29),
        )
    ),
]


@pytest.mark.parametrize(("kind", "k", "kept", "criterion", "joints"), LARGE)
def test_large_problems_compile(kind, k, kept, criterion, joints):
    """XLA splits what it finds expensive over threads, and long reductions into windows; a kernel can hold neither."""
    grasp, rng = soft_or_hard(kind, k, kept), np.random.default_rng(7)
    wrench = rng.normal(size=(40, 6)).astype(kept)
    limits = None
    if joints:
        J = 0.1 * rng.normal(size=(40, k * grasp.model.force_size(3), joints)).astype(kept)
        limits = (J, np.full(joints, 2.0, kept))
    asked = {"criterion": criterion, "max_normal": rng.uniform(2, 20, (40, k)).astype(kept)}
    asked["torque_limits"] = limits
    out = jg.optimize_forces(grasp, wrench, **asked)
    proved = np.isin(np.asarray(out.status), [Status.OPTIMAL, Status.INFEASIBLE])
    assert proved.mean() > 0.9
    assert np.asarray(jg.check(grasp, out, wrench=wrench, **asked))[proved].all()


def test_a_limit_that_bites_is_met_exactly(dtype):
    """Fingers at 0, 90 and 180 degrees and a push of 2 N towards the one at 90: SmallestSum loads it as far as the cap
    allows."""
    grasp = ring([4, 4], dtype, mu=0.0)
    load = np.array([0, 2.0, 0, 0, 0, 0], dtype)  # towards +y: the finger there pushes back
    cap = np.array([[np.inf] * 4, [np.inf, 1.9, np.inf, np.inf]], dtype)
    out = jg.optimize_forces(grasp, load, criterion=jg.SmallestSum(), max_normal=cap)
    np.testing.assert_array_equal(out.status, [Status.OPTIMAL, Status.INFEASIBLE])
    np.testing.assert_allclose(
        np.asarray(out.force[0]).reshape(4, 3)[:, 2], [0, 2, 0, 0], atol=10 * solved_to(dtype)
    )
    assert jg.check(grasp, out, wrench=load, criterion=jg.SmallestSum(), max_normal=cap).all()


def test_every_status_has_its_proof(dtype):
    """Held; outside the range of G; beyond the cones; no load; no number; no grasp."""
    grasp = ring([2] * 6, dtype)
    spoiled = np.array(grasp.position)
    spoiled[5, 0, 0] = np.nan
    grasp = jg.Grasp(spoiled, grasp.normal, grasp.model, grasp.active)
    load = np.tile(LIFT, (6, 1)).astype(dtype)
    load[1] = [0, 0, 0, 1, 0, 0]  # two hard fingers on the x axis cannot hold a torque about it
    load[2], load[3], load[4] = [0, 0, 0, 0, 0, 0], 0, np.nan
    out = jg.optimize_forces(grasp, load)
    expected = [
        Status.OPTIMAL,
        Status.INFEASIBLE,
        Status.OPTIMAL,
        Status.OPTIMAL,
        Status.INVALID,
        Status.INVALID,
    ]
    np.testing.assert_array_equal(out.status, expected)
    twist = np.asarray(out.escape_twist[1])
    np.testing.assert_allclose(np.abs(twist[3]) / np.linalg.norm(twist), 1.0, rtol=1e-6)
    assert twist @ load[1] > 0
    np.testing.assert_array_equal(np.asarray(out.force)[2:4], 0.0)
    np.testing.assert_array_equal(np.asarray(out.cost)[2:4], 0.0)
    assert np.all(np.isnan(np.asarray(out.cost)[4:]))
    assert jg.check(grasp, out, wrench=load, criterion=jg.Gentlest()).all()


def test_bits_do_not_depend_on_neighbours_batch_or_bad_lanes(dtype):
    rng = np.random.default_rng(0)
    p = rng.normal(size=(70, 4, 3))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    grasp = jg.Grasp(
        p.astype(dtype), -p.astype(dtype), jg.HardFinger(np.full((70, 4), 0.6, dtype)), np.ones((70, 4), bool)
    )
    load = rng.normal(size=(70, 6)).astype(dtype)
    out = jg.optimize_forces(grasp, load)
    bad = load.copy()
    bad[3] = np.nan
    spoiled = jg.optimize_forces(grasp, bad)
    keep = np.arange(70) != 3
    order = rng.permutation(70)
    shuffled = jg.optimize_forces(grasp[order], load[order])
    for name in ("status", "force", "cost", "lower", "escape_twist", "load_twist"):
        value = np.asarray(getattr(out, name))
        np.testing.assert_array_equal(np.asarray(getattr(spoiled, name))[keep], value[keep])
        np.testing.assert_array_equal(np.asarray(getattr(shuffled, name)), value[order])
    many = jg.optimize_forces(grasp[:5], np.broadcast_to(load[:5, None], (5, 2, 6)))
    assert many.cost.shape == (5, 2)
    np.testing.assert_array_equal(np.asarray(many.cost)[:, 1], np.asarray(out.cost)[:5])


def test_costs_do_not_depend_on_frame_order_or_units(dtype):
    rng = np.random.default_rng(1)
    p = rng.normal(size=(20, 4, 3))
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    load = rng.normal(size=(20, 6))
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.linalg.det(Q))

    def cost(p, n, load):
        model = jg.HardFinger(np.full((20, 4), 0.6, dtype))
        grasp = jg.Grasp(p.astype(dtype), n.astype(dtype), model, np.ones((20, 4), bool))
        return jg.optimize_forces(grasp, load.astype(dtype))

    out = cost(p, -p, load)
    best, held = np.asarray(out.cost), np.asarray(out.status) == Status.OPTIMAL
    assert held.sum() > 5
    near = 4 * solved_to(dtype)
    turned = cost(p @ Q.T, -p @ Q.T, np.concatenate([load[:, :3] @ Q.T, load[:, 3:] @ Q.T], -1))
    shuffled = cost(p[:, ::-1], -p[:, ::-1], load)
    metres = np.concatenate([load[:, :3], 1e3 * load[:, 3:]], -1)
    for other, factor in (
        (turned, 1),
        (shuffled, 1),
        (cost(1e3 * p, -p, metres), 1),
        (cost(p, -p, 50 * load), 50),
    ):
        np.testing.assert_array_equal(other.status, out.status)
        np.testing.assert_allclose(np.asarray(other.cost)[held], factor * best[held], rtol=near)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"wrench": np.ones(5)}, r"wrench must have shape \(\*batch, \*loads, 6\)"),
        ({"wrench": np.ones((3, 6))}, r"must start with the grasp's batch axes \(2,\)"),
        ({"criterion": "gentlest"}, "criterion must be an object such as jaxgrasp.Gentlest()"),
        ({"max_normal": np.ones(3)}, r"max_normal must broadcast to shape \(2, 4\)"),
        ({"torque_limits": np.ones(3)}, "torque_limits must be a pair"),
        (
            {"torque_limits": (np.ones((3, 1)), 1.0)},
            r"the hand Jacobian J must have shape \(\*batch, 12, q\)",
        ),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"smoothing": -1.0}, "smoothing must be a number of at least 0"),
    ],
)
def test_wrong_arguments_say_what_to_do(arguments, message):
    arguments = {"grasp": ring([2, 3], "float32"), "wrench": LIFT.astype("float32"), **arguments}
    with pytest.raises(ValueError, match=message):
        jg.optimize_forces(**arguments)


def forgeries(out, criterion):
    """Answers of the second lane, each wrong in one way."""

    def changed(**values):
        return jax.tree.map(lambda x: x, out).__class__(**{**vars(out), **values})

    squeeze = 1.01 * out.force
    return {
        "forces 1 % off": changed(force=squeeze, upper=criterion.cost(ring([3], out.cost.dtype), squeeze)),
        "cheaper than it is": changed(upper=0.99 * out.upper - 0.01),
        "a bound too high": changed(lower=out.lower + 0.01 * jnp.abs(out.lower)),
        "a bound too low": changed(lower=out.lower - 0.01 * jnp.abs(out.lower)),
        "called infeasible": changed(status=jnp.full_like(out.status, int(Status.INFEASIBLE))),
        "another multiplier": changed(load_twist=-out.load_twist),
    }


@pytest.mark.parametrize("criterion", CRITERIA, ids=lambda c: type(c).__name__)
def test_forged_answers_are_rejected(criterion):
    grasp = ring([2, 3, 4], "float64")
    answers = jg.optimize_forces(grasp, LIFT, criterion=criterion)
    one, out = grasp[1:2], jax.tree.map(lambda x: x[1:2], answers)
    asked = {"wrench": LIFT, "criterion": criterion}
    assert jg.check(one, out, **asked).all()
    for name, forged in forgeries(out, criterion).items():
        assert not jg.check(one, forged, **asked).any(), name
    assert not jg.check(one, out, wrench=0.99 * LIFT, criterion=criterion).any()
    for other in CRITERIA:
        if type(other) is not type(criterion):
            assert not jg.check(one, out, wrench=LIFT, criterion=other).any(), "an answer to another question"


def test_a_forged_twist_is_rejected():
    grasp = ring([2], "float64")
    load = np.array([[0, 0, 0, 1.0, 0, 0]])
    out = jg.optimize_forces(jg.Grasp(*(np.repeat(x, 3, 0) for x in (grasp.position, grasp.normal)),
        jg.HardFinger(np.full((3, 4), MU)), np.repeat(grasp.active, 3, 0)), np.repeat(load, 3, 0))  # fmt: skip
    out = jax.tree.map(lambda x: x[:1], out)
    asked = {"wrench": load, "criterion": jg.Gentlest()}
    assert jg.check(grasp, out, **asked).all()
    for twist in (-out.escape_twist, out.escape_twist + 0.01, 0 * out.escape_twist):
        forged = out.__class__(**{**vars(out), "escape_twist": twist})
        assert not jg.check(grasp, forged, **asked).any()


@pytest.mark.parametrize("size", [1e-200, 1e150, 1e300])
def test_an_escape_proves_at_any_size(size):
    """Evidence is a ray: what it proves does not depend on its length, and nothing overflows."""
    rng = np.random.default_rng(0)
    grasp = ring([3], "float64")
    jacobian, torque = rng.normal(size=(12, 7)), np.full(7, 1e-4)
    asked = {"wrench": np.array([0.0, 0, -10, 0, 0, 0]), "criterion": jg.SmallestSum()}
    out = jg.optimize_forces(grasp, **asked, torque_limits=(jacobian, torque))
    assert (out.status == Status.INFEASIBLE).all()
    longer = {"escape_twist": size * out.escape_twist, "joint_rates": size * out.joint_rates}
    forged = out.__class__(**{**vars(out), **longer})
    assert jg.check(grasp, forged, **asked, torque_limits=(jacobian, torque)).all()


@pytest.mark.f32
def test_loads_that_over_or_underflow_are_invalid_or_solved(dtype):
    """The pinch of a disc squeezed by w / (2 mu) a finger, for loads w whose squares are numbers."""
    limit = 2.0**510 if dtype == "float64" else 2.0**62
    tiny, huge = (1e-310, 1e308) if dtype == "float64" else (1e-40, 3e38)
    grasp = jg.Grasp(
        np.array([[-1, 0], [1, 0]], dtype), np.array([[1, 0], [-1, 0]], dtype), jg.HardFinger(0.5)
    )
    loads = np.array([tiny, 1 / limit / 4, 2 / limit, 10.0, limit / 2, 4 * limit, huge, 0.0], dtype)
    wrench = np.stack([0 * loads, -loads, 0 * loads], -1)
    found = jg.optimize_forces(grasp, wrench)
    invalid, optimal = [jg.Status.INVALID] * 2, [jg.Status.OPTIMAL]
    assert list(found.status) == invalid + 3 * optimal + invalid + optimal
    np.testing.assert_allclose(
        np.asarray(found.cost)[2:5] / loads[2:5], 1.0, rtol=1e-7 if dtype == "float64" else 1e-4
    )
    assert found.cost[7] == 0


@pytest.mark.skipif(not jax.config.jax_enable_x64, reason="compares with float64")
def test_float32_stops_where_nothing_improves():
    """Its residuals end at some 20 eps: waiting for less took every lane its whole budget of 60."""
    rng = np.random.default_rng(3)
    position, normal, friction = (x.astype(np.float32) for x in ball(rng, 300, 4))
    load = rng.normal(size=(300, 6)).astype(np.float32)
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    found = jg.optimize_forces(grasp, load)
    iterations = np.asarray(found.iterations)
    assert (np.asarray(found.status) == jg.Status.OPTIMAL).sum() > 100
    assert iterations.mean() < 15 and np.mean(iterations >= 60) < 0.02
    exact = jg.optimize_forces(
        jax.tree.map(lambda x: x.astype(np.float64) if x.dtype != bool else x, grasp), load
    )
    both = (np.asarray(found.status) == jg.Status.OPTIMAL) & (np.asarray(exact.status) == jg.Status.OPTIMAL)
    assert (np.asarray(found.lower, np.float64) <= np.asarray(exact.upper))[both].all()
    assert jg.check(grasp, found, wrench=load, criterion=jg.Gentlest()).all()
