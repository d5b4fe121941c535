"""Problems that others publish: readers of SDPLIB and Siconos files, second-order cone problems, the values known."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

# SDPLIB 1.2's README (Borchers, Optim. Methods Softw. 11 (1999)): optimal values of min c.x, sum_i x_i F_i >= F_0, to
# the digits given there; infinite where nothing is feasible, -infinite where the cost has no lower bound.
SDPLIB = {
    "truss1": -8.999996, "truss2": -1.233804e2, "truss3": -9.109996, "truss4": -9.009996,
    "control1": 1.778463e1, "control2": 8.300000, "theta1": 2.300000e1,
    "hinf1": 2.0326, "hinf2": 1.0967e1, "hinf3": 5.69e1, "hinf4": 2.74764e2, "hinf5": 3.63e2,
    "hinf6": 4.490e2, "hinf7": 3.91e2, "hinf8": 1.16e2, "hinf9": 2.3625e2, "hinf10": 1.09e2,
    "infp1": np.inf, "infp2": np.inf, "infd1": -np.inf, "infd2": -np.inf,
}  # fmt: skip
# How far from these the true value may be: a unit of the last digit published.
DIGITS = {
    "truss1": 1e-6, "truss2": 1e-4, "truss3": 1e-6, "truss4": 1e-6, "control1": 1e-5, "control2": 1e-6, "theta1": 1e-5,
    "hinf1": 1e-4, "hinf2": 1e-3, "hinf3": 0.1, "hinf4": 1e-3, "hinf5": 1.0, "hinf6": 0.1, "hinf7": 1.0, "hinf8": 1.0,
    "hinf9": 1e-2, "hinf10": 1.0,
}  # fmt: skip


def read_sdpa(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(c, S_0, S_1 .. S_N) of ``min c.x, S_0 + sum x_i S_i >= 0`` from SDPA's sparse format; blocks on the diagonal."""
    lines = [line for line in path.read_text().splitlines() if line.strip() and line[0] not in '"*']
    words = [line.translate(str.maketrans(",{}()", "     ")).split() for line in lines]
    count, blocks = int(words[0][0]), int(words[1][0])
    sizes = [abs(int(float(word))) for word in words[2][:blocks]]
    numbers = [float(word) for line in words[3:] for word in line]
    first = np.concatenate([[0], np.cumsum(sizes)])
    F = np.zeros((count + 1, first[-1], first[-1]))
    for k, block, i, j, value in np.array(numbers[count:]).reshape(-1, 5):
        row, column = first[int(block) - 1] + int(i) - 1, first[int(block) - 1] + int(j) - 1
        F[int(k), row, column] = F[int(k), column, row] = value
    return np.array(numbers[:count]), -F[0], F[1:]


# Siconos -----------------------------------------------------------------------------------------------


class Bodies(NamedTuple):
    """Bodies that are touched in two or more places: k contacts each, padded with inactive ones."""

    position: np.ndarray  # (bodies, k, 3), from the body's centre of mass
    normal: np.ndarray  # (bodies, k, 3), into the body
    active: np.ndarray  # (bodies, k)
    friction: float
    weight: np.ndarray  # (bodies, 6): the wrench that the file puts on the body
    defect: float  # how far the file's torque rows are from those of a lever


