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
# A grasp that holds an object can do so with many different forces: fingers may always squeeze harder.
# This notebook asks for the best ones, by five meanings of *best*, and for proof that there are none better.
# It ends with a grasp that improves itself.
#
# Lengths are in m, forces in N, torques in N m. Most pictures are planar, because a planar friction cone can
# be drawn on paper. The calls are the same in space.

# %%
import dataclasses
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from IPython.display import Image, display

import jaxgrasp as jg
from jaxgrasp.objects.builtin import make_object
from jaxgrasp.objects.sampling import SurfaceSampler
from jaxgrasp.report import Verdict, draw

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32
jax.config.update(
    "jax_disable_most_optimizations", True
)  # compiles faster, runs slower: right for a notebook
plt.rcParams.update({"figure.dpi": 110, "axes.grid": True, "grid.alpha": 0.3, "font.size": 9})
BLUE, RED, GREY, YELLOW = "#00798c", "#d1495b", "0.45", "#edae49"

# %% [markdown]
# The object: an ellipse, 10 cm wide and 7 cm high, that weighs 10 N. A contact is an angle on it.

# %%
AXES = np.array([0.05, 0.035])
WEIGHT = 10.0
lift = np.array([0.0, -WEIGHT, 0.0])  # the load: force, and torque about the centre of mass
MU = 0.5


def on_ellipse(degrees, friction=MU, active=None):
    """Hard fingers on the ellipse; angles (*batch, k)."""
    angle = jnp.deg2rad(jnp.asarray(degrees, float))
    ring = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return jg.Grasp(AXES * ring, -ring / AXES, jg.HardFinger(friction), active)


def normals(grasp):
    n = np.asarray(grasp.normal)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def in_plane(grasp, force):
    """The forces (k, 2) in the plane's axes: f_t t + f_n n, with t = (n_y, -n_x)."""
    n, f = normals(grasp), np.asarray(force).reshape(-1, 2)
    return f[:, :1] * np.stack([n[:, 1], -n[:, 0]], axis=-1) + f[:, 1:] * n


def show(axes, grasp, force=None, load=None, newton=0.005, twist=None, colour=BLUE):
    """Object, friction cones (outside, where the fingers are), forces; ``newton`` is the length of 1 N in m."""
    around = np.linspace(0, 2 * np.pi, 100)
    ring = AXES * np.stack([np.cos(around), np.sin(around)], axis=-1)
    axes.fill(*ring.T, color="0.85", edgecolor=GREY, linewidth=1)
    if twist is not None:
        step = 0.25 * AXES[0] / np.hypot(np.linalg.norm(twist[:2]), AXES[0] * twist[2])
        c, s = np.cos(step * twist[2]), np.sin(step * twist[2])
        moved = ring @ np.array([[c, s], [-s, c]]) + step * twist[:2]
        axes.fill(*moved.T, facecolor="none", edgecolor=YELLOW, linewidth=2)
    live, n = np.asarray(grasp.active), normals(grasp)
    t = np.stack([n[:, 1], -n[:, 0]], axis=-1)
    mu = np.asarray(grasp.model.friction_coefficient)
    for i in np.flatnonzero(live):
        p = np.asarray(grasp.position)[i]
        axes.fill(*np.stack([p, p - 0.035 * (n[i] + mu[i] * t[i]), p - 0.035 * (n[i] - mu[i] * t[i])]).T,
                  color=RED, alpha=0.2, linewidth=0)  # fmt: skip
        axes.plot(*p, "o", color=RED, markersize=4)
        if force is not None:
            f = newton * in_plane(grasp, force)[i]
            axes.annotate("", p, p - f, arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2})
    if load is not None:
        end = newton * np.asarray(load)[:2]
        axes.annotate("", end, (0, 0), arrowprops={"arrowstyle": "-|>", "color": "k", "linewidth": 1.5})
    axes.set(aspect="equal", xlim=(-0.09, 0.09), ylim=(-0.085, 0.06), xticks=[], yticks=[])
    axes.grid(False)


