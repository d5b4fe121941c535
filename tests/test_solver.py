"""The solver's parts against numpy, and the whole of it against Clarabel on cone programs that are no grasps."""

import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csc_matrix

from jaxgrasp.backend import tiles as lanes
from jaxgrasp.conic import (
    LinearConeProgram,
    LinearPoint,
    begin_linear_cone_program,
    solve_linear_cone_program,
)
from jaxgrasp.conic.cholesky import cholesky, cholesky_solve, inverse_frobenius, solve_transposed
from jaxgrasp.conic.gram_schmidt import orthonormal_rows
from jaxgrasp.conic.products import gram, matvec, rmatvec
from jaxgrasp.conic.singular_values import row_svd
from jaxgrasp.core.status import Status

LANES, K, TOLERANCE = 24, 4, 32 * np.finfo(float).eps


def columns_of(B, d):
    """(LANES, m, k d) with d components a cone to d arrays (m, k, LANES)."""
    parts = B.reshape(len(B), B.shape[1], -1, d)
    return tuple(jnp.asarray(np.moveaxis(parts[..., j], 0, -1)) for j in range(d))


def lower_columns(M):
    """Symmetric (LANES, m, m) to its lower columns (m - j, LANES)."""
    return tuple(jnp.asarray(M[:, j:, j].T) for j in range(M.shape[1]))


def vector(x):
    """(LANES, m) to (m, LANES)."""
    return jnp.asarray(x.T)


@pytest.mark.parametrize("m", [3, 6])
def test_cholesky_solves(m):
    rng = np.random.default_rng(m)
    B, rhs = rng.normal(size=(LANES, m, m + 3)), rng.normal(size=(LANES, m))
    M = B @ np.swapaxes(B, 1, 2)
    factor = cholesky(lower_columns(M), TOLERANCE)
    L = np.zeros((LANES, m, m))
    for j, column in enumerate(factor.columns):
        L[:, j:, j] = np.asarray(column).T
    np.testing.assert_allclose(L, np.linalg.cholesky(M), rtol=1e-10, atol=1e-12)
    x = np.asarray(cholesky_solve(factor, vector(rhs))).T
    np.testing.assert_allclose(x, np.linalg.solve(M, rhs[..., None])[..., 0], rtol=1e-7, atol=1e-9)
    expected = np.trace(np.linalg.inv(M), axis1=1, axis2=2)
    np.testing.assert_allclose(inverse_frobenius(factor), expected, rtol=1e-8)
    assert (np.asarray(inverse_frobenius(factor)) >= 1 / np.linalg.eigvalsh(M)[:, 0] * (1 - 1e-9)).all()


@pytest.mark.parametrize("m, rank", [(3, 2), (6, 5), (6, 3), (6, 1)])
def test_cholesky_solves_consistent_singular_systems(m, rank):
    rng = np.random.default_rng(10 * m + rank)
    B = rng.normal(size=(LANES, m, rank)) @ rng.normal(size=(LANES, rank, 9))
    M = B @ np.swapaxes(B, 1, 2)
    rhs = (M @ rng.normal(size=(LANES, m, 1)))[..., 0]
    factor = cholesky(lower_columns(M), TOLERANCE)
    x = np.asarray(cholesky_solve(factor, vector(rhs))).T
    size = np.linalg.norm(rhs, axis=-1)
    assert (np.linalg.norm((M @ x[..., None])[..., 0] - rhs, axis=-1) <= 1e-8 * size).all()
    # Rounding may pass for a pivot, but never for a smallest eigenvalue beyond rounding.
    largest = np.linalg.eigvalsh(M)[:, -1]
    assert (1 / np.asarray(inverse_frobenius(factor)) <= TOLERANCE * largest).all()
    assert (sum((np.asarray(v) > 0).astype(int) for v in factor.inverse) >= rank).all()


def test_cholesky_of_nothing_is_nothing():
    factor = cholesky(lower_columns(np.zeros((LANES, 6, 6))), TOLERANCE)
    assert (np.asarray(cholesky_solve(factor, vector(np.ones((LANES, 6))))) == 0).all()


