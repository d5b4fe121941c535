"""Grasps drawn with matplotlib (extra ``viz``): contacts, friction cones, forces, and the way out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ..core import Status, UserError, contact_frame
from .answers import Verdict
from .words import Screw, screw, status_words

if TYPE_CHECKING:
    import trimesh

__all__ = ["draw", "moved", "view_of"]

LIGHT = np.array([0.3, -0.5, 0.81])
BODY, CONTACT, FORCE, ESCAPE = (0.62, 0.68, 0.75), "#d1495b", "#00798c", "#edae49"
MOST_FACES = 6000


def moved(
    points: np.ndarray, motion: Screw, centre_of_mass: np.ndarray, size: float, step: float
) -> np.ndarray:
    """``points`` after a turn of ``step`` rad (Rodrigues) and its advance, or a slide of step * size."""
    if motion.kind == "slide" or motion.point is None:
        return points + step * size * motion.direction
    arm, axis = points - motion.point, motion.direction
    # A far axis would carry the object out of the picture: bound the arc by the same step * size.
    angle = step * size / max(size, float(np.linalg.norm(motion.point - centre_of_mass)))
    turned = (
        arm * np.cos(angle)
        + np.cross(axis, arm) * np.sin(angle)
        + (arm @ axis)[:, None] * axis * (1 - np.cos(angle))
    )
    bound = abs(step) * size
    advance = np.clip(motion.pitch * angle, -bound, bound)
    return motion.point + turned + advance * axis


def view_of(verdict: Verdict, points: np.ndarray) -> tuple[float, float]:
    """Elevation and azimuth in degrees from which contacts face us and ``points`` spread out."""
    normals = verdict.normal[verdict.active]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    spread = np.cov(points.T, bias=True)
    spread = spread / max(float(np.linalg.eigvalsh(spread)[-1]), 1e-300)
    best, chosen = -np.inf, (20.0, -60.0)
    for azimuth in range(-180, 180, 15):
        for elevation in (15.0, 30.0, 45.0):
            a, e = np.radians(azimuth), np.radians(elevation)
            eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
            facing = -(normals @ eye)  # 1 where the contact's outer side looks at us
            score = float(np.minimum(facing + 0.2, 0.6).mean() - eye @ spread @ eye)
            if score > best:
                best, chosen = score, (elevation, float(azimuth))
    return chosen


def _surface(axes, mesh, points, colour, alpha, zorder) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    triangles = points[np.asarray(mesh.faces)]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    shade = 0.55 + 0.45 * np.clip(normals @ LIGHT, 0, 1)
    colours = np.concatenate([shade[:, None] * np.asarray(colour), np.full((len(shade), 1), alpha)], axis=1)
    axes.add_collection3d(Poly3DCollection(triangles, facecolors=colours, linewidths=0, zorder=zorder))


def _arrow(axes, start, along, colour, width=2.0) -> None:
    axes.quiver(*start, *along, color=colour, linewidth=width, arrow_length_ratio=0.25, zorder=30)


def _cone(axes, point, normal, friction, length) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    helper = np.eye(3)[np.argmin(np.abs(normal))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    turn = np.linspace(0, 2 * np.pi, 25)[:, None]
    # Drawn outside the body, where the finger is: the forces that this finger may press with.
    rim = point - length * (normal + friction * (np.cos(turn) * first + np.sin(turn) * second))

    sides = [[point, rim[j], rim[j + 1]] for j in range(len(turn) - 1)]
    axes.add_collection3d(Poly3DCollection(sides, facecolors=CONTACT, alpha=0.25, linewidths=0, zorder=20))


def draw(verdict: Verdict, path: Path, mesh: trimesh.Trimesh | None = None) -> None:
    """A picture: object, contacts, friction cones, forces; and the object moved along its escape.

    It is written whole or not at all; the suffix of ``path`` (png, svg, pdf) is the format.
    """
    if verdict.status is Status.INVALID:
        raise UserError("an invalid grasp has no picture; jaxgrasp explain says what is wrong with it")
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError("pictures need matplotlib: pip install 'jaxgrasp[viz]'") from error
    figure = Figure(figsize=(7, 6.4), dpi=150)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 0.9), projection="3d", computed_zorder=False)
    motion = None if verdict.twist is None else screw(verdict.twist, verdict.centre_of_mass, verdict.size)
    shown = np.concatenate(_draw_scene(axes, verdict, motion, mesh))
    _frame(axes, shown)
    axes.view_init(*view_of(verdict, shown))
    kind = "" if motion is None else f": it escapes by a {motion.kind}"
    figure.suptitle(f"{status_words(verdict.status)}{kind}, margin {verdict.margin:.3f}", y=0.96)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        with matplotlib.rc_context({"svg.hashsalt": "jaxgrasp"}):
            figure.savefig(beside, facecolor="white", metadata=_undated(path))
        os.replace(beside, path)
    except (OSError, ValueError) as error:
        reason = (getattr(error, "strerror", None) or str(error)).splitlines()[0]
        raise UserError(f"{path} cannot be written as a picture: {reason}") from error
    finally:
        beside.unlink(missing_ok=True)


def _draw_scene(
    axes, verdict: Verdict, motion: Screw | None, mesh: trimesh.Trimesh | None
) -> list[np.ndarray]:
    """All there is to see; returns points that the picture must show."""
    size, com = verdict.size, verdict.centre_of_mass
    shown = [verdict.position[verdict.active]]
    if mesh is not None:
        size = max(size, 0.4 * float(np.max(mesh.extents)))
        mesh = _simpler(mesh)
        points = np.asarray(mesh.vertices)
        shown.append(points)
        _surface(axes, mesh, points, BODY, 0.45, 5)
        if motion is not None:
            ghost = moved(points, motion, com, size, 0.3)
            _surface(axes, mesh, ghost, (0.93, 0.68, 0.29), 0.18, 4)
            shown.append(ghost)
    length = 0.28 * size
    for i in np.flatnonzero(verdict.active):
        n = verdict.normal[i] / np.linalg.norm(verdict.normal[i])
        point = verdict.position[i]
        _cone(axes, point, n, min(verdict.friction[i], 3.0), length)
        axes.scatter(*point, color=CONTACT, s=28, depthshade=False, zorder=25)
        if verdict.force is not None and motion is None:
            force = _world_force(verdict, i, n)
            _arrow(axes, point - 1.3 * length * force, 1.3 * length * force, FORCE)
        shown.append((point - 1.3 * length * n)[None])
    axes.scatter(*com, color="black", marker="+", s=60, depthshade=False, zorder=25)
    if motion is not None:
        shown.append(_draw_motion(axes, motion, com, size))
    return shown


def _frame(axes, points: np.ndarray) -> None:
    """Equal scales on all axes, no room wasted around ``points``, and no axes drawn."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.02 * float((high - low).max())
    low, high = low - margin, high + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    sides = (high - low) / np.linalg.norm(high - low)
    axes.set_box_aspect(high - low, zoom=0.95 / np.sqrt(sides.max()))
    axes.set_axis_off()