# %% [markdown]
# ## 1. Five meanings of best
#
# Three fingers lift the ellipse. `optimize_forces` solves
#
# $$\min_f h(f) \quad\text{subject to}\quad G f + w = 0,\quad f_i \in C_i$$
#
# with the load $w$ and one of five costs $h$:
#
# | criterion | cost $h(f)$ | unit |
# |---|---|---|
# | `Gentlest()` | $\max_i f_{n,i}$ | N |
# | `Robust(weight)` | $\max_i f_{n,i} - \mathrm{weight} \sum_i \log\det P_i(f_i)$ | N |
# | `SmallestSum()` | $\sum_i f_{n,i}$ | N |
# | `SumOfSquares()` | $\sum_i f_{n,i}^2$ | N² |
# | `LeastNorm()` | $\sum_i \lVert f_i \rVert^2$ | N² |
#
# Every answer has a cost and a *bound*: no admissible forces cost less than the bound. The gap between the two
# is all that is left to doubt.

# %%
criteria = {
    "Gentlest": jg.Gentlest(),
    "Robust": jg.Robust(weight=0.5),
    "SmallestSum": jg.SmallestSum(),
    "SumOfSquares": jg.SumOfSquares(),
    "LeastNorm": jg.LeastNorm(),
}
grasp = on_ellipse([160.0, 300.0, 340.0])
best = {name: jg.optimize_forces(grasp, lift, criterion=criterion) for name, criterion in criteria.items()}

print("criterion      status    cost       bound      gap        normal forces (N)")
for name, out in best.items():
    f_n = np.asarray(out.force).reshape(3, 2)[:, 1]
    status = jg.Status(int(out.status)).name
    print(f"{name:13s}  {status}  {out.cost:9.5f}  {out.bound:9.5f}  {out.gap:.1e}   {f_n.round(3)}")
    assert out.status == jg.Status.OPTIMAL and out.gap < 1e-7 * max(1, out.cost)

# %% [markdown]
# Each criterion is the best by its own measure, and by no other:

# %%
table = np.array(
    [[criterion.cost(grasp, out.force) for criterion in criteria.values()] for out in best.values()]
)
print("forces of \\ cost   " + "  ".join(f"{name:>12s}" for name in criteria))
for name, row in zip(best, table, strict=True):
    print(f"{name:17s}  " + "  ".join(f"{cost:12.4f}" for cost in row))
assert (table.argmin(axis=0) == np.arange(5)).all()

# %%
fig, panels = plt.subplots(1, 5, figsize=(13, 2.9), layout="constrained")
for axes, (name, out) in zip(panels, best.items(), strict=True):
    show(axes, grasp, out.force, lift)
    axes.set_title(f"{name}\n$\\max f_n$ = {criteria['Gentlest'].cost(grasp, out.force):.2f} N")
plt.show()

# %% [markdown]
# The same forces inside their friction cones. On the edge a contact is about to slip. Only `Robust` keeps
# away from it, and pays with a firmer grip.

# %%
fig, panels = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained", sharey=True)
marks = {"Gentlest": ("o", BLUE), "Robust": ("D", RED), "SmallestSum": ("s", GREY)}
marks |= {"SumOfSquares": ("^", YELLOW), "LeastNorm": ("v", "k")}
reach = 1.15 * max(float(np.abs(out.force).max()) for out in best.values())
for i, axes in enumerate(panels):
    axes.fill([0, -MU * reach, MU * reach], [0, reach, reach], color=RED, alpha=0.12, linewidth=0)
    for name, (mark, colour) in marks.items():
        f_t, f_n = np.asarray(best[name].force).reshape(3, 2)[i]
        axes.plot([0, f_t], [0, f_n], color=colour, linewidth=0.8)
        axes.plot(f_t, f_n, mark, color=colour, label=name, markersize=6)
    axes.set(xlabel="$f_t$ (N)", title=f"contact {i}", ylim=(0, reach), aspect="equal")
