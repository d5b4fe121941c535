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
# # Can the fingers steer it?
#
# A grasp that is not wrench resistant may still be *controllable*: gravity is one more finger. An object that hangs
# below two fingertips swings, and moving the fingertips' forces can stop the swing, although no two hard fingers can
# produce a torque about the line between them. This notebook asks when that works, shows the motion that stays out of
# reach when it does not, and closes the loop.
#
# Lengths are in m, forces in N, angles in rad.

# %%
import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import Image, display

import jaxgrasp as jg
from jaxgrasp.objects import SurfaceSampler, make_object
from jaxgrasp.report import explain_controllability, plots

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32
jax.config.update("jax_disable_most_optimizations", True)  # compiles faster, runs slower

# %% [markdown]
# ## 1. The pendulum grasp
#
# Two hard fingers pinch a body of 200 g; the line between them passes at some height above or below the centre of
# mass, or through it. All heights are one batch. The equilibrating forces are found by force optimisation.

# %%
MASS, G = 0.2, 9.81
body = jg.RigidBody(MASS, 1e-4 * np.diag([1.0, 1.2, 1.5]))
heights = np.linspace(-0.03, 0.03, 61)


def pinched(heights):
    """Two hard fingers on the line z = height, x from -3 to 3 cm."""
    heights = np.asarray(heights, float)
    position = np.zeros((len(heights), 2, 3))
    position[:, :, 0], position[..., 2] = [-0.03, 0.03], heights[:, None]
    normal = np.zeros_like(position)
    normal[:, :, 0] = [1, -1]
    return jg.Grasp(position, normal, jg.HardFinger(0.5))


pendulum = pinched(heights)
found = jg.controllability(pendulum, body)
above, through = 50, 30
for lane in (above, through):
    print(f"Line at {1000 * heights[lane]:.0f} mm:")
    print(explain_controllability(found, lane), "\n")
assert (found.rank[above], found.rank[through], found.grasp_rank[above]) == (12, 10, 5)

# %% [markdown]
# The rank of the controllability matrix $[B\; AB \dots A^{11}B]$ is 12 at every height but zero. How hard the weakest
# direction is, the rank does not say. The finite-horizon Gramian does: the nearer the line is to the centre of mass,
# the more force it takes.

# %%
figure = plots.rank_and_effort(heights, found)
assert np.asarray(found.effort)[above] < np.asarray(found.effort)[through + 1]

# %% [markdown]
# ## 2. The escape twist
#
# With the line through the centre of mass one motion is out of reach: the rotation about that line. It is also the
# *escape twist* that proves that the grasp is not wrench resistant, whatever the height. Gravity helps only where
# that rotation moves the centre of mass.

# %%
resistance = jg.wrench_resistance(pendulum)
print("not wrench resistant:", set(np.asarray(resistance.status).tolist()) == {jg.Status.NOT_RESISTANT})
print("escape twist, line at 20 mm   (v; omega)", np.asarray(resistance.escape_twist[above]).round(3) + 0.0)
print("out of reach, line at  0 mm   (v; omega)", np.asarray(found.uncontrollable[through]).round(3) + 0.0)

figure = plots.pendulum({"above: it swings back": 0.02, "through: nothing moves it": 0.0})

# %% [markdown]
# Seen along the line of the fingers (cross): dots are the centre of mass.
#
# ## 3. Stopping the swing
#
# `regulator` solves the linear-quadratic problem on the linearisation and projects the forces onto their friction
# cones. With the line above, the swing dies; with the line through the centre of mass no feedback exists, and the
# regulator says so.

# %%
few = pinched([0.02, 0.0])
H, STEPS = 0.002, 1500
keep = jg.regulator(few, body, timestep=H, effort=3.0)
print("stabilises:", keep.stabilizes.tolist())
assert keep.stabilizes.tolist() == [True, False]
start = jg.BodyState.at_rest(3, (2,)).displaced(jnp.array([0.0, 0, 0, 0.1, 0.02, 0]))
swing = jg.close_loop(few, body, controller=keep, state=start, simulation=jg.motion.Simulation(STEPS, H))
figure = plots.swing(H * np.arange(STEPS), swing, ("line above", "line through"))
assert float(swing.orientation_error[-1, 0]) < 1e-3 < 0.09 < float(swing.orientation_error[-1, 1])
assert float(swing.cone_use.max()) <= 1 + 1e-9