def read_bodies(path: Path) -> Bodies:
    """Contacts body by body of an FCLIB file: ``H_body = [D; [r]x D]``, D = (normal, tangents) of a contact at r."""
    import h5py

    file = h5py.File(path)["fclib_global"]
    matrix = file["H"]
    H = np.zeros((int(matrix["m"][0]), int(matrix["n"][0])))
    np.add.at(H, (matrix["i"][:], matrix["p"][:]), matrix["x"][:])
    mu, load = file["vectors/mu"][:], file["vectors/f"][:]
    blocks = H.reshape(len(H) // 6, 6, len(mu), 3).swapaxes(1, 2)  # (bodies, contacts, 6, 3)
    touches = np.any(blocks != 0, axis=(2, 3))
    chosen = np.flatnonzero(touches.sum(1) >= 2)
    k, defect = touches.sum(1).max(), 0.0
    position, normal = np.zeros((2, len(chosen), k, 3))
    active = np.zeros((len(chosen), k), bool)
    for row, body in enumerate(chosen):
        for column, contact in enumerate(np.flatnonzero(touches[body])):
            directions, torques = blocks[body, contact, :3], blocks[body, contact, 3:]
            lever = torques @ directions.T  # [r]x
            defect = max(defect, np.abs(lever + lever.T).max())
            position[row, column] = np.array([lever[2, 1], lever[0, 2], lever[1, 0]])
            normal[row, column], active[row, column] = directions[:, 0], True
    return Bodies(position, normal, active, float(mu[0]), load.reshape(-1, 6)[chosen], defect)


def read_contact_problem(path: Path) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """(dimension, W, q, mu) of a dense local problem ``u = W r + q``, normals first; ValueError for a sparse one."""
    words = path.read_text().split()
    dimension, contacts, storage = (int(word) for word in words[:3])
    if storage != 0:
        raise ValueError(f"{path.name} is not dense")
    size = dimension * contacts
    numbers = np.array(words[5:], float)
    W = numbers[2 : 2 + size * size].reshape(size, size, order="F")
    q = numbers[2 + size * size :][:size]
    return dimension, W, q, numbers[2 + size * size + size :][:contacts]


# Second-order cone problems ----------------------------------------------------------------------------


class ConeProblem(NamedTuple):
    """``min c.x, |A_i x + b_i| <= c_i.x + d_i``, cones of length 1 included: rows ``0 <= c_i.x + d_i``."""

    cost: np.ndarray
    cones: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]
    value: float
    x: np.ndarray
    duals: list[tuple[float, list[float]] | None]  # (multiplier of the height, of the vector)


def _row(c, d):
    return np.zeros((0, len(c))), np.zeros(0), np.array(c, float), float(d)


def cone_problems() -> dict[str, ConeProblem]:
    """From cvxpy's tests (solver_test_helpers.py, Apache-2.0): socp_1 to socp_4 and their values, primal and dual."""
    one = ConeProblem(
        np.array([3.0, 2, 1, 0]),
        [
            (np.eye(3, 4), np.zeros(3), np.array([0.0, 0, 0, 1]), 0.0),
            _row([1, 1, 3, 0], -1),
            _row([0, 0, 0, -1], 5),
        ],
        -13.548638904065102,
        np.array([-3.87462, -2.12979, 2.33480, 5]),
        [(2.86560262, [2.22062583, 1.22062583, -1.33812252]), (0.7793969212, []), (2.865602615, [])],
    )
    two = ConeProblem(
        np.array([-4.0, -5]),
        [
            _row([-2, -1], 3),
            (np.array([[1.0, 2]]), np.zeros(1), np.zeros(2), 3.0),
            _row([1, 0], 0),
            _row([0, 1], 0),
        ],
        -9.0,
        np.array([1.0, 1]),
        [(1.0, []), (2.0, [-2.0]), (0.0, []), (0.0, [])],
    )
    root = np.sqrt(2)
    turn = np.diag([root, 1 / root]) @ np.array([[1, -1], [1, 1]]).T / root
    three = ConeProblem(
        np.array([-1.0, 2]),
        [(A, np.zeros(2), np.zeros(2), 1.0) for A in (turn, np.eye(2), np.diag([0.2, 1.8]))],
        -1.932105,
        np.array([0.83666003, -0.54772256]),
        [
            (0.0, [0.0, 0.0]),
            (1.16454469, [-0.974311819, 0.637872081]),
            (0.767560451, [-0.12844086, 0.756737724]),
        ],
    )
    # x = (y, 1 - sum y): the equation of socp_4 is put in; -1.65 is its multiplier, the cost of the last variable.
    E, e = np.concatenate([np.eye(3), -np.ones((1, 3))]), np.array([0.0, 0, 0, 1])
    maps = [
        (np.array([[1.0, -2, 2, -1]]), np.zeros(1), 1.0),
        (np.array([[1.0, 0, -2, 2], [0, -2, 2, 2]]), np.zeros(2), 2.0),
        (np.array([[-2.0, -2, -2, -1], [0, 1, 1, 1], [0, 2, -1, 0]]), np.array([0.0, 2, 2]), 3.0),
    ]
    c = np.array([3.0, 1, 2, -1])
    four = ConeProblem(
        c @ E,
        [(A @ E, A @ e - b, np.zeros(3), d) for A, b, d in maps],
        -1.32552809 - c @ e,
        np.array([-0.69418893, 0.35428326, 0.58088704]),
        [(1.2, [1.2]), (0.88776405, [0.15, -0.875]), (0.0, [0.0, 0.0, 0.0])],
    )
    return {"socp_1": one, "socp_2": two, "socp_3": three, "socp_4": four}