panels[0].set_ylabel("$f_n$ (N)")
panels[2].legend(loc="center left", bbox_to_anchor=(1, 0.5))
plt.show()

# %% [markdown]
# ## 2. How hard must a pinch squeeze?
#
# Two opposing fingers lift the ellipse by friction alone (Figure 11.1 of the chapter, turned to lift). Each
# carries half the weight along its tangent, which no cone allows without a normal force of $W / (2\mu)$.
# `squeeze` adds a multiple $s$ of an internal force until all forces are inside their cones.
#
# The third contact is padding, `active = False`: so that grasps with different numbers of fingers fit in one
# batch, and here so that nothing has to be compiled again.

# %%
pinch = on_ellipse([180.0, 0.0, 90.0], active=np.array([True, True, False]))
pressed = jg.squeeze(pinch, lift)
print("f_p  ", np.asarray(pressed.particular).round(6) + 0.0)
print("f_int", np.asarray(pressed.internal).round(6) + 0.0)
print(f"s_min = {float(pressed.effort):.6f} N; W / (2 mu) = {WEIGHT / (2 * MU)} N")
assert np.isclose(pressed.effort, WEIGHT / (2 * MU))

mu = np.linspace(0.1, 1.5, 57)
many = on_ellipse(np.broadcast_to([180.0, 0.0, 90.0], (57, 3)), mu[:, None], pinch.active)
gentlest = jg.optimize_forces(many, lift, criterion=jg.Gentlest())
closed_form = WEIGHT / (2 * mu)
print("largest relative difference from W / (2 mu):", float(np.abs(gentlest.cost / closed_form - 1).max()))
assert np.allclose(gentlest.cost, closed_form, rtol=1e-7)

fig, panels = plt.subplots(1, 3, figsize=(11, 3.1), layout="constrained")
for axes, part, title in zip(
    panels[:2], (0.0, 1.0), ("$f_p$ alone: nobody can do that", "$f_p + s_{min} f_{int}$"), strict=True
):
    show(
        axes,
        pinch,
        pressed.particular + part * pressed.effort * pressed.internal,
        lift,
        colour=[RED, BLUE][int(part)],
    )
    axes.set_title(title)
panels[2].plot(mu, gentlest.cost, color=BLUE, label="optimize_forces")
panels[2].plot(mu[::4], closed_form[::4], "o", color=RED, markersize=4, label="$W / (2 \\mu)$")
panels[2].set(xlabel="friction coefficient $\\mu$", ylabel="normal force of each finger (N)", ylim=(0, None))
panels[2].legend()
plt.show()

# %% [markdown]
# ## 3. A load that no force balances
#
# Three fingers under the ellipse cradle it. They hold its weight; they cannot hold it down. We turn a load of
# 10 N through all directions: up to some angle there are forces, beyond it there is an *escape twist*, a
# motion that the load drives and no finger force opposes. It proves that there are no forces.

# %%
cradle = on_ellipse([215.0, 270.0, 325.0])
direction = np.arange(0, 360, 2)  # degrees
loads = WEIGHT * np.stack(
    [np.cos(np.radians(direction)), np.sin(np.radians(direction)), 0 * direction], axis=-1
)
around = jg.optimize_forces(cradle, loads, criterion=jg.Gentlest())
held = np.asarray(around.status) == jg.Status.OPTIMAL
lost = np.asarray(around.status) == jg.Status.INFEASIBLE
assert (held ^ lost).all()

sideways = int(np.flatnonzero(direction == 350)[0])
twist = np.asarray(around.escape_twist[sideways])
speeds = np.asarray(jg.grasp_map(cradle)).T @ twist
slack = np.asarray(cradle.model.dual_slack(speeds.reshape(3, 2), 2))
print(jg.Status(int(around.status[sideways])).sentence)
print("escape twist (v_x, v_y; omega):", twist.round(4))
if abs(twist[2]) * AXES[0] > 1e-6:
    pivot = np.array([-twist[1], twist[0]]) / twist[2]
    print(f"a {'left' if twist[2] > 0 else 'right'} turn about the point {pivot.round(3)} m")
