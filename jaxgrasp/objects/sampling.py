"""Candidate contacts on a surface, drawn from a seed: row i is the same whatever else is drawn.

Area-weighted points: ``p = a + u e_1 + v e_2`` on a triangle chosen with probability ``A_j / sum A``,
normal inwards. Antipodal pairs: such a point, a ray into the body within the friction cone of its normal,
and the point where the ray first leaves the body, with its own inward normal (Nguyen, Constructing
force-closure grasps, 1988).

Rows come in blocks of ``BLOCK``. A block's numbers depend on (seed, block) and nothing else, so any range
of rows can be drawn at any time, in any order, on any number of threads.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import trimesh

from ..core import UserError
from .raycast import RayCaster

__all__ = ["BLOCK", "AntipodalSampler", "SurfaceSampler", "geometric_filter", "slide_escapes"]

BLOCK = 4096
CLOSEST = 1e-3  # m, for the filter
ROUNDS = 64  # draws of a block's missing pairs before giving up


def _generator(seed: int, block: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(block,))))


class _Blocks(ABC):
    """Rows [start, stop) put together from whole blocks."""

    fingers: int
    seed: int

    @abstractmethod
    def block(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and normals of the rows of one block, the same for the same seed and index."""

    def rows(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and inward unit normals (stop - start, k, 3) of these rows, m, mesh frame."""
        shape = (stop - start, self.fingers, 3)
        position, normal = np.empty(shape), np.empty(shape)
        for index in range(start // BLOCK, -(-stop // BLOCK)):
            first = index * BLOCK
            low, high = max(start, first), min(stop, first + BLOCK)
            p, n = self.block(index)
            position[low - start : high - start] = p[low - first : high - first]
            normal[low - start : high - start] = n[low - first : high - first]
        return position, normal


class SurfaceSampler(_Blocks):
    """K independent points a grasp, uniform over the surface, with inward unit normals.

    mesh  triangles in m with outward normals; degenerate faces have no area and are never chosen
    """

    def __init__(self, mesh: trimesh.Trimesh, *, fingers: int, seed: int):
        _check(fingers, seed)
        triangles = np.array(mesh.triangles, np.float64)
        edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        outward = np.cross(edge_1, edge_2)
        double_area = np.linalg.norm(outward, axis=1)
        self.face = np.flatnonzero(double_area > 0)
        if not len(self.face):
            raise UserError("the mesh has a surface of zero area: there is nowhere to put a finger")
        self.fingers, self.seed = fingers, seed
        double_area = double_area[self.face]
        normal = -outward[self.face] / double_area[:, None]
        # One row a face: corner, edges, normal. A draw then reads one stretch of memory.
        self.table = np.concatenate(
            [triangles[self.face, 0], edge_1[self.face], edge_2[self.face], normal], axis=1
        )
        self.cumulative = np.cumsum(double_area)
        self.cumulative /= self.cumulative[-1]
        # Where in `cumulative` the search for u begins, for u in equal steps: no long search is left.
        self.steps = 1 << int(np.ceil(np.log2(2 * len(self.face) + 2)))
        self.guide = np.searchsorted(self.cumulative, np.arange(self.steps) / self.steps, side="right")

    def choose(self, u: np.ndarray) -> np.ndarray:
        """Rows of ``table`` for uniform numbers u in [0, 1): the first whose cumulative area exceeds u."""
        row = self.guide[(u * self.steps).astype(np.intp)]
        for _ in range(2):
            row = row + (self.cumulative[row] <= u)
        late = np.flatnonzero(self.cumulative[row] <= u)
        row[late] = np.searchsorted(self.cumulative, u[late], side="right")
        return row

    def points(self, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, inward normals (n, 3) and faces for uniform numbers (3, n)."""
        row = self.choose(uniform[0])
        u, v = uniform[1], uniform[2]
        outside = u + v > 1
        u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
        data = self.table[row]
        points = data[:, :3] + u[:, None] * data[:, 3:6] + v[:, None] * data[:, 6:9]
        return points, data[:, 9:], self.face[row]

    def block(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and inward normals (BLOCK, fingers, 3) of a block, m, mesh frame."""
        uniform = _generator(self.seed, index).random((3, BLOCK * self.fingers))
        points, normals, _ = self.points(uniform)
        return points.reshape(BLOCK, self.fingers, 3), normals.reshape(BLOCK, self.fingers, 3)


class AntipodalSampler(_Blocks):
    """Pairs of contacts joined by a line that starts within the friction cone of the first.

    friction  mu of the first contact: the ray is within atan(mu) of the normal, uniform over the cone's base

    A ray that leaves through a hole of an open mesh is drawn again.
    """

    fingers = 2

    def __init__(self, mesh: trimesh.Trimesh, *, friction: float, seed: int):
        self.surface = SurfaceSampler(mesh, fingers=1, seed=seed)
        self.seed, self.friction = seed, friction
        self.caster = RayCaster(mesh.triangles)
        self.inward = np.full((len(mesh.faces), 3), np.nan)
        self.inward[self.surface.face] = self.surface.table[:, 9:]
        self.shortest = 1e-6 * float(np.linalg.norm(mesh.extents))

    def block(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and inward normals (BLOCK, 2, 3) of a block, m, mesh frame; UserError for an open mesh."""
        generator = _generator(self.seed, index)
        position, normal = np.empty((BLOCK, 2, 3)), np.empty((BLOCK, 2, 3))
        done = 0
        for _ in range(ROUNDS):
            pair, inward = self._pairs(generator.random((5, BLOCK)))
            take = min(len(pair), BLOCK - done)
            position[done : done + take], normal[done : done + take] = pair[:take], inward[:take]
            done += take
            if done == BLOCK:
                return position, normal
        raise UserError(
            "rays into the mesh find no second contact: the mesh is open or its faces point inwards; "
            "repair it, or take --sampler surface"
        )

    def _pairs(self, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        start, inward, face = self.surface.points(uniform[:3])
        radius, turn = self.friction * np.sqrt(uniform[3]), 2 * np.pi * uniform[4]
        # Any two directions across the normal do: the angle about it is uniform.
        helper = np.eye(3)[np.argmin(np.abs(inward), axis=1)]
        first = np.cross(inward, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(inward, first)
        direction = inward + radius[:, None] * (
            np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        )
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        distance, other = self.caster.nearest(start, direction, self.shortest, face)
        # The ray leaves the body where the outward normal goes with it; a hit from outside is no exit.
        exits = np.einsum("ij,ij->i", self.inward[other], direction) < 0
        found = np.flatnonzero((other >= 0) & exits)
        end = start[found] + distance[found, None] * direction[found]
        return (
            np.stack([start[found], end], axis=1),
            np.stack([inward[found], self.inward[other[found]]], axis=1),
        )


def _check(fingers: int, seed: int) -> None:
    if fingers < 1:
        raise UserError(f"a grasp needs at least one finger, got {fingers}; set --fingers to 1 or more")
    if seed < 0:
        raise UserError(f"the seed must not be negative, got {seed}")


def geometric_filter(
    position: np.ndarray, normal: np.ndarray, *, friction: np.ndarray, active: np.ndarray
) -> dict[str, np.ndarray]:
    """For each reason to drop a grasp unsolved, the rows (n,) it concerns; a row has one reason at most."""
    slide = slide_escapes(normal, friction, active)
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
    pair = np.triu(np.ones(apart.shape[1:], bool), 1) & active[:, :, None] & active[:, None]
    close = ((apart < CLOSEST) & pair).any(axis=(1, 2)) & ~slide
    return {
        "a slide along the mean normal meets no finger, so not resistant": slide,
        "two contacts closer than 1 mm": close,
    }


def slide_escapes(normal: np.ndarray, friction: np.ndarray, active: np.ndarray) -> np.ndarray:
    """``n_i . d > mu_i |d - (n_i . d) n_i|`` for all i: a slide along the mean normal d meets no finger.

    Such a slide is an escape twist, so these grasps are certainly not resistant. normal (n, k, 3) of any
    length, friction and active (n, k). A hundredth of the cone is kept in hand for rounding.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        total = np.where(active[..., None], unit, 0.0).sum(axis=-2)
        direction = total / np.linalg.norm(total, axis=-1, keepdims=True)
        along = np.einsum("nkj,nj->nk", unit, direction)
        across = np.sqrt(np.maximum(0.0, 1 - along * along))
        slips = (
            along > 1.01 * friction * across + 1e-9
        )  # False for NaN: those go to the solver, which says INVALID
    return active.any(axis=-1) & (slips | ~active).all(axis=-1)
