"""One grasp's iterations, and the file that reproduces a lane."""

import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_coefficients, random_contacts
from shapes import PLANAR, SOFT

import jaxgrasp as jg
from jaxgrasp.core.status import Status


@pytest.fixture(scope="module", params=["planar", pytest.param("soft", marks=pytest.mark.slow)])
def grasps(request, dtype):
    """Hard fingers in the plane: of the three shapes the one that compiles fastest. Soft ones in space: slowly."""
    rng = np.random.default_rng(21)
    k, dimension = (PLANAR, 2) if request.param == "planar" else (SOFT, 3)
    position, normal, _ = random_contacts(rng, 40, k, dimension)
    friction, torsion = random_coefficients(rng, 40, k)
    friction += 0.05
    if dimension == 2:
        model = jg.HardFinger(friction.astype(dtype))
    else:
        model = jg.SoftFinger(friction.astype(dtype), torsion.astype(dtype))
    active = np.ones((40, k), bool)
    active[7, k // 2 + k % 2 :] = False
    return jg.Grasp(position.astype(dtype), normal.astype(dtype), model, active)


@pytest.fixture(scope="module")
def results(grasps):
    return jg.wrench_resistance(grasps)


@pytest.fixture(scope="module")
def lane(results):
    """A resistant lane that took its iterations."""
    busy = (np.asarray(results.status) == jg.Status.RESISTANT) & (np.asarray(results.iterations) >= 5)
    return int(np.flatnonzero(busy)[0])


@pytest.fixture(scope="module")
def traced(grasps, lane):
    return jg.trace(grasps[lane])


def test_the_bracket_shrinks_around_the_margin(traced, results, lane):
    lower, upper = np.asarray(traced.lower), np.asarray(traced.upper)
    margin, gap = float(results.margin[lane]), float(results.gap[lane])
    assert (upper >= margin - 1e-9).all()
    assert (lower <= margin + gap + 1e-9).all()
    np.testing.assert_allclose(upper - lower, traced.gap, atol=1e-9)
    assert (np.diff(traced.gap) < 0).all()
    assert traced.gap[-1] <= 1e-8 < traced.gap[-2]


def test_the_trace_tells_what_the_solver_did(traced, results, lane):
    assert len(traced.gap) == int(results.iterations[lane]) + 1
    assert traced.stop == Status.CONVERGED == int(results.stop[lane])
    assert np.isnan([traced.residual[0], traced.centering[0], traced.length[0]]).all()
    assert (np.asarray(traced.residual[1:]) < 1e-9).all()
    for field in (traced.centering, traced.length):
        assert ((np.asarray(field[1:]) >= 0) & (np.asarray(field[1:]) <= 1)).all()
    assert (np.asarray(traced.length[1:]) > 0.1).all()


def test_the_table_has_a_row_an_iteration_and_the_reason(traced):
    lines = str(traced).splitlines()
    assert len(lines) == len(traced.gap) + 2
    for word in ("iteration", "lower bound", "upper bound", "gap", "residual", "length"):
        assert word in lines[0]
    assert [int(line.split()[0]) for line in lines[1:-1]] == list(range(len(traced.gap)))
    last = lines[-2].split()
    assert float(last[1]) == pytest.approx(float(traced.lower[-1]), abs=1e-9)
    assert lines[-1] == Status.CONVERGED.sentence


def test_a_short_budget_and_a_loose_tolerance_are_obeyed(grasps, lane):
    short = jg.trace(grasps[lane], max_iterations=2)
    assert len(short.gap) == 3
    assert short.stop == Status.RUNNING
    assert str(short).endswith(Status.RUNNING.sentence)
    loose = jg.trace(grasps[lane], tolerance=1e-2)
    assert loose.gap[-1] <= 1e-2 < loose.gap[-2]


def test_a_batch_is_refused_with_advice(grasps):
    with pytest.raises(ValueError, match=r"one grasp; index the batch \(40,\)"):
        jg.trace(grasps)


def test_a_lane_that_is_no_grasp_is_skipped(grasps):
    shape, dtype = grasps.position.shape[1:], grasps.position.dtype
    model = jg.HardFinger if grasps.dimension == 2 else jg.SoftFinger
    invalid = jg.Grasp(np.full(shape, np.nan, dtype), np.ones(shape, dtype), model(np.asarray(0.5, dtype)))
    traced = jg.trace(invalid)
    assert traced.stop == Status.SKIPPED
    assert len(traced.gap) == 1


def bits(tree):
    return [np.asarray(x).tobytes() for x in jax.tree.leaves(tree)]


@pytest.mark.f32
def test_a_saved_lane_reproduces_its_verdict_bit_for_bit(tmp_path, grasps, results):
    for i in (0, 7, 19):
        path = tmp_path / f"lane{i}.npz"
        jg.save_grasp(grasps[i], path)
        again = jg.load_grasp(path)
        assert again.position.dtype == grasps.position.dtype
        assert type(again.model) is type(grasps.model)
        assert bits(again) == bits(grasps[i])
        assert bits(jg.wrench_resistance(again)) == bits(jax.tree.map(lambda x, i=i: x[i], results))


@pytest.mark.parametrize("model", [jg.HardFinger(0.3), jg.Frictionless(), jg.SoftFinger(0.3, 0.2)])
def test_every_model_survives_the_file(tmp_path, model):
    rng = np.random.default_rng(0)
    grasp = jg.Grasp(rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), model, np.array([True, True, False]))
    jg.save_grasp(grasp, tmp_path / "lane.npz")
    again = jg.load_grasp(tmp_path / "lane.npz")
    assert type(again.model) is type(model)
    assert bits(again) == bits(grasp)


