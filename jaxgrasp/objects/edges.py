"""Which faces belong together at an edge that more than two share.

Faces that lie on each other belong together: they are the two sides of a wall between parts that touch. So do the last
two. Of more, those do that have solid between them, by the file's winding: counterclockwise about the edge a face opens
solid or closes it, and each that opens belongs to the one that closes it as brackets do, inner ones first. So parts
that meet at an edge come apart, and of parts that overlap what both fill lies in a part of its own.
"""

from __future__ import annotations

import numpy as np

__all__ = ["around_edges"]

SAME_ANGLE = 1e-6  # rad


def around_edges(
    vertices: np.ndarray, faces: np.ndarray, number: np.ndarray, upwards: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Pairs (n, 2) of sides, 3 f + c, of the faces ``rows`` at edges that more than two of them share.

    number, upwards  (f, 3) of ``edge_numbers``
    """
    side = (3 * rows[:, None] + np.arange(3)).ravel()
    side = side[np.argsort(number.ravel()[side], kind="stable")]
    uses = np.bincount(number.ravel()[side])[number.ravel()[side]]
    side = side[(uses > 2) & (uses % 2 == 0)]
    if not len(side):
        return np.empty((0, 2), np.intp)
    starts, edge = _runs(number.ravel()[side])
    angle = _angles(vertices, faces, side, upwards.ravel()[side], starts[edge])
    order = np.lexsort((angle, edge))
    side, edge, angle = side[order], edge[order], angle[order]
    direction = np.cumsum((np.diff(angle, prepend=-1.0) > SAME_ANGLE) | (np.diff(edge, prepend=-1) > 0))
    # Rightly wound, a face has solid counterclockwise of it where it passes the edge downwards.
    opens = ~upwards.ravel()[side]

    wall = np.bincount(direction)[direction] == 2
    left = np.bincount(edge, ~wall)[edge]
    surplus = np.bincount(edge, np.where(wall, 0, np.where(opens, 1, -1)))[edge]
    last, more = ~wall & (left == 2), ~wall & (left > 2) & (surplus == 0)
    brackets = _brackets(edge[more], direction[more], opens[more])
    return side[
        np.concatenate([np.flatnonzero(wall), np.flatnonzero(last), np.flatnonzero(more)[brackets]])
    ].reshape(-1, 2)


def _brackets(edge: np.ndarray, direction: np.ndarray, opens: np.ndarray) -> np.ndarray:
    """An order in which each face that opens solid stands beside the one that closes it."""
    if not len(edge):
        return np.empty(0, np.intp)
    order = np.lexsort((opens, direction))  # in the same direction solid is closed before it is opened
    step, (starts, run) = np.where(opens[order], 1, -1), _runs(edge)
    depth = np.cumsum(step)  # every edge ends at 0
    lowest = np.lexsort((depth, run))[starts]  # begin after it: no bracket is closed that was not opened
    turn = (np.arange(len(order)) - lowest[run] - 1) % np.bincount(run)[run]
    return order[np.lexsort((turn, depth + (step < 0), run))]


def _runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where runs of equal values start, and the number of each value's run."""
    new = np.diff(values, prepend=values[0] - 1) != 0
    return np.flatnonzero(new), np.cumsum(new) - 1


def _angles(
    vertices: np.ndarray, faces: np.ndarray, side: np.ndarray, up: np.ndarray, reference: np.ndarray
) -> np.ndarray:
    """Of each face about its edge, from the face of side ``reference``, in [0, 2 pi); just below that is 0."""
    face, corner = side // 3, side % 3
    start, end, apex = (vertices[faces[face, (corner + i) % 3]] for i in range(3))
    axis = np.where(up[:, None], end - start, start - end)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    across = apex - start
    across -= np.einsum("ij,ij->i", across, axis)[:, None] * axis
    zero = across[reference]
    y = np.einsum("ij,ij->i", np.cross(zero, across), axis)
    angle = np.arctan2(y, np.einsum("ij,ij->i", zero, across)) % (2 * np.pi)
    return np.where(angle > 2 * np.pi - SAME_ANGLE, 0.0, angle)
