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
# below two fingertips swings, and moving the fingertips' forces can stop the swing, although no two hard
# fingers can produce a torque about the line between them. This notebook asks when that works, shows the
# motion that stays out of reach when it does not, and closes the loop.
#
# Lengths are in m, forces in N, angles in rad.

# %%
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
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
# ## 1. The pendulum grasp
#
# Two hard fingers pinch a body of 200 g; the line between them passes at some height above or below the centre
# of mass, or through it. All heights are one batch. The equilibrating forces are found by force optimisation.

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
    print(jg.report.explain_controllability(found, lane), "\n")
assert (found.rank[above], found.rank[through], found.grasp_rank[above]) == (12, 10, 5)

# %% [markdown]
# The rank of the controllability matrix $[B\; AB \dots A^{11}B]$ is 12 at every height but zero. How hard the
# weakest direction is, the rank does not say. The finite-horizon Gramian does: the nearer the line is to the
# centre of mass, the more force it takes.

# %%
fig, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
panels[0].step(1000 * heights, np.asarray(found.rank), color=BLUE, where="mid")
panels[0].set(xlabel="height of the line (mm)", ylabel="rank of (11.30)", yticks=[10, 11, 12])
panels[1].semilogy(
    1000 * heights, np.asarray(found.singular_values)[:, -1], color=BLUE, label="least singular value"
)
reachable = np.isfinite(found.effort)
panels[1].semilogy(
    1000 * heights[reachable], np.asarray(found.effort)[reachable], color=RED, label="effort (weights)"
)
panels[1].set(xlabel="height of the line (mm)")
panels[1].legend()
plt.show()
assert np.asarray(found.effort)[above] < np.asarray(found.effort)[through + 1]

# %% [markdown]
# ## 2. The escape twist
#
# With the line through the centre of mass one motion is out of reach: the rotation about that line. It is also
# the *escape twist* that proves that the grasp is not wrench resistant, whatever the height. Gravity helps only
# where that rotation moves the centre of mass.

# %%
resistance = jg.wrench_resistance(pendulum)
print("not wrench resistant:", set(np.asarray(resistance.status).tolist()) == {jg.Status.NOT_RESISTANT})
print("escape twist, line at 20 mm   (v; omega)", np.asarray(resistance.escape_twist[above]).round(3) + 0.0)
print("out of reach, line at  0 mm   (v; omega)", np.asarray(found.uncontrollable[through]).round(3) + 0.0)