print(f"the load's power along it: {twist @ loads[sideways]:.4f} W")
print("least power the forces of each contact can have along it, per N of f_n:", slack.round(12) + 0.0, "W")
assert twist @ loads[sideways] > 0 and (slack > -1e-9).all()

# %%
fig, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
down = int(np.flatnonzero(direction == 270)[0])
show(left, cradle, around.force[down], loads[down])
left.set_title(f"down: held with {around.cost[down]:.2f} N")
show(middle, cradle, None, loads[sideways], twist=twist)
middle.set_title("10 degrees below sideways: it escapes")
right.plot(direction[held], np.asarray(around.cost)[held], color=BLUE)
for first, last in ((180, direction[held].min()), (direction[held].max(), 360)):
    right.axvspan(first, last, color=RED, alpha=0.2, linewidth=0)
right.text(186, 1, "infeasible", color=RED)
right.set(xlabel="direction of the load (degrees; 270: down)", ylabel="largest normal force (N)")
right.set(xlim=(180, 360), ylim=(0, None), xticks=[180, 225, 270, 315, 360])
plt.show()

# %% [markdown]
# ## 4. Friction is a guess
#
# Forces on the edge of a cone rely on every bit of friction. We optimise for $\mu = 0.5$, then let each
# contact's true coefficient vary: normal, standard deviation 0.1. In what share of 20 000 draws do all forces
# remain inside their true cones?
#
# `Gentlest` stakes everything on $\mu$. `Robust` buys distance from the edge with normal force; its weight is
# the price it is ready to pay, in N.

# %%
weights = np.geomspace(0.01, 10, 25)
same = on_ellipse(np.broadcast_to([160.0, 300.0, 340.0], (25, 3)))
robust = jg.optimize_forces(same, lift, criterion=jg.Robust(weight=weights))
assert (np.asarray(robust.status) == jg.Status.OPTIMAL).all()

true_mu = np.random.default_rng(0).normal(MU, 0.1, size=(20_000, 3)).clip(min=0)


def share_held(force):
    f_t, f_n = np.moveaxis(np.asarray(force).reshape(-1, 1, 3, 2), -1, 0)
    return (np.abs(f_t) <= true_mu * f_n).all(axis=-1).mean(axis=-1)


held_by_robust = share_held(robust.force)
held_by_gentlest = float(share_held(best["Gentlest"].force)[0])
price = np.asarray(jg.Gentlest().cost(same, robust.force)) / float(best["Gentlest"].cost)
print(f"Gentlest: held in {100 * held_by_gentlest:.1f} % of draws")
print("weight (N)   held       largest normal force / gentlest")
for j in range(0, 25, 4):
    print(f"{weights[j]:8.3g}     {100 * held_by_robust[j]:5.1f} %    {price[j]:.2f}")
assert (np.diff(price) > 0).all() and price[0] < 1.02
assert held_by_robust.max() > 0.9 > held_by_robust[0] > held_by_gentlest

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.3), layout="constrained")
left.semilogx(weights, 100 * held_by_robust, "o-", color=BLUE, markersize=3)
left.axhline(100 * held_by_gentlest, color=RED, linestyle="--", label="Gentlest")
left.set(xlabel="weight of Robust (N)", ylabel="draws in which the grasp holds (%)", ylim=(0, 102))
left.legend(loc="lower right")
right.plot(price, 100 * held_by_robust, "o-", color=BLUE, markersize=3)
right.plot(1, 100 * held_by_gentlest, "o", color=RED, label="Gentlest")
for j in (0, 12, 16, 20, 24):
    right.annotate(
        f"{weights[j]:.2g}", (price[j], 100 * held_by_robust[j]), (5, -10), textcoords="offset points"
    )
