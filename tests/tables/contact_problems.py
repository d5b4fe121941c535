"""Contact problems of the Siconos collection as this library's problems, and Clarabel's answers to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import clarabel
import numpy as np
from published import Bodies, read_contact_problem
from scipy.linalg import block_diag
from scipy.sparse import csc_matrix

import jaxgrasp as jg

LOADS = 32  # a body
DENSE = ["Rover4396", "FC3D_Example1", "FrictionContactProblem00394", "Rover1039", "Rover11211", "Rover4144",
         "Rover4493", "Rover4516", "Rover4622"]  # fmt: skip


def clarabel_cones(P, q, A, b, cones) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    return clarabel.DefaultSolver(csc_matrix(P), q, csc_matrix(A), b, cones, settings).solve()


def loads(bodies: Bodies, G: np.ndarray) -> np.ndarray:
    """(bodies, LOADS, 6): the file's weight, forces from inside all cones, and directions at random."""
    rng = np.random.default_rng(8)
    count, k = bodies.active.shape
    w = np.empty((count, LOADS, 6))
    w[:, 0] = bodies.weight / np.linalg.norm(bodies.weight, axis=1, keepdims=True)
    inside = rng.normal(size=(count, 10, k, 3))
    inside[..., :2] *= (0.9 * bodies.friction * rng.random((count, 10, k, 1))) / np.linalg.norm(
        inside[..., :2], axis=-1, keepdims=True
    )
    inside[..., 2] = 1.0
    push = rng.random((count, 10, k, 1)) * bodies.active[:, None, :, None]
    w[:, 1:11] = -np.einsum("bij,blj->bli", G, (inside * push).reshape(count, 10, -1))
    other = rng.normal(size=(count, LOADS - 11, 6))
    w[:, 11:] = other / np.linalg.norm(other, axis=-1, keepdims=True)
    return w


def clarabel_sums(bodies: Bodies, G: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """(bodies, loads): the smallest sum of normal forces that balances each load; infinite where Clarabel finds it
    impossible, NaN where it does not know."""
    k, mu = bodies.active.shape[1], bodies.friction
    cone = np.zeros((3 * k, 3 * k))
    for i in range(k):
        cone[3 * i, 3 * i + 2], cone[3 * i + 1, 3 * i], cone[3 * i + 2, 3 * i + 1] = -mu, -1.0, -1.0
    price = np.zeros(3 * k)
    price[np.arange(k) * 3 + 2] = 1.0
    cones = [clarabel.ZeroConeT(6), *[clarabel.SecondOrderConeT(3)] * k]
    found = np.empty(wrench.shape[:2])
    for i, j in np.ndindex(*found.shape):
        right = np.append(-wrench[i, j], np.zeros(3 * k))
        answer = clarabel_cones(np.zeros((3 * k,) * 2), price, np.concatenate([G[i], cone]), right, cones)
        known = {"Solved": answer.obj_val, "PrimalInfeasible": np.inf}
        found[i, j] = known.get(str(answer.status), np.nan)
    return found


def local_problem(path: Path) -> tuple[jg.lmi.LMIProblem, float]:
    """``min r.W r / 2 + q.r / |q|`` over the friction cones, the convex part of a contact problem; Clarabel's value."""
    n, W, q, mu = read_contact_problem(path)
    W, q, contacts = (W + W.T) / 2, q / np.abs(q).max(), len(mu)
    blocks, A, cones = [], [], []
    for i in range(contacts):
        tangents = np.zeros((n - 1, n * contacts))
        tangents[np.arange(n - 1), n * i + 1 + np.arange(n - 1)] = 1.0
        height = np.zeros(n * contacts)
        height[n * i] = mu[i]
        blocks.append(jg.lmi.second_order_cone_lmi(tangents, np.zeros(n - 1), height, 0.0))
        A += [-height[None], -tangents]
        cones.append(clarabel.SecondOrderConeT(n))
    constant = block_diag(*(np.asarray(block[0]) for block in blocks))
    matrices = np.array([block_diag(*(np.asarray(b[1])[j] for b in blocks)) for j in range(n * contacts)])
    start = np.zeros(n * contacts)
    start[::n] = 1.0
    answer = clarabel_cones(np.triu(W), q, np.concatenate(A), np.zeros(n * contacts), cones)
    value = answer.obj_val if str(answer.status) == "Solved" else np.nan
    return jg.lmi.LMIProblem(q, constant, matrices, start, W), value
