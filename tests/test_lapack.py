"""No LAPACK call on many matrices and no two calls at once: they can wait for each other's workers for ever on few
cores, be they in one program or in two threads.

Outside of ``lmi`` nothing calls LAPACK on JAX arrays; there, problems run one after another, a matrix a call, and one
call waits for the other.
"""

import ast
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import USERS_OPTIONS
from grasps import ball
from lapack import at_once, compiled_at_once, lapack_calls
from motion import random_bodies, random_states

import jaxgrasp as jg
from jaxgrasp.conic import eigenvalues, left_svd, null_basis, pseudo_inverse, singular_values, solve
from jaxgrasp.lmi import LMIProblem, lmi_feasibility, lmi_forces, lmi_margin, lmi_minimize, sdp_minimize
from jaxgrasp.lmi.order import after
from jaxgrasp.motion import Simulation, gramian
from jaxgrasp.placement.objectives import EpsilonFloor
from jaxgrasp.quality import grasp_isotropy, grasp_volume

PACKAGE = Path(jg.__file__).parent


def test_the_finder_finds_calls_wherever_they_are():
    x = np.eye(3)
    factor, svd = jnp.linalg.cholesky, functools.partial(jnp.linalg.svd, compute_uv=False)
    assert lapack_calls(lambda x: (factor(x), jax.jit(svd)(x)), x) == [("cholesky", 1), ("svd", 1)]
    assert lapack_calls(jax.vmap(jax.vmap(factor)), np.ones((2, 5, 3, 3))) == [("cholesky", 10)]
    loop = functools.partial(jax.lax.fori_loop, 0, 3, lambda _, x: factor(x) + factor(x.T))
    assert lapack_calls(loop, x) == [("cholesky", 1)] * 2
    assert lapack_calls(jax.vmap(loop), x[None].repeat(4, 0)) == [("cholesky", 4)] * 2
    assert lapack_calls(jax.grad(lambda x: jnp.sum(svd(x))), x)[0] == ("svd", 1)


def test_the_finder_finds_what_runs_at_once():
    x = np.eye(3)
    factor, svd = jnp.linalg.cholesky, functools.partial(jnp.linalg.svd, compute_uv=False)
    assert at_once(lambda x: (factor(x), factor(2 * x)), x) == [("cholesky", "cholesky")]
    assert at_once(lambda x: factor(factor(x)), x) == []
    assert at_once(lambda x: (jax.jit(factor)(x), jax.vmap(svd)(x[None])), x) == [("cholesky", "svd")]
    # A function in a function is written out: one of its results does not wait for the other.
    two = jax.jit(lambda x: (factor(x), x + 1))
    assert at_once(lambda x: factor(two(x)[1]), x) == [("cholesky", "cholesky")]
    assert at_once(lambda x: factor(two(x)[0]), x) == []
    loop = functools.partial(jax.lax.fori_loop, 0, 3, lambda _, x: factor(x) + factor(x.T))
    assert at_once(loop, x) == [("cholesky", "cholesky")]
    (pair,) = at_once(lambda x: (loop(x), factor(x))[0] + factor(x), x)[1:2]
    assert pair[1] == "cholesky"