fig, panels = plt.subplots(1, 2, figsize=(7, 3.2), layout="constrained")
outline = 0.03 * np.array([[-0.7, -1.4], [0.7, -1.4], [0.7, 1.4], [-0.7, 1.4], [-0.7, -1.4]])
for axes, height, title in zip(
    panels, (0.02, 0.0), ("above: it swings back", "through: nothing moves it"), strict=True
):
    for angle, colour, width in ((0.0, GREY, 1.5), (0.5, YELLOW, 2.0)):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        pivot = np.array([0, height])
        axes.plot(*((outline - pivot) @ turn.T + pivot).T, color=colour, linewidth=width)
        axes.plot(*(-turn @ pivot + pivot), "o", color=colour, markersize=6)
    axes.plot(0, height, "x", color=RED, markersize=9, markeredgewidth=2)
    axes.set(aspect="equal", title=title, xlabel="y", ylabel="z", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# Seen along the line of the fingers (cross): dots are the centre of mass.
#
# ## 3. Stopping the swing
#
# `regulator` solves the linear-quadratic problem on the linearisation and projects the forces onto their
# friction cones. With the line above, the swing dies; with the line through the centre of mass no feedback
# exists, and the regulator says so.

# %%
few = pinched([0.02, 0.0])
H, STEPS = 0.002, 1500
keep = jg.regulator(few, body, timestep=H, effort=3.0)
print("stabilises:", keep.stabilizes.tolist())
assert keep.stabilizes.tolist() == [True, False]
start = jg.BodyState.at_rest(3, (2,)).displaced(jnp.array([0.0, 0, 0, 0.1, 0.02, 0]))
swing = jg.close_loop(few, body, controller=keep, state=start, steps=STEPS, timestep=H)
t = H * np.arange(STEPS)

fig, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for lane, (name, colour) in enumerate((("line above", BLUE), ("line through", RED))):
    panels[0].plot(t, np.asarray(swing.orientation_error)[:, lane], color=colour, label=name)
panels[0].set(xlabel="time (s)", ylabel="tilt (rad)")
panels[0].legend()
panels[1].plot(t, np.asarray(swing.cone_use)[:, 0], color=BLUE)
panels[1].axhline(1, color=GREY, linestyle=":")
panels[1].set(xlabel="time (s)", ylabel="friction used, line above")
plt.show()
assert float(swing.orientation_error[-1, 0]) < 1e-3 < 0.09 < float(swing.orientation_error[-1, 1])
assert float(swing.cone_use.max()) <= 1 + 1e-9

# %% [markdown]
# ## 4. A disturbed grasp recovers
#
# Three fingers hold the built-in mug. Computed torque asks for the wrench that makes the error obey
# $\ddot e + K_v \dot e + K_p e = 0$; force optimisation finds contact forces for it in every step, inside their
# friction cones. Eight lanes: eight sideways pushes of 50 ms, from none to 1.4 times the weight.

# %%
mug = make_object("mug")
position, inward = (x[282] for x in SurfaceSampler(mug, fingers=3, seed=0).rows(0, 300))
MU = 0.5
on_mug = jg.Grasp(
    np.broadcast_to(position - mug.center_mass, (8, 3, 3)),
    np.broadcast_to(inward, (8, 3, 3)),
    jg.HardFinger(MU),
)
mug_body = jg.RigidBody.from_mesh(mug, mass=0.3)
RATE, STEPS = 20.0, 400
control = jg.ComputedTorque(jg.Gains.of_rate(RATE))
shares = 0.2 * np.arange(8)
push = np.zeros((STEPS, 8, 6))
push[25:50, :, 0] = shares * 0.3 * G
out = jg.close_loop(
    on_mug,
    mug_body,
    controller=control,
    state=jg.BodyState.at_rest(3, (8,)),
    steps=STEPS,
    timestep=H,
    disturbance=push,
)
t = H * np.arange(STEPS)

fig, panels = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
for lane in range(8):
    colour = plt.get_cmap("viridis")(lane / 8)
    panels[0].plot(t, 1000 * np.asarray(out.position_error)[:, lane], color=colour)
    panels[1].plot(t, np.asarray(out.largest_normal)[:, lane], color=colour)
    panels[2].plot(t, np.asarray(out.cone_use)[:, lane], color=colour)
for axes, label in zip(
    panels, ("position error (mm)", "largest normal force (N)", "friction used"), strict=True
):
    axes.set(xlabel="time (s)", ylabel=label)
panels[2].set_ylim(0, 1.05)
plt.show()
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
print(
    f"largest departure from the design: {100 * np.abs(design @ fit - after).max() / after.max():.2f} % of the error"
)
assert np.abs(design @ fit - after).max() < 0.02 * after.max()

# %% [markdown]
# ## 5. Too little friction is said, not hidden
#
# The same push with less and less friction. Where no admissible forces produce the commanded wrench, the step
# says `INFEASIBLE`, the last admissible forces stay, and the mug goes where they and gravity take it.

# %%
frictions = np.linspace(0.05, 0.75, 8)
slippery = jg.Grasp(on_mug.position, on_mug.normal, jg.HardFinger(frictions[:, None] * np.ones((8, 3))))
push[25:50, :, 0] = 0.6 * 0.3 * G
slips = jg.close_loop(
    slippery,
    mug_body,
    controller=control,
    state=jg.BodyState.at_rest(3, (8,)),
    steps=STEPS,
    timestep=H,
    disturbance=push,
)
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
plant = jg.motion.mujoco_plant(
    jax.tree.map(lambda x: jnp.broadcast_to(x, (8, *x.shape)), mug_body), timestep=H
)
again = jg.close_loop(
    on_mug,
    mug_body,
    controller=control,
    state=jg.BodyState.at_rest(3, (8,)),
    steps=STEPS,
    timestep=H,
    disturbance=push,
    plant=plant,
)
other = jg.close_loop(
    on_mug,
    mug_body,
    controller=control,
    state=jg.BodyState.at_rest(3, (8,)),
    steps=STEPS,
    timestep=H,
    disturbance=push,
)
difference = float(jnp.abs(again.final.position - other.final.position).max())
print(f"largest difference of the final positions: {difference:.1e} m")
assert difference < 1e-9

# %%
verdict = jg.wrench_resistance(on_mug)
forces = (
    jg.optimize_forces(on_mug, np.array([0, 0, -0.3 * G, 0, 0, 0]), criterion=jg.SumOfSquares())
    .force[0]
    .reshape(3, 3)
)
drawn = Verdict(
    position=position,
    normal=inward,
    friction=np.full(3, MU),
    torsion=np.zeros(3),
    active=np.ones(3, bool),
    centre_of_mass=np.asarray(mug.center_mass),
    model="hard",
    status=jg.Status(int(verdict.status[0])),
    margin=float(verdict.margin[0]),
    upper=float(verdict.margin[0] + verdict.gap[0]),
    rank=int(verdict.rank[0]),
    force=np.asarray(forces / forces[:, 2].mean()),
    twist=None,
)
with tempfile.TemporaryDirectory() as folder:
    picture = Path(folder) / "held.png"
    draw(drawn, picture, mug)
    display(Image(picture.read_bytes(), width=560))
