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
# # What if motors are weak, and which way is better?
#
# [02_force_optimization](02_force_optimization.ipynb) asks for the best forces of a grasp. Here the joints of a hand
# have limits, and derivatives say how a grasp should change. Lengths are in m, forces in N, torques in N m.
#
# The object: an ellipse, 10 cm wide and 7 cm high, that weighs 10 N. A contact is an angle on it.

# %%
import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxgrasp as jg
from jaxgrasp.report import planar_plots

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32
jax.config.update("jax_disable_most_optimizations", True)  # compiles faster, runs slower

AXES = np.array([0.05, 0.035])
lift = np.array([0.0, -10.0, 0.0])  # the load: force, and torque about the centre of mass


def on_ellipse(degrees):
    """Hard fingers on the ellipse; angles (*batch, k)."""
    angle = jnp.deg2rad(jnp.asarray(degrees, float))
    ring = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return jg.Grasp(AXES * ring, -ring / AXES, jg.HardFinger(0.5))


# %% [markdown]
# ## 1. Motors have limits
#
# Two fingers of two joints each hold the ellipse from the sides, a palm without motors supports it from below.
# `TorqueLimits(J, tau_max, axes="body")` adds $|J^T f| \le \tau_{max}$, where the hand Jacobian $J$ takes joint rates
# to the velocities of the contacts, here in the axes of the body. We weaken the motors step by step.

# %%
hand = on_ellipse([180.0, 0.0, 270.0])
joints = np.array([[[-0.07, -0.09], [-0.085, -0.035]], [[0.07, -0.09], [0.085, -0.035]]])  # m: finger, joint
arm = np.asarray(hand.position)[:2, None] - joints  # (finger, joint, 2)
velocity = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)  # of a fingertip, for each joint's rate of 1 rad/s
J = np.zeros((6, 4))  # two rows a contact, one column a joint; the palm's rows are zero
for finger in range(2):
    J[2 * finger : 2 * finger + 2, 2 * finger : 2 * finger + 2] = velocity[finger].T

limit = np.linspace(0.02, 0.6, 59)  # N m
many = on_ellipse(np.broadcast_to([180.0, 0.0, 270.0], (59, 3)))
limits = jg.TorqueLimits(J, np.repeat(limit[:, None], 4, axis=1), axes="body")
weak = jg.optimize_forces(many, lift, criterion=jg.Gentlest(), torque_limits=limits)
assert (np.asarray(weak.status) == jg.Status.OPTIMAL).all()
assert jg.check(many, weak, wrench=lift, criterion=jg.Gentlest(), torque_limits=limits).all()
torque = np.abs(np.asarray(jg.force_vectors(many, weak.force)).reshape(59, 6) @ J)  # |J^T f|
assert (torque <= limit[:, None] * (1 + 1e-7)).all()

active = np.abs(weak.joint_rates).max(axis=-1) > 1e-5
used = torque.max(axis=-1)[active] / limit[active]
print(
    f"the limit is active up to {limit[active].max():.2f} N m, where torques reach {used.min()} to {used.max()} of it"
)
rate = -np.abs(weak.joint_rates).sum(axis=-1)  # d cost / d limit
measured = np.gradient(np.asarray(weak.cost), limit)
inner = active & np.roll(active, 1) & np.roll(active, -1)
inner[[0, -1]] = False
print("d cost / d limit: multipliers", float(rate[inner][0]), "differences", float(measured[inner][0]))
panels = {
    f"motors of {limit[i]:.2f} N m": {"grasp": hand, "force": weak.force[i], "load": lift} for i in (5, 58)
}
figure = planar_plots.planar_grasps(AXES, panels)
figure = planar_plots.joint_torques(limit, torque, weak.cost, {0: "base joints", 1: "tip joints"})

# %% [markdown]
# Weak motors: the palm carries more.
#
# ## 2. The derivative with respect to the load
#
# Costs and forces have exact derivatives. The simplest is free: `load_twist` is the derivative of the cost with
# respect to the load.

# %%
grasp = on_ellipse([160.0, 300.0, 340.0])
tilted = np.array([lift, [4.0, -9.0, 0.05], [-2.0, -8.0, -0.1]])


def cost_of(loads):
    return jg.optimize_forces(grasp, loads, criterion=jg.LeastNorm()).cost


def differences(function, at, h):
    """Central differences of a function of (*batch, 3)."""
    steps = at[..., None, None, :] + h * np.array([1, -1])[:, None, None] * np.eye(3)  # (*batch, 2, 3, 3)
    above, below = np.moveaxis(np.asarray(function(steps)), -2, 0)
    return (above - below) / (2 * h)


by_grad = jax.grad(lambda loads: cost_of(loads).sum())(jnp.asarray(tilted))
load_twist = jg.optimize_forces(grasp, tilted, criterion=jg.LeastNorm()).load_twist
by_differences = differences(cost_of, tilted, 1e-5)
for name, value in (("jax.grad", by_grad), ("load_twist", load_twist), ("differences", by_differences)):
    print(f"{name:12s}", np.asarray(value[0]).round(5))
assert np.allclose(by_grad, load_twist, rtol=1e-5) and np.allclose(by_grad, by_differences, rtol=1e-5)

# %% [markdown]
# ## 3. A grasp that improves itself
#
# Now the contacts move. The task: the weight, with 15 N pushing from each of eight sides. The cost: the mean of
# `LeastNorm` over the task. `jax.grad` gives its derivative with respect to the three angles; Adam goes down from
# eight grasps that can do the task.

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
slope, by_differences = np.asarray(slopes_of(starts)), differences(mean_cost, starts, 1e-3)
print("N^2 per degree, jax.grad    ", slope[0].round(4))
print("N^2 per degree, differences ", by_differences[0].round(4))
assert np.allclose(slope, by_differences, rtol=1e-4, atol=1e-4 * np.abs(slope).max())

# %%
descent = optax.adam(optax.exponential_decay(4.0, 20, 0.5))  # degrees
angles, state = jnp.asarray(starts), descent.init(jnp.asarray(starts))
path = [angles]
for _ in range(80):
    updates, state = descent.update(slopes_of(angles), state)
    angles = angles + updates
    path.append(angles)
costs = np.asarray(mean_cost(jnp.stack(path)))  # (81, 8)
print("mean cost (N^2) at the start:", costs[0].round(0))
print("              after 80 steps:", costs[-1].round(0))
assert (costs[-1] < costs[0]).all()

winner, shown = int(costs[-1].argmin()), {}
for step, title in ((0, "start"), (80, "80 steps later")):
    at = on_ellipse(path[step][winner])
    forces = jg.optimize_forces(at, task, criterion=jg.LeastNorm())
    assert jg.check(at, forces, wrench=task, criterion=jg.LeastNorm()).all()
    shown[f"{title}: {costs[step, winner]:.0f} N²"] = (at, forces.force)
figure = planar_plots.descent(AXES, shown, task, costs)
