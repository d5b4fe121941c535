"""Which faces belong together at an edge that more than two share: those with solid between them.

Around such an edge, counterclockwise about its direction, a face either opens solid or closes it. Each that opens
belongs to the one that closes it as brackets do, inner ones first; at the same angle solid is closed before it is
opened. So parts that touch come apart, and of parts that overlap what both fill lies in a part of its own.
"""

from __future__ import annotations

import numpy as np

__all__ = ["around_edges"]

SAME_ANGLE = 1e-6  # rad


def around_edges(
    vertices: np.ndarray, faces: np.ndarray, number: np.ndarray, upwards: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Pairs (n, 2) of sides, 3 f + c, of the faces ``rows`` at edges that more than two share, by the file's winding.

    number, upwards  (f, 3) of ``edge_numbers``; an edge that is not passed as often upwards as downwards has no pairs
    """
    side = (3 * rows[:, None] + np.arange(3)).ravel()
    # Rightly wound, a face has solid counterclockwise of it where it passes the edge downwards.
    edge, opens = number.ravel()[side], ~upwards.ravel()[side]
    crowded = (np.bincount(edge) > 2) & (np.bincount(edge, np.where(opens, 1, -1)) == 0)
    side = side[crowded[edge]]
    if not len(side):
        return np.empty((0, 2), np.intp)
    side = side[np.argsort(number.ravel()[side], kind="stable")]
    opens, (starts, group) = ~upwards.ravel()[side], _runs(number.ravel()[side])

    angle = _angles(vertices, faces, side, opens, starts[group])
    order = np.lexsort((angle, group))
    gap = np.diff(angle[order], prepend=-1.0) > SAME_ANGLE
    order = order[np.lexsort((opens[order], np.cumsum(gap), group))]

    step = np.where(opens[order], 1, -1)
    depth = np.cumsum(step)  # every edge ends at 0
    lowest = np.lexsort((depth, group))[starts]  # begin after it: no bracket is closed that was not opened
    turn = (np.arange(len(order)) - lowest[group] - 1) % np.bincount(group)[group]
    order = order[np.lexsort((turn, depth + (step < 0), group))]
    return side[order].reshape(-1, 2)


def _runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where runs of equal values start, and the number of each value's run."""
    new = np.diff(values, prepend=values[0] - 1) != 0
    return np.flatnonzero(new), np.cumsum(new) - 1


def _angles(
    vertices: np.ndarray, faces: np.ndarray, side: np.ndarray, opens: np.ndarray, reference: np.ndarray
) -> np.ndarray:
    """Of each face about its edge, from the face of side ``reference``, in [0, 2 pi); just below that is 0."""
    face, corner = side // 3, side % 3
    start, end, apex = (vertices[faces[face, (corner + i) % 3]] for i in range(3))
    axis = np.where(opens[:, None], start - end, end - start)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    across = apex - start
    across -= np.einsum("ij,ij->i", across, axis)[:, None] * axis
    zero = across[reference]
    y = np.einsum("ij,ij->i", np.cross(zero, across), axis)
    angle = np.arctan2(y, np.einsum("ij,ij->i", zero, across)) % (2 * np.pi)
    return np.where(angle > 2 * np.pi - SAME_ANGLE, 0.0, angle)
