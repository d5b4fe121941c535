"""The surface of a triangle mesh: a spline through its signed distance inside jit, the triangles themselves outside.

Inside: ``x <- x - phi grad phi / |grad phi|^2``, a fixed number of times, phi the spline of ``DistanceGrid``. On the
surface the derivative of this map is the projection onto the tangent plane; near it, it differs from the nearest
point's by curvature times the square of the distance. Outside: ``project_exact``, the nearest point of the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core import Array, ArrayLike, Float, UserError
from .grid import DistanceGrid, distance_grid
from .nearest import TriangleSearch
from .surface import SmoothSurface, Surface, generator, unit_or
from .triangles import Triangles

if TYPE_CHECKING:
    import trimesh

    from ..objects import Body

__all__ = ["GridSurface", "MeshSurface", "NearestPoint"]

STEPS = 6  # Newton steps of a projection: from within the band they end at rounding, thin parts apart
SMALL_STEPS = 3  # of a retraction: it leaves the cube of the way, over curvature squared
LEAST_SLOPE = 0.25  # of phi, squared, that a step divides by; 1 on the surface
PROBES = 4000  # points of the mesh at which a new grid is tried
MOST_LOST = 0.25  # share of them that may be lost before the grid is refused


@dataclass(frozen=True)
class NearestPoint:
    """Nearest points on the triangles of a mesh, in float64.

    point          (*batch, 3) m
    normal         (*batch, 3) inward unit normal of the face
    smooth_normal  (*batch, 3) inward unit normal interpolated between the face's corners
    face           (*batch,) its number in the mesh given
    barycentric    (*batch, 3) weights of its corners; exactly 0 for the corner opposite of a side that is met
    distance       (*batch,) m, without a sign
    """

    point: np.ndarray
    normal: np.ndarray
    smooth_normal: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    distance: np.ndarray


class GridSurface(SmoothSurface):
    """The zero level of a spline: what of a mesh runs inside jit, without its triangles.

    All meshes of one resolution have the same shapes of arrays (with sharp edges or without), hence one program.
    """

    grid: DistanceGrid
    centre: Float[Array, " 3"]
    radius: Float[Array, ""]

    def _on(self, point: Array, steps: int = STEPS) -> Array:
        x = self.grid.clamp(point)
        for _ in range(steps):
            value, slope = self.grid.distance_and_gradient(x)
            square = jnp.sum(slope * slope)
            x = x - value * slope / jnp.maximum(square, jnp.full_like(square, LEAST_SLOPE))
        return x

    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        x = self._on(point)
        return x, self._normal_on(x)

    def _retract(self, point: Float[Array, " 3"]) -> Array:
        return self._on(point, SMALL_STEPS)

    def _tangent_normal(self, x: Float[Array, " 3"]) -> Array:
        return unit_or(self.grid.distance_and_gradient(x)[1], jnp.asarray([0.0, 0.0, 1.0], x.dtype))[0]

    def _normal_on(self, x: Float[Array, " 3"]) -> Array:
        return unit_or(-self.grid.values(x)[1:4], jnp.asarray([0.0, 0.0, 1.0], x.dtype))[0]

    def _distance(self, point: Float[Array, " 3"]) -> Array:
        inner = self.grid.clamp(point)
        beyond = unit_or(point - inner, jnp.zeros_like(point))[1]
        return self.grid.distance_and_gradient(inner)[0] + beyond

    def _edge_distance(self, point: Float[Array, " 3"]) -> Array:
        if not self.grid.sharp:
            return super()._edge_distance(point)
        return self.grid.values(self._on(point))[4]


class MeshSurface(Surface):
    """The surface of a mesh, on which contacts can be moved by gradients and then put exactly.

    mesh        a ``trimesh.Trimesh``, m, outward normals; ``from_body`` takes a ``Body`` of ``objects.load_mesh``
    resolution  nodes of the grid along the mesh's longest side, 16 or more
    centre      (3,) centre of mass, m; by default that of the volume inside, of the surface where the mesh is open
    crease      rad: an edge is sharp where its faces' normals differ by more; the rim of an open mesh is sharp

    grid        the spline, a cube of nodes, 5 x 8 bytes each in float64: 35 MB at 96
    lost        share of the surface's area that the grid does not resolve: walls thinner than about two cells
    warnings    sentences for the user, each naming its consequence

    ``distance`` is the spline's value, ``normal`` that of a spline through the smooth normals, so that it turns
    within a facet as the shape does that the facets stand for. Both are smooth across sharp edges too, over
    about a cell. ``edge_distance`` keeps contacts away from these.

    An open mesh is accepted, with a warning: its sign is that of the nearest face's side, and the surface goes on
    beyond its rim for a while; the rim counts as sharp.

    UserError for a mesh without faces, area or volume, with NaN coordinates or faces inwards, and for one that the
    resolution cannot resolve; ValueError for wrong arguments.
    """

    faceted: ClassVar[bool] = True
    smooth: GridSurface
    triangles: Triangles = eqx.field(static=True)
    search: TriangleSearch = eqx.field(static=True)
    lost: float = eqx.field(static=True)
    warnings: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        *,
        resolution: int = 96,
        centre: Float[ArrayLike, " 3"] | None = None,
        crease: float = np.pi / 6,
    ):
        if not isinstance(resolution, int | np.integer) or resolution < 16:
            raise ValueError(f"resolution must be an integer of 16 or more nodes a side, got {resolution!r}")
        if not 0 < crease < np.pi:
            raise ValueError(f"crease must be an angle between 0 and pi rad, got {crease!r}")
        self.triangles = Triangles(mesh.vertices, mesh.faces, crease)
        self.search = TriangleSearch(self.triangles.corner)
        grid = distance_grid(self.triangles, self.search, int(resolution))
        middle = self.triangles.centre if centre is None else np.asarray(centre, np.float64)
        if middle.shape != (3,) or not np.isfinite(middle).all():
            raise ValueError(f"centre must be three finite numbers in m, got {centre!r}")
        dtype = grid.origin.dtype
        radius = jnp.asarray(self.triangles.farthest(middle), dtype)
        self.smooth = GridSurface(centre=jnp.asarray(middle, dtype), radius=radius, grid=grid)
        self.lost = self._lost()
        self.warnings = self._words(int(resolution))

    @classmethod
    def from_body(cls, body: Body, *, resolution: int = 96, crease: float = np.pi / 6) -> MeshSurface:
        """The surface of a body, about the body's own centre of mass."""
        return cls(body.mesh, resolution=resolution, centre=body.centre_of_mass, crease=crease)

    @property
    def grid(self) -> DistanceGrid:
        """The spline's coefficients and where they lie."""
        return self.smooth.grid

    @property
    def centre(self) -> Float[Array, " 3"]:
        """The centre of mass, m."""
        return self.smooth.centre

    @property
    def radius(self) -> Float[Array, ""]:
        """The largest distance of the surface from ``centre``, m."""
        return self.smooth.radius

    @property
    def traced(self) -> GridSurface:
        """The spline without the triangles: what to hand to a jitted function."""
        return self.smooth

    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        return self.smooth._contact(point)

    def _lost(self) -> float:
        """Share of the area that the spline misses by half a cell, or sees with its sides swapped."""
        face, weight = self.triangles.draw(generator(0, PROBES), PROBES)
        point = jnp.asarray(self.triangles.at(face, weight) + self.triangles.middle, self.grid.origin.dtype)
        value, slope = jnp.vectorize(self.grid.distance_and_gradient, signature="(d)->(),(d)")(point)
        along = np.einsum("ij,ij->i", np.asarray(slope), self.triangles.normal[face])
        return float(np.mean((np.abs(value) > 0.5 * float(self.grid.spacing)) | (along < 0.25)))

    def _words(self, resolution: int) -> tuple[str, ...]:
        spacing = float(self.grid.spacing)
        advice = f"the grid's cells measure {spacing:.2g} m; take a resolution above {resolution}"
        if self.lost > MOST_LOST:
            raise UserError(f"{self.lost:.0%} of the surface is too thin for the grid: {advice}")
        words = []
        if self.lost > 0.01:
            words.append(f"{self.lost:.1%} of the surface is too thin or sharp for the grid: {advice}")
        if not self.triangles.closed:
            words.append(
                "the mesh is not watertight: inside and outside are told by the nearest face, and contacts may "
                "leave the rim unless edge_distance keeps them"
            )
        return tuple(words)

    def project_exact(self, point: Float[ArrayLike, "*batch 3"]) -> NearestPoint:
        """``argmin_x |x - p|`` over the triangles, exact to rounding, on the host: points (*batch, 3) in m.

        Points with NaN or infinite coordinates get NaN, and -1 for their face. Of several nearest faces the one
        with the lowest number is taken where they are equally near to the last bit.
        """
        given = np.asarray(point, np.float64)
        if given.ndim < 1 or given.shape[-1] != 3:
            raise ValueError(f"points must have shape (*batch, 3), got {given.shape}")
        batch, t = given.shape[:-1], self.triangles
        flat = given.reshape(-1, 3)
        finite = np.asarray(np.isfinite(flat).all(axis=1))
        distance, face, weight = self.search.nearest(np.where(finite[:, None], flat, t.middle) - t.middle)

        def shaped(values: np.ndarray, missing: float = np.nan) -> np.ndarray:
            kept = finite.reshape(-1, *[1] * (values.ndim - 1))
            return np.where(kept, values, missing).reshape((*batch, *values.shape[1:]))

        return NearestPoint(
            shaped(t.at(face, weight) + t.middle),
            shaped(-t.normal[face]),
            shaped(-t.smooth_normal(face, weight)),
            shaped(t.number[face], -1).astype(np.int64),
            shaped(weight),
            shaped(distance),
        )

    def exact_contact(self, point: Float[ArrayLike, "*batch 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Nearest points (*batch, 3) of the triangles, m, and their faces' inward normals: exact to rounding."""
        near = self.project_exact(point)
        return near.point, near.normal

    def sample(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Points (count, 3) in m on the triangles, uniform over the area, with the faces' own inward normals: exact."""
        face, weight = self.triangles.draw(generator(seed, count), count)
        return self.triangles.at(face, weight) + self.triangles.middle, -self.triangles.normal[face]
