# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # With which forces?
#
# A grasp that holds an object can do so with many different forces: fingers may always squeeze harder. This notebook
# asks for the best ones, by five meanings of *best*, and for proof that there are none better. The notebook
# [05_force_limits_and_gradients](05_force_limits_and_gradients.ipynb) goes on with weak motors and with derivatives.
# Lengths are in m, forces in N, torques in N m. Most pictures are planar, because a planar friction cone can be drawn
# on paper; the calls are the same in space.
#
# The object: an ellipse, 10 cm wide and 7 cm high, that weighs 10 N. A contact is an angle on it.

# %%
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import Image, display

import jaxgrasp as jg
from jaxgrasp.objects import SurfaceSampler, make_object
from jaxgrasp.report import planar_plots, plots

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32
jax.config.update("jax_disable_most_optimizations", True)  # compiles faster, runs slower

AXES, WEIGHT, MU = np.array([0.05, 0.035]), 10.0, 0.5
lift = np.array([0.0, -WEIGHT, 0.0])  # the load: force, and torque about the centre of mass
Status = jg.Status


def on_ellipse(degrees, friction=MU, active=None):
    """Hard fingers on the ellipse; angles (*batch, k)."""
    angle = jnp.deg2rad(jnp.asarray(degrees, float))
    ring = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return jg.Grasp(AXES * ring, -ring / AXES, jg.HardFinger(friction), active)


def forces(grasp, load, criterion):
    """The answer, proved again: NumPy rebuilds the grasp map, balances the forces, and derives the bound again."""
    answer = jg.optimize_forces(grasp, load, criterion=criterion)
    assert jg.check(grasp, answer, wrench=load, criterion=criterion).all()
    return answer


# %% [markdown]
# ## 1. Five meanings of best
#
# $\min_f h(f)$ subject to $G f + w = 0$ and $f_i \in C_i$, with the load $w$ and one of five costs $h$: `Gentlest`
# $\max_i f_{n,i}$; `Robust(weight)` $\max_i f_{n,i} - \mathrm{weight} \sum_i \log\det P_i(f_i)$; `SmallestSum`
# $\sum_i f_{n,i}$; `SumOfSquares` $\sum_i f_{n,i}^2$; `LeastNorm` $\sum_i \lVert f_i \rVert^2$. No admissible forces
# cost less than `lower`; the forces given cost `upper`. Each criterion is the best by its own measure, and by no
# other.

# %%
five = [jg.Gentlest(), jg.Robust(weight=0.5), jg.SmallestSum(), jg.SumOfSquares(), jg.LeastNorm()]
grasp = on_ellipse([160.0, 300.0, 340.0])
best = {type(criterion).__name__: forces(grasp, lift, criterion) for criterion in five}
for name, out in best.items():
    print(f"{name:13s} {out.values()}  normal forces {np.asarray(out.force).reshape(3, 2)[:, 1].round(3)} N")
    assert out.status == Status.OPTIMAL and out.gap < 1e-7 * max(1, out.cost)
table = np.array([[criterion.cost(grasp, out.force) for criterion in five] for out in best.values()])
print("rows: forces; columns: costs\n", table.round(4))
assert (table.argmin(axis=0) == np.arange(5)).all()
panels = {name: {"grasp": grasp, "force": out.force, "load": lift} for name, out in best.items()}
figure = planar_plots.planar_grasps(AXES, panels)
figure = planar_plots.forces_in_cones(best, MU)

# %% [markdown]
# On the edge of its cone a contact is about to slip. Only `Robust` keeps away from it, and pays with a firmer grip.
#
# ## 2. How hard must a pinch squeeze?
#
# Two opposing fingers lift the ellipse by friction alone (Figure 11.1 of the chapter, turned to lift). Each carries
# half the weight along its tangent, which needs a normal force of $W / (2\mu)$. `squeeze` adds a multiple $s$ of an
# internal force until all forces are inside their cones. The third contact is padding, `active = False`: grasps with
# different numbers of fingers fit in one batch, and nothing has to be compiled again.

# %%
pinch = on_ellipse([180.0, 0.0, 90.0], active=np.array([True, True, False]))
pressed = jg.squeeze(pinch, lift)
print(f"s_min = {float(pressed.effort):.6f} N; W / (2 mu) = {WEIGHT / (2 * MU)} N")
assert np.isclose(pressed.effort, WEIGHT / (2 * MU))
mu = np.linspace(0.1, 1.5, 57)
pinches = on_ellipse(np.broadcast_to([180.0, 0.0, 90.0], (57, 3)), mu[:, None], pinch.active)
gentlest = forces(pinches, lift, jg.Gentlest())
assert np.allclose(gentlest.cost, WEIGHT / (2 * mu), rtol=1e-7)
figure = planar_plots.pinch(AXES, pinch, pressed, lift, mu, gentlest.cost)

# %% [markdown]
# ## 3. A load that no force balances
#
# Three fingers under the ellipse hold its weight; they cannot hold it down. We turn a load of 10 N through all
# directions: beyond some angle there is an *escape twist*, a motion that the load drives and no finger force opposes.

