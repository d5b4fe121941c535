"""Faces that say something: equal vertices merged, and faces dropped that are there twice or have no area.

Two faces on the same three vertices that look the same way are one. Two that look in opposite directions are a wall
between parts that touch, and go both, where the surface around them closes without them; otherwise one stays. A face
with three vertices on a line stays where the surface would open without it.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

__all__ = ["clean", "double_areas", "edge_numbers", "joined_at_edges"]

SAME = 1e-8  # of the mesh's size: vertices nearer than this are one
THINNEST = 1e-12  # a triangle with less area than this times its longest side squared has none


def edge_numbers(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(f, 3) the number of the edge that goes from each corner to the next, and whether it goes upwards."""
    start, end = faces, np.roll(faces, -1, axis=1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, number = np.unique(low * (faces.max(initial=0) + 1) + high, return_inverse=True)
    return number.reshape(-1, 3), start < end


def double_areas(triangles: np.ndarray) -> np.ndarray:
    """Twice the areas (f,) of triangles (f, 3, 3)."""
    side = triangles[:, 1:] - triangles[:, :1]
    return np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=-1)


def joined_at_edges(number: np.ndarray) -> np.ndarray:
    """A label for each row of edges (f, 3): the same for faces that hang together at edges."""
    count = len(number)
    pairs = (np.repeat(np.arange(count), 3), number.ravel() + count)
    size = count + int(number.max(initial=0)) + 1
    graph = csr_matrix((np.ones(3 * count, bool), pairs), shape=(size, size))
    return connected_components(graph, directed=False)[1][:count]


def equal_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first of equal rows of integers (n, 3), by number, and for each row which of these it equals."""
    order = np.lexsort(rows.T)
    new = np.ones(len(rows), bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    same = np.empty(len(rows), np.intp)
    same[order] = np.cumsum(new) - 1
    return order[new], same


def clean(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Vertices and faces that are used and say something, in the order given, and a sentence about what was dropped."""
    used, faces = np.unique(faces, return_inverse=True)
    unused, vertices = len(vertices) - len(used), vertices[used]
    vertices, faces = _merge(vertices, faces.reshape(-1, 3))
    counts = [len(faces)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    counts.append(len(faces))
    from_lowest = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    faces = faces[np.sort(equal_rows(np.take_along_axis(faces, from_lowest, axis=1))[0])]
    counts.append(len(faces))
    faces = _without_slivers(vertices, faces)
    counts.append(len(faces))
    faces = _without_opposites(vertices, faces)
    counts.append(len(faces))
    repeated, double, thin, opposite = -np.diff(counts)
    kinds = ((double + opposite, "faces that were there twice"), (repeated + thin, "faces without area"))
    dropped = ", ".join(f"{n} {kind}" for n, kind in (*kinds, (unused, "vertices without a face")) if n)
    kept, faces = np.unique(faces, return_inverse=True)
    return vertices[kept], faces.reshape(-1, 3), [f"the mesh lost {dropped}"] * bool(dropped)


def _merge(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low = vertices.min(axis=0)
    cell = SAME * max(float(np.ptp(vertices, axis=0).max()), np.finfo(float).tiny / SAME)
    first, merged = equal_rows(np.rint((vertices - low) / cell).astype(np.int64))
    return vertices[first], merged[faces]


def _without_slivers(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Without faces that have no area and an edge of their own: they close nothing."""
    while len(faces):
        triangles = vertices[faces]
        side = triangles - np.roll(triangles, 1, axis=1)
        thin = double_areas(triangles) <= THINNEST * (side**2).sum(axis=-1).max(axis=-1)
        number, _ = edge_numbers(faces)
        loose = thin & (np.bincount(number.ravel())[number] == 1).any(axis=1)
        if not loose.any():
            break
        faces = faces[~loose]
    return faces


def _without_opposites(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of patches of faces that are there in both directions: none where the rest closes around them, else one."""
    first, same = equal_rows(np.sort(faces, axis=1))
    again = np.ones(len(faces), bool)
    again[first] = False
    if not again.any():
        return faces
    number, _ = edge_numbers(faces)
    paired = np.isin(same, same[again])
    others = np.bincount(number[~paired].ravel(), minlength=number.max() + 1)
    edges = number[again]
    rim = np.bincount(edges.ravel(), minlength=len(others))[edges] == 1
    closes = np.where(others[edges] == 0, 0, 1 - 2 * (others[edges] % 2))
    patch = joined_at_edges(edges)
    votes = np.bincount(patch, (rim * closes).sum(axis=1))[patch]
    inner = np.isin(same, same[again][votes > 0])
    return faces[~again & ~inner]
