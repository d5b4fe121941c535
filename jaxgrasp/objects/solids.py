"""What is solid: cavities kept, parts that overlap or touch joined, walls between them dropped.

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

from .cleaning import edge_numbers
from .parts import Parts, find_parts

__all__ = ["solid"]

NEAR = 1e-9  # of the mesh's size: boxes nearer than this touch; of volumes and areas: equal
WHOLE = 1 - 1e-6  # of a part's volume in another: it lies inside
MOST_PARTS = 1000  # that are looked at for what overlaps
NAMED = 3  # parts or pairs of them in one sentence
JOINED = "they were joined, and the surface inside was dropped"


@dataclass(frozen=True, eq=False)
class Closed:
    """A closed part: its own vertices (v, 3) and faces (f, 3), outwards.

    number   in the file, from 1
    inwards  whether most of its faces pointed inwards there
    """

    number: int
    vertices: np.ndarray
    faces: np.ndarray
    inwards: bool
    volume: float
    area: float

    @classmethod
    def of(cls, vertices: np.ndarray, parts: Parts, part: int) -> Closed:
        """Part number ``part``."""
        used, faces = np.unique(parts.faces[parts.label == part], return_inverse=True)
        volume, area = float(parts.volume[part]), float(parts.area[part])
        return cls(
            part + 1, vertices[used], faces.reshape(-1, 3), bool(parts.inwards[part] > 0.5), volume, area
        )

    @cached_property
    def box(self) -> np.ndarray:
        """(2, 3): lowest and highest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def body(self) -> Any:
        """The part as the union's own type."""
        from manifold3d import Manifold, Mesh64

        return Manifold(Mesh64(self.vertices, self.faces.astype(np.uint64)))

    @cached_property
    def pinched(self) -> bool:
        """Whether it meets itself at an edge."""
        return bool((np.bincount(edge_numbers(self.faces)[0].ravel()) > 2).any())