# %%
cradle = on_ellipse([215.0, 270.0, 325.0])
direction = np.arange(0, 360, 2)  # degrees
loads = WEIGHT * np.stack([f(np.radians(direction)) for f in (np.cos, np.sin, np.zeros_like)], axis=-1)
around = forces(cradle, loads, jg.Gentlest())
assert np.isin(around.status, (Status.OPTIMAL, Status.INFEASIBLE)).all()
down, sideways = (int(np.flatnonzero(direction == angle)[0]) for angle in (270, 350))
twist = np.asarray(around.escape_twist[sideways])
slack = np.asarray(cradle.model.dual_slack((np.asarray(jg.grasp_map(cradle)).T @ twist).reshape(3, 2), 2))
print(around.sentence(sideways), twist.round(4), "power of the load:", float(twist @ loads[sideways]), "W")
print("least power the forces of each contact can have along it, per N of f_n:", slack.round(12) + 0.0, "W")
assert twist @ loads[sideways] > 0 and (slack > -1e-9).all()
held = {"grasp": cradle, "force": around.force[down], "load": loads[down]}
lost = {"grasp": cradle, "load": loads[sideways], "twist": twist}
figure = planar_plots.planar_grasps(AXES, {f"held with {around.cost[down]:.2f} N": held, "it escapes": lost})
figure = planar_plots.loads_around(direction, around)

# %% [markdown]
# ## 4. Friction is a guess
#
# Forces on the edge of a cone rely on every bit of friction. We optimise for $\mu = 0.5$, then let each contact's
# true coefficient vary: normal, standard deviation 0.1. In what share of 20 000 draws do all forces remain inside
# their true cones? `Robust` buys distance from the edge with normal force; its weight is the price it is ready to
# pay, in N.

# %%
weights = np.geomspace(0.01, 10, 25)
robust = forces(on_ellipse(np.broadcast_to([160.0, 300.0, 340.0], (25, 3))), lift, jg.Robust(weight=weights))
assert (np.asarray(robust.status) == Status.OPTIMAL).all()
true_mu = np.random.default_rng(0).normal(MU, 0.1, size=(20_000, 3)).clip(min=0)


def share_held(force):
    f_t, f_n = np.moveaxis(np.asarray(force).reshape(-1, 1, 3, 2), -1, 0)
    return (np.abs(f_t) <= true_mu * f_n).all(axis=-1).mean(axis=-1)


by_robust, by_gentlest = share_held(robust.force), float(share_held(best["Gentlest"].force)[0])
price = np.asarray(jg.Gentlest().cost(grasp, robust.force)) / float(best["Gentlest"].cost)
assert (np.diff(price) > 0).all() and price[0] < 1.02
assert by_robust.max() > 0.9 > by_robust[0] > by_gentlest
figure = planar_plots.price_of_robustness(weights, by_robust, price, by_gentlest)

# %% [markdown]
# Beyond a weight of some 3 N nothing is gained: the fingers squeeze harder and harder along one internal force, and
# every force keeps its direction.
#
# ## 5. The proof
#
# `jg.check` takes nothing on trust: it proves the problem that we state with the numbers of the answer. Every answer
# above was accepted. A forged one is not.

# %%
honest = best["Gentlest"]
forgeries = {
    "forces 1 % smaller": {"force": 0.99 * honest.force, "upper": 0.99 * honest.upper},
    "forces 1 % larger": {"force": 1.01 * honest.force, "upper": 1.01 * honest.upper},
    "a smaller cost": {"upper": 0.99 * honest.upper},
    "a larger bound": {"lower": 1.01 * honest.lower, "upper": 1.01 * honest.upper},
    "called infeasible": {"status": jnp.int32(Status.INFEASIBLE)},
    "forces of Robust": {"force": best["Robust"].force, "upper": table[1, 0]},
}
for name, changes in forgeries.items():
    forged = dataclasses.replace(honest, **changes)
    accepted = bool(jg.check(grasp, forged, wrench=lift, criterion=jg.Gentlest()))
    print(f"{name:19s} {'ACCEPTED' if accepted else 'rejected'}")
    assert not accepted

# %% [markdown]
# ## 6. In space
#
# Three fingers hold the built-in mug (row 282 of `jaxgrasp screen mug --fingers 3`), which weighs 3 N. Its $z$ axis
# is up.

# %%
mug = make_object("mug")
position, inward = (x[282] for x in SurfaceSampler(mug, fingers=3, seed=0).rows(0, 300))
on_mug = jg.Grasp(position - mug.center_mass, inward, jg.HardFinger(friction=0.5))
carried = forces(on_mug, np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]), jg.Gentlest())
f = np.asarray(carried.force).reshape(3, 3)
print(carried)
for i, (f_x, f_y, f_n) in enumerate(f):
    print(f"contact {i}: f_n = {f_n:.3f} N, {100 * np.hypot(f_x, f_y) / (0.5 * f_n):5.1f} % of friction used")
drawn = plots.verdict_of(on_mug, jg.wrench_resistance(on_mug), mug.center_mass, f / f[:, 2].mean())
display(Image(plots.grasp_picture(drawn, mug), width=560))
