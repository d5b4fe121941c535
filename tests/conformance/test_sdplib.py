"""SDPLIB's small problems: no bracket contradicts a published value; rays and multipliers prove the others."""

import numpy as np
import pytest
from exact_matrix import at, excludes_all, is_ray, is_semidefinite
from published import DIGITS, SDPLIB, read_sdpa
from real_data import real_data

import jaxgrasp as jg
from jaxgrasp import Status

pytestmark = pytest.mark.realdata

POSED = ["truss1", "truss4", "control1"]
# No Z > 0 is a dual point of these: upper bounds alone, or brackets that do not close.
ILL_POSED = [f"hinf{i}" for i in range(1, 11)]


def solved(name):
    u, constant, matrices = read_sdpa(real_data("conformance") / "sdplib" / f"{name}.dat-s")
    return jg.lmi.sdp_minimize(u, constant, matrices), u, constant, matrices


def check_bracket(name, out, u, constant, matrices):
    x, value, width = np.asarray(out.x), SDPLIB[name], DIGITS[name]
    assert is_semidefinite(at(x, constant, matrices))
    assert u @ x <= float(out.upper) <= u @ x + 1e-9 * (1 + np.abs(u) @ np.abs(x))
    assert float(out.lower) <= value + width
    assert float(out.upper) >= value - width
    if np.isfinite(out.lower):
        Z = np.asarray(out.Z)
        assert is_semidefinite(Z)
        rest = np.einsum("iab,ab->i", matrices, Z) - u
        assert np.all(np.abs(rest) <= 1e-13 * np.linalg.norm(Z) * np.linalg.norm(matrices, axis=(1, 2)))
        np.testing.assert_allclose(-np.sum(constant * Z), out.lower, rtol=1e-9)


def test_semidefinite_matrices_are_told_from_others_by_one_bit():
    tiny = 2.0**-52
    assert is_semidefinite(np.array([[1.0, 1], [1, 1]])) and is_semidefinite(np.zeros((3, 3)))
    assert not is_semidefinite(np.array([[1.0, 1 + tiny], [1 + tiny, 1]]))
    assert is_semidefinite(np.array([[1 + tiny, 1, 0], [1, 1, 0], [0, 0, 0]]))
    assert not is_semidefinite(np.array([[0.0, tiny], [tiny, 1]]))
    assert is_semidefinite(at(np.array([0.1]), -0.1 * np.eye(2), np.eye(2)[None]))
    assert not is_semidefinite(at(np.array([0.1]), -0.30000000000000004 * np.eye(2), 3 * np.eye(2)[None]))
    root = np.random.default_rng(0).normal(size=(30, 20))
    exact = np.array([[int(v) for v in row] for row in np.round(1e3 * root)], dtype=object)
    assert is_semidefinite(exact @ exact.T)


@pytest.mark.parametrize(
    "name",
    ["truss4", *(pytest.param(n, marks=pytest.mark.slow("test_well_posed_problems_are_optimal")) for n in (
        "truss1", "truss2", "truss3", "control1", "control2", "theta1",
    ))],
)  # fmt: skip
def test_well_posed_problems_are_optimal(name):
    out, *problem = solved(name)
    assert out.status == Status.OPTIMAL
    check_bracket(name, out, *problem)
    assert float(out.gap) <= 1e-8 * max(1, abs(SDPLIB[name])) * 1.01
    assert abs(float(out.upper) - SDPLIB[name]) <= DIGITS[name]


@pytest.mark.parametrize(
    "name",
    ["hinf3", *(pytest.param(n, marks=pytest.mark.slow("test_ill_posed_problems_are_undecided_or_right"))
                for n in ILL_POSED if n != "hinf3")],
)  # fmt: skip
def test_ill_posed_problems_are_undecided_or_right(name):
    """The cost of the point is the published one to its few digits; the bound is a true one or none."""
    out, *problem = solved(name)
    assert Status(out.status) in (Status.OPTIMAL, Status.STALLED)
    check_bracket(name, out, *problem)
    assert abs(float(out.upper) - SDPLIB[name]) <= DIGITS[name]


@pytest.mark.parametrize("name", ["infd1", "infd2"])
def test_unbounded_problems_have_a_ray(name):
    """The cost falls along the ray, S(x) stays positive: at x, and what the ray adds is never negative."""
    out, u, constant, matrices = solved(name)
    assert out.status == Status.UNBOUNDED
    x, ray = np.asarray(out.x), np.asarray(out.ray)
    assert u @ ray < -1e-3 * np.linalg.norm(u) * np.linalg.norm(ray)
    assert is_ray(u, matrices, ray)
    assert is_semidefinite(at(x, constant, matrices))
    assert float(out.lower) == -np.inf


@pytest.mark.parametrize("name", ["infp1", "infp2"])
def test_infeasible_problems_have_multipliers(name):
    """``Z > 0, tr(S_i Z) = 0, tr(S_0 Z) < 0``, for every x."""
    out, _, constant, matrices = solved(name)
    assert out.status == Status.INFEASIBLE
    assert float(out.lower) == float(out.upper) == float(out.feasibility.reach) == np.inf
    assert excludes_all(constant, matrices, np.asarray(out.Z))