def _undated(path: Path) -> dict[str, None] | None:
    """Without the time of day, the same grasp gives the same file."""
    return {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix.lower())


def _world_force(verdict: Verdict, i, n: np.ndarray) -> np.ndarray:
    """Contact i's force in mesh axes, N, in the frame convention of ``geometry.contact_frame``."""
    assert verdict.force is not None
    if verdict.force.shape[1] == 1:
        return verdict.force[i, 0] * n
    first, second = (np.asarray(t, float) for t in contact_frame(jnp.asarray(n)))
    f_x, f_y, f_n = verdict.force[i, :3]
    return f_x * first + f_y * second + f_n * n


def _draw_motion(axes, motion: Screw, com: np.ndarray, size: float) -> np.ndarray:
    """The axis, or the direction of a slide; returns points that the picture must show."""
    reach = 1.2 * size
    if motion.kind == "slide" or motion.point is None:
        _arrow(axes, com, reach * motion.direction, ESCAPE, 3.5)
        return (com + reach * motion.direction)[None]
    ends = motion.point + reach * np.array([[-1.0], [1.0]]) * motion.direction
    axes.plot(*ends.T, color=ESCAPE, linewidth=2, linestyle="--", zorder=28)
    _arrow(axes, motion.point + 0.8 * reach * motion.direction, 0.4 * reach * motion.direction, ESCAPE, 3)
    # An arc about the axis, on the far side of which the object turns.
    helper = np.eye(3)[np.argmin(np.abs(motion.direction))]
    first = np.cross(motion.direction, helper)
    first /= np.linalg.norm(first)
    second = np.cross(motion.direction, first)
    turn = np.linspace(0, 1.5 * np.pi, 60)[:, None]
    arc = (
        motion.point
        + 0.8 * reach * motion.direction
        + 0.25 * size * (np.cos(turn) * first + np.sin(turn) * second)
    )
    axes.plot(*arc.T, color=ESCAPE, linewidth=2.5, zorder=29)
    _arrow(axes, arc[-2], 4 * (arc[-1] - arc[-2]), ESCAPE, 2.5)
    return np.concatenate([ends, arc])


def _simpler(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with vertices gathered on a grid until matplotlib can draw it."""
    import trimesh

    cells = 64
    while len(mesh.faces) > MOST_FACES and cells >= 8:
        step = float(np.max(mesh.extents)) / cells
        where = np.round(np.asarray(mesh.vertices) / step).astype(np.int64)
        _, first, inverse = np.unique(where, axis=0, return_index=True, return_inverse=True)
        faces = inverse.reshape(-1)[np.asarray(mesh.faces)]
        faces = faces[
            (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        ]
        mesh = trimesh.Trimesh(np.asarray(mesh.vertices)[first], faces, process=False)
        cells = cells * 3 // 4
    return mesh