right.set(xlabel="largest normal force / gentlest", ylim=(0, 102), title="what it costs; labels: weight")
plt.show()

# %% [markdown]
# Beyond a weight of some 3 N nothing is gained: the fingers squeeze harder and harder along one internal force,
# and every force keeps its direction.
#
# ## 5. Motors have limits
#
# Two fingers of two joints each hold the ellipse from the sides, a palm without motors supports it from
# below. `torque_limits = (J, tau_max)` adds $|J^T f| \le \tau_{max}$, where the hand Jacobian $J$ takes joint
# rates to contact velocities in the contacts' own frames. We weaken the motors step by step.

# %%
hand = on_ellipse([180.0, 0.0, 270.0])
joints = np.array([[[-0.07, -0.09], [-0.085, -0.035]], [[0.07, -0.09], [0.085, -0.035]]])  # m: finger, joint


def hand_jacobian(grasp):
    """(k n, q): row by row the contact's f_t and f_n directions, a column for each joint."""
    n, p = normals(grasp), np.asarray(grasp.position)
    frame = np.stack([np.stack([n[:, 1], -n[:, 0]], axis=-1), n], axis=1)  # (k, 2, 2): t and n
    J = np.zeros((6, 4))
    for finger in range(2):
        for joint in range(2):
            arm = p[finger] - joints[finger, joint]
            J[2 * finger : 2 * finger + 2, 2 * finger + joint] = frame[finger] @ [-arm[1], arm[0]]
    return J


J = hand_jacobian(hand)
limit = np.linspace(0.02, 0.6, 59)  # N m
weak = jg.optimize_forces(
    on_ellipse(np.broadcast_to([180.0, 0.0, 270.0], (59, 3))),
    lift,
    criterion=jg.Gentlest(),
    torque_limits=(J, np.repeat(limit[:, None], 4, axis=1)),
)
assert (np.asarray(weak.status) == jg.Status.OPTIMAL).all()
torque = np.abs(np.asarray(weak.force) @ J)  # |J^T f|
assert (torque <= limit[:, None] * (1 + 1e-7)).all()
active = np.abs(weak.joint_rates).max(axis=-1) > 1e-5
rate = -np.abs(weak.joint_rates).sum(axis=-1)  # d cost / d limit
measured = np.gradient(np.asarray(weak.cost), limit)
inner = active & np.roll(active, 1) & np.roll(active, -1)
inner[[0, -1]] = False
print(f"the limit is active up to {limit[active].max():.2f} N m, where the torques reach it:")
used = torque.max(axis=-1)[active] / limit[active]
print("  largest torque / limit there:", used.min(), "to", used.max())
print(
    "  d cost / d limit, multipliers against differences:", float(rate[inner][0]), float(measured[inner][0])
)

fig, panels = plt.subplots(1, 3, figsize=(11, 3.1), layout="constrained")
show(panels[0], hand, weak.force[5], lift)
for finger in range(2):
    chain = np.concatenate([joints[finger], np.asarray(hand.position)[finger : finger + 1]])
    panels[0].plot(*chain.T, "o-", color="k", linewidth=2, markersize=5, markerfacecolor="w")
panels[0].set(xlim=(-0.11, 0.11), ylim=(-0.1, 0.06), title=f"motors of {limit[5]:.2f} N m")
panels[1].plot([0, 0.6], [0, 0.6], "--", color=GREY, label="limit")
for j, (colour, label) in enumerate(((BLUE, "base joints"), (RED, "tip joints"))):
    panels[1].plot(limit, torque[:, j], color=colour, label=label)
panels[1].set(xlabel="$\\tau_{max}$ (N m)", ylabel="$|J^T f|$ (N m)")
panels[1].legend()
panels[2].plot(limit, weak.cost, color=BLUE)
panels[2].set(
    xlabel="$\\tau_{max}$ (N m)",
    ylabel="largest normal force (N)",
    title="weak motors: the palm carries more",
)
plt.show()

