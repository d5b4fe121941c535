"""What is solid: closed parts turned outwards, cavities kept, parts that overlap or touch joined.

``body = union_i (part_i minus the cavities in part_i)``: a part is a connected closed surface. Seen from the outermost
part around it, one whose faces point the other way, and whose smallest container is solid, is a cavity. All others are
solid. The union (Manifold, Lalish 2023) has none of the surface that lies inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from .cleaning import double_areas, edge_numbers
from .edges import around_edges

__all__ = ["signed_volume", "solid"]

NEAR = 1e-9  # of the mesh's size: boxes nearer than this touch; of volumes and areas: equal
MOST_PARTS = 1000  # that are looked at for what overlaps
NAMED = 3  # parts or pairs of them in one sentence
JOINED = "they were joined, and the surface inside was dropped"


@dataclass(frozen=True)
class Part:
    """A connected surface of its own: faces (f, 3) into ``vertices`` (v, 3), outwards; ``number`` counts from 1.

    rows      (f,) of its faces in the mesh
    closed    whether it encloses a volume; an open part keeps the file's winding
    inwards   share of its faces that pointed inwards in the file
    """

    number: int
    vertices: np.ndarray
    faces: np.ndarray
    rows: np.ndarray
    closed: bool
    inwards: float

    @cached_property
    def box(self) -> np.ndarray:
        """(2, 3): lowest and highest coordinates."""
        corners = self.vertices[self.faces].reshape(-1, 3)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    @cached_property
    def volume(self) -> float:
        """Inside the surface."""
        return signed_volume(self.vertices[self.faces])

    @cached_property
    def area(self) -> float:
        """Of the surface."""
        return float(double_areas(self.vertices[self.faces]).sum()) / 2

    @cached_property
    def body(self) -> Any:
        """The part as the union's own type."""
        from manifold3d import Manifold, Mesh64

        return Manifold(Mesh64(*self.compact()))

    @cached_property
    def pinched(self) -> bool:
        """Whether it meets itself at an edge."""
        return bool((np.bincount(edge_numbers(self.faces)[0].ravel()) > 2).any())

    def compact(self) -> tuple[np.ndarray, np.ndarray]:
        """Its own vertices and its faces into these."""
        used, faces = np.unique(self.faces, return_inverse=True)
        return self.vertices[used], faces.reshape(-1, 3).astype(np.uint64)