def test_a_nan_lane_of_the_cholesky_is_alone():
    rng = np.random.default_rng(0)
    B = rng.normal(size=(LANES, 6, 9))
    M, rhs = B @ np.swapaxes(B, 1, 2), rng.normal(size=(LANES, 6))
    clean = np.asarray(cholesky_solve(cholesky(lower_columns(M), TOLERANCE), vector(rhs)))
    M[5] = np.nan
    dirty = np.asarray(cholesky_solve(cholesky(lower_columns(M), TOLERANCE), vector(rhs)))
    others = np.arange(LANES) != 5
    np.testing.assert_array_equal(clean[:, others], dirty[:, others])


@pytest.mark.parametrize("m, d", [(3, 1), (3, 2), (6, 1), (6, 3), (6, 4)])
def test_products_with_the_columns(m, d):
    rng = np.random.default_rng(m + d)
    B = rng.normal(size=(LANES, m, K * d))
    x, y = rng.normal(size=(LANES, K * d)), rng.normal(size=(LANES, m))
    columns = columns_of(B, d)
    parts = tuple(jnp.asarray(x.reshape(LANES, K, d)[..., j].T) for j in range(d))
    np.testing.assert_allclose(matvec(columns, parts).T, (B @ x[..., None])[..., 0], rtol=1e-11, atol=1e-12)
    back = np.stack(rmatvec(columns, vector(y)), -1)  # (K, LANES, d)
    expected = (np.swapaxes(B, 1, 2) @ y[..., None])[..., 0].reshape(LANES, K, d)
    np.testing.assert_allclose(np.moveaxis(back, 1, 0), expected, rtol=1e-11, atol=1e-12)
    M = B @ np.swapaxes(B, 1, 2)
    for j, column in enumerate(gram(columns)):
        np.testing.assert_allclose(column.T, M[:, j:, j], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("kind", ["full", "deficient", "graded", "wide rows"])
def test_row_svd(m, kind):
    rng = np.random.default_rng(m)
    A = rng.normal(size=(LANES, m, 12))
    if kind == "deficient":
        A[:, -1] = A[:, 0] - 2 * A[:, 1]
    elif kind == "graded":  # singular values from 1 to 1e-12 in general position
        u, _, vt = np.linalg.svd(A, full_matrices=False)
        A = u * np.logspace(0, -12, m) @ vt
    elif kind == "wide rows":
        A = A * np.logspace(0, -12, m)[:, None]
    svd = row_svd(jnp.asarray(np.moveaxis(A, 0, -1)))
    values, vectors = np.asarray(svd.values).T, np.moveaxis(np.asarray(svd.vectors), -1, 0)
    expected = np.linalg.svd(A, compute_uv=False)
    largest = expected[:, :1]
    np.testing.assert_allclose(-np.sort(-values, 1) / largest, expected / largest, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        vectors @ np.swapaxes(vectors, 1, 2), np.tile(np.eye(m), (LANES, 1, 1)), atol=1e-13
    )
    images = np.linalg.norm(vectors @ A, axis=-1)
    np.testing.assert_allclose(images / largest, values / largest, rtol=0, atol=1e-14)
    smallest, null = svd.smallest()
    np.testing.assert_array_equal(smallest, values.min(1))
    residual = np.linalg.norm(np.einsum("ml,lmn->ln", null, A), axis=-1)
    assert (residual <= expected[:, -1] + 1e-14 * largest[:, 0]).all()
    if kind in ("graded", "wide rows"):
        np.testing.assert_allclose(smallest, expected[:, -1], rtol=1e-2)


# The whole solver ---------------------------------------------------------------------------------------


def random_programs(d, m=3, lanes_count=LANES, seed=0):
    """Strictly feasible on both sides: b = B u_0 and c = B^T y_0 + z_0 for interior u_0 and z_0."""
    rng = np.random.default_rng(seed + d)

    def interior():
        x = rng.normal(size=(lanes_count, K, d))
        x[..., 0] = np.linalg.norm(x[..., 1:], axis=-1) + rng.uniform(0.1, 1.0, (lanes_count, K))
        return x

    B, y = rng.normal(size=(lanes_count, m, K * d)), rng.normal(size=(lanes_count, m))
    u, z = interior(), interior()
    b = (B @ u.reshape(lanes_count, -1, 1))[..., 0]
    c = (np.swapaxes(B, 1, 2) @ y[..., None])[..., 0].reshape(lanes_count, K, d) + z
    return B, b, c, y, u, z


def split(x):
    """(LANES, K, d) to d arrays (K, LANES)."""
    return tuple(jnp.asarray(np.moveaxis(x[..., j], 0, -1)) for j in range(x.shape[-1]))


def tile_of(B, b, c, y, u, z):
    program = LinearConeProgram(columns_of(B, c.shape[-1]), vector(b), split(c), jnp.ones((K, len(B))), 0.25)
    return program, LinearPoint(vector(y), split(u), split(z))


def run(program, point, tolerance=1e-9, budget=40, skip=None):
    skip = jnp.zeros(point.y[0].shape, bool) if skip is None else jnp.asarray(skip)

    @jax.jit
    def go(program, point, skip, tolerance, budget):
        return solve_linear_cone_program(
            program._replace(constant=0.25),
            begin_linear_cone_program(program, point, skip),
            tolerance,
            budget,
        )

    return go(program, point, skip, jnp.asarray(tolerance), jnp.int32(budget))


def clarabel_value(B, b, c):
    """min <c, u> subject to B u = b, u in K."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    size, d = c.size, c.shape[-1]
    A = csc_matrix(np.concatenate([B, -np.eye(size)]))
    cones = [
        clarabel.ZeroConeT(len(b)),
        *([clarabel.SecondOrderConeT(d)] * K if d > 1 else [clarabel.NonnegativeConeT(K)]),
    ]
    right = np.concatenate([b, np.zeros(size)])
    solution = clarabel.DefaultSolver(csc_matrix((size, size)), c.ravel(), A, right, cones, settings).solve()
    assert solution.status in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved)
    return float(solution.obj_val)


@pytest.mark.parametrize("d", [1, 3, 4])
def test_random_cone_programs_against_clarabel(d):
    data = random_programs(d)
    program, point = tile_of(*data)
    end = run(program, point)
    assert (np.asarray(end.stop) == Status.CONVERGED).all()
    expected = np.array([clarabel_value(*one) for one in zip(*data[:3], strict=True)])
    size = np.maximum(1.0, np.abs(expected))
    assert (np.abs(program.primal_value(end.point.u) - 0.25 - expected) <= 1e-7 * size).all()
    assert (np.abs(program.dual_value(end.point.y) - 0.25 - expected) <= 1e-7 * size).all()
    residual, complementarity = program.optimality(end.point.y, end.point.u)
    assert np.abs(np.asarray(residual)).max() < 1e-8
    slack = program.slack(end.point.y)
    assert (np.asarray(complementarity[0]).sum(0) <= 1e-8 * size).all()
    # |u_0 z_1 + z_0 u_1|^2 <= 2 u_0 z_0 <u, z> for any two points of the cone
    bound = np.sqrt(2 * np.asarray(end.point.u[0] * slack[0] * np.maximum(complementarity[0], 0)))
    tail = np.sqrt(sum(np.asarray(x) ** 2 for x in complementarity[1:]))
    assert (tail <= bound + 1e-7).all()
    for kept, exact in zip(end.point.z, slack, strict=True):
        np.testing.assert_allclose(kept, exact, atol=1e-9)
    assert (np.asarray(end.iterations) <= 15).all()


@pytest.fixture(scope="module")
def tile():
    return tile_of(*random_programs(3, seed=50))


def lane_bits(state, lanes_kept):
    return [np.asarray(x)[..., lanes_kept].tobytes() for x in jax.tree.leaves(state)]


def test_finished_lanes_are_frozen_whole(tile):
    """A lane is the same bit for bit whether the loop goes on for others or not."""
    program, point = tile
    budgets = [run(program, point, budget=n) for n in (6, 7, 8, 40)]
    for early, late in pairwise(budgets):
        done = np.flatnonzero(np.asarray(early.stop) != Status.RUNNING)
        assert lane_bits(early, done) == lane_bits(late, done)
    assert len(set(np.asarray(budgets[-1].iterations).tolist())) > 1


def test_a_finished_lane_keeps_its_iterate_when_solved_again(tile):
    program, point = tile
    end = run(program, point)
    again = jax.jit(
        lambda p, s: solve_linear_cone_program(p._replace(constant=0.25), s, jnp.asarray(1e-14), jnp.int32(5))
    )(program, end)
    assert lane_bits(end, slice(None)) == lane_bits(again, slice(None))


def test_budgets_of_nothing_and_of_one_step(tile):
    program, point = tile
    none = run(program, point, budget=0)
    assert (np.asarray(none.stop) == Status.RUNNING).all()
    assert (np.asarray(none.iterations) == 0).all()
    assert lane_bits(none.point, slice(None)) == lane_bits(point, slice(None))
    one = run(program, point, budget=1)
    assert (np.asarray(one.iterations) == 1).all()
    assert (np.asarray(one.gap) < np.asarray(none.gap)).all()


def test_interrupting_changes_no_bit(tile):
    program, point = tile
    whole = run(program, point, budget=9)
    step = jax.jit(
        lambda p, s, n: solve_linear_cone_program(p._replace(constant=0.25), s, jnp.asarray(1e-9), n)
    )
    half = step(program, run(program, point, budget=4), jnp.int32(5))
    assert lane_bits(whole, slice(None)) == lane_bits(half, slice(None))


def test_a_nan_lane_stays_alone_and_says_so(tile):
    program, point = tile
    clean = run(program, point)
    bad = program._replace(rhs=program.rhs.at[:, 3].set(jnp.nan))
    dirty = run(bad, point)
    others = np.flatnonzero(np.arange(LANES) != 3)
    assert lane_bits(clean, others) == lane_bits(dirty, others)
    assert int(dirty.stop[3]) == Status.BREAKDOWN
    assert lane_bits(dirty.point, [3]) == lane_bits(point, [3])  # the best iterate: the start
    assert int(dirty.iterations[3]) == 1


def test_skipped_lanes_never_run(tile):
    program, point = tile
    skip = np.arange(LANES) % 4 == 1
    end = run(program, point, skip=skip)
    np.testing.assert_array_equal(np.asarray(end.stop) == Status.SKIPPED, skip)
    assert (np.asarray(end.iterations)[skip] == 0).all()
    assert lane_bits(end.point, np.flatnonzero(skip)) == lane_bits(point, np.flatnonzero(skip))
    assert (np.asarray(end.stop)[~skip] == Status.CONVERGED).all()


def test_an_impossible_tolerance_stalls_on_the_best_iterate(tile):
    program, point = tile
    end = run(program, point, tolerance=1e-30, budget=200)
    assert set(np.unique(end.stop)) <= {Status.STALLED, Status.BREAKDOWN}
    assert (np.asarray(end.iterations) < 200).all()
    assert (np.asarray(end.gap) < 1e-9).all()


def test_a_question_stops_the_lanes_it_is_answered_for(tile):
    program, point = tile
    gap = begin_linear_cone_program(program, point, jnp.zeros(LANES, bool)).gap

    def decided(program, iterate):
        return program.primal_value(iterate.u) - program.dual_value(iterate.y) < 0.1

    state = begin_linear_cone_program(program, point, jnp.zeros(LANES, bool))
    go = jax.jit(
        lambda p, s: solve_linear_cone_program(
            p._replace(constant=0.25), s, jnp.asarray(1e-9), jnp.int32(40), decided
        )
    )
    end = go(program, state)
    assert (np.asarray(end.stop) == Status.DECIDED).all()
    assert (np.asarray(end.gap) < 0.1).all()
    assert (np.asarray(gap) > 0.1).all()


def test_padding_cones_take_no_part():
    """The same program with a cone that does not exist: zero columns, e as its u."""
    B, b, c, y, u, z = random_programs(3, seed=70)
    program, point = tile_of(B, b, c, y, u, z)
    end = run(program, point)
    pad = jnp.ones((1, LANES))
    padded = program._replace(
        columns=tuple(jnp.concatenate([x, jnp.zeros((3, 1, LANES))], 1) for x in program.columns),
        cost=tuple(jnp.concatenate([x, 0 * pad]) for x in program.cost),
        exists=jnp.concatenate([program.exists, 0 * pad]),
    )
    unit = (pad, 0 * pad, 0 * pad)
    wider = LinearPoint(
        point.y,
        tuple(jnp.concatenate([x, e]) for x, e in zip(point.u, unit, strict=True)),
        tuple(jnp.concatenate([x, e]) for x, e in zip(point.z, unit, strict=True)),
    )
    wide = run(padded, wider)
    np.testing.assert_array_equal(wide.stop, end.stop)
    np.testing.assert_allclose(
        padded.primal_value(wide.point.u), program.primal_value(end.point.u), atol=1e-7
    )


# Lanes and kernels --------------------------------------------------------------------------------------


def test_map_selected_touches_only_what_is_selected():
    rows = (jnp.arange(16.0), jnp.arange(32.0).reshape(16, 2))
    selected = jnp.asarray(np.random.default_rng(0).random(16) < 0.4)
    out = lanes.map_selected(lambda tile: tile[0] * 10 + tile[1][:, 1], selected, rows, -jnp.ones(16), 4)
    expected = np.where(selected, np.arange(16.0) * 10 + np.arange(1.0, 32, 2), -1)
    np.testing.assert_array_equal(out, expected)
    none = lanes.map_selected(lambda tile: tile[0], jnp.zeros(16, bool), rows, -jnp.ones(16), 4)
    np.testing.assert_array_equal(none, -np.ones(16))


def test_map_tiles_works_as_far_as_asked():
    rows = jnp.arange(16.0)
    out = lanes.map_tiles(lambda x: 2 * x, rows, jnp.int32(5), 4)
    np.testing.assert_array_equal(out, np.where(np.arange(16) < 8, 2 * np.arange(16.0), 0))


KERNELS = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxgrasp as jg
from jaxgrasp.backend import xla as stages
from grasps import random_coefficients, random_contacts

def double(x):
    return 2 * x
called = ["jit" in str(jax.make_jaxpr(cut(double))(1.0)) for cut in (stages.stage, stages.kernel)]
rng = np.random.default_rng(2)
position, normal, _ = random_contacts(rng, 300, 3, 2)
friction, _ = random_coefficients(rng, 300, 3)
res = jg.wrench_resistance(jg.Grasp(position, normal, jg.HardFinger(friction)), tolerance=1e-11)
fields = {name: getattr(res, name) for name in ("status", "margin", "gap", "rank")}
np.savez(sys.argv[1], called=called, **fields)
"""


def test_kernels_off_gives_the_same_answers(tmp_path):
    here = Path(__file__).resolve().parent
    answers = {}
    for switch in ("on", "off"):
        environment = {
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "JAXGRASP_KERNELS": switch,
            "PYTHONPATH": os.pathsep.join([str(here.parent), str(here / "tables")]),
        }
        path = tmp_path / f"{switch}.npz"
        subprocess.run([sys.executable, "-c", KERNELS, str(path)], env=environment, check=True, timeout=300)
        with np.load(path) as file:
            answers[switch] = {name: file[name] for name in file.files}
    on, off = answers["on"], answers["off"]
    assert on["called"].tolist() == [True, True]
    assert off["called"].tolist() == [True, False]  # stages stay
    np.testing.assert_array_equal(on["status"], off["status"])
    np.testing.assert_array_equal(on["rank"], off["rank"])
    np.testing.assert_array_equal(np.isneginf(on["margin"]), np.isneginf(off["margin"]))
    finite = np.isfinite(on["margin"])
    margins, gaps = (np.stack([on[name][finite], off[name][finite]]) for name in ("margin", "gap"))
    scale = np.maximum(1.0, np.abs(margins[0]))
    assert (margins.max(0) <= (margins + gaps).min(0) + 1e-10 * scale).all()  # the brackets overlap
    closed = gaps.max(0) <= 5e-10 * scale
    assert closed.mean() > 0.97  # near a lost rank brackets are as wide as rounding makes them
    assert (np.abs(margins[0] - margins[1]) <= 1e-9 * scale)[closed].all()


@pytest.mark.parametrize("m", [3, 6])
def test_orthonormal_rows_reproduce_the_matrix(m, dtype):
    """A = L Q, Q Q^T = I on the independent rows; a dependent row becomes zero, a graded one stays orthogonal."""
    rng = np.random.default_rng(m)
    A = rng.normal(size=(m, 4, 3, 8))
    A[-1, ..., 1] = A[0, ..., 1] - 2 * A[1, ..., 1]  # dependent
    A[-1, ..., 2] = A[0, ..., 2] + (1e-9 if dtype == "float64" else 1e-3) * A[-1, ..., 2]  # nearly so
    A = A.astype(dtype)
    eps = np.finfo(dtype).eps
    floor = 64 * eps * np.sqrt((A**2).sum((0, 1, 2)))
    columns = tuple(jnp.asarray(A[:, :, j]) for j in range(3))
    rows, factor = orthonormal_rows(columns, jnp.asarray(floor.astype(dtype)))
    Q = np.stack([np.asarray(r) for r in rows], 2)
    L = np.zeros((m, m, 8))
    for j, column in enumerate(factor.columns):
        L[j:, j] = np.asarray(column)
    np.testing.assert_allclose(np.einsum("ijl,jkdl->ikdl", L, Q), A, atol=100 * eps)
    product = np.einsum("ikdl,jkdl->ijl", Q, Q)
    expected = np.repeat(np.eye(m)[..., None], 8, -1)
    expected[-1, -1, 1] = 0
    np.testing.assert_allclose(product, expected, atol=50 * eps)
    y = rng.normal(size=(m, 8)).astype(dtype)
    twist = np.asarray(solve_transposed(factor, jnp.asarray(y)))
    kept = np.delete(np.arange(8), [1, 2])
    np.testing.assert_allclose(np.einsum("jil,jl->il", L, twist)[:, kept], y[:, kept], atol=1e4 * eps)


def test_packing_gives_back_what_it_took():
    rows = {
        "a": jnp.arange(12.0).reshape(3, 2, 2),
        "none": jnp.zeros((3, 0)),
        "flag": jnp.array([True, False, True]),
        "count": jnp.array([1, 2, 3], jnp.int32),
        "b": jnp.arange(3.0),
    }
    packing = lanes.Packing(rows)
    packed = packing.pack(rows)
    assert {name: x.shape for name, x in packed.items()} == {
        "bool": (3, 1),
        "int32": (3, 1),
        rows["a"].dtype.name: (3, 5),
    }
    back = packing.unpack(packed)
    for name, x in rows.items():
        np.testing.assert_array_equal(back[name], x)
        assert back[name].dtype == x.dtype and back[name].shape == x.shape


def test_sweeps_return_to_what_is_unfinished_and_to_nothing_else():
    """Each row counts down to zero, two a sweep; rows beyond the count stay zero."""
    rows = jnp.array([1, 2, 3, 4, 5, 6, 7, 8], jnp.int32)
    shapes = {"left": rows, "sweeps": rows}

    def step(start, _, out, sweep):
        left = jnp.where(sweep == 0, start, out["left"])
        return {"left": jnp.maximum(left - 2, 0), "sweeps": out["sweeps"] + 1}

    sweeps = lanes.Sweeps(step, lambda out: out["left"] > 0, 3)
    out = lanes.in_sweeps(sweeps, rows, None, shapes, jnp.int32(7), 4)
    np.testing.assert_array_equal(out["left"], [0, 0, 0, 0, 0, 0, 1, 0])
    np.testing.assert_array_equal(out["sweeps"], [1, 1, 2, 2, 3, 3, 3, 0])


def test_what_a_sweep_makes_necessary_is_known_in_the_next():
    """Odd rows ask for their square and are answered before the second sweep; nobody else is."""
    rows = jnp.arange(8, dtype=jnp.int32)
    shapes = {"asks": rows, "answer": rows}

    def step(start, square, out, sweep):
        return {"asks": jnp.where(sweep == 0, start % 2, 0), "answer": square}

    def between(square, out):
        return jnp.where(out["asks"] > 0, rows * rows, square)

    sweeps = lanes.Sweeps(step, lambda out: out["asks"] > 0, 2, between)
    out = lanes.in_sweeps(sweeps, rows, jnp.full(8, -1, jnp.int32), shapes, jnp.int32(8), 4)
    np.testing.assert_array_equal(out["answer"], [-1, 1, -1, 9, -1, 25, -1, 49])
