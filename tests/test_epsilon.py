"""The Ferrari-Canny quality: closed forms, Qhull's pyramids, optimal forces, invariances, derivatives, proofs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import ball
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.quality.unit_wrench_space import effort_map, scaled, torque_lengths


@pytest.fixture(scope="module")
def grasp():
    position, normal, friction = ball(np.random.default_rng(0), 64, 4)
    return jg.Grasp(position, normal, jg.HardFinger(friction))


@pytest.fixture(scope="module")
def answer(grasp):
    return jg.epsilon_quality(grasp, certificate=True)


def pyramid_epsilon(A, edges, outer):
    """Qhull's ball in the hull of pyramids inside, or around, the friction cones of A (k, 6, 3)."""
    angle = 2 * np.pi * np.arange(edges) / edges
    reach = 1 / np.cos(np.pi / edges) if outer else 1.0
    points = [
        a[:, 0] + reach * (np.cos(angle)[:, None] * a[:, 1] + np.sin(angle)[:, None] * a[:, 2]) for a in A
    ]
    return float(-ConvexHull(np.concatenate(points)).equations[:, -1].max())


def assert_touching(grasp, q):
    """Where smooth, forces of unit effort inside their cones whose wrench is the worst one, ``upper * direction``."""
    A = np.asarray(effort_map(grasp, q.torque_scale))
    s = np.asarray(scaled(grasp, q.touching))
    smooth = np.asarray(q.smooth)
    effort = s[..., 0].sum(-1) if q.norm == "L1" else s[..., 0].max(-1)
    assert (effort[smooth] <= 1 + 1e-8).all()
    assert (np.linalg.norm(s[..., 1:], axis=-1) <= s[..., 0] + 1e-8)[smooth].all()
    wrench = np.einsum("...kmn,...kn->...m", A, s)
    worst = np.asarray(q.upper)[:, None] * np.asarray(q.direction)
    np.testing.assert_allclose(wrench[smooth], worst[smooth], atol=1e-8)


def test_the_bracket_is_narrow_and_opens_only_where_resistant(answer):
    resistant = np.asarray(answer.status) == Status.RESISTANT
    assert 20 < resistant.sum() < 60
    width = np.asarray(answer.width)
    assert (width[resistant] <= 0.0101).all()
    assert np.asarray(answer.smooth)[resistant].mean() > 0.9
    assert (np.asarray(answer.lower)[~resistant] == 0).all()
    refuted = np.asarray(answer.status) == Status.NOT_RESISTANT
    assert refuted.sum() > 10
    assert (np.asarray(answer.upper)[refuted] == 0).all()


def test_the_touching_forces_are_the_worst_wrench(grasp, answer):
    assert_touching(grasp, answer)


def test_the_checker_accepts_and_finds_every_fault(grasp, answer):
    resistant = np.asarray(answer.status) == Status.RESISTANT
    assert jg.check(grasp, answer).all()
    faults = [
        eqx.tree_at(lambda q: q.lower, answer, answer.lower * 1.0001),
        eqx.tree_at(lambda q: q.upper, answer, answer.upper * 0.9999),
        eqx.tree_at(lambda q: q.forces, answer, answer.forces * 1.001),
        eqx.tree_at(lambda q: q.facets, answer, answer.facets.at[:, 3].set(-1)),
        eqx.tree_at(lambda q: q.facets, answer, answer.facets.at[:, 3].set(answer.facets[:, 4])),
        eqx.tree_at(lambda q: q.direction, answer, -answer.direction),
        eqx.tree_at(lambda q: q.direction, answer, answer.direction * jnp.nan),
    ]
    for fault in faults:
        assert not jg.check(grasp, fault)[resistant].any()


def test_pyramids_inside_and_outside_agree(grasp, answer):
    A = np.asarray(effort_map(grasp, torque_lengths(grasp)))
    chosen = np.flatnonzero(np.asarray(answer.status) == Status.RESISTANT)[:6]
    for i in chosen:
        inner, outer = pyramid_epsilon(A[i], 16, False), pyramid_epsilon(A[i], 16, True)
        assert inner <= float(answer.upper[i]) * (1 + 1e-9)
        assert float(answer.lower[i]) <= outer * (1 + 1e-9)


@pytest.mark.slow("test_pyramids_inside_and_outside_agree")
def test_a_hundred_grasps_against_pyramids_of_32_edges():
    rng = np.random.default_rng(1)
    position, normal, friction = ball(rng, 400, 4)
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    q = jg.epsilon_quality(grasp)
    resistant = np.flatnonzero(np.asarray(q.status) == Status.RESISTANT)
    A = np.asarray(effort_map(grasp, torque_lengths(grasp)))
    assert len(resistant) > 100
    assert np.mean(np.asarray(q.width)[resistant] <= 0.01) >= 0.99
    for i in resistant[:100]:
        inner, outer = pyramid_epsilon(A[i], 32, False), pyramid_epsilon(A[i], 32, True)
        assert inner <= float(q.upper[i]) * (1 + 1e-9)
        assert float(q.lower[i]) <= outer * (1 + 1e-9)