def solid(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Vertices and faces of the body that a clean mesh stands for, and sentences about what was changed.

    Faces keep their order where nothing was joined. Parts share no vertices, so that those that touch at an edge or a
    point are each closed.
    """
    found = _parts(vertices, faces)
    parts, words = _without_walls(found, float(np.ptp(vertices, axis=0).max()))
    closed = [part for part in parts if part.closed]
    owner: list[Part | None] = [None] * len(closed)
    groups = [[i] for i in range(len(closed))]
    if len(closed) > MOST_PARTS:
        words.append(
            f"the mesh has {len(closed)} closed parts: where they overlap, their surface inside is not dropped"
        )
    elif len(closed) > 1:
        near = _boxes_touch(closed)
        owner = _owners(closed, near)
        label = connected_components(csr_matrix(near), directed=False)[1]
        groups = [np.flatnonzero(label == i).tolist() for i in range(label.max() + 1)]
    words += _turned_words(closed, owner, len(found))

    pieces = [(part.compact(), part.rows) for part in parts if not part.closed]
    last = len(faces)
    for group in groups:
        joined, said = _joined([closed[i] for i in group], [owner[i] for i in group])
        words += said
        if joined is not None:
            pieces.append((joined, np.arange(last, last + len(joined[1]))))
            last += len(joined[1])
            continue
        for i in group:
            corners, own = closed[i].compact()
            pieces.append(((corners, own if owner[i] is None else own[:, ::-1]), closed[i].rows))
    offsets = np.cumsum([0] + [len(corners) for (corners, _), _ in pieces[:-1]])
    all_faces = np.concatenate(
        [own.astype(np.int64) + o for ((_, own), _), o in zip(pieces, offsets, strict=True)]
    )
    order = np.argsort(np.concatenate([rows for _, rows in pieces]))
    return np.concatenate([corners for (corners, _), _ in pieces]), all_faces[order], words


def _without_walls(parts: list[Part], size: float) -> tuple[list[Part], list[str]]:
    """Without closed parts that enclose nothing: walls between parts that touch."""
    kept = [part for part in parts if not part.closed or abs(part.volume) > NEAR * size * part.area]
    if len(kept) in (0, len(parts)):
        return parts, []
    lost = sum(len(part.faces) for part in parts) - sum(len(part.faces) for part in kept)
    return kept, [
        f"the mesh lost {lost} faces that have no volume on either side: walls between parts that touch"
    ]


def _boxes_touch(parts: list[Part]) -> np.ndarray:
    """(n, n): whether the boxes of two parts have a point in common."""
    low, high = np.moveaxis(np.stack([part.box for part in parts]), 1, 0)
    slack = NEAR * (high.max(axis=0) - low.min(axis=0)).max()
    return (low[:, None] <= high[None] + slack).all(axis=-1) & (low[None] <= high[:, None] + slack).all(
        axis=-1
    )


def _owners(parts: list[Part], near: np.ndarray) -> list[Part | None]:
    """For each part the solid one that it is a cavity of, or None where it is solid itself."""
    owner: list[Part | None] = [None] * len(parts)
    if all(part.inwards <= 0.5 for part in parts):
        return owner
    by_size = sorted(range(len(parts)), key=lambda i: -parts[i].volume)
    root = list(range(len(parts)))
    for rank, i in enumerate(by_size):
        around = [j for j in by_size[:rank] if near[i, j] and _inside(parts[i], parts[j])]
        if not around:
            continue
        root[i], smallest = root[around[0]], around[-1]
        if (parts[i].inwards > 0.5) != (parts[root[i]].inwards > 0.5) and owner[smallest] is None:
            owner[i] = parts[smallest]
    return owner


def _inside(inner: Part, outer: Part) -> bool:
    if (inner.box[0] < outer.box[0]).any() or (inner.box[1] > outer.box[1]).any():
        return False
    return (inner.body ^ outer.body).volume() > (1 - 1e-6) * inner.volume


def _joined(
    parts: list[Part], owner: list[Part | None]
) -> tuple[tuple[np.ndarray, np.ndarray] | None, list[str]]:
    """The union of solid parts without their cavities, and which of them met; None where none did."""
    if len(parts) == 1 and not parts[0].pinched:
        return None, []
    from manifold3d import Error, Manifold, OpType

    def whole(part: Part) -> Any:
        cavities = [other.body for other, its in zip(parts, owner, strict=True) if its is part]
        return Manifold.batch_boolean([part.body, *cavities], OpType.Subtract)

    solids = [part for part, its in zip(parts, owner, strict=True) if its is None]
    union = Manifold.batch_boolean([whole(part) for part in solids], OpType.Add)
    volume = sum(part.volume if its is None else -part.volume for part, its in zip(parts, owner, strict=True))
    area = sum(part.area for part in parts)
    if union.status() != Error.NoError or union.is_empty():
        return None, []
    apart = abs(union.volume() - volume) <= NEAR * volume and abs(union.surface_area() - area) <= NEAR * area
    if apart and not any(part.pinched for part in parts):
        return None, []
    mesh = union.to_mesh64()
    result = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)
    cavities = [part for part, its in zip(parts, owner, strict=True) if its is not None]
    return result, [] if apart else [_met_words(solids, cavities)]


def _met_words(*kinds: list[Part]) -> str:
    """Which of the solid parts, and which of the cavities, have surface in each other."""
    met = []
    for a, b in chain.from_iterable(combinations(parts, 2) for parts in kinds):
        if (np.maximum(a.box[0], b.box[0]) > np.minimum(a.box[1], b.box[1])).any():
            continue
        common, smaller = (a.body ^ b.body).volume(), min((a, b), key=lambda part: part.volume)
        if common > (1 - 1e-6) * smaller.volume:
            met.append(
                f"part {smaller.number} lies in part {(b if smaller is a else a).number} and is no cavity"
            )
        elif common > NEAR * smaller.volume:
            met.append(f"parts {a.number} and {b.number} overlap")
        elif (a.body + b.body).surface_area() < (1 - NEAR) * (a.area + b.area):
            met.append(f"parts {a.number} and {b.number} touch")
        if len(met) > NAMED:
            return f"{', '.join(met[:NAMED])} and more; {JOINED}"
    return f"{', '.join(met) or 'parts meet'}; {JOINED}"


def _turned_words(closed: list[Part], owner: list[Part | None], count: int) -> list[str]:
    turned = [
        part.number
        for part, its in zip(closed, owner, strict=True)
        if (part.inwards > 0 if its is None else part.inwards < 1)
    ]
    if not turned:
        return []
    named = ", ".join(str(number) for number in turned[:NAMED]) + ", ..." * (len(turned) > NAMED)
    where = f" of part{'s' * (len(turned) > 1)} {named}" if count > 1 else ""
    return [
        f"some faces{where} pointed inwards; they were turned so that all normals point out of the volume"
    ]


def signed_volume(triangles: np.ndarray) -> float:
    """``sum a . (b x c) / 6`` about their middle; positive where the faces look outwards."""
    a, b, c = np.moveaxis(triangles - triangles.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def _parts(vertices: np.ndarray, faces: np.ndarray) -> list[Part]:
    """The connected parts of a clean mesh, in the order of their first faces, closed ones turned outwards.

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
    rows = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    by_first = sorted(range(len(rows)), key=lambda i: rows[i][0])
    return [
        _part(n, vertices, faces, rows[i], flip[rows[i]], bool(closed[i])) for n, i in enumerate(by_first, 1)
    ]


def _part(
    number: int, vertices: np.ndarray, faces: np.ndarray, rows: np.ndarray, flip: np.ndarray, closed: bool
) -> Part:
    faces = faces[rows]
    if not closed:
        return Part(number, vertices, faces, rows, False, 0.0)
    turned = np.where(flip[:, None], faces[:, ::-1], faces)
    if signed_volume(vertices[turned]) < 0:
        turned, flip = turned[:, ::-1], ~flip
    return Part(number, vertices, turned, rows, True, float(flip.mean()))


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
    label = connected_components(plain, directed=False)[1]
    first = np.unique(label, return_index=True)[1]
    return label, node[:count] != node[first][label]


def _closes(label: np.ndarray, number: np.ndarray, upwards: np.ndarray) -> np.ndarray:
    """Whether each part passes every edge as often upwards as downwards."""
    edges = int(number.max()) + 1
    key, at = np.unique((label[:, None] * edges + number).ravel(), return_inverse=True)
    surplus = np.bincount(at.ravel(), np.where(upwards, 1, -1).ravel())
    open_parts = key[surplus != 0] // edges
    closed = np.ones(int(label.max()) + 1, bool)
    closed[open_parts] = False
    return closed
