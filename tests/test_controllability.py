"""(11.28)-(11.33): A and B, the rank tests, what they prove at which equilibrium; fixed cases, exact arithmetic."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import KINDS, random_active, random_coefficients, random_contacts, random_rotation
from motion import random_bodies

import jaxgrasp as jg
from jaxgrasp.core.tolerances import rank_tolerance
from jaxgrasp.motion.linearization import scaled_system

V = jg.Status
BODY = jg.RigidBody(0.2, 1e-4 * np.diag([1.0, 1.2, 1.5])) if jax.config.jax_enable_x64 else None
X, Y, Z = np.eye(3)
TETRAHEDRON = 0.03 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
TRIANGLE = 0.03 * np.array([[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]])
pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="equilibria are compared in float64")

# name: (positions, normals, mu, gamma, rank of G, rank of the controllability matrix, verdict)
CASES = {
    "two hard, line above": ([-X + Z, X + Z], [X, -X], 0.5, 0, 5, 12, V.CONTROLLABLE),
    "two hard, line below": ([-X - Z, X - Z], [X, -X], 0.5, 0, 5, 12, V.CONTROLLABLE),
    "two hard, line through, horizontal": ([-X, X], [X, -X], 0.5, 0, 5, 10, V.NOT_CONTROLLABLE),
    "two hard, line through, vertical": ([-Z, Z], [Z, -Z], 0.5, 0, 5, 10, V.NOT_CONTROLLABLE),
    "two hard, vertical line beside": ([X - Z, X + Z], [Z, -Z], 0.5, 0, 5, 12, V.CONTROLLABLE),
    "three collinear above": ([-X + Z, X + Z, Z], [X, -X, Y], 0.5, 0, 5, 12, V.CONTROLLABLE),
    "three collinear through": ([-X, X, X / 3], [X, -X, Y], 0.5, 0, 5, 10, V.NOT_CONTROLLABLE),
    "three in the plane of the centre": (TRIANGLE / 0.03, -TRIANGLE, 0.5, 0, 6, 12, V.RESISTANT),
    "two soft, line through": ([-X, X], [X, -X], 0.5, 0.3, 6, 12, V.RESISTANT),
    "two soft, line above": ([-X + Z, X + Z], [X, -X], 0.5, 0.3, 6, 12, V.RESISTANT),
    "tetrahedron": (TETRAHEDRON / 0.03, -TETRAHEDRON, 0.5, 0, 6, 12, V.RESISTANT),
    # a table: it carries the weight from below, forces strictly inside; pushing only, so not resistant
    "three from below": (TRIANGLE / 0.03 - Z, [Z, Z, Z], 0.5, 0, 6, 12, V.CONTROLLABLE),
    # tilting turns the vertical forces, which makes up for two directions; nothing turns it about z
    "frictionless from below": (TRIANGLE / 0.03 - Z, [Z, Z, Z], 0.0, 0, 3, 10, V.NOT_CONTROLLABLE),
    "one soft finger from below": ([-Z], [Z], 0.5, 0.3, 4, 12, V.CONTROLLABLE),
    "one hard finger from below": ([-Z], [Z], 0.5, 0, 3, 10, V.NOT_CONTROLLABLE),
    # two fingers press from above: nothing carries the weight
    "from above": ([-X + Z, X + Z], [-Z, -Z], 0.5, 0, 5, 12, V.NO_EQUILIBRIUM),
    # one face, inclined at the friction angle: the only equilibrating force lies on the edge of the cone
    "on the edge": ([-Z], [Z + 0.5 * X], 0.5, 0.3, 4, 12, V.MARGINAL),
}


def stacked(cases, k, dimension=3):
    """One batch of soft fingers (gamma 0: hard), padded to k contacts; lengths of 3 cm."""
    n = len(cases)
    position, normal = np.zeros((n, k, dimension)), np.zeros((n, k, dimension))
    active, mu, gamma = np.zeros((n, k), bool), np.zeros((n, k)), np.zeros((n, k))
    for i, (p, normals, friction, torsion, *_) in enumerate(cases):
        c = len(p)
        position[i, :c], normal[i, :c], active[i, :c] = 0.03 * np.array(p), normals, True
        mu[i, :c], gamma[i, :c] = friction, 0.03 * torsion
    model = jg.SoftFinger(mu, gamma) if dimension == 3 else jg.HardFinger(mu)
    return jg.Grasp(position, normal, model, active)


def carrying(grasp, load):
    """Forces that balance ``load``, squeezed by 50 times as much where the grasp can be squeezed."""
    G = np.asarray(jg.contacts.folded_grasp_map(grasp))
    n = grasp.model.force_size(grasp.dimension)
    push = np.zeros((len(G), grasp.contacts, n))
    push[..., grasp.model.normal_index(grasp.dimension)] = 50 * np.linalg.norm(load)
    push, inverse = push.reshape(len(G), -1), np.linalg.pinv(G, rcond=1e-10)
    scaled = -inverse @ load + push - np.einsum("nij,njk,nk->ni", inverse, G, push)
    scaling = np.where(np.asarray(grasp.active)[..., None], grasp.model.scaling(grasp.dimension), 0)
    return scaled * scaling.reshape(len(G), -1)


@pytest.fixture(scope="module")
def answers():
    grasp = stacked(CASES.values(), 4)
    force = carrying(grasp, np.array([0, 0, -0.2 * 9.81, 0, 0, 0]))
    return grasp, jg.controllability(grasp, BODY, gravity=(0, 0, -9.81), force=force)


@pytest.mark.slow("test_the_equilibrium_is_found_in_the_plane_too")
def test_the_equilibrium_is_found_when_no_forces_are_given(answers):
    grasp, given = answers
    found = jg.controllability(grasp, BODY)
    for name in ("status", "rank", "reduced_rank", "grasp_rank"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name), err_msg=name)
    assert int(found.equilibrium[list(CASES).index("from above")]) == jg.Status.NO_EQUILIBRIUM
    weightless = jg.controllability(grasp, BODY, gravity=(0, 0, 0))
    names = list(CASES)
    resistant = [i for i, n in enumerate(names) if CASES[n][-1] == V.RESISTANT]
    assert set(np.asarray(weightless.status)[resistant].tolist()) == {V.RESISTANT.value}
    # pushing only from below: no forces but none at all hold a weightless object, so the rank proves nothing
    assert V(int(weightless.status[names.index("three from below")])) == V.MARGINAL


@pytest.mark.parametrize("name", CASES)
def test_fixed_cases(answers, name):
    _, found = answers
    lane = list(CASES).index(name)
    *_, grasp_rank, rank, verdict = CASES[name]
    assert V(int(found.status[lane])) == verdict
    if name == "on the edge":
        assert int(found.reduced_rank[lane]) == 6
        return
    assert (int(found.grasp_rank[lane]), int(found.rank[lane])) == (grasp_rank, rank)
    assert int(found.reduced_rank[lane]) * 2 == rank


def test_the_uncontrollable_motion_is_the_one_to_picture(answers):
    """Two hard fingers cannot turn the object about their line; a finger below cannot spin it."""
    grasp, found = answers
    names = list(CASES)
    for name, wanted in (
        ("two hard, line through, horizontal", [0, 0, 0, 1, 0, 0]),
        ("two hard, line through, vertical", [0, 0, 0, 0, 0, 1]),
        ("one hard finger from below", [0, 0, 0, 0, 0, 1]),
        ("frictionless from below", [0, 0, 0, 0, 0, 1]),
    ):
        np.testing.assert_allclose(found.uncontrollable[names.index(name)], wanted, atol=1e-9)
    # it is one: neither the forces nor their turning with the body do work along it
    low = np.flatnonzero(np.asarray(found.status) == V.NOT_CONTROLLABLE)
    G = np.asarray(jg.contacts.folded_grasp_map(grasp))[low]
    linear = jg.linearize(grasp, BODY, force=found.force)
    M = np.diag([0.2] * 3 + [1e-4, 1.2e-4, 1.5e-4])
    turning = M @ np.asarray(linear.A)[low, 6:, :6] @ np.asarray(linear.B)[low, 6:]
    xi = np.asarray(found.uncontrollable)[low]
    assert np.abs(np.einsum("ni,nij->nj", xi, G)).max() < 1e-12
    assert np.abs(np.einsum("ni,nij->nj", xi, turning)).max() < 1e-9


def test_the_reason_is_told_in_words(answers):
    _, found = answers

    def told(name):
        return jg.report.explain_controllability(found, list(CASES).index(name), [0.1, 0, 0])

    text = told("two hard, line through, horizontal")
    assert "Not controllable to first order" in text and "rank 10 of 12" in text
    assert "Out of reach: a rotation about the axis along (1, 0, 0) through the centre of mass." in text
    text = told("two hard, line above")
    assert (
        "though not wrench resistant" in text
        and "The fingers alone reach 5 of 6 directions, with gravity 6" in text
    )
    assert "times the weight" in text and "Out of reach" not in text
    assert "they do not carry the weight" in told("from above")
    assert "one of 3" in told("one hard finger from below") or "Out of reach:" in told(
        "one hard finger from below"
    )


def test_without_gravity_nothing_helps_the_fingers(answers):
    grasp, found = answers
    weight = np.array([0, 0, -1.0, 0, 0, 0])
    force = carrying(grasp, weight) - 0.5 * (
        carrying(grasp, weight) - carrying(grasp, -weight)
    )  # squeeze only
    found = jg.controllability(grasp, BODY, gravity=(0, 0, 0), force=force)
    np.testing.assert_array_equal(found.rank, 2 * found.grasp_rank)
    lane = list(CASES).index("two hard, line above")
    assert V(int(found.status[lane])) == V.NOT_CONTROLLABLE


def least_squeezed(grasp, force, lane):
    """The forces of ``lane`` with just so much squeeze that some contact is at the edge of its cone, by bisection."""
    load = np.array([0, 0, -0.2 * 9.81, 0, 0, 0])
    G = np.asarray(jg.grasp_map(grasp))[lane]
    particular = -np.linalg.pinv(np.asarray(jg.contacts.folded_grasp_map(grasp))[lane], rcond=1e-10) @ load
    scaling = np.asarray(grasp.model.scaling(3))[lane].ravel()
    particular, low, high = particular * scaling, 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        part = (particular + middle * (force[lane] - particular)).reshape(4, 4)
        inside = np.hypot(part[:, 0], part[:, 1]) <= 0.5 * part[:, 2]
        low, high = (low, middle) if inside.all() else (middle, high)
    edge = particular + high * (force[lane] - particular)
    assert np.abs(G @ edge + load).max() < 1e-12
    return np.where(np.arange(len(CASES))[:, None] == lane, edge, force)


def test_given_forces_are_judged_and_change_no_rank(answers):
    grasp, found = answers
    lane = list(CASES).index("tetrahedron")
    force = np.asarray(found.force)
    point = jg.linearize(grasp, BODY, force=force).status
    there = np.asarray(found.status) != V.NO_EQUILIBRIUM
    np.testing.assert_array_equal(np.asarray(point)[there], np.asarray(found.equilibrium)[there])
    assert set(np.asarray(point)[~there].tolist()) == {jg.Status.NOT_BALANCED.value}
    pulling = jg.linearize(grasp, BODY, force=-force)
    assert int(pulling.status[lane]) == jg.Status.NOT_BALANCED
    edge = jg.linearize(grasp, BODY, force=least_squeezed(grasp, force, lane))
    assert int(edge.status[lane]) == jg.Status.MARGINAL
    np.testing.assert_array_equal(edge.A[lane], jg.linearize(grasp, BODY, force=force).A[lane])


# A and B ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimension", [2, 3])
def test_A_and_B_are_the_derivatives_of_the_motion(dimension):
    """Against automatic derivatives of (11.21) with contact forces that turn with the body; any gravity."""
    rng = np.random.default_rng(41)
    k, m = 4, 6 if dimension == 3 else 3
    position, normal, _ = random_contacts(rng, 1, k, dimension)
    body = jax.tree.map(lambda x: x[0], random_bodies(rng, 1, dimension))
    gravity = rng.normal(size=dimension)
    model = jg.SoftFinger(0.5, 0.2) if dimension == 3 else jg.HardFinger(0.5)
    grasp = jg.Grasp(position[0], normal[0], model)
    load = np.concatenate([np.asarray(body.mass) * gravity, np.zeros(m - dimension)])
    G = np.asarray(jg.grasp_map(grasp))
    force = -np.linalg.pinv(G) @ load
    np.testing.assert_allclose(G @ force, -load, atol=1e-12)

    def motion(x, f):
        state = jg.BodyState.at_rest(dimension).displaced(x[:m], x[m:])
        wrench = jg.motion.world_grasp_map(grasp, state.orientation) @ f
        return jnp.concatenate([state.velocity, jg.motion.acceleration(body, state, wrench, gravity=gravity)])

    A, B = jax.jacfwd(motion, argnums=(0, 1))(jnp.zeros(2 * m), jnp.asarray(force))
    from jaxgrasp.motion.linearization import _blocks

    A_c, B_c = _blocks(grasp, body, jnp.asarray(gravity))
    np.testing.assert_allclose(A[m:, :m], A_c, atol=1e-11)
    np.testing.assert_allclose(A[:m, m:], np.eye(m), atol=1e-12)
    np.testing.assert_allclose(B[m:], B_c, rtol=1e-11, atol=1e-11)


def test_the_factor_g_is_there(answers):
    """Erratum 9: Q alone, without g, is a mistake."""
    grasp, found = answers
    lane = list(CASES).index("tetrahedron")
    for g in (9.81, 1.62):
        A = jg.linearize(grasp, BODY, force=found.force * (g / 9.81), gravity=(0, 0, -g)).A[lane]
        np.testing.assert_allclose(A[6:9, 3:6], g * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]]), atol=1e-12)


def test_derivatives_pass_through(answers):
    grasp, found = answers

    def size(position, mass):
        body = jg.RigidBody(mass, BODY.inertia)
        moved = jg.Grasp(position, grasp.normal, grasp.model, grasp.active)
        return jnp.sum(jg.linearize(moved, body, force=found.force * (mass / 0.2)).B ** 2)

    by_position, by_mass = jax.jit(jax.grad(size, argnums=(0, 1)))(grasp.position, jnp.asarray(0.2))
    h = 5e-5
    numeric = (size(grasp.position, 0.2 + h) - size(grasp.position, 0.2 - h)) / (2 * h)
    assert float(by_mass) == pytest.approx(float(numeric), rel=1e-6)
    assert np.isfinite(by_position).all() and np.abs(by_position).max() > 0


# Ranks ------------------------------------------------------------------------------------------------


def kalman(A, B):
    """(11.30) by numpy, all 2 m powers."""
    blocks = [B]
    for _ in range(A.shape[-1] - 1):
        blocks.append(A @ blocks[-1])
    return np.concatenate(blocks, axis=-1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_reduced_and_full_rank_agree_on_random_grasps(dimension):
    """(11.32) against (11.30), 10 000 grasps of eight kinds, some frictionless, padded, any inertia and gravity.

    A rank is clear where no singular value, as a share of the largest, lies between 8 eps and 1e-11; it is 64 eps that
    decides.
    """
    rng = np.random.default_rng(41)
    n, k, m = 10_000, 4, 6 if dimension == 3 else 3
    position, normal, kind = random_contacts(rng, n, k, dimension)
    mu, gamma = random_coefficients(rng, n, k)
    active = random_active(rng, n, k)
    model = jg.SoftFinger(mu, gamma) if dimension == 3 else jg.HardFinger(mu)
    grasp = jg.Grasp(position, normal, model, active)
    gravity = np.where(rng.random((n, 1)) < 0.05, 0.0, rng.normal(size=(n, dimension)))
    system = scaled_system(grasp, random_bodies(rng, n, dimension), gravity)
    A_c, B_c = np.asarray(system.A_c), np.asarray(system.B_c)
    cut = rank_tolerance(A_c.dtype)

    def ranks(matrix):
        values = np.linalg.svd(matrix, compute_uv=False)
        share = values / np.maximum(values[:, :1], 1e-300)
        unclear = ((share > cut / 8) & (share < 1e-11)).any(1)
        return (share > cut).sum(1), unclear

    A = np.zeros((n, 2 * m, 2 * m))
    A[:, :m, m:], A[:, m:, :m] = np.eye(m), A_c
    full, doubtful = ranks(kalman(A, np.concatenate([0 * B_c, B_c], axis=1)))
    reduced, unclear = ranks(np.concatenate([B_c, A_c @ B_c], axis=2))
    clear = ~(doubtful | unclear)
    assert clear.mean() > 0.98
    np.testing.assert_array_equal(full[clear], 2 * reduced[clear])
    assert len(set(reduced.tolist())) >= m - 1  # every rank there is, but perhaps the least
    gained = (reduced > ranks(B_c)[0]) & clear
    assert gained.mean() > 0.01  # gravity as a finger: controllable without full rank of G
    assert set(kind[gained].tolist()) >= {KINDS.index("duplicate")}


def exact_rank(rows):
    """Rank over the rationals."""
    rows, rank = [list(r) for r in rows], 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            if rows[i][column]:
                share = rows[i][column] / rows[rank][column]
                rows[i] = [a - share * b for a, b in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank


def test_ranks_are_those_of_exact_arithmetic():
    """Integer contacts on boxes, rational inertias: the ranks of 500 grasps without any rounding."""
    n, k = 500, 3
    rng = np.random.default_rng(5)
    position, axis, side = (
        rng.integers(-2, 3, (n, k, 3)),
        rng.integers(3, size=(n, k)),
        rng.choice([-1, 1], size=(n, k)),
    )
    normal = np.zeros((n, k, 3))
    np.put_along_axis(normal, axis[..., None], side[..., None], -1)
    mu = rng.integers(0, 2, (n, k)) / 2
    moments = rng.integers(2, 4, (n, 3))
    body = jg.RigidBody(np.ones(n), np.stack([np.diag(x).astype(float) for x in moments]))
    grasp = jg.Grasp(position.astype(float), normal, jg.HardFinger(mu))
    system = scaled_system(grasp, body)
    reduced = np.concatenate([system.B_c, system.A_c @ system.B_c], axis=2)
    values = np.linalg.svd(reduced, compute_uv=False)
    found = (values > rank_tolerance("float64") * values[:, :1]).sum(1)
    G = np.asarray(jg.contacts.folded_grasp_map(grasp))
    for i in range(n):
        B = [[Fraction(x).limit_denominator(1000) for x in row] for row in G[i]]
        B = B[:3] + [[x / int(moments[i, j]) for x in B[3 + j]] for j in range(3)]
        zero = [Fraction(0)] * len(B[0])
        # A_c B_c = ([gravity]_x; 0) of the torque rows, gravity = -e_z
        tilted = [B[4], [-x for x in B[3]], zero, zero, zero, zero]
        assert exact_rank([b + t for b, t in zip(B, tilted, strict=True)]) == found[i]
    assert set(found.tolist()) >= {4, 5, 6}


@pytest.mark.slow("test_planar_verdicts_do_not_depend_on_axes_or_units")
def test_verdicts_do_not_depend_on_axes_or_units(answers):
    rng = np.random.default_rng(41)
    grasp, found = answers
    turn, size = random_rotation(rng), 1000.0
    inertia = size**2 * turn @ np.asarray(BODY.inertia) @ turn.T
    body = jg.RigidBody(0.2, (inertia + inertia.T) / 2)
    model = jg.SoftFinger(grasp.model.friction_coefficient, size * grasp.model.torsion_coefficient)
    moved = jg.Grasp(size * grasp.position @ turn.T, grasp.normal @ turn.T, model, grasp.active)
    other = jg.controllability(moved, body, gravity=turn @ [0, 0, -9.81])
    edge = list(CASES).index("on the edge")  # rounding pushes it over the edge or not
    same = np.arange(len(CASES)) != edge
    np.testing.assert_array_equal(np.asarray(other.status)[same], np.asarray(found.status)[same])
    np.testing.assert_array_equal(np.asarray(other.rank)[same], np.asarray(found.rank)[same])
    np.testing.assert_allclose(other.singular_values, found.singular_values, atol=1e-9)


# The Gramian ------------------------------------------------------------------------------------------


def test_the_gramian_is_its_integral():
    from scipy.linalg import expm

    grasp = stacked([CASES["two hard, line above"]], 4)
    system = scaled_system(grasp, BODY)
    A = np.zeros((12, 12))
    A[:6, 6:], A[6:, :6] = np.eye(6), system.A_c[0]
    B = np.concatenate([np.zeros((6, 16)), system.B_c[0]])
    nodes, weights = np.polynomial.legendre.leggauss(8)
    wanted = sum(
        w / 2 * 1.5 * (E := expm(A * 1.5 * (x + 1) / 2)) @ B @ B.T @ E.T
        for x, w in zip(nodes, weights, strict=True)
    )
    np.testing.assert_allclose(
        jg.motion.gramian(jnp.asarray(A), jnp.asarray(B), horizon=1.5), wanted, atol=1e-12
    )


def test_the_weakest_direction_costs_its_effort(answers):
    """Steering there with the least controls of the Gramian: it arrives, and the controls have that size."""
    from scipy.linalg import expm

    grasp, found = answers
    lane = list(CASES).index("two hard, line above")
    assert np.isinf(found.effort[list(CASES).index("two hard, line through, vertical")])
    system = jax.tree.map(lambda x: np.asarray(x)[lane], scaled_system(grasp, BODY))
    A = np.zeros((12, 12))
    A[:6, 6:], A[6:, :6] = np.eye(6), system.A_c
    B = np.concatenate([np.zeros((6, 16)), system.B_c])
    unit = np.concatenate([np.full(3, system.length), np.ones(3)])
    state = np.asarray(found.weakest[lane]) / np.concatenate([unit, unit / system.time])
    assert np.linalg.norm(state) == pytest.approx(1.0)
    W = np.asarray(jg.motion.gramian(jnp.asarray(A), jnp.asarray(B)))
    nodes, weights = np.polynomial.legendre.leggauss(10)
    costate, reached, energy = np.linalg.solve(W, state), 0, 0
    for t, w in zip((nodes + 1) / 2, weights / 2, strict=True):
        E = expm(A * (1 - t))
        control = B.T @ E.T @ costate
        reached, energy = reached + w * E @ B @ control, energy + w * control @ control
    np.testing.assert_allclose(reached, state, atol=1e-6)
    assert np.sqrt(energy) == pytest.approx(float(found.effort[lane]), rel=1e-6)


# Bad input --------------------------------------------------------------------------------------------


def test_bad_lanes_say_so_and_harm_no_other(answers):
    grasp, found = answers
    n = len(CASES)
    inertia = np.broadcast_to(np.asarray(BODY.inertia), (n, 3, 3)).copy()
    mass, position = np.full(n, 0.2), np.array(grasp.position)
    inertia[0, 2, 2], mass[1], position[2, 0, 0] = 1.0, -1.0, np.nan
    gravity = np.tile([0, 0, -9.81], (n, 1))
    gravity[3, 0] = np.nan
    broken = jg.Grasp(position, grasp.normal, grasp.model, grasp.active)
    other = jg.controllability(broken, jg.RigidBody(mass, inertia), gravity=gravity, force=found.force)
    assert set(np.asarray(other.status)[:4].tolist()) == {V.INVALID.value}
    np.testing.assert_array_equal(np.asarray(other.rank)[:4], -1)
    for name in ("status", "rank", "singular_values", "uncontrollable", "effort", "force", "equilibrium"):
        np.testing.assert_array_equal(getattr(other, name)[4:], getattr(found, name)[4:], err_msg=name)


def test_wrong_structure_raises():
    grasp = stacked([CASES["tetrahedron"]], 4)
    with pytest.raises(ValueError, match="must be a jaxgrasp"):
        jg.controllability(grasp, 0.2)
    with pytest.raises(ValueError, match="3 dimensions, the body in 2"):
        jg.controllability(grasp, jg.RigidBody(1.0, 1.0))
    with pytest.raises(ValueError, match="do not broadcast"):
        jg.linearize(
            stacked([CASES["tetrahedron"]] * 3, 4), jg.RigidBody(np.ones(2), np.stack([np.eye(3)] * 2))
        )
    with pytest.raises(ValueError, match="force must have shape"):
        jg.linearize(grasp, BODY, force=np.zeros(5))
    with pytest.raises(ValueError, match="gravity must be a vector of 3"):
        jg.linearize(grasp, BODY, force=np.zeros(16), gravity=9.81)


# The plane --------------------------------------------------------------------------------------------

E1, E2 = np.eye(2)
PLANAR = {
    "two above": ([-E1 + E2, E1 + E2], [E1, -E1], 0.5, 0, 3, 6, V.RESISTANT),
    "two through": ([-E1, E1], [E1, -E1], 0.5, 0, 3, 6, V.RESISTANT),
    "one finger below": ([-E2], [E2], 0.5, 0, 2, 6, V.CONTROLLABLE),
    "one finger above, hanging": ([E2], [E2], 0.5, 0, 2, 6, V.CONTROLLABLE),
    "one finger at the centre": ([0 * E2], [E2], 0.5, 0, 2, 4, V.NOT_CONTROLLABLE),
    "frictionless finger below": ([-E2], [E2], 0.0, 0, 1, 2, V.NOT_CONTROLLABLE),
    "two frictionless from below": ([-E1 - E2, E1 - E2], [E2, E2], 0.0, 0, 2, 6, V.CONTROLLABLE),
    "a roof": ([-E1, E1], [E1 - E2, -E1 - E2], 0.2, 0, 3, 6, V.NO_EQUILIBRIUM),
}


FLAT = jg.RigidBody(0.2, 1e-4)


@pytest.fixture(scope="module")
def planar_answers():
    grasp = stacked(PLANAR.values(), 3, 2)
    force = carrying(grasp, np.array([0, -0.2 * 9.81, 0]))
    return grasp, jg.controllability(grasp, FLAT, force=force), jg.controllability(grasp, FLAT)


def test_planar_cases(planar_answers):
    _, found, _ = planar_answers
    wanted = [case[-3:] for case in PLANAR.values()]
    got = [
        (int(r), int(c), V(int(v)))
        for r, c, v in zip(found.grasp_rank, found.rank, found.status, strict=True)
    ]
    assert dict(zip(PLANAR, got, strict=True)) == dict(zip(PLANAR, wanted, strict=True))
    lane = list(PLANAR).index("one finger at the centre")
    np.testing.assert_allclose(found.uncontrollable[lane], [0, 0, 1], atol=1e-12)


def test_the_equilibrium_is_found_in_the_plane_too(planar_answers):
    grasp, given, found = planar_answers
    for name in ("status", "rank", "reduced_rank", "grasp_rank"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name), err_msg=name)
    assert int(found.equilibrium[list(PLANAR).index("a roof")]) == jg.Status.NO_EQUILIBRIUM
    weightless = jg.controllability(grasp, FLAT, gravity=(0, 0))
    resistant = [i for i, case in enumerate(PLANAR.values()) if case[-1] == V.RESISTANT]
    assert set(np.asarray(weightless.status)[resistant].tolist()) == {V.RESISTANT.value}
    # fingers on a roof push downwards only: no forces but none hold a weightless object, so the rank proves nothing
    assert V(int(weightless.status[list(PLANAR).index("a roof")])) == V.MARGINAL


def test_planar_verdicts_do_not_depend_on_axes_or_units(planar_answers):
    grasp, _, found = planar_answers
    turn, size = random_rotation(np.random.default_rng(41), 2), 1000.0
    body = jg.RigidBody(0.2, 1e-4 * size**2)
    moved = jg.Grasp(size * grasp.position @ turn.T, grasp.normal @ turn.T, grasp.model, grasp.active)
    other = jg.controllability(moved, body, gravity=turn @ [0, -9.81])
    np.testing.assert_array_equal(other.status, found.status)
    np.testing.assert_array_equal(other.rank, found.rank)
    np.testing.assert_allclose(other.singular_values, found.singular_values, atol=1e-9)