# %% [markdown]
# ## 4. A disturbed grasp recovers
#
# Three fingers hold the built-in mug. Computed torque asks for the wrench that makes the error obey $\ddot e + K_v
# \dot e + K_p e = 0$; force optimisation finds contact forces for it in every step, inside their friction cones.
# Eight lanes: eight sideways pushes of 50 ms, from none to 1.4 times the weight.

# %%
mug = make_object("mug")
position, inward = (x[282] for x in SurfaceSampler(mug, fingers=3, seed=0).rows(0, 300))
eight = [np.broadcast_to(x, (8, 3, 3)) for x in (position - mug.center_mass, inward)]
on_mug = jg.Grasp(*eight, jg.HardFinger(0.5))
mug_body = jg.RigidBody.from_mesh(mug, mass=0.3)
RATE, STEPS = 20.0, 400
control = jg.ComputedTorque(jg.Gains.of_rate(RATE))
shares = 0.2 * np.arange(8)
push = np.zeros((STEPS, 8, 6))
push[25:50, :, 0] = shares * 0.3 * G
at_rest = jg.BodyState.at_rest(3, (8,))


def held(grasp, push, plant=None):
    """Eight lanes under computed torque."""
    run = jg.motion.Simulation(STEPS, H, plant=plant)
    loop = {"controller": control, "state": at_rest, "simulation": run}
    return jg.close_loop(grasp, mug_body, disturbance=push, **loop)


out = held(on_mug, push)
figure = plots.recovery(H * np.arange(STEPS), out)
status = {jg.Status(int(s)).name for s in np.unique(out.status)}
print("every step:", status)
assert status == {"COMMANDED"} and float(out.cone_use.max()) <= 1 + 1e-9
assert float(out.position_error[-1].max()) < 1e-3

# %% [markdown]
# After the push the error decays as designed: $(a + b t) e^{-20 t}$. The measured rate comes from the last part.

# %%
after = np.asarray(out.position_error)[60:200, 4]
ages = H * np.arange(len(after))
design = np.stack([np.ones_like(ages), ages], axis=-1) * np.exp(-RATE * ages)[:, None]
fit, *_ = np.linalg.lstsq(design, after, rcond=None)
departure = np.abs(design @ fit - after).max() / after.max()
print(f"largest departure from the design: {100 * departure:.2f} % of the error")
assert departure < 0.02

# %% [markdown]
# ## 5. Too little friction is said, not hidden
#
# The same push with less and less friction. Where no admissible forces produce the commanded wrench, the step says
# `INFEASIBLE`, the last admissible forces stay, and the mug goes where they and gravity take it.

# %%
frictions = np.linspace(0.05, 0.75, 8)
slippery = jg.Grasp(on_mug.position, on_mug.normal, jg.HardFinger(frictions[:, None] * np.ones((8, 3))))
push[25:50, :, 0] = 0.6 * 0.3 * G
slips = held(slippery, push)
lost = np.mean(np.asarray(slips.status) == jg.Status.INFEASIBLE, axis=0)
margin = jg.wrench_resistance(slippery).margin
print("mu     margin   infeasible steps   final error (m)")
for i, mu in enumerate(frictions):
    print(f"{mu:.2f}  {margin[i]:7.3f}   {100 * lost[i]:14.1f} %   {slips.position_error[-1, i]:12.2g}")
assert lost[0] == 1.0 and lost[-1] == 0.0
assert float(slips.cone_use.max()) <= 1 + 1e-9

# %% [markdown]
# ## 6. MuJoCo agrees
#
# The same loop around MJX instead of the analytic step: the same path.

# %%
bodies = jax.tree.map(lambda x: jnp.broadcast_to(x, (8, *x.shape)), mug_body)
again = held(on_mug, push, jg.motion.mujoco_plant(bodies, timestep=H))
other = held(on_mug, push)
difference = float(jnp.abs(again.final.position - other.final.position).max())
print(f"largest difference of the final positions: {difference:.1e} m")
assert difference < 1e-9

# %%
weight = np.array([0, 0, -0.3 * G, 0, 0, 0])
force = jg.optimize_forces(on_mug[0], weight, criterion=jg.SumOfSquares()).force.reshape(3, 3)
drawn = plots.verdict_of(
    on_mug[0], jg.wrench_resistance(on_mug[0]), mug.center_mass, force / force[:, 2].mean()
)
display(Image(plots.grasp_picture(drawn, mug), width=560))