# %% [markdown]
# ## 6. Which way is better?
#
# Costs and forces have exact derivatives. The simplest is free: `load_twist` is the derivative of the cost
# with respect to the load.

# %%
tilted = np.array([lift, [4.0, -9.0, 0.05], [-2.0, -8.0, -0.1]])


def cost_of(loads):
    return jg.optimize_forces(grasp, loads, criterion=jg.LeastNorm()).cost


by_grad = jax.grad(lambda loads: cost_of(loads).sum())(jnp.asarray(tilted))
load_twist = jg.optimize_forces(grasp, tilted, criterion=jg.LeastNorm()).load_twist
h = 1e-5
shifted = tilted[:, None, None] + h * np.array([1, -1])[:, None, None] * np.eye(3)  # (3, 2, 3, m)
above, below = np.moveaxis(np.asarray(cost_of(shifted)), 1, 0)
differences = (above - below) / (2 * h)
print("jax.grad       ", np.asarray(by_grad[0]).round(5))
print("load_twist     ", np.asarray(load_twist[0]).round(5))
print("differences    ", differences[0].round(5))
assert np.allclose(by_grad, load_twist, rtol=1e-5) and np.allclose(by_grad, differences, rtol=1e-5)

# %% [markdown]
# Now the contacts move. The task: the weight, with 15 N pushing from each of eight sides. The cost: the mean of
# `LeastNorm` over the task. `jax.grad` gives its derivative with respect to the three angles; Adam goes down
# from eight grasps that can do the task.

# %%
pushes = np.radians(np.arange(0, 360, 45))
task = lift + 15 * np.stack([np.cos(pushes), np.sin(pushes), np.zeros(8)], axis=-1)


def mean_cost(degrees):
    """The mean cost of the task, for each grasp (*batch, 3)."""
    loads = jnp.broadcast_to(task, (*degrees.shape[:-1], 8, 3))
    return jg.optimize_forces(on_ellipse(degrees), loads, criterion=jg.LeastNorm()).cost.mean(axis=-1)


tries = np.random.default_rng(1).uniform(0, 360, size=(200, 3))
starts = tries[np.isfinite(mean_cost(tries))][:8]
slopes_of = jax.jit(jax.grad(lambda degrees: mean_cost(degrees).sum()))

slope = np.asarray(slopes_of(starts))
h = 1e-3
steps = starts[:, None, None] + h * np.array([1, -1])[:, None, None] * np.eye(3)
above, below = np.moveaxis(np.asarray(mean_cost(steps)), 1, 0)
differences = (above - below) / (2 * h)
print("N^2 per degree, jax.grad    ", slope[0].round(4))
print("N^2 per degree, differences ", differences[0].round(4))
assert np.allclose(slope, differences, rtol=1e-4, atol=1e-4 * np.abs(slope).max())

# %%
descent = optax.adam(optax.exponential_decay(4.0, 20, 0.5))  # degrees
angles, state = jnp.asarray(starts), descent.init(jnp.asarray(starts))
path = [angles]
for _ in range(80):
    updates, state = descent.update(slopes_of(angles), state)
    angles = angles + updates
    path.append(angles)
costs = np.asarray(mean_cost(jnp.stack(path)))  # (81, 8)
winner = int(costs[-1].argmin())
print("mean cost (N^2) at the start:", costs[0].round(0))
print("              after 80 steps:", costs[-1].round(0))
assert (costs[-1] < costs[0]).all()

fig, panels = plt.subplots(1, 3, figsize=(11, 3.1), layout="constrained")
for axes, step, title in zip(panels, (0, 80), ("start", "80 steps later"), strict=False):
    at = on_ellipse(path[step][winner])
    forces = np.asarray(jg.optimize_forces(at, task, criterion=jg.LeastNorm()).force)
    show(axes, at)
    for force, load in zip(forces, task, strict=True):
        for p, f in zip(np.asarray(at.position), in_plane(at, force), strict=True):
            axes.plot(*np.stack([p, p - 0.002 * f]).T, color=BLUE, linewidth=1)
        axes.plot(*np.stack([[0, 0], 0.002 * load[:2]]).T, color="k", linewidth=0.8)
    axes.set_title(f"{title}: {costs[step, winner]:.0f} N²")
