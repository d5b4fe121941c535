"""A triangle mesh as a surface: areas, normals of faces, edges and vertices, sharp edges, centre of mass.

Smooth normal at a corner: ``sum_j alpha_j n_j`` over the faces around the vertex that are joined to the corner's
own across edges of less than the crease angle, alpha_j the face's angle at the vertex. The same sums over all
faces of an edge or vertex (the pseudonormals) tell inside from outside. Sources: Thürmer, Wüthrich, Computing
vertex normals from polygonal facets, 1998; Bærentzen, Aanæs, Signed distance computation using the angle weighted
pseudonormal, 2005.
"""

from __future__ import annotations

import numpy as np

from ..core import UserError

__all__ = ["Triangles"]

FLATTEST = 1e-9  # a body thinner than this times its size encloses no volume
THINNEST = 1e-12  # a triangle with less area than this times its longest side squared has none


def _unit(v: np.ndarray, other: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(length > 1e-12, v / np.maximum(length, 1e-300), other)


class Triangles:
    """Faces with area of a mesh, equal vertices merged, coordinates about the middle of its box.

    vertices, faces  (v, 3) in m and (f, 3); outward normals, anticlockwise seen from outside
    crease           rad: an edge is sharp where its faces' normals differ by more; so is the rim of an open mesh

    number           (f,) of each face in the mesh given: faces without area are left out
    corner           (f, 3, 3) triangles, relative to ``middle``, m
    normal, area     (f, 3) outward, (f,) m^2
    smooth           (f, 3, 3) outward smooth normals at the corners
    sharp            (e, 2, 3) sharp edges, relative to ``middle``, m
    closed           whether every edge joins faces that agree about the outside, two or, where parts touch, more

    UserError for a mesh without faces or area, with NaN coordinates, without volume, or with its faces inwards.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, crease: float):
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        if not len(faces):
            raise UserError("the mesh has no faces, so it has no surface to grasp; export triangles")
        if not np.isfinite(vertices[faces]).all():
            raise UserError("the mesh holds NaN or infinite vertex coordinates; repair it first")
        used, faces = np.unique(faces, return_inverse=True)
        vertices, merged = np.unique(vertices[used], axis=0, return_inverse=True)
        faces = merged.reshape(-1)[faces.reshape(-1, 3)]
        self.middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        vertices = vertices - self.middle

        side = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
        cross = np.cross(side[:, 0], -side[:, 2])
        double = np.linalg.norm(cross, axis=1)
        good = double > THINNEST * (side**2).sum(axis=2).max(axis=1)
        if not good.any():
            raise UserError("the mesh has a surface of zero area: every face is degenerate; export it again")
        self._edges(faces, good)
        self.number, self.faces = np.flatnonzero(good), faces[good]
        self.vertices, self.corner = vertices, vertices[faces[good]]
        self.area, self.normal = double[good] / 2, cross[good] / double[good][:, None]
        self._check_volume()
        self._normals(crease, side[good])

    def _edges(self, faces: np.ndarray, good: np.ndarray) -> None:
        """Undirected edges; half-edge 3 f + c runs from corner c of face f to the next."""
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        # Faces on two points join nothing; those without area on three points still close a mesh.
        real = np.repeat((faces != np.roll(faces, 1, axis=1)).all(axis=1), 3)
        low, high = np.minimum(start, end), np.maximum(start, end)
        key, edge = np.unique(low * (faces.max() + 1) + high, return_inverse=True)
        edge = edge.ravel()
        self.ends = np.stack(np.divmod(key, faces.max() + 1), axis=1)
        sides = np.bincount(edge[real], minlength=len(key))
        forward = np.bincount(edge[real & (start < end)], minlength=len(key))
        self.closed = bool((sides == 2 * forward).all())  # more than two sides where parts touch
        self.rim, self.manifold = sides == 1, sides == 2
        self.edge = edge.reshape(-1, 3)[good]

    def _check_volume(self) -> None:
        size = float(np.ptp(self.vertices, axis=0).max())
        if np.linalg.svd(self.vertices[self.faces.ravel()], compute_uv=False)[-1] <= FLATTEST * size:
            raise UserError("the mesh is flat: it encloses no volume; give it a thickness")
        a, b, c = np.moveaxis(self.corner, 1, 0)
        volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
        if self.closed:
            if abs(volume.sum()) <= FLATTEST * size**3:
                raise UserError("the mesh encloses no volume; give it a thickness")
            if volume.sum() < 0:
                raise UserError(
                    "the faces point inwards; jaxgrasp.objects.load_mesh turns them, or invert the mesh"
                )
            weight, centroid = volume, (a + b + c) / 4
        else:
            weight, centroid = self.area, (a + b + c) / 3
        # The volume inside where there is one, the surface otherwise; see meshes.
        self.centre = self.middle + weight @ centroid / weight.sum()

    def _normals(self, crease: float, after: np.ndarray) -> None:
        from scipy.sparse import csr_matrix  # when needed, as in nearest
        from scipy.sparse.csgraph import connected_components

        count = len(self.faces)
        edge = self.edge.ravel()
        owner = np.repeat(np.arange(count), 3)
        self.edge_normal = np.zeros((len(self.ends), 3))
        np.add.at(self.edge_normal, edge, self.normal[owner])

        order = np.argsort(edge, kind="stable")
        joins = np.flatnonzero((np.diff(edge[order]) == 0) & self.manifold[edge[order][1:]])
        one, two = order[joins], order[joins + 1]
        cosine = np.einsum("ij,ij->i", self.normal[owner[one]], self.normal[owner[two]])
        bent = np.arccos(np.clip(cosine, -1, 1)) > crease
        sharp = self.rim.copy()
        sharp |= np.bincount(edge, minlength=len(self.ends)) > 2
        sharp[edge[one[bent]]] = True
        self.sharp = self.vertices[self.ends[sharp]]

        # Corners that share a vertex and a face's edge that is not sharp belong together.
        one, two = one[~bent], two[~bent]
        following = np.arange(3 * count).reshape(-1, 3)[:, [1, 2, 0]].ravel()
        vertex = self.faces.ravel()
        swap = vertex[one] != vertex[two]
        pairs = np.concatenate(
            [
                np.stack([one, np.where(swap, following[two], two)]),
                np.stack([following[one], np.where(swap, two, following[two])]),
            ],
            axis=1,
        )
        graph = csr_matrix((np.ones(pairs.shape[1], bool), pairs), shape=(3 * count, 3 * count))
        fans, fan = connected_components(graph, directed=False)
        before = -np.roll(after, 1, axis=1)  # from each corner to the one before it
        across = np.linalg.norm(np.cross(after, before), axis=-1)
        angle = np.arctan2(across, np.einsum("fcj,fcj->fc", after, before)).ravel()
        weighted = angle[:, None] * self.normal[owner]
        total = np.zeros((fans, 3))
        np.add.at(total, fan, weighted)
        self.smooth = _unit(total[fan], self.normal[owner]).reshape(-1, 3, 3)
        self.vertex_normal = np.zeros((len(self.vertices), 3))
        np.add.at(self.vertex_normal, vertex, weighted)

    def farthest(self, point: np.ndarray) -> float:
        """Largest distance of the surface from ``point``, m."""
        return float(np.linalg.norm(self.vertices + (self.middle - point), axis=1).max())

    def at(self, face: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """``sum_c weight_c corner_c``: points (n, 3) relative to ``middle``."""
        return np.einsum("nc,ncj->nj", weight, self.corner[face])

    def smooth_normal(self, face: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """``sum_c weight_c smooth_c`` of unit length, outwards; the face's own where the sum vanishes."""
        return _unit(np.einsum("nc,ncj->nj", weight, self.smooth[face]), self.normal[face])

    def pseudonormal(self, face: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """A vector (n, 3) whose product with p - x is positive outside, x the point nearest to p."""
        normal = self.normal[face].copy()
        zeros = (weight == 0).sum(axis=1)
        on_edge = np.flatnonzero(zeros == 1)
        opposite = (np.argmin(weight[on_edge], axis=1) + 1) % 3
        normal[on_edge] = self.edge_normal[self.edge[face[on_edge], opposite]]
        on_vertex = np.flatnonzero(zeros == 2)
        corner = np.argmax(weight[on_vertex], axis=1)
        normal[on_vertex] = self.vertex_normal[self.faces[face[on_vertex], corner]]
        return normal

    def draw(self, generator: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Faces and barycentric weights of points uniform over the area."""
        u = generator.random((3, count))
        cumulative = np.cumsum(self.area)
        face = np.searchsorted(cumulative, u[0] * cumulative[-1], side="right")
        face = np.minimum(face, len(self.area) - 1)
        root = np.sqrt(u[1])
        return face, np.stack([1 - root, root * (1 - u[2]), root * u[2]], axis=1)
