"""An independent oracle: grasp force optimisation by Clarabel, a general conic solver, in numpy.

Written from Definition 5 alone; it builds its own grasp map and shares no code with jaxgrasp. Forces are
folded (s = f_n; f_t / mu; tau / gamma), lengths over max |p_i|, forces over the load's size. -log det P of a cone:
``s_0^2 - |s_t|^2 >= g^2`` iff ``|(s_t, g)| <= s_0``, so its logarithm is 2 log g, an exponential cone.
"""

from __future__ import annotations

import clarabel
import numpy as np
from scipy.sparse import csc_matrix

TOLERANCE = 1e-11


def _settings():
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    settings.tol_infeas_abs = settings.tol_infeas_rel = 1e-10
    settings.max_threads = 1
    return settings


SETTINGS = _settings()


def frames(n: np.ndarray) -> list[np.ndarray]:
    """Tangents of the convention the hand Jacobian is written in (Duff et al. 2017; planar: t x n = +z)."""
    if n.size == 2:
        return [np.array([n[1], -n[0]])]
    x, y, z = n
    sign = 1.0 if z >= 0 else -1.0
    a = -1 / (sign + z)
    b = x * y * a
    return [np.array([1 + sign * x * x * a, sign * b, -sign * x]), np.array([b, sign + y * y * a, -y])]


def _torque(p, f):
    return np.atleast_1d(p[0] * f[1] - p[1] * f[0]) if p.size == 2 else np.cross(p, f)


def folded_map(position, normal, friction, torsion, components):
    """(contacts, m, n) blocks, normal first, lengths over L; L."""
    length = max(float(np.max(np.linalg.norm(position, axis=-1))), 0.0) or 1.0
    blocks = []
    for p, n, mu, gamma in zip(position, normal, friction, torsion, strict=True):
        n = n / np.linalg.norm(n)
        p = p / length
        tangents = frames(n)
        columns = [np.concatenate([n, _torque(p, n)])]
        for name in components:
            if name in ("f_x", "f_y"):
                t = tangents[0 if name == "f_x" else 1]
                columns.append(mu * np.concatenate([t, _torque(p, t)]))
            elif name == "tau_n":
                columns.append(gamma / length * np.concatenate([np.zeros(3), n]))
        blocks.append(np.array(columns).T)
    return np.array(blocks), length


def log_det_terms(mu, components, dimension):
    """log det P = a log f_n + b log(f_n^2 - psi^2) + c."""
    if mu == 0 or components == ["f_n"]:
        return 1.0, 0.0, 0.0
    if "tau_n" in components:
        return 2.0, 1.0, 0.0
    return dimension - 2.0, 1.0, dimension * np.log(mu)


class _Model:
    """Rows ``A x + s = b`` of a growing conic program."""

    def __init__(self, size):
        self.size, self.rows, self.right, self.cones = size, [], [], []

    def add(self, matrix, right, cone):
        self.rows.append(np.atleast_2d(matrix))
        self.right.append(np.atleast_1d(right))
        self.cones.append(cone)

    def solve(self, P, q):
        A = csc_matrix(np.concatenate(self.rows))
        b = np.concatenate(self.right)
        upper = csc_matrix(np.triu(P))
        return clarabel.DefaultSolver(upper, q, A, b, self.cones, SETTINGS).solve()