panels[2].semilogy(costs, color=GREY, linewidth=1)
panels[2].semilogy(costs[:, winner], color=BLUE, linewidth=2)
panels[2].set(xlabel="step", ylabel="mean cost (N²)", title="eight starts")
plt.show()

# %% [markdown]
# ## 7. The proof
#
# `check_certificate` takes nothing on trust. With NumPy alone it rebuilds the grasp map, balances the forces,
# puts them into their cones and under their limits, evaluates the cost, and derives the lower bound again from
# the twist. A forged answer does not pass.

# %%
proofs = {
    "five criteria": all(jg.check(grasp, out) for out in best.values()),
    "pinches": jg.check(many, gentlest).all(),
    "loads all around": jg.check(cradle, around).all(),
    "robust weights": jg.check(same, robust).all(),
    "weak motors": jg.check(on_ellipse(np.broadcast_to([180.0, 0.0, 270.0], (59, 3))), weak).all(),
}
for name, proved in proofs.items():
    print(f"{name:17s} {'proved' if proved else 'NOT PROVED'}")
assert all(proofs.values())

honest = best["Gentlest"]
forgeries = {
    "forces 1 % smaller": {"force": 0.99 * honest.force, "cost": 0.99 * honest.cost},
    "forces 1 % larger": {"force": 1.01 * honest.force, "cost": 1.01 * honest.cost},
    "a smaller cost": {"cost": 0.99 * honest.cost},
    "a larger bound": {"bound": 1.01 * honest.bound, "cost": 1.01 * honest.cost},
    "called infeasible": {"status": jnp.int32(jg.Status.INFEASIBLE)},
    "forces of Robust": {"force": best["Robust"].force, "cost": table[1, 0]},
}
for name, changes in forgeries.items():
    accepted = bool(jg.check(grasp, dataclasses.replace(honest, **changes)))
    print(f"{name:19s} {'ACCEPTED' if accepted else 'rejected'}")
    assert not accepted

# %% [markdown]
# ## 8. In space
#
# The same call. Three fingers hold the built-in mug (row 282 of `jaxgrasp screen mug --fingers 3`), which
# weighs 3 N. Its $z$ axis points up.

# %%
mug = make_object("mug")
position, inward = (x[282] for x in SurfaceSampler(mug, fingers=3, seed=0).rows(0, 300))
on_mug = jg.Grasp(position - mug.center_mass, inward, jg.HardFinger(friction=0.5))
carried = jg.optimize_forces(on_mug, np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]), criterion=jg.Gentlest())
f = np.asarray(carried.force).reshape(3, 3)
print(jg.Status(int(carried.status)).sentence)
print(f"largest normal force {carried.cost:.4f} N, gap {carried.gap:.0e} N")
for i, (f_x, f_y, f_n) in enumerate(f):
    print(f"contact {i}: f_n = {f_n:.3f} N, {100 * np.hypot(f_x, f_y) / (0.5 * f_n):5.1f} % of friction used")
assert jg.check(on_mug, carried)

verdict = jg.wrench_resistance(on_mug)
drawn = Verdict(
    position=position,
    normal=inward,
    friction=np.full(3, 0.5),
    torsion=np.zeros(3),
    active=np.ones(3, bool),
    centre_of_mass=np.asarray(mug.center_mass),
    model="hard",
    status=jg.Status(int(verdict.status)),
    margin=float(verdict.margin),
    upper=float(verdict.margin + verdict.gap),
    rank=int(verdict.rank),
    force=f / f[:, 2].mean(),
    twist=None,
)
with tempfile.TemporaryDirectory() as folder:
    picture = Path(folder) / "forces.png"
    draw(drawn, picture, mug)
    display(Image(picture.read_bytes(), width=560))