def test_numbers_that_are_no_grasp_survive_too(tmp_path):
    """A bug report needs the NaN payload as it was."""
    position = np.array([[0.1, np.nan, np.inf], [1e-320, -0.0, 2.0]])
    grasp = jg.Grasp(position, -position, jg.HardFinger(np.array([-1.0, np.nan])))
    jg.save_grasp(grasp, tmp_path / "lane.npz")
    assert bits(jg.load_grasp(tmp_path / "lane.npz")) == bits(grasp)


def test_the_file_is_replaced_whole_and_nothing_is_left_beside_it(tmp_path, grasps):
    path = tmp_path / "lane.npz"
    jg.save_grasp(grasps[0], path)
    jg.save_grasp(grasps[1], str(path))
    assert bits(jg.load_grasp(path)) == bits(grasps[1])
    assert [p.name for p in tmp_path.iterdir()] == ["lane.npz"]


def test_a_failed_write_leaves_the_old_file(tmp_path, grasps, monkeypatch):
    path = tmp_path / "lane.npz"
    jg.save_grasp(grasps[0], path)
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", fail)
    with pytest.raises(OSError, match="disk full"):
        jg.save_grasp(grasps[1], path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["lane.npz"]


def test_an_unknown_model_is_refused_before_anything_is_written(tmp_path, grasps):
    class Sticky(jg.HardFinger):
        def with_coefficients(self, friction, torsion):
            return Sticky(friction)

    grasp = jg.Grasp(grasps.position[0], grasps.normal[0], Sticky(0.3))
    with pytest.raises(ValueError, match="contact model Sticky; known models"):
        jg.save_grasp(grasp, tmp_path / "lane.npz")
    assert list(tmp_path.iterdir()) == []


def fields(path):
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def header(**changes):
    entries = {"format": "jaxgrasp lane", "version": 1, "model": "HardFinger", **changes}
    return np.frombuffer(json.dumps(entries).encode(), np.uint8)


class Armed:
    """Unpickling this would call ``fired``."""

    calls = 0

    def __reduce__(self):
        return (fired, ())


def fired():
    Armed.calls += 1
    return 0


def spoiled(kind, path, grasps):
    jg.save_grasp(grasps[0], path)
    content, arrays = path.read_bytes(), fields(path)
    if kind == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("not a zip archive")
    elif kind == "pickle":
        path.write_bytes(pickle.dumps(Armed()))
    elif kind == "object array":
        np.savez(path, **{**arrays, "position": np.array([Armed()], dtype=object)})
    elif kind == "flipped bytes":
        middle = content.index(b"position") + 200
        path.write_bytes(
            content[:middle] + bytes(255 - b for b in content[middle : middle + 8]) + content[middle + 8 :]
        )
    elif kind == "foreign archive":
        np.savez(path, x=np.zeros(3))
    elif kind == "foreign array":
        with open(path, "wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "unknown model":
        np.savez(path, **{**arrays, "header": header(model="Suction")})
    elif kind == "foreign header":
        np.savez(path, **{**arrays, "header": header(format="something else")})
    elif kind == "newer version":
        np.savez(path, **{**arrays, "header": header(version=99)})
    elif kind == "header is a list":
        np.savez(path, **{**arrays, "header": np.frombuffer(b"[1, 2]", np.uint8)})
    elif kind == "wrong shape":
        np.savez(path, **{**arrays, "normal": arrays["normal"][:2]})
    elif kind == "missing":
        path.unlink()


KINDS = [
    "truncated",
    "empty",
    "text",
    "pickle",
    "object array",
    "flipped bytes",
    "foreign archive",
    "foreign array",
    "unknown model",
    "foreign header",
    "newer version",
    "header is a list",
    "wrong shape",
    "missing",
]


@pytest.mark.parametrize("kind", KINDS)
def test_anything_else_is_refused_with_the_path(tmp_path, grasps, kind):
    path = tmp_path / "lane.npz"
    spoiled(kind, path, grasps)
    Armed.calls = 0
    with pytest.raises(ValueError, match=r"lane\.npz"):
        jg.load_grasp(path)
    assert Armed.calls == 0


def test_the_trace_is_a_pytree_of_the_grasps_dtype(traced, dtype):
    assert all(x.dtype == jnp.dtype(dtype) for x in jax.tree.leaves(traced))
