"""A field on a regular grid, interpolated by cubic B-splines: twice continuously differentiable everywhere.

``phi(x) = sum_ijk c_ijk b(u - i) b(v - j) b(w - k)``, (u, v, w) = (x - origin) / spacing, b the cubic B-spline; the
c_ijk make phi equal to the values at the nodes. Source: Unser, Splines: a perfect fit for signal and image processing,
IEEE Signal Processing Magazine 16(6), 1999.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core import Array, Float, Int
from .nearest import TriangleSearch, pieces
from .triangles import Triangles

__all__ = ["BAND", "MARGIN", "DistanceGrid", "distance_grid"]

MARGIN = 4  # cells between the mesh and the grid's edge
BAND = 2.5  # cells: nodes at least this near the surface hold the exact distance
CHANNELS = 5  # distance, outward normal, distance of sharp edges


def _weights(t: Array) -> tuple[Array, Array]:
    """Values (4,) and derivatives (4,) of the four B-splines over a cell, at t in [0, 1]."""
    s = 1 - t
    value = jnp.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3]) / 6
    slope = jnp.stack([-(s**2), 3 * t**2 - 4 * t, -3 * s**2 + 4 * s, t**2]) / 2
    return value, slope


class DistanceGrid(eqx.Module):
    """Spline coefficients of a signed distance (channel 0, m) and of what belongs to the nearest point (the others).

    coefficients  (n, n, n, channels), those of the nodes (nx, ny, nz) in use first, so that all grids have one shape
    used          (3,) int32: nx, ny, nz
    origin        (3,) the node (0, 0, 0), m
    spacing       () m
    """

    coefficients: Float[Array, "n n n channels"]
    used: Int[Array, " 3"]
    origin: Float[Array, " 3"]
    spacing: Float[Array, ""]

    @property
    def sharp(self) -> bool:
        """Whether there are sharp edges, whose distance is the last channel."""
        return self.coefficients.shape[3] == CHANNELS

    def clamp(self, point: Float[Array, " 3"]) -> Array:
        """The point of the grid's inner box nearest to ``point``."""
        last = self.used.astype(point.dtype) - 2
        return jnp.clip(point, self.origin + self.spacing, self.origin + last * self.spacing)

    def _support(self, point: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        u = (self.clamp(point) - self.origin) / self.spacing
        last = self.used - 3
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(u)).astype(jnp.int32), 1, last)
        start = [cell[i] - 1 for i in range(3)] + [jnp.zeros((), jnp.int32)]
        block = jax.lax.dynamic_slice(
            self.coefficients, start, (4, 4, 4, self.coefficients.shape[3]), allow_negative_indices=False
        )
        t = u - cell.astype(point.dtype)
        return block, [_weights(t[i]) for i in range(3)]

    def distance_and_gradient(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        """Signed distance () in m and its gradient (3,); those of the clamped point outside the grid."""
        block, ((x, dx), (y, dy), (z, dz)) = self._support(point)
        block = block[..., 0]
        # Sums, not matrix products: an accelerator would round those to fewer bits.
        along_z = jnp.sum(block * z, axis=2), jnp.sum(block * dz, axis=2)
        plain = jnp.sum(along_z[0] * y, axis=1)
        slope = [
            jnp.sum(plain * dx),
            jnp.sum(jnp.sum(along_z[0] * dy, axis=1) * x),
            jnp.sum(jnp.sum(along_z[1] * y, axis=1) * x),
        ]
        return jnp.sum(plain * x), jnp.stack(slope) / self.spacing

    def values(self, point: Float[Array, " 3"]) -> Array:
        """All channels (channels,) at a point."""
        block, ((x, _), (y, _), (z, _)) = self._support(point)
        weight = x[:, None, None] * y[:, None] * z
        return jnp.sum(block * weight[..., None], axis=(0, 1, 2))


def _segment_distance(point: np.ndarray, segment: np.ndarray, step: float) -> np.ndarray:
    """Distance (n,) of points to the nearest of segments (s, 2, 3), exact where they are longer than ``step``."""
    from scipy.spatial import KDTree

    length = np.linalg.norm(segment[:, 1] - segment[:, 0], axis=1)
    parts = np.maximum(1, np.ceil(length / step)).astype(int)
    owner = np.repeat(np.arange(len(segment)), parts)
    place = (np.arange(len(owner)) - np.repeat(np.cumsum(parts) - parts, parts) + 0.5) / parts[owner]
    start, side = segment[owner, 0], segment[owner, 1] - segment[owner, 0]
    tree = KDTree(start + place[:, None] * side)
    near = tree.query(point, k=min(4, len(owner)))[1].reshape(len(point), -1)
    best = np.full(len(point), np.inf)
    for row in near.T:
        a, d = segment[owner[row], 0], segment[owner[row], 1] - segment[owner[row], 0]
        t = np.einsum("ij,ij->i", point - a, d) / np.maximum(np.einsum("ij,ij->i", d, d), 1e-300)
        best = np.minimum(best, np.linalg.norm(point - a - np.clip(t, 0, 1)[:, None] * d, axis=1))
    return best


def distance_grid(triangles: Triangles, search: TriangleSearch, resolution: int) -> DistanceGrid:
    """The grid of a mesh with ``resolution`` nodes along its longest side, cells being cubes.

    Nodes nearer than 2.5 cells hold the exact distance, its sign from the pseudonormal of the nearest triangle, edge
    or vertex, the smooth outward normal and the distance to the nearest sharp edge. Farther nodes take the nearest of
    these nodes' triangle: their distance is an upper bound, their sign right. Without sharp edges the last channel is
    left out.
    """
    from scipy import ndimage  # when needed, as in nearest

    low, size = triangles.vertices.min(axis=0), np.ptp(triangles.vertices, axis=0)
    spacing = float(size.max()) / (resolution - 1 - 2 * MARGIN)
    shape = np.ceil(size / spacing - 1e-9).astype(int) + 1 + 2 * MARGIN
    # The mesh sits in the middle of its box.
    origin = low + size / 2 - spacing * (shape - 1) / 2

    centre, _, _ = pieces(triangles.corner, spacing / 2)
    far = np.ones(shape, bool)
    far[tuple(np.rint((centre - origin) / spacing).astype(int).T)] = False
    # A point is within half a cell of a piece's centre, and that within half a cell's diagonal of its node.
    distance = ndimage.distance_transform_edt(far)
    near = distance <= BAND + 0.5 + 0.75**0.5
    index = np.asarray(np.nonzero(near)).T
    node = origin + spacing * index
    length, face, weight = search.nearest(node)
    away = node - triangles.at(face, weight)
    sign = np.where(np.einsum("ij,ij->i", away, triangles.pseudonormal(face, weight)) < 0, -1.0, 1.0)

    channels = CHANNELS if len(triangles.sharp) else CHANNELS - 1
    values = np.empty((*shape, channels))
    values[near, 0] = sign * length
    values[near, 1:4] = triangles.smooth_normal(face, weight)
    if channels == CHANNELS:
        values[near, 4] = _segment_distance(triangles.at(face, weight), triangles.sharp, spacing / 2)

    row = np.full(shape, -1)
    row[near] = np.arange(len(node))
    nearest = np.asarray(ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True))
    rest = np.asarray(np.nonzero(~near)).T
    source = row[tuple(nearest[:, ~near])]
    values[~near] = values[near][source]
    values[~near, 0] = sign[source] * np.linalg.norm(
        origin + spacing * rest - triangles.at(face, weight)[source], axis=1
    )
    padded = np.zeros((resolution, resolution, resolution, channels), jnp.result_type(float))
    inside = tuple(slice(n) for n in shape)
    for channel in range(channels):
        padded[(*inside, channel)] = ndimage.spline_filter(values[..., channel], order=3, mode="mirror")
    dtype = padded.dtype
    return DistanceGrid(
        jnp.asarray(padded),
        jnp.asarray(shape, jnp.int32),
        jnp.asarray(origin + triangles.middle, dtype),
        jnp.asarray(spacing, dtype),
    )