def test_no_room_but_lmi_names_a_lapack_routine():
    """Norms, and NumPy on the host, are none."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            name = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
            if isinstance(node, ast.ImportFrom) and "linalg" in (node.module or ""):
                name = f"jax.{node.module}"
            routine = name.startswith(
                ("jnp.linalg.", "jax.scipy.linalg.", "jax.numpy.linalg.", "lax.linalg.")
            )
            if routine and name != "jnp.linalg.norm" and path.parent.name != "lmi":
                found.append(f"{path.name}: {name}")
    assert found == []


def grasps(dimension=2, k=3, count=2):
    position, normal, friction = ball(np.random.default_rng(0), count, k, dimension=dimension)
    return jg.Grasp(position, normal, jg.HardFinger(friction))


LOAD = np.array([0.0, -1.0, 0.1])


def body():
    return random_bodies(np.random.default_rng(1), 2, 2)


def state():
    return random_states(np.random.default_rng(2), 2, 2)


LIMITS = jg.TorqueLimits(np.eye(6)[:, :2], np.ones(2))


def closed(grasp, controller):
    return jg.close_loop(
        grasp, body(), controller=controller, state=state(), simulation=Simulation(2, timestep=0.002)
    )


def regulated(grasp):
    return closed(grasp, jg.regulator(grasp, body()))


FREE = {
    "grasp_map": jg.grasp_map,
    "grasp_rank": jg.grasp_rank,
    "null_space": jg.null_space,
    "internal_force_part": lambda g: jg.contacts.internal_force_part(g, jg.grasp_map(g)[:, 0]),
    "wrench_resistance": jg.wrench_resistance,
    "gentlest": lambda g: jg.optimize_forces(g, LOAD),
    "robust": lambda g: jg.optimize_forces(g, LOAD, criterion=jg.Robust(0.1)),
    "sum of squares": lambda g: jg.optimize_forces(g, LOAD, criterion=jg.SumOfSquares()),
    "least norm": lambda g: jg.optimize_forces(g, LOAD, criterion=jg.LeastNorm(), max_normal=9.0),
    "limited": lambda g: jg.optimize_forces(g, LOAD, torque_limits=LIMITS),
    "equilibrium": lambda g: jg.equilibrium(g, LOAD),
    "squeeze": lambda g: jg.squeeze(g, LOAD),
    "resistible_wrenches": lambda g: jg.resistible_wrenches(g, LOAD[None]),
    "epsilon_quality": jg.epsilon_quality,
    "epsilon_quality Linf": lambda g: jg.epsilon_quality(g, norm="Linf"),
    "critical_friction": jg.critical_friction,
    "guaranteed_radius": jg.guaranteed_radius,
    "task_quality": lambda g: jg.task_quality(g, LOAD[None]),
    "isotropy and volume": lambda g: (grasp_isotropy(g), grasp_volume(g)),
    "linearize": lambda g: jg.linearize(g, body()),
    "controllability": lambda g: jg.controllability(g, body()),
    "gramian": lambda g: gramian(*(getattr(jg.linearize(g, body()), name) for name in "AB")),
    "regulator": lambda g: jg.regulator(g, body()),
    "closed loop, regulated": regulated,
    "closed loop, computed torque": lambda g: closed(g, jg.ComputedTorque(jg.Gains.of_rate(25.0))),
    "a body's numbers": lambda g: (body().valid, body().inverse_inertia),
    "placement's floor": lambda g: EpsilonFloor().value(g, ()),
    "d radius": jax.grad(lambda g: jnp.sum(jg.guaranteed_radius(g).radius), allow_int=True),
    "d volume": jax.grad(lambda g: jnp.sum(grasp_volume(g)), allow_int=True),
    "d squeeze": jax.grad(lambda g: jnp.sum(jg.squeeze(g, LOAD).effort), allow_int=True),
    "d gentlest": jax.grad(lambda g: jnp.sum(jg.optimize_forces(g, LOAD).cost), allow_int=True),
    "d epsilon": jax.grad(lambda g: jnp.sum(jg.epsilon_quality(g).upper), allow_int=True),
}


@pytest.mark.parametrize("name", FREE)
def test_programs_without_lapack(name):
    assert lapack_calls(FREE[name], grasps()) == []


def interval(count=2):
    """``x >= 1, x <= 2``, some times."""
    constant = np.broadcast_to(np.diag([-1.0, 2.0]), (count, 2, 2))
    return np.ones((count, 1)), constant, np.broadcast_to(np.diag([1.0, -1.0]), (count, 1, 2, 2))


def curved(cost, constant, matrices):
    term = jg.lmi.LogDetTerm(np.ones(len(cost)), constant, matrices)
    return lmi_minimize(LMIProblem(cost, constant, matrices, 1.5 * cost, np.ones((len(cost), 1, 1)), term))


ORDERED = {
    "lmi_margin": (lmi_margin, grasps),
    "gentlest by LMI": (lambda g: lmi_forces(g, LOAD, criterion=jg.Gentlest()), grasps),
    "robust by LMI": (lambda g: lmi_forces(g, LOAD, criterion=jg.Robust(0.1)), grasps),
    "squares by LMI": (
        lambda g: lmi_forces(g, LOAD, criterion=jg.SumOfSquares(), max_normal=np.full(3, 9.0)), grasps
    ),
    "lmi_feasibility": (lambda p: lmi_feasibility(*p[1:]), interval),
    "lmi_minimize": (lambda p: curved(*p), interval),
    "sdp_minimize": (lambda p: sdp_minimize(*p), interval),
}  # fmt: skip


@pytest.mark.parametrize("name", ORDERED)
@pytest.mark.parametrize("count", [1, 3])
def test_programs_with_one_matrix_a_call_and_one_call_after_another(name, count):
    function, given = ORDERED[name]
    found = lapack_calls(function, given(count=count))
    assert len(found) > 5
    assert {matrices for _, matrices in found} == {1}
    assert at_once(function, given(count=count)) == []


@pytest.mark.parametrize("name", ["lmi_margin", "robust by LMI"])
def test_compiled_programs_wait_too(name):
    """No pass of the compiler takes the dependence for idle."""
    function, given = ORDERED[name]
    text = jax.jit(function).lower(given()).compile().as_text()
    assert text.count('custom_call_target="lapack') > 5
    assert compiled_at_once(text) == []


@pytest.mark.parametrize("options", [None, USERS_OPTIONS], ids=["quick", "users"])
def test_what_waits_by_a_count(options):
    """``after`` makes one call wait for another at every level of optimisation; a product with zero would not."""
    x, factor = np.eye(40), jnp.linalg.cholesky

    def text(second):
        def both(x, y):
            first = factor(x)
            return first, factor(second(y, first))

        return jax.jit(both).lower(x, x).compile(options).as_text()

    assert len(compiled_at_once(text(lambda y, first: y))) == 1
    assert compiled_at_once(text(after)) == []


# What stands for LAPACK --------------------------------------------------------------------------------

SHAPES = [(1, 4), (2, 2), (3, 5), (6, 3), (6, 12), (12, 12)]


def matrices(m, n, dtype):
    return np.random.default_rng(m + n).normal(size=(2, 3, m, n)).astype(dtype)


def close(dtype):
    return {"rtol": 0, "atol": 1e-13 if dtype == "float64" else 3e-5}


@pytest.mark.parametrize(("m", "n"), SHAPES)
def test_singular_values_and_vectors(m, n, dtype):
    A = matrices(m, n, dtype)
    values, U = map(np.asarray, left_svd(jnp.asarray(A)))
    expected = np.linalg.svd(A, compute_uv=False)
    np.testing.assert_allclose(values[..., : min(m, n)], expected, **close(dtype))
    assert (values[..., n:] == 0).all()
    np.testing.assert_allclose(
        np.swapaxes(U, -1, -2) @ U, np.broadcast_to(np.eye(m), U.shape), **close(dtype)
    )
    np.testing.assert_allclose(
        np.linalg.norm(np.swapaxes(U, -1, -2) @ A, axis=-1), values, atol=10 * close(dtype)["atol"]
    )
    vmapped = jax.vmap(jax.vmap(singular_values))(jnp.asarray(A))
    np.testing.assert_array_equal(vmapped, values)


def test_eigenvalues_of_either_sign(dtype):
    M = matrices(6, 6, dtype)
    M = M + np.swapaxes(M, -1, -2)
    found = eigenvalues(jnp.asarray(M))
    np.testing.assert_allclose(found, np.linalg.eigvalsh(M)[..., ::-1], atol=20 * close(dtype)["atol"])


def test_pseudo_inverse_at_a_lower_rank(dtype):
    A = matrices(6, 12, dtype)
    A[..., 5, :] = A[..., 0, :] - A[..., 1, :]
    found = np.asarray(pseudo_inverse(jnp.asarray(A), 1e-5))
    np.testing.assert_allclose(found, np.linalg.pinv(A, rcond=1e-5), atol=20 * close(dtype)["atol"])


def test_pseudo_inverse_of_an_ill_conditioned_matrix(dtype):
    """What is balanced is balanced to eps cond, not to eps cond^2."""
    eps = np.finfo(dtype).eps
    A = np.linalg.qr(matrices(6, 6, "float64"))[0] * eps ** (np.arange(6) / 10)
    A = (A @ np.linalg.qr(matrices(6, 12, "float64").swapaxes(-1, -2))[0].swapaxes(-1, -2)).astype(dtype)
    P = np.asarray(pseudo_inverse(jnp.asarray(A), 64 * eps))
    assert np.linalg.cond(A).max() > 0.5 * eps**-0.5
    assert np.abs(A @ P - np.eye(6)).max() < 30 * eps**0.5


def test_solve_exchanges_rows(dtype):
    M, b = matrices(5, 5, dtype), matrices(5, 2, dtype)
    M[..., 0, 0] = 0.0
    M[..., 1, :2] = 0.0
    found = solve(jnp.asarray(M), jnp.asarray(b))
    np.testing.assert_allclose(found, np.linalg.solve(M, b), atol=1e3 * close(dtype)["atol"])
    assert not np.isfinite(solve(jnp.zeros((2, 2)), jnp.ones((2, 1)))).any()


def test_null_basis_is_orthonormal_and_complete(dtype):
    A, exists = matrices(3, 8, dtype), np.ones((2, 3, 8), bool)
    exists[0, :, 5:] = False
    exists[1, 0] = False
    A[1, 2, 2] = A[1, 2, 0] - A[1, 2, 1]
    A = np.where(exists[..., None, :], A, 0.0).astype(dtype)
    V = np.asarray(null_basis(jnp.asarray(A), jnp.asarray(exists), 1e-5))
    count = exists.sum(-1) - np.linalg.matrix_rank(A, rtol=1e-5)
    gram = np.swapaxes(V, -1, -2) @ V
    np.testing.assert_allclose(gram, (np.arange(8) < count[..., None])[..., None] * np.eye(8), **close(dtype))
    np.testing.assert_allclose(A @ V, 0.0, atol=20 * close(dtype)["atol"])
    assert (V[~exists] == 0).all()


@pytest.mark.parametrize(
    "function",
    [
        lambda A: singular_values(A),
        lambda A: pseudo_inverse(A, 1e-6),
        lambda A: solve(A[..., :3], A[..., 3:]),
        lambda A: (V := null_basis(A, jnp.ones(A.shape[-1:], bool), 1e-6)) @ V.T,
        lambda A: eigenvalues(A @ A.T),
    ],
    ids=["singular values", "pseudo-inverse", "solve", "null space", "eigenvalues"],
)
def test_derivatives_both_ways(function, dtype):
    if dtype == "float32":
        pytest.skip("differences need float64")
    A = jnp.asarray(np.random.default_rng(3).normal(size=(3, 5)))
    change = jnp.asarray(np.random.default_rng(4).normal(size=(3, 5)))
    step = 1e-6
    slope = (function(A + step * change) - function(A - step * change)) / (2 * step)
    value, forward = jax.jvp(function, (A,), (change,))
    np.testing.assert_allclose(forward, slope, atol=1e-7, rtol=1e-7)
    weight = jnp.cos(jnp.arange(value.size)).reshape(value.shape)
    backward = jax.grad(lambda A: jnp.sum(weight * function(A)))(A)
    np.testing.assert_allclose(jnp.sum(backward * change), jnp.sum(weight * slope), rtol=1e-6)
