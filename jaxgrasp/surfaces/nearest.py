"""Nearest points of a triangle mesh, exact to rounding: ``argmin over triangles and their points of |x - p|``.

Triangles are cut into pieces of bounded radius rho, whose centres go into a k-d tree. A piece at centre distance d is
no nearer than d - rho. So candidates are taken in the order of d, four times as many a round, until the next one could
not be nearer than the best triangle so far. Source: Ericson, Real-time collision detection, 2005, 5.1.5, for
a point and a triangle.
"""

from __future__ import annotations

import numpy as np

__all__ = ["TriangleSearch", "pieces", "point_triangle"]

FIRST = 8  # candidates of the first round
CHUNK = 1 << 15  # points at a time
MOST_PIECES = 2_000_000


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", a, b)


def point_triangle(point: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances (n,) and barycentric weights (n, 3) of the points of triangles nearest to points.

    point (n, 3), corner (n, 3, 3). The weight of a corner is exactly 0 where the nearest point lies on the side
    opposite. Sides are tried apart from the plane, so that thin triangles cost no digits.
    """
    side = np.roll(corner, -1, axis=1) - corner
    away = point[:, None] - corner
    square = np.einsum("nci,nci->nc", side, side)
    along = np.clip(np.einsum("nci,nci->nc", away, side) / np.maximum(square, 1e-300), 0, 1)
    rest = away - along[..., None] * side
    distance = np.einsum("nci,nci->nc", rest, rest)
    best = np.argmin(distance, axis=1)
    rows = np.arange(len(point))
    least, t = distance[rows, best], along[rows, best]
    weight = np.zeros((len(point), 3))
    weight[rows, best], weight[rows, (best + 1) % 3] = 1 - t, t

    normal = np.cross(side[:, 0], side[:, 1])
    size = np.maximum(_dot(normal, normal), 1e-300)
    # Each weight is a height over the side opposite: three of a kind, none a difference from 1.
    height = np.einsum("nci,ni->nc", np.cross(side, away), normal) / size[:, None]
    inside = (height > 0).all(axis=1)
    over = _dot(away[:, 0], normal) ** 2 / size
    inner = height[:, [1, 2, 0]] / np.maximum(height.sum(axis=1, keepdims=True), 1e-300)
    return np.where(inside, over, least), np.where(inside[:, None], inner, weight)


def pieces(corner: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (n, 3), radii (n,) and triangles (n,) of pieces no larger than ``radius``, by halving longest sides.

    Stops at two million pieces; the radii are then larger, and right.
    """
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    owner, total = np.arange(len(corner)), 0
    while len(corner):
        centre = corner.mean(axis=1)
        size = np.sqrt(((corner - centre[:, None]) ** 2).sum(axis=2).max(axis=1))
        large = size > radius
        if total + 2 * len(corner) > MOST_PIECES:
            large[:] = False
        done.append((centre[~large], size[~large], owner[~large]))
        total += int((~large).sum())
        corner, owner = corner[large], owner[large]
        longest = np.argmax(((np.roll(corner, -1, axis=1) - corner) ** 2).sum(axis=2), axis=1)
        turned = np.take_along_axis(corner, ((longest[:, None] + np.arange(3)) % 3)[..., None], axis=1)
        a, b, c = np.moveaxis(turned, 1, 0)
        middle = (a + b) / 2
        corner = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        owner = np.concatenate([owner, owner])
    centre, size, which = (np.concatenate(part) for part in zip(*done, strict=True))
    return centre, size, which


class TriangleSearch:
    """Finds nearest points of triangles ``corner`` (f, 3, 3), given about their middle for the least rounding."""

    def __init__(self, corner: np.ndarray):
        self.corner = np.asarray(corner, np.float64)
        side = self.corner[:, 1:] - self.corner[:, :1]
        area = float(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum()) / 2
        size = np.linalg.norm(self.corner - self.corner.mean(axis=1, keepdims=True), axis=2).max(axis=1)
        radius = np.clip(1.5 * np.median(size), (area / 400_000) ** 0.5, (area / 5_000) ** 0.5)
        centre, self.size, self.face = pieces(self.corner, float(radius))
        self.largest = float(self.size.max())
        from scipy.spatial import KDTree  # when needed: the library is imported without it

        self.tree = KDTree(centre)

    def nearest(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance (n,), triangle (n,) and barycentric weights (n, 3) of the nearest point to each of (n, 3)."""
        parts = [self._chunk(point[i : i + CHUNK]) for i in range(0, max(len(point), 1), CHUNK)]
        distance, face, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        return distance, face, weight

    def _chunk(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        count = len(point)
        best, face, weight = np.full(count, np.inf), np.zeros(count, np.intp), np.zeros((count, 3))
        waiting, seen, wanted = np.arange(count), 0, FIRST
        while len(waiting):
            wanted = min(wanted, self.tree.n)
            distance, piece = self.tree.query(point[waiting], k=wanted)
            distance, piece = distance.reshape(-1, wanted), piece.reshape(-1, wanted)
            if seen == 0:
                self._improve(point, waiting, piece[:, 0], best, face, weight)
                seen = 1
            floor = distance[:, seen:] - self.size[piece[:, seen:]]
            row, column = np.nonzero(floor < best[waiting][:, None])
            self._improve(point, waiting[row], piece[row, column + seen], best, face, weight)
            going = (distance[:, -1] - self.largest < best[waiting]) & (wanted < self.tree.n)
            waiting, seen, wanted = waiting[going], wanted, 4 * wanted
        return best, face, weight

    def _improve(self, point, row, piece, best, face, weight) -> None:
        """Take the triangles of ``piece`` for the points ``row``, with repeats, where nearer; ties go to the lower."""
        triangle = self.face[piece]
        square, bary = point_triangle(point[row], self.corner[triangle])
        distance = np.sqrt(square)
        order = np.lexsort((triangle, distance, row))
        first = np.ones(len(order), bool)
        first[1:] = row[order][1:] != row[order][:-1]
        pick = order[first]
        pick = pick[distance[pick] < best[row[pick]]]
        target = row[pick]
        best[target], face[target], weight[target] = distance[pick], triangle[pick], bary[pick]
