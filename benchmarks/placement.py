"""Contact placement on one core: what it costs, and what it finds beside random sampling and Nelder-Mead.

    python benchmarks/placement.py [--json FILE] [--starts 128] [--simplexes 8] [--objects mug bowl part.stl:mm]
                                   [--fingers 3 4 2] [--no-table]

Costs: starts and steps per second on the mug; value, gradient and quality measures per grasp; the epsilon bracket
beside Qhull's hull of 32-edge pyramids. Table: every object, three and four hard fingers (mu 0.5), two soft ones
(gamma 1 cm), the objective epsilon (L1, torques over the object's radius). Beside ``place_contacts``, per start:

    random m   the random grasp of largest margin among as many as fit in the same time
    random e   half that time for margins, half for epsilon of those with the largest margins: the largest epsilon
    simplex    SciPy's Nelder-Mead (adaptive) from the first starts, on the triangles, as many evaluations of epsilon
               as placement takes steps and trials

Contacts of all are judged alike: on the mesh's own triangles, epsilon to 1 %. Objects are built-in names, mesh files
(FILE or FILE:UNIT), and, where JAXGRASP_DATA or ../shared/data has them, twelve real meshes. One process pinned to one
core; compile time apart.
"""

from __future__ import annotations

import argparse
import os
import threading
import time
from pathlib import Path

# isort: split
from figures import write_figures
from wrench_resistance import hardware  # also pins the process and sets it to one thread

# isort: split
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from quality import pyramid, timed
from scipy.optimize import minimize

import jaxgrasp as jg
from jaxgrasp import objects, surfaces
from jaxgrasp.contacts.models import ContactModel
from jaxgrasp.placement.objectives import Epsilon, Margin, lessons
from jaxgrasp.placement.place import Placement, place_contacts
from jaxgrasp.placement.search import CANDIDATES, Search
from jaxgrasp.placement.settle import ROUNDS, TRIALS
from jaxgrasp.quality.unit_wrench_space import effort_map, torque_lengths
from jaxgrasp.surfaces.mesh import MeshSurface

REAL = (
    "ycb/005_tomato_soup_can.obj.gz", "ycb/009_gelatin_box.obj.gz", "ycb/011_banana.obj.gz",
    "ycb/012_strawberry.obj.gz", "ycb/016_pear.obj.gz", "ycb/043_phillips_screwdriver.obj.gz",
    "ycb/048_hammer.obj.gz", "ycb/061_foam_brick.obj.gz", "ycb/077_rubiks_cube.obj.gz",
    "models/bunny.ply", "models/suzanne.ply", "models/torus.STL:mm",
)  # fmt: skip


def models() -> dict[int, ContactModel]:
    """Fingers and their contact model."""
    return {3: jg.HardFinger(0.5), 4: jg.HardFinger(0.5), 2: jg.SoftFinger(0.5, 0.01)}


def real_meshes() -> list[str]:
    folder = Path(os.environ.get("JAXGRASP_DATA") or Path(__file__).parents[2] / "shared" / "data") / "meshes"
    found = [f"{folder / name}" for name in REAL if (folder / name.partition(":")[0]).exists()]
    if len(found) < len(REAL):
        print(f"{len(REAL) - len(found)} of {len(REAL)} real meshes are missing in {folder}")
    return found


def surface_of(name: str) -> MeshSurface:
    source, _, unit = name.partition(":")
    return surfaces.of(source, unit=unit or "m")