def solid(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Vertices and faces of the body that a clean mesh stands for, and sentences about what was changed.

    Faces keep their order where nothing was joined. Parts share no vertices, so that those that touch at an edge or a
    point are each closed.
    """
    parts, words = _without_walls(find_parts(vertices, faces), float(np.ptp(vertices, axis=0).max()))
    numbers, count = np.flatnonzero(parts.closed), len(parts.closed)
    cavity, replaced = np.zeros(count, bool), np.zeros(count, bool)
    joined, met = [], []
    if len(numbers) > MOST_PARTS:
        words.append(
            f"the mesh has {len(numbers)} closed parts, too many to look for surface that lies inside another"
        )
    elif len(numbers):
        closed = [Closed.of(vertices, parts, int(i)) for i in numbers]
        near = _boxes_touch(closed)
        owner = _owners(closed, near)
        cavity[numbers] = [its is not None for its in owner]
        group = connected_components(csr_matrix(near), directed=False)[1]
        for members in (np.flatnonzero(group == i) for i in range(group.max() + 1)):
            union, said = _joined([closed[i] for i in members], [owner[i] for i in members])
            joined += [union] * (union is not None)
            replaced[numbers[members]] = union is not None
            met += said
    turned = parts.closed & np.where(cavity, parts.inwards < 1, parts.inwards > 0)
    words += _turned_words(turned, cavity)

    rest = parts.without(replaced)
    kept = np.where(cavity[rest.label, None], rest.faces[:, ::-1], rest.faces)
    used, own = np.unique(rest.label[:, None] * len(vertices) + kept, return_inverse=True)
    pieces = [(vertices[used % len(vertices)], own.reshape(-1, 3)), *joined]
    offsets = np.cumsum([0] + [len(points) for points, _ in pieces[:-1]])
    all_faces = np.concatenate(
        [own.astype(np.int64) + start for (_, own), start in zip(pieces, offsets, strict=True)]
    )
    return np.concatenate([points for points, _ in pieces]), all_faces, words + met


def _without_walls(parts: Parts, size: float) -> tuple[Parts, list[str]]:
    """Without closed parts that enclose nothing: walls between parts that touch."""
    empty = parts.closed & (parts.volume <= NEAR * size * parts.area)
    if not empty.any() or empty.all():
        return parts, []
    lost = int(empty[parts.label].sum())
    said = f"the mesh lost {lost} faces with no volume on either side: walls between parts that touch"
    return parts.without(empty), [said]


def _boxes_touch(parts: list[Closed]) -> np.ndarray:
    """(n, n): whether the boxes of two parts have a point in common."""
    low, high = np.moveaxis(np.stack([part.box for part in parts]), 1, 0)
    slack = NEAR * np.ptp(np.concatenate([low, high]), axis=0).max()
    return (low[:, None] <= high[None] + slack).all(axis=-1) & (low[None] <= high[:, None] + slack).all(
        axis=-1
    )


def _owners(parts: list[Closed], near: np.ndarray) -> list[Closed | None]:
    """For each part the solid one that it is a cavity of, or None where it is solid itself."""
    owner: list[Closed | None] = [None] * len(parts)
    if not any(part.inwards for part in parts):
        return owner
    by_size = sorted(range(len(parts)), key=lambda i: -parts[i].volume)
    root = list(range(len(parts)))
    for rank, i in enumerate(by_size):
        around = [j for j in by_size[:rank] if near[i, j] and _inside(parts[i], parts[j])]
        if not around:
            continue
        root[i], smallest = root[around[0]], around[-1]
        if parts[i].inwards != parts[root[i]].inwards and owner[smallest] is None:
            owner[i] = parts[smallest]
    return owner


def _inside(inner: Closed, outer: Closed) -> bool:
    if (inner.box[0] < outer.box[0]).any() or (inner.box[1] > outer.box[1]).any():
        return False
    return (inner.body ^ outer.body).volume() > WHOLE * inner.volume


def _joined(
    parts: list[Closed], owner: list[Closed | None]
) -> tuple[tuple[np.ndarray, np.ndarray] | None, list[str]]:
    """The union of solid parts without their cavities, and which of them met; None where none did."""
    pinched = any(part.pinched for part in parts)
    if len(parts) == 1 and not pinched:
        return None, []
    from manifold3d import Error, Manifold, OpType

    def whole(part: Closed) -> Any:
        its = [other.body for other, around in zip(parts, owner, strict=True) if around is part]
        return Manifold.batch_boolean([part.body, *its], OpType.Subtract)

    solids = [part for part, around in zip(parts, owner, strict=True) if around is None]
    cavities = [part for part, around in zip(parts, owner, strict=True) if around is not None]
    union = Manifold.batch_boolean([whole(part) for part in solids], OpType.Add)
    if union.status() != Error.NoError or union.is_empty():
        return None, []
    volume = sum(part.volume for part in solids) - sum(part.volume for part in cavities)
    area = sum(part.area for part in parts)
    apart = abs(union.volume() - volume) <= NEAR * volume and abs(union.surface_area() - area) <= NEAR * area
    if apart and not pinched:
        return None, []
    mesh = union.to_mesh64()
    result = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)
    return result, [] if apart else [_met_words(solids, cavities)]


def _met_words(*kinds: list[Closed]) -> str:
    """Which of the solid parts, and which of the cavities, have surface in each other."""
    met = []
    for a, b in chain.from_iterable(combinations(parts, 2) for parts in kinds):
        if (np.maximum(a.box[0], b.box[0]) > np.minimum(a.box[1], b.box[1])).any():
            continue
        common, smaller = (a.body ^ b.body).volume(), min((a, b), key=lambda part: part.volume)
        if common > WHOLE * smaller.volume:
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


def _turned_words(turned: np.ndarray, cavity: np.ndarray) -> list[str]:
    if not turned.any():
        return []
    where = f" of {_numbered(turned)}" if len(turned) > 1 else ""
    kept = f"; {_numbered(turned & cavity)} stayed hollow" if (turned & cavity).any() else ""
    return [
        f"some faces{where} pointed inwards; they were turned so that all normals point out of the volume{kept}"
    ]


def _numbered(parts: np.ndarray) -> str:
    numbers = [str(part + 1) for part in np.flatnonzero(parts)[: NAMED + 1]]
    named = ", ".join(numbers[:NAMED]) + ", ..." * (len(numbers) > NAMED)
    return f"part{'s' * (len(numbers) > 1)} {named}"
