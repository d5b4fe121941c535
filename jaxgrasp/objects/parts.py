"""The connected parts of a surface: which faces hang together, which parts close, how large they are.

Signed volume of a part: ``sum a . (b x c) / 6`` over its triangles, about the middle of its corners. Closed parts are
turned outwards. Everything is done for all parts at once: a damaged mesh may have as many as faces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from .cleaning import double_areas, edge_numbers
from .edges import around_edges

__all__ = ["Parts", "find_parts", "signed_volumes"]


@dataclass(frozen=True)
class Parts:
    """Parts 0 to n - 1 of the faces (f, 3), numbered in the order of their first faces.

    faces, label  (f, 3) with those of closed parts turned outwards, and (f,) the part of each
    closed        (n,) whether it encloses a volume; an open part keeps the file's winding
    inwards       (n,) share of its faces that were turned
    volume, area  (n,)
    """

    faces: np.ndarray
    label: np.ndarray
    closed: np.ndarray
    inwards: np.ndarray
    volume: np.ndarray
    area: np.ndarray

    def without(self, dropped: np.ndarray) -> Parts:
        """Without the faces of the parts (n,) that are dropped; numbers stay."""
        keep = ~dropped[self.label]
        return replace(self, faces=self.faces[keep], label=self.label[keep], closed=self.closed & ~dropped)


def find_parts(vertices: np.ndarray, faces: np.ndarray) -> Parts:
    """The parts of a clean mesh.

    Faces belong together across an edge that two share, and, where that closes no part, as ``around_edges`` says.
    """
    number, upwards = edge_numbers(faces)
    order = np.argsort(number.ravel(), kind="stable")
    pairs = order[np.bincount(number.ravel())[number.ravel()[order]] == 2].reshape(-1, 2)
    label, flip = _wound_alike(pairs, upwards)
    closed = _closes(label, number, upwards ^ flip[:, None])
    if not closed.all():
        more = around_edges(vertices, faces, number, upwards, np.flatnonzero(~closed[label]))
        label, flip = _wound_alike(np.concatenate([pairs, more]), upwards)
        closed = _closes(label, number, upwards ^ flip[:, None])
    flip &= closed[label]
    volume = signed_volumes(vertices[np.where(flip[:, None], faces[:, ::-1], faces)], label)
    flip ^= (closed & (volume < 0))[label]
    return Parts(
        faces=np.where(flip[:, None], faces[:, ::-1], faces),
        label=label,
        closed=closed,
        inwards=np.bincount(label, flip) / np.bincount(label),
        volume=np.where(closed, np.abs(volume), volume),
        area=np.bincount(label, double_areas(vertices[faces])) / 2,
    )


def signed_volumes(triangles: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Of each part the volume that its triangles enclose; positive where they look outwards."""
    corners = np.bincount(label)[:, None] * 3
    middle = np.stack([np.bincount(label, triangles[..., i].sum(axis=1)) for i in range(3)], axis=1) / corners
    a, b, c = np.moveaxis(triangles - middle[label][:, None], 1, 0)
    return np.bincount(label, np.einsum("ij,ij->i", a, np.cross(b, c))) / 6


def _wound_alike(pairs: np.ndarray, upwards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of each face (f,), and whether it is turned so that all of a part agree with its first face.

    pairs  (n, 2) sides of faces that belong together, 3 f + c; two nodes a face, as it is and turned
    """
    count, (one, other) = len(upwards), pairs.T // 3
    agree = upwards.ravel()[pairs[:, 0]] != upwards.ravel()[pairs[:, 1]]
    rows = np.concatenate([one, one + count])
    columns = np.concatenate([np.where(agree, other, other + count), np.where(agree, other + count, other)])
    graph = csr_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(2 * count, 2 * count))
    node = connected_components(graph, directed=False)[1]
    plain = csr_matrix((np.ones(len(one), bool), (one, other)), shape=(count, count))
    found = connected_components(plain, directed=False)[1]
    first = np.unique(found, return_index=True)[1]
    rank = np.empty(len(first), np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[found], node[:count] != node[first][found]


def _closes(label: np.ndarray, number: np.ndarray, upwards: np.ndarray) -> np.ndarray:
    """Whether each part passes every edge as often upwards as downwards."""
    edges = int(number.max()) + 1
    key, at = np.unique((label[:, None] * edges + number).ravel(), return_inverse=True)
    surplus = np.bincount(at.ravel(), np.where(upwards, 1, -1).ravel())
    closed = np.ones(int(label.max()) + 1, bool)
    closed[key[surplus != 0] // edges] = False
    return closed