class Problem(NamedTuple):
    """One object, one hand."""

    surface: MeshSurface
    fingers: int
    model: ContactModel

    @property
    def radius(self) -> float:
        return float(self.surface.radius)

    def grasp(self, position: np.ndarray, normal: np.ndarray) -> jg.Grasp:
        return jg.Grasp(position - np.asarray(self.surface.centre), normal, self.model)

    def judged(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Margin and epsilon (upper bound) of grasps at the points of the mesh nearest to ``position``."""
        grasp = self.grasp(*self.surface.exact_contact(position))
        margin = np.asarray(jg.wrench_resistance(grasp).margin)
        return margin, np.asarray(jg.epsilon_quality(grasp, torque_scale=self.radius).upper)

    def random(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        point, normal = self.surface.sample(seed, count * self.fingers)
        return point.reshape(count, self.fingers, 3), normal.reshape(count, self.fingers, 3)


def margins(problem: Problem, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    value = np.asarray(jg.wrench_resistance(problem.grasp(position, normal)).margin)
    return np.where(np.isfinite(value), value, -np.inf)


def random_sampling(problem: Problem, starts: int, seconds: float) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Positions that ``random m`` and ``random e`` find in ``seconds`` a start; the grasps a start each looked at."""
    probe = problem.random(1, 8192)
    margins(problem, *probe)  # compiles
    begin = time.perf_counter()
    value = margins(problem, *problem.random(2, 8192))
    each = (time.perf_counter() - begin) / 8192
    best = np.argsort(-margins(problem, *probe))[:128]
    scale = problem.radius
    sharp = problem.grasp(probe[0][best], probe[1][best])
    jg.epsilon_quality(sharp, torque_scale=scale, tolerance=0.1)
    begin = time.perf_counter()
    jax.block_until_ready(jg.epsilon_quality(sharp, torque_scale=scale, tolerance=0.1).upper)
    costly = (time.perf_counter() - begin) / 128

    by_margin, by_epsilon = [], []
    many, few = max(1, int(seconds / each)), max(1, int(seconds / 2 / costly))
    for i in range(starts):
        position, normal = problem.random(1000 + i, many)
        value = margins(problem, position, normal)
        by_margin.append(position[value.argmax()])
        top = np.argsort(-value[: many // 2])[:few]
        quality = jg.epsilon_quality(
            problem.grasp(position[top], normal[top]), torque_scale=scale, tolerance=0.1
        )
        epsilon = np.asarray(quality.upper)
        by_epsilon.append(position[top[np.where(np.isfinite(epsilon), epsilon, 0).argmax()]])
    return np.array(by_margin), np.array(by_epsilon), many, few


def simplex(problem: Problem, origin: np.ndarray, evaluations: int) -> np.ndarray:
    """Where Nelder-Mead ends from each of ``origin``; coordinates in units of the radius, first moves of 5 % of it.

    All simplexes wait for each other at every evaluation: a batch costs little more than one grasp.
    """
    radius, shape, count = problem.radius, origin.shape[1:], len(origin)
    epsilon = Epsilon("L1", radius)
    asked, answers = np.array(origin), np.zeros(count)

    def answer() -> None:
        grasp = problem.grasp(*problem.surface.exact_contact(asked))
        values = np.asarray(epsilon.value(grasp, lessons(epsilon, grasp)))  # within 0.1 % for nine in ten
        answers[:] = np.where(np.isfinite(values), -values, 10.0)

    together = threading.Barrier(count, answer)

    def run(i: int) -> np.ndarray:
        def cost(x: np.ndarray) -> float:
            asked[i] = radius * x.reshape(shape)
            together.wait()
            return float(answers[i])

        x = origin[i].ravel() / radius
        options = {"maxfev": evaluations, "adaptive": True, "xatol": 0, "fatol": 0}
        options["initial_simplex"] = np.concatenate([x[None], x + 0.05 * np.eye(x.size)])
        found = minimize(cost, x, method="Nelder-Mead", options=options)
        for _ in range(found.nfev, evaluations):  # one that shrank to nothing lets the others go on
            together.wait()
        return radius * found.x.reshape(shape)

    with ThreadPoolExecutor(count) as pool:
        return np.array(list(pool.map(run, range(count))))


def row(name: str, problem: Problem, starts: int, simplexes: int) -> dict[str, Any]:
    objective = Epsilon("L1", problem.radius)

    def place() -> Placement:
        return place_contacts(
            problem.surface,
            fingers=problem.fingers,
            model=problem.model,
            objective=objective,
            search=Search(starts, seed=1),
        )

    place()  # compiles
    begin = time.perf_counter()
    out = place()
    seconds = (time.perf_counter() - begin) / starts
    steps = round(float(out.steps.mean()))
    by_margin, by_epsilon, many, few = random_sampling(problem, starts, seconds)
    ends = {
        "random": problem.random(3, starts)[0], "start": out.origin, "placed": out.end,
        "random m": by_margin, "random e": by_epsilon,
        "simplex": simplex(problem, out.origin[:simplexes], steps + ROUNDS * TRIALS),
    }  # fmt: skip
    figures: dict[str, Any] = {
        "object": Path(name.partition(":")[0]).name.partition(".")[0],
        "fingers": problem.fingers,
        "milliseconds": 1e3 * seconds,
        "steps": steps,
        "random grasps by margin": many,
        "random grasps by epsilon": few,
        "certified resistant": float(out.resistant.mean()),
    }
    for key, position in ends.items():
        margin, epsilon = problem.judged(position)
        figures[key] = {
            "resistant": float(np.mean(margin > 0)),
            "margin": float(np.median(margin)),
            "epsilon": float(np.median(epsilon)),
            "best epsilon": float(epsilon.max()),
        }
    return figures


def table(options: argparse.Namespace) -> list[dict[str, Any]]:
    names = options.objects or [*real_meshes(), *objects.OBJECTS]
    keys = ("random", "start", "placed", "random m", "random e", "simplex")
    print("\nshare resistant; median margin; median epsilon of " + ", ".join(keys))
    rows = []
    for name in names:
        surface = surface_of(name)
        for fingers in options.fingers:
            problem = Problem(surface, fingers, models()[fingers])
            rows.append(row(name, problem, options.starts, options.simplexes))
            r = rows[-1]
            parts = [" ".join(f"{r[k][what]:.3f}" for k in keys) for what in ("resistant", "margin")]
            epsilons = " ".join(f"{r[k]['epsilon']:.4f}" for k in keys)
            print(
                f"  {r['object']:24s} k {fingers}  {r['milliseconds']:.1f} ms {r['steps']} steps, certified "
                f"{r['certified resistant']:.3f} | {parts[0]} | {parts[1]} | {epsilons}",
                flush=True,
            )
    for fingers in options.fingers:
        of = [r for r in rows if r["fingers"] == fingers]
        for rival in ("random m", "random e", "simplex"):
            ratio = [r["placed"]["epsilon"] / max(r[rival]["epsilon"], 1e-9) for r in of]
            print(
                f"k {fingers}: median epsilon above {rival} on {sum(x > 1 for x in ratio)} of {len(of)} objects, more "
                f"than 1 % below on {sum(x < 0.99 for x in ratio)}; median ratio {np.median(ratio):.2f}"
            )
        share = [r["certified resistant"] for r in of]
        print(f"k {fingers}: certified resistant {min(share):.3f} of the starts or more")
    return rows


def costs() -> list[dict[str, Any]]:
    surface = surfaces.of("mug")
    rows: list[dict[str, Any]] = []
    for fingers, model in models().items():
        problem = Problem(surface, fingers, model)
        for objective in (Margin(), Epsilon("L1", problem.radius), Epsilon("Linf", problem.radius)):
            first = time.perf_counter()
            place_contacts(surface, fingers=fingers, model=model, objective=objective, search=Search(64))
            first = time.perf_counter() - first
            begin = time.perf_counter()
            out = place_contacts(
                surface, fingers=fingers, model=model, objective=objective, search=Search(256)
            )
            seconds = time.perf_counter() - begin
            name = f"{type(objective).__name__} {getattr(objective, 'norm', '')}".strip()
            rows.append({
                "what": f"place, {name}", "fingers": fingers, "milliseconds a start": 1e3 * seconds / 256,
                "starts x steps a second": float(out.steps.sum()) / seconds,
                "random grasps a start": CANDIDATES, "steps a start": float(out.steps.mean()),
                "compile seconds": first - seconds / 4,
            })  # fmt: skip
        position, normal = problem.random(0, 4096)
        grasp = problem.grasp(position, normal)
        order = np.argsort(-margins(problem, position, normal))
        sharp = grasp[order[:256]]

        def slope(grasp: jg.Grasp) -> Any:
            return jax.grad(
                lambda p: jnp.sum(jg.wrench_resistance(jg.Grasp(p, grasp.normal, grasp.model)).margin)
            )(grasp.position)

        scale = problem.radius
        calls: dict[str, tuple[jg.Grasp, Callable[[jg.Grasp], Any]]] = {
            "margin": (grasp, lambda g: jg.wrench_resistance(g).margin),
            "margin and gradient": (grasp, jax.jit(slope)),
            "epsilon L1": (sharp, lambda g, scale=scale: jg.epsilon_quality(g, torque_scale=scale).upper),
            "epsilon Linf": (
                sharp,
                lambda g, scale=scale: jg.epsilon_quality(g, norm="Linf", torque_scale=scale).upper,
            ),
            "critical friction": (sharp, lambda g: jg.critical_friction(g).factor),
            "guaranteed radius": (sharp, lambda g: jg.guaranteed_radius(g).radius),
        }
        for name, (given, call) in calls.items():
            _, compiling, seconds = timed(lambda given=given, call=call: call(given))
            each = 1e6 * seconds / given.batch_shape[0]
            rows.append({"what": name, "fingers": fingers, "us a grasp": each, "compile seconds": compiling})
        if fingers > 2:
            A = np.asarray(effort_map(sharp, torque_lengths(sharp, problem.radius)))[:20]
            begin = time.perf_counter()
            for a in A:
                pyramid(a, 32, False)
            each = 1e6 * (time.perf_counter() - begin) / len(A)
            rows.append({"what": "Qhull, 32 edges, one bound", "fingers": fingers, "us a grasp": each})
    print("\nthe mug")
    for r in rows:
        figures = [f"{key} {value:,.4g}" for key, value in r.items() if key not in ("what", "fingers")]
        print(f"  k {r['fingers']} {r['what']:26s} " + ", ".join(figures), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--starts", type=int, default=128)
    parser.add_argument("--simplexes", type=int, default=8, help="starts that Nelder-Mead has")
    parser.add_argument("--objects", nargs="+", help="built-in names and mesh files, FILE or FILE:UNIT")
    parser.add_argument("--fingers", type=int, nargs="+", default=[3, 4, 2], choices=[2, 3, 4])
    parser.add_argument("--no-table", action="store_true", help="costs alone")
    parser.add_argument("--no-costs", action="store_true", help="the table alone")
    options = parser.parse_args()
    machine = hardware()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    paid = [] if options.no_costs else costs()
    found = [] if options.no_table else table(options)
    write_figures(options, machine, costs=paid, table=found)


if __name__ == "__main__":
    main()
