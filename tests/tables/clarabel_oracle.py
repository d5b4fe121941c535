"""An independent oracle: the margin of a grasp by Clarabel, a general conic solver.

Written from the dual form of the margin problem alone (six unknowns in space, three in the plane), in numpy;
it shares no code with jaxgrasp and builds its own grasp map:

    t* = min over lambda of 1 + sum_i v_n,i,   v_i = G_i^T lambda,
         subject to  (x_n, mu x_1, mu x_2, gamma x_tau) in the second-order cone,  x_i = nu e_n - v_i,
         nu = (1 + sum_i v_n,i) / k,  lengths in units of max |p_i|.
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
    settings.max_threads = 1
    return settings


SETTINGS = _settings()
EMPTY = {m: csc_matrix((m, m)) for m in (3, 6)}


def _tangents(n: np.ndarray) -> list[np.ndarray]:
    if n.size == 2:
        return [np.array([n[1], -n[0]])]
    helper = np.eye(3)[np.argmin(np.abs(n))]
    first = np.cross(n, helper)
    first /= np.linalg.norm(first)
    return [first, np.cross(n, first)]


def _torque(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    return np.atleast_1d(p[0] * f[1] - p[1] * f[0]) if p.size == 2 else np.cross(p, f)


def _contact_columns(p, n, mu, gamma, components) -> np.ndarray:
    """Rows: the wrenches of the normal, then of every tangential component times its coefficient."""
    rows = [np.concatenate([n, _torque(p, n)])]
    tangents = _tangents(n)
    for name in components:
        if name in ("f_x", "f_y"):
            t = tangents[0] if name == "f_x" else tangents[1]
            rows.append(mu * np.concatenate([t, _torque(p, t)]))
        elif name == "tau_n":
            rows.append(gamma * np.concatenate([np.zeros(3), n]))
        elif name != "f_n":
            raise ValueError(f"unknown force component {name!r}")
    return np.array(rows)


def clarabel_margin(position, normal, friction, torsion, active, components) -> tuple[float, bool]:
    """(t*, whether it is known: Clarabel reports Solved, or the dual is unbounded) for one grasp.

    position, normal (k, 3) or (k, 2); friction, torsion numbers or (k,); active (k,) bool or None; components
    the names ``f_x f_y f_n tau_n`` of the force components that a contact transmits. -inf for the unbounded
    dual.
    """
    position, normal = np.asarray(position, float), np.asarray(normal, float)
    k = len(position)
    friction, torsion = (np.broadcast_to(np.asarray(value, float), k) for value in (friction, torsion))
    use = np.flatnonzero(np.ones(k, bool) if active is None else np.asarray(active, bool))
    if use.size == 0:
        raise ValueError("no active contact")
    length = max(float(np.max(np.linalg.norm(position[use], axis=-1))), 0.0) or 1.0
    blocks = np.array(
        [
            _contact_columns(
                position[i] / length,
                normal[i] / np.linalg.norm(normal[i]),
                friction[i],
                torsion[i] / length,
                components,
            )
            for i in use
        ]
    )  # (contacts, n, m)
    contacts, n, m = blocks.shape
    if _dual_is_unbounded(blocks):
        return -np.inf, True
    cost = blocks[:, 0].sum(0)
    rows = blocks.copy()
    rows[:, 0] -= cost / contacts
    rows = rows.reshape(contacts * n, m)
    right = np.zeros((contacts, n))
    right[:, 0] = 1.0 / contacts
    matrix = csc_matrix(
        (
            np.ascontiguousarray(rows.T).ravel(),
            np.tile(np.arange(contacts * n, dtype=np.int32), m),
            np.arange(m + 1, dtype=np.int32) * (contacts * n),
        ),
        shape=(contacts * n, m),
    )
    if n == 1:
        cones = [clarabel.NonnegativeConeT(contacts)]
    else:
        cones = [clarabel.SecondOrderConeT(n)] * contacts
    solution = clarabel.DefaultSolver(EMPTY[m], cost, matrix, right.ravel(), cones, SETTINGS).solve()
    return 1.0 + float(solution.obj_val), solution.status == clarabel.SolverStatus.Solved


def _dual_is_unbounded(blocks: np.ndarray) -> bool:
    """Whether some lambda has ``v_n,i = 1``, ``mu v_t,i = 0``, ``gamma v_tau,i = 0`` at every contact.

    That is when t* = -inf. Clarabel answers such programs with an infeasibility ray, a huge or a wrong value,
    or not at all, so linear algebra decides.
    """
    rows = blocks.reshape(-1, blocks.shape[-1])
    target = np.zeros(blocks.shape[:2])
    target[:, 0] = 1.0
    twist = np.linalg.lstsq(rows, target.ravel(), rcond=1e-13)[0]
    return bool(np.max(np.abs(rows @ twist - target.ravel())) < 1e-11)