def clarabel_forces(
    position,
    normal,
    friction,
    torsion,
    active,
    components,
    wrench,
    criterion,
    parameter=None,
    cap=None,
    limits=None,
):
    """(answer, cost, force): "optimal", "infeasible" or "unknown"; force (k n) in the chapter's component order.

    criterion  gentlest, robust, smallest sum, sum of squares, least norm; parameter is the weight or the length
    """
    position, normal, wrench = (np.asarray(x, float) for x in (position, normal, wrench))
    k, d = position.shape
    use = np.flatnonzero(active)
    mu, gamma = (np.broadcast_to(np.asarray(x, float), k)[use] for x in (friction, torsion))
    blocks, length = folded_map(position[use], normal[use], mu, gamma, components)
    c, m, n = blocks.shape
    A = np.moveaxis(blocks, 0, 1).reshape(m, c * n)
    load = np.concatenate([wrench[:d], wrench[d:] / length])
    size = np.linalg.norm(load)
    size = size + (parameter if criterion == "robust" else 0.0)
    size = size or 1.0
    order = [components.index("f_n"), *(i for i, name in enumerate(components) if name != "f_n")]
    by_name = {"f_x": mu, "f_y": mu, "f_n": np.ones(c), "tau_n": gamma}
    scale = np.stack([by_name[components[i]] for i in order], -1)  # (c, n), normal first

    terms = [log_det_terms(x, components, d) for x in mu]
    levels = criterion in ("gentlest", "robust")
    logs = [i for i, t in enumerate(terms) if t[1] > 0] if criterion == "robust" else []
    heads = [i for i, t in enumerate(terms) if t[0] > 0] if criterion == "robust" else []
    total = c * n + levels + 2 * len(logs) + len(heads)
    model = _Model(total)
    pad = np.zeros((m, total - c * n))
    # Dependent equations trouble a solver: keep an orthonormal basis of the range, refuse loads outside it.
    u, values, _ = np.linalg.svd(A)
    rank = int((values > 1e-12 * max(values[0], 1e-300)).sum()) if values.size else 0
    if np.linalg.norm(u[:, rank:].T @ load) > 1e-7 * np.linalg.norm(load):
        return "infeasible", np.inf, None
    basis = u[:, :rank].T
    model.add(np.concatenate([basis @ A, basis @ pad], 1), -basis @ load / size, clarabel.ZeroConeT(rank))
    eye = np.eye(total)
    for i in range(c):
        rows = eye[i * n : (i + 1) * n]
        if i in logs:
            rows = np.concatenate([rows, eye[[c * n + levels + logs.index(i)]]])
        cone = clarabel.NonnegativeConeT(1) if len(rows) == 1 else clarabel.SecondOrderConeT(len(rows))
        model.add(-rows, np.zeros(len(rows)), cone)
    if levels:
        model.add(eye[: c * n : n] - eye[[c * n]], np.zeros(c), clarabel.NonnegativeConeT(c))
    if cap is not None:
        bounded = np.flatnonzero(np.isfinite(np.asarray(cap)[use]))
        if bounded.size:
            model.add(
                eye[bounded * n],
                np.asarray(cap)[use][bounded] / size,
                clarabel.NonnegativeConeT(bounded.size),
            )
    if limits is not None:
        jacobian, torque = np.asarray(limits[0], float), np.asarray(limits[1], float)
        q = jacobian.shape[-1]
        J = jacobian.reshape(k, n, q)[use][:, order] * scale[..., None]
        rows = np.concatenate([J.reshape(c * n, q).T, np.zeros((q, total - c * n))], 1)
        for sign in (1.0, -1.0):
            model.add(sign * rows, torque / size, clarabel.NonnegativeConeT(q))

    P, cost = np.zeros((total, total)), np.zeros(total)
    if levels:
        cost[c * n] = 1.0
    if criterion == "smallest sum":
        cost[: c * n : n] = 1.0
    if criterion == "sum of squares":
        P[range(0, c * n, n), range(0, c * n, n)] = 2.0
    if criterion == "least norm":
        weights = np.ones((c, n))
        for j, i in enumerate(order):
            if components[i] in ("f_x", "f_y"):
                weights[:, j] = mu**2
            elif components[i] == "tau_n":
                weights[:, j] = 1.0 if parameter is None else (gamma / parameter) ** 2
        P[range(c * n), range(c * n)] = 2 * weights.ravel()
    constant = 0.0
    if criterion == "robust":
        omega = parameter / size
        first = c * n + levels + len(logs)
        for j, i in enumerate(logs):
            exponent = first + j
            cost[exponent] = -2 * omega * terms[i][1]
            rows = np.zeros((3, total))
            rows[0, exponent], rows[2, c * n + levels + j] = -1.0, -1.0
            model.add(rows, np.array([0.0, 1.0, 0.0]), clarabel.ExponentialConeT())
        for j, i in enumerate(heads):
            exponent = first + len(logs) + j
            cost[exponent] = -omega * terms[i][0]
            rows = np.zeros((3, total))
            rows[0, exponent], rows[2, i * n] = -1.0, -1.0
            model.add(rows, np.array([0.0, 1.0, 0.0]), clarabel.ExponentialConeT())
        constant = -parameter * sum(t[2] + (t[0] + 2 * t[1]) * np.log(size) for t in terms)
    found = model.solve(P, cost)
    status = str(found.status)
    if status == "PrimalInfeasible":
        return "infeasible", np.inf, None
    if status != "Solved":
        return "unknown", np.nan, None
    power = 2 if criterion in ("sum of squares", "least norm") else 1
    s = np.array(found.x)[: c * n].reshape(c, n) * size * scale
    force = np.zeros((k, n))
    force[use[:, None], np.array(order)[None]] = s
    return "optimal", float(found.obj_val) * size**power + constant, force.ravel()