def two_planar(mu):
    """Opposite fingers at (-1, 0) and (1, 0), and a place left empty."""
    position = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    return jg.Grasp(position, -position, jg.HardFinger(mu), np.array([True, True, False]))


@pytest.mark.parametrize("mu", [0.2, 1.0])
def test_two_opposite_planar_fingers(mu):
    """W is the tetrahedron of (1, +-mu, -+mu), (-1, +-mu, +-mu): its faces lie at mu / sqrt(mu^2 + 2)."""
    q = jg.epsilon_quality(two_planar(mu), certificate=True)
    exact = mu / np.sqrt(mu**2 + 2)
    assert float(q.lower) == pytest.approx(exact, rel=1e-9)
    assert float(q.upper) == pytest.approx(exact, rel=1e-9)
    assert jg.check(two_planar(mu), q)


@pytest.mark.slow(
    "test_two_opposite_planar_fingers", "test_spatial_linf_against_support_directions_and_linear_programs"
)
@pytest.mark.parametrize("mu", [0.2, 1.0])
def test_two_opposite_planar_fingers_with_bounds_of_their_own(mu):
    """With every force up to 1 both edges of both cones can push at once: twice the L1 ball or more."""
    exact = mu / np.sqrt(mu**2 + 2)
    both = jg.epsilon_quality(two_planar(mu), norm="Linf", certificate=True)
    assert float(both.lower) >= exact * (1 - 1e-9)
    assert jg.check(two_planar(mu), both)


def resisted_multiple(wide, limits, equal, w):
    """The largest t with t w a wrench of forces x >= 0 (columns of ``wide``), ``limits x <= equal`` the effort."""
    count = wide.shape[1]
    out = linprog(
        np.append(np.zeros(count), -1.0),
        A_ub=np.hstack([limits, np.zeros((len(limits), 1))]),
        b_ub=equal,
        A_eq=np.hstack([wide, -w[:, None]]),
        b_eq=np.zeros(len(w)),
    )
    assert out.status == 0
    return -out.fun


