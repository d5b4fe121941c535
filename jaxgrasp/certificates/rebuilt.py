"""What every proof starts from: the grasp map rebuilt in float64 from positions, normals, mu and gamma; numpy only."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "EPS",
    "RANK_TOLERANCE",
    "ROUNDING",
    "Rebuilt",
    "component_vectors",
    "part_of",
    "rebuild",
    "scaled_force",
    "scaled_twist",
    "scaled_wrench",
]

ROUNDING = 16.0  # c
RANK_TOLERANCE = 64.0  # in units of eps of the grasp's dtype, relative to the largest singular value
EPS = float(np.finfo(np.float64).eps)


def part_of(arrays: Any, lanes: slice | np.ndarray) -> Any:
    """Some lanes of a named tuple of arrays, or of named tuples of them; what is no array belongs to all."""

    def part(x: Any) -> Any:
        if hasattr(x, "_asdict"):
            return part_of(x, lanes)
        return x[lanes] if isinstance(x, np.ndarray) else x

    return arrays._replace(**{name: part(x) for name, x in arrays._asdict().items()})


def _frame(normal: np.ndarray) -> list[np.ndarray]:
    """Tangents of the convention the forces are written in (Duff et al. 2017; planar: t x n = +z)."""
    if normal.shape[-1] == 2:
        return [np.stack([normal[..., 1], -normal[..., 0]], -1)]
    x, y, z = np.moveaxis(normal, -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return [
        np.stack([1 + sign * x * x * a, sign * b, -sign * x], -1),
        np.stack([b, sign + y * y * a, -y], -1),
    ]


def _cross(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    if p.shape[-1] == 2:
        return (p[..., 0] * f[..., 1] - p[..., 1] * f[..., 0])[..., None]
    return np.cross(p, f)


def _folded(position, normal, friction, torsion, components) -> np.ndarray:
    """Contact blocks (lanes, k, m, n) with the normal column first and the coefficients folded in."""
    tangents = _frame(normal)
    columns = [np.concatenate([normal, _cross(position, normal)], -1)]
    for name in components:
        if name in ("f_x", "f_y"):
            d = friction[..., None] * tangents[("f_x", "f_y").index(name)]
            columns.append(np.concatenate([d, _cross(position, d)], -1))
        elif name == "tau_n":
            columns.append(np.concatenate([np.zeros_like(normal), torsion[..., None] * normal], -1))
    return np.stack(columns, -1)


def scaled_force(force, scale, normal_index) -> np.ndarray:
    """s with f = scale * s, normal first; infinite where a component is asked for that does not exist."""
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(force == 0, 0.0, force / scale)
    tangential = np.delete(s, normal_index, -1)
    return np.concatenate([s[..., normal_index : normal_index + 1], tangential], -1)


def scaled_twist(twist: np.ndarray, length: np.ndarray, dimension: int) -> np.ndarray:
    """(v; L omega) of twists (N, m), lengths (N,)."""
    return np.concatenate([twist[:, :dimension], twist[:, dimension:] * length[:, None]], -1)


def scaled_wrench(wrench: np.ndarray, length: np.ndarray, dimension: int) -> np.ndarray:
    """(F; tau / L) of wrenches (N, m), lengths (N,)."""
    return np.concatenate([wrench[:, :dimension], wrench[:, dimension:] / length[:, None]], -1)


class Rebuilt(NamedTuple):
    """The lanes of a grasp in float64, harmless numbers in lanes and contacts that do not count.

    valid (N,), live (N, k): what counts            length (N,): L          friction, torsion (N, k)
    position, normal (N, k, d): as given
    blocks (N, k, m, n): folded maps, lengths over L, normal column first    A (N, m, k n): the same, side by side
    scale (N, k, n): f = scale s, in the order of the components            components, normal_index
    """

    valid: np.ndarray
    live: np.ndarray
    length: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    torsion: np.ndarray
    blocks: np.ndarray
    A: np.ndarray
    scale: np.ndarray
    components: list[str]
    normal_index: int


def _sound(position, normal, friction, torsion, active, dtype: np.finfo) -> np.ndarray:
    """(N,) which numbers are a grasp.

    Those of active contacts, at least one, are finite, the largest component of a normal is no denormal number, mu and
    gamma are at least 0; and the sizes are such that products neither over- nor underflow in the dtype: with
    S = 2^256 (float64), 2^32 (float32) and P the largest |component| of a position, P is 0 or in [1/S, S], mu <= S,
    gamma <= S P (<= S for P = 0).
    """
    limit = 2.0 ** (dtype.maxexp // 4)
    usable = np.isfinite(position).all(-1) & np.isfinite(normal).all(-1)
    usable &= np.max(np.abs(normal), -1) >= float(dtype.tiny)
    usable &= (friction >= 0) & (friction <= limit) & (torsion >= 0)
    largest = np.max(np.where(active[..., None], np.abs(position), 0.0), (-1, -2), initial=0.0)
    length = np.where(largest > 0, largest, 1.0)
    spin = np.max(np.where(active, torsion, 0.0), -1, initial=0.0)
    sized = (length >= 1 / limit) & (length <= limit) & (spin <= limit * length)
    return (usable | ~active).all(-1) & active.any(-1) & sized


def rebuild(grasp) -> Rebuilt:
    """The folded grasp map of every lane, from the numbers that define the grasp."""
    k, dimension = grasp.position.shape[-2], grasp.position.shape[-1]
    m = 3 if dimension == 2 else 6
    components = [c.value for c in grasp.model.components(dimension)]
    n, normal_index = len(components), components.index("f_n")

    def lanes(array, *shape):
        return np.asarray(array).reshape(-1, *shape)

    position = lanes(grasp.position, k, dimension).astype(np.float64)
    normal = lanes(grasp.normal, k, dimension).astype(np.float64)
    friction = lanes(grasp.model.friction_coefficient, k).astype(np.float64)
    torsion = lanes(grasp.model.torsion_coefficient, k).astype(np.float64)
    active = lanes(grasp.active, k)
    with np.errstate(all="ignore"):
        size = np.max(np.abs(normal), -1)
        valid = _sound(position, normal, friction, torsion, active, np.finfo(np.dtype(grasp.position.dtype)))
        live = active & valid[:, None]
        given = np.where(live[..., None], normal, 0.0)
        normal = np.where(
            live[..., None], normal / np.where(size > 0, size, 1.0)[..., None], np.eye(dimension)[-1]
        )
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    position = np.where(live[..., None], position, 0.0)
    friction, torsion = np.where(live, friction, 0.0), np.where(live, torsion, 0.0)
    largest = np.max(np.abs(position), (-1, -2))
    largest = np.where(largest > 0, largest, 1.0)
    length = largest * np.max(np.linalg.norm(position / largest[:, None, None], axis=-1), -1)
    length = np.where(length > 0, length, 1.0)
    blocks = _folded(
        position / length[:, None, None], normal, friction, torsion / length[:, None], components
    )
    blocks = np.where(live[..., None, None], blocks, 0.0)
    A = np.moveaxis(blocks, 1, 2).reshape(len(blocks), m, k * n)
    by_component = {"f_x": friction, "f_y": friction, "f_n": np.ones_like(friction), "tau_n": torsion}
    scale = np.stack([by_component[c] for c in components], -1)
    return Rebuilt(
        valid, live, length, position, given, friction, torsion, blocks, A, scale, components, normal_index
    )


def component_vectors(grasp, orientation=None) -> np.ndarray:
    """(*batch, k, r, n): each force component as a vector (force; torque of a soft finger), body or world axes."""
    dimension = grasp.position.shape[-1]
    names = [c.value for c in grasp.model.components(dimension)]
    normal = np.asarray(grasp.normal, np.float64)
    with np.errstate(all="ignore"):
        normal = normal / np.max(np.abs(normal), -1, keepdims=True)
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        axes = [*_frame(normal), normal]
    if orientation is not None:
        turn = _rotation(np.asarray(orientation, np.float64))
        axes = [np.einsum("...ij,...kj->...ki", turn, v) for v in axes]
    column = {"f_x": axes[0], "f_y": axes[-2], "f_n": axes[-1], "tau_n": axes[-1]}
    if "tau_n" not in names:
        return np.stack([column[c] for c in names], -1)
    zero = np.zeros_like(normal)
    return np.stack(
        [np.concatenate([zero, column[c]] if c == "tau_n" else [column[c], zero], -1) for c in names], -1
    )


def _rotation(orientation: np.ndarray) -> np.ndarray:
    """R_WB of an angle (*batch, 1), or of a quaternion (w, x, y, z) of unit length."""
    if orientation.shape[-1] == 1:
        c, s = np.cos(orientation[..., 0]), np.sin(orientation[..., 0])
        return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    w, v = orientation[..., :1, None], orientation[..., 1:]
    cross = np.cross(np.eye(3), v[..., None, :])  # v x e_i as columns, transposed below
    outer = v[..., :, None] * v[..., None, :]
    square = np.sum(v * v, -1)[..., None, None]
    return (w * w - square) * np.eye(3) + 2 * outer - 2 * w * np.swapaxes(cross, -1, -2)