@pytest.mark.slow("test_spatial_linf_against_support_directions_and_linear_programs")
def test_linf_ball_is_resisted_and_no_larger_one():
    """The lower ball by linear programs, exact in the plane, the upper bound by 10^5 support directions."""
    rng = np.random.default_rng(3)
    angle = np.sort(rng.uniform(0, 2 * np.pi, (40, 4)), axis=-1)
    position = np.stack([np.cos(angle), np.sin(angle)], -1)
    normal = -position + 0.3 * rng.normal(size=position.shape)
    grasp = jg.Grasp(position, normal, jg.HardFinger(0.4))
    q = jg.epsilon_quality(grasp, norm="Linf", tolerance=1e-6, certificate=True)
    assert jg.check(grasp, q).all()
    assert_touching(grasp, q)
    resistant = np.flatnonzero(np.asarray(q.status) == Status.RESISTANT)
    assert len(resistant) >= 20
    A = np.asarray(effort_map(grasp, torque_lengths(grasp)))
    direction = rng.normal(size=(100_000, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    effort = np.repeat(np.eye(4), 2, axis=1)
    for i in resistant:
        lower, upper, worst = float(q.lower[i]), float(q.upper[i]), np.asarray(q.direction[i])
        v = np.einsum("kmn,dm->dkn", A[i], direction)
        support = np.maximum(v[..., 0] + np.abs(v[..., 1]), 0).sum(-1).min()
        assert lower <= upper * (1 + 1e-9) <= support * (1 + 2e-9)  # none of 10^5 directions is weaker
        edges = np.stack([A[i][..., 0] + A[i][..., 1], A[i][..., 0] - A[i][..., 1]], 1).reshape(-1, 3).T
        for w in direction[:30]:
            assert resisted_multiple(edges, effort, np.ones(4), w) >= lower * (1 - 1e-7)
        least = resisted_multiple(edges, effort, np.ones(4), worst)
        assert lower * (1 - 1e-7) <= least <= upper * (1 + 1e-7)  # the worst wrench takes it all


def test_spatial_linf_against_support_directions_and_linear_programs():
    """No one of 10^5 directions is weaker than ``upper``, and linear programs agree with both bounds.

    cone(c mu) < pyramid of 32 edges inside cone(mu) < cone(mu) < pyramid around it, with c = cos(pi / 32): what the
    cones resist is bounded by the pyramids on either side, in random directions and along the weakest one.
    """
    rng = np.random.default_rng(3)
    position, normal, friction = ball(rng, 24, 4)
    edges, c = 32, np.cos(np.pi / 32)
    q, less = (
        jg.epsilon_quality(
            jg.Grasp(position, normal, jg.HardFinger(share * friction)), norm="Linf", certificate=True
        )
        for share in (1.0, c)
    )
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    resistant = np.flatnonzero(np.asarray(q.status) == Status.RESISTANT)
    assert len(resistant) >= 10
    assert jg.check(grasp, q).all()
    assert_touching(grasp, q)
    A = np.asarray(effort_map(grasp, torque_lengths(grasp)))
    direction = rng.normal(size=(100_000, 6))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    angle = 2 * np.pi * np.arange(edges) / edges
    effort = np.repeat(np.eye(4), edges, axis=1)  # the normal force of each contact
    for i in resistant:
        lower, upper, worst = float(q.lower[i]), float(q.upper[i]), np.asarray(q.direction[i])
        v = np.einsum("kmn,dm->dkn", A[i], direction)
        support = np.maximum(v[..., 0] + np.linalg.norm(v[..., 1:], axis=-1), 0).sum(-1).min()
        assert lower <= upper * (1 + 1e-9) <= support * (1 + 2e-9)
        rim = np.cos(angle)[:, None] * A[i][:, None, :, 1] + np.sin(angle)[:, None] * A[i][:, None, :, 2]
        inner = (A[i][:, None, :, 0] + rim).reshape(-1, 6).T
        outer = (A[i][:, None, :, 0] + rim / c).reshape(-1, 6).T
        for w in (worst, *direction[:20]):
            assert resisted_multiple(inner, effort, np.ones(4), w) >= float(less.lower[i]) * (1 - 1e-7)
            assert resisted_multiple(outer, effort, np.ones(4), w) >= lower * (1 - 1e-7)
        v = np.einsum("kmn,m->kn", A[i], worst)
        assert resisted_multiple(inner, effort, np.ones(4), worst) <= upper * (1 + 1e-7)
        around = np.maximum(v[:, 0] + np.linalg.norm(v[:, 1:], axis=-1) / c, 0).sum()
        assert resisted_multiple(outer, effort, np.ones(4), worst) <= around * (1 + 1e-7)


def test_nothing_depends_on_axes_order_or_units(grasp, answer):
    chosen = np.flatnonzero(np.asarray(answer.status) == Status.RESISTANT)[:10]
    part = grasp[chosen]
    rotation, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    rotation = rotation * np.sign(np.linalg.det(rotation))
    position, normal = np.asarray(part.position), np.asarray(part.normal)
    friction = np.asarray(part.model.friction_coefficient)
    order = [2, 0, 3, 1]
    turned = jg.Grasp(position @ rotation.T, normal @ rotation.T, part.model)
    permuted = jg.Grasp(position[:, order], normal[:, order], jg.HardFinger(friction[:, order]))
    larger = jg.Grasp(position * 1e3, normal * 7.0, part.model)
    for other in (turned, permuted, larger):
        q = jg.epsilon_quality(other, certificate=True)  # the fixture's executable
        both = np.asarray(q.smooth) & np.asarray(answer.smooth)[chosen]
        assert both.sum() >= 8
        np.testing.assert_allclose(
            np.asarray(q.upper)[both], np.asarray(answer.upper)[chosen][both], rtol=1e-8
        )
        assert (np.asarray(q.lower) <= np.asarray(answer.upper)[chosen] * (1 + 1e-9)).all()


@pytest.mark.slow(
    "test_bad_lanes_stay_alone", "test_objectives.py::test_the_bank_finds_the_weakest_direction"
)
def test_jit_and_vmap_prove_the_same(grasp, answer):
    """Programs of their own, which may stop elsewhere within the tolerance: their brackets hold one epsilon."""
    eager = jg.epsilon_quality(grasp[:8])
    traced = jax.jit(jg.epsilon_quality)(grasp[:8])
    mapped = jax.vmap(jg.epsilon_quality)(grasp[:8])
    for other in (traced, mapped):
        np.testing.assert_array_equal(other.status, eager.status)
        assert (np.maximum(other.lower, eager.lower) <= np.minimum(other.upper, eager.upper)).all()
        assert (np.asarray(other.lower) >= 0.99 * np.asarray(other.upper)).all()
        np.testing.assert_allclose(other.upper, eager.upper, rtol=0.01)
        same = np.abs(other.upper - eager.upper) <= 1e-9 * eager.upper
        assert same.sum() >= 7  # most searches end in the same corner
    np.testing.assert_array_equal(np.asarray(eager.upper), np.asarray(answer.upper)[:8])


def test_bad_lanes_stay_alone(grasp, answer):
    """And neighbours do not matter: eight of many have the same bits."""
    few = jg.epsilon_quality(grasp[:8], certificate=True)  # the fixture's executable
    np.testing.assert_array_equal(np.asarray(few.upper), np.asarray(answer.upper)[:8])
    position = np.asarray(grasp.position)[:8].copy()
    position[3, 0, 0] = np.nan
    broken = jg.epsilon_quality(jg.Grasp(position, grasp.normal[:8], grasp[:8].model), certificate=True)
    assert int(broken.status[3]) == Status.INVALID
    assert np.isnan(np.asarray(broken.upper)[3])
    assert np.isnan(np.asarray(broken.lower)[3])
    others = [i for i in range(8) if i != 3]
    np.testing.assert_array_equal(np.asarray(broken.upper)[others], np.asarray(few.upper)[others])


@pytest.mark.slow(
    "test_the_checker_accepts_and_finds_every_fault", "test_the_touching_forces_are_the_worst_wrench"
)
@pytest.mark.parametrize("norm", ["L1", "Linf"])
@pytest.mark.parametrize("name", ["soft", "frictionless", "mixed and padded"])
def test_every_contact_model(norm, name):
    rng = np.random.default_rng(6)
    k = 9 if name == "frictionless" else 5
    position, normal, friction = ball(rng, 60, k)
    active = np.ones((60, k), bool)
    if name == "soft":
        model = jg.SoftFinger(friction, 0.2)
    elif name == "frictionless":
        normal = normal + rng.normal(size=normal.shape)
        model = jg.Frictionless()
    else:
        friction[::2, 0] = 0.0
        active[:, 4] = rng.random(60) < 0.5
        model = jg.SoftFinger(friction, np.where(rng.random((60, k)) < 0.5, 0.1, 0.0))
    grasp = jg.Grasp(position, normal, model, active)
    q = jg.epsilon_quality(grasp, norm=norm, certificate=True)
    resistant = np.asarray(q.status) == Status.RESISTANT
    assert resistant.sum() >= 5
    assert_touching(grasp, q)
    assert jg.check(grasp, q).all()
    assert np.mean(np.asarray(q.width)[resistant] <= 0.01) >= 0.99


PLANAR = {  # norm: positions, normals, friction
    "Linf": (
        [
            [1.0, -0.27710692747975063],
            [-0.6740479098057703, 1.0],
            [-1.0, 0.03981048180497937],
            [1.0, 0.8378955940061579],
        ],
        [[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]],
        0.0,
    ),
    "L1": (
        [
            [0.012605073292335952, 0.022365187437492336],
            [0.026958607222740155, 0.024620470029656772],
            [0.01670167386354499, 0.04007658999246538],
            [0.02871482169382895, 0.03019514587850878],
        ],
        [
            [0.6110120401089807, 0.7916213026705771],
            [-0.8243413529314396, 0.5660930434541337],
            [0.2013519829880769, -0.9795189528267276],
            [-0.9999628000403193, 0.008625458568932725],
        ],
        1.1045378964680608e-05,
    ),
}


@pytest.mark.parametrize(("norm", "least"), [("Linf", 0.0), ("L1", 1.967e-6)])
def test_qualities_as_small_as_rounding_are_accepted(norm, least):
    """An epsilon of 0 to rounding, and one of 2e-6: what rounding can do is relative to the map, not to epsilon."""
    position, normal, friction = PLANAR[norm]
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    q = jg.epsilon_quality(grasp, norm=norm, certificate=True)
    assert least <= float(q.upper) < least + 1e-9
    assert q.status == (Status.RESISTANT if least else Status.MARGINAL)
    assert jg.check(grasp, q)
    low = jg.prove(grasp, q).lower
    assert 0 <= low <= q.upper


def test_mistakes_are_answered(grasp):
    with pytest.raises(ValueError, match="norm must be one of L1, Linf"):
        jg.epsilon_quality(grasp, norm="L2")
    with pytest.raises(ValueError, match="tolerance must be between 0 and 1"):
        jg.epsilon_quality(grasp, tolerance=0.0)
    with pytest.raises(ValueError, match="torque_scale must be a length"):
        jg.epsilon_quality(grasp, torque_scale=np.ones(3))
    with pytest.raises(ValueError, match=r"takes a jaxgrasp\.Grasp"):
        jg.epsilon_quality(np.ones(3))
