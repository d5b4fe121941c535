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
# # Does this grasp hold?
#
# Fingers touch an object. Can they, by squeezing, balance every push and turn from outside? A grasp that
# can is *wrench resistant*; others say *force closure*. This notebook goes from one contact to a verdict
# with its proof, and ends with the way a mug leaves three fingers that do not hold it.
#
# Lengths are in m, forces in N, torques in N m. The body frame has its origin at the centre of mass.

# %%
import dataclasses
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image, display

import jaxgrasp as jg
from jaxgrasp.objects.builtin import make_object
from jaxgrasp.objects.sampling import SurfaceSampler
from jaxgrasp.report import Verdict, draw, explain

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32
plt.rcParams.update({"figure.dpi": 110, "axes.grid": True, "grid.alpha": 0.3, "font.size": 9})
BLUE, RED, GREY = "#00798c", "#d1495b", "0.45"

# %% [markdown]
# ## 1. What a contact can do
#
# A contact model says which force components exist and which of them are feasible. Three models, one
# inequality:
#
# $$\psi(f) = \left\| \left( \frac{f_x}{\mu}, \frac{f_y}{\mu}, \frac{\tau_n}{\gamma} \right) \right\| \le f_n$$
#
# - `Frictionless`: $f = (f_n)$;
# - `HardFinger`: a point with Coulomb friction, $f = (f_x, f_y, f_n)$;
# - `SoftFinger`: also a torque about the normal, $f = (f_x, f_y, f_n, \tau_n)$; $\gamma$ is a length.

# %%
models = [jg.Frictionless(), jg.HardFinger(friction=0.5), jg.SoftFinger(friction=0.5, torsion=0.01)]
for model in models:
    names = ", ".join(c.value for c in model.components(3))
    print(
        f"{type(model).__name__:13s} f = ({names:20s})  f = s * {np.asarray(model.scaling(3))}, |s_t| <= s_n"
    )

# %% [markdown]
# Left: the friction cone of a hard finger, cut through its axis. Right: what a soft finger with $f_n = 1$ N
# can do at once sideways and in torsion. The ellipse is the edge of the feasible forces.

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
f_n = np.linspace(0, 1, 2)
for mu, shade in ((0.3, 0.45), (0.6, 0.3), (1.0, 0.15)):
    left.fill_betweenx(f_n, -mu * f_n, mu * f_n, color=BLUE, alpha=shade, linewidth=0)
    left.text(mu, 1.03, f"{mu}", ha="center", va="bottom")
left.set(
    xlabel="tangential force (N)",
    ylabel="normal force (N)",
    aspect="equal",
    title="hard finger, $\\mu$ = 0.3, 0.6, 1",
)
left.set(xlim=(-1.2, 1.2), ylim=(0, 1.25))

soft = models[2]
f_x, tau = np.meshgrid(np.linspace(-0.6, 0.6, 121), np.linspace(-0.013, 0.013, 121))
force = np.stack([f_x, np.zeros_like(f_x), np.ones_like(f_x), tau], axis=-1)
slack = np.asarray(soft.feasibility_slack(force, 3))
shown = right.contourf(f_x, 1000 * tau, slack, levels=np.linspace(-0.6, 1, 17), cmap="RdBu", vmin=-1, vmax=1)
right.contour(f_x, 1000 * tau, slack, levels=[0], colors="k")
right.set(xlabel="$f_x$ (N)", ylabel="$\\tau_n$ (N mm)", title="soft finger, $\\mu$ = 0.5, $\\gamma$ = 10 mm")
fig.colorbar(shown, ax=right, label="$f_n - \\psi(f)$ (N)", ticks=[-0.5, 0, 0.5, 1])
plt.show()

# %% [markdown]
# ## 2. The grasp map
#
# Three fingers, 120 degrees apart, on a can of 4 cm radius. `grasp_map` takes contact forces to the wrench
# they apply to the object: $w = G f$. Its null space holds the *internal forces*, which squeeze and do
# nothing else.

# %%
turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)  # inward
grasp = jg.Grasp(-0.04 * normal, normal, jg.HardFinger(friction=0.5))

G = jg.grasp_map(grasp)
V = jg.null_space(grasp)
basis = V[:, np.any(V != 0, axis=0)]
print(
    "G", G.shape, "  rank of the folded map", int(jg.grasp_rank(grasp)), "  internal forces:", basis.shape[1]
)
print("largest entry of G V:", float(np.abs(G @ V).max()))

squeeze = np.tile([0.0, 0.0, 1.0], 3)
print("equal normal forces make the wrench", np.asarray(G @ squeeze).round(12) + 0.0)

# %% [markdown]
# ## 3. Friction as a linear matrix inequality
#
# A force is feasible exactly when a symmetric matrix $P(f)$, linear in $f$, is positive semidefinite. For a
# hard finger
#
# $$P(f) = \begin{pmatrix} \mu f_n & 0 & f_x \\ 0 & \mu f_n & f_y \\ f_x & f_y & \mu f_n \end{pmatrix},
# \qquad \lambda_{\min}(P) = \mu\,(f_n - \psi(f)).$$
#
# All contacts together make one block-diagonal matrix.

# %%
P, S = jg.lmi.friction_lmi(grasp)
print("P", P(squeeze).shape, " one S_l per force component:", S.shape)
print(np.asarray(P(squeeze))[:3, :3])

sideways = np.linspace(0, 1, 41)
forces = np.tile(squeeze, (41, 1))
forces[:, 0] = sideways
eigenvalues = np.linalg.eigvalsh(jax.vmap(P)(forces))

fig, axes = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
axes.plot(sideways, eigenvalues, color=GREY, linewidth=1)
axes.plot(sideways, eigenvalues[:, 0], color=RED, linewidth=2, label="smallest eigenvalue of $P(f)$")
axes.plot(
    sideways[::4],
    0.5 * (1 - sideways[::4] / 0.5),
    "o",
    color=BLUE,
    markersize=4,
    label="$\\mu (f_n - \\psi)$",
)
axes.axvline(0.5, color="k", linewidth=0.8, linestyle="--")
axes.set(
    xlabel="$f_x$ of the first contact (N), $f_n$ = 1 N",
    ylabel="eigenvalues (N)",
    title="feasible up to $f_x = \\mu f_n$",
)
axes.legend(loc="lower left")
plt.show()

# %% [markdown]
# ## 4. The margin, by two roads
#
# How far inside their cones can all contacts press at once, with a mean normal force of 1 and no net
# wrench?
#
# $$t^\star = \max t \quad\text{subject to}\quad G f = 0,\quad f_{n,i} - \psi_i(f_i) \ge t,\quad \sum_i f_{n,i} = k$$
#
# The grasp is wrench resistant if and only if the folded map has full rank and $t^\star > 0$.
# `wrench_resistance` solves this with a structured interior-point method, thousands of grasps at a time.
# `lmi_margin` solves the same problem as a general LMI: slower, and written independently. They agree.

# %%
rng = np.random.default_rng(0)
normals = rng.normal(size=(200, 3, 3))
normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
many = jg.Grasp(-0.04 * normals, normals, jg.HardFinger(friction=0.8))

result = jg.wrench_resistance(many)
by_lmi = np.asarray(jg.lmi.lmi_margin(many))
difference = np.abs(result.margin - by_lmi) / np.maximum(1, np.abs(by_lmi))
print("largest difference, relative:", float(difference.max()))
assert difference.max() < 1e-6

fig, axes = plt.subplots(figsize=(4.2, 4), layout="constrained")
resistant = np.asarray(result.status) == jg.Status.RESISTANT
for chosen, colour, label in (
    (resistant, BLUE, "resistant"),
    (~resistant, RED, "not resistant, or marginal"),
):
    axes.plot(result.margin[chosen], by_lmi[chosen], ".", color=colour, label=f"{label}: {chosen.sum()}")
axes.axline((0, 0), slope=1, color="k", linewidth=0.6)
axes.set(xlabel="margin, structured solver", ylabel="margin, LMI", aspect="equal", xlim=(-4, 1), ylim=(-4, 1))
axes.set_title("200 random grasps of a ball")
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# ## 5. One grasp under the magnifying glass
#
# `trace` shows every iteration of one grasp. Lower and upper bound hold from the first row on; the solver
# only has to bring them together.

# %%
worst = int(np.argmax(result.iterations))
trace = jg.trace(many[worst])
print(trace)

fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
steps = np.arange(len(trace.gap))
left.fill_between(steps, trace.lower, trace.upper, color=BLUE, alpha=0.25, linewidth=0)
left.plot(steps, trace.lower, "o-", color=BLUE, markersize=3, label="lower bound (a force)")
left.plot(steps, trace.upper, "o-", color=RED, markersize=3, label="upper bound (a twist)")
left.set(xlabel="iteration", ylabel="margin $t^\\star$", title="the bracket")
left.legend()
right.semilogy(steps, trace.gap, "o-", color="k", markersize=3)
right.set(xlabel="iteration", ylabel="duality gap", title="the gap")
plt.show()

# %% [markdown]
# ## 6. A verdict and its proof
#
# A yes comes with an internal force strictly inside every cone. A no comes with an *escape twist*: a motion
# in which every contact draws away from its finger at too steep an angle for friction to follow: no finger
# force opposes it. `check_certificate` proves each verdict again in float64, with nothing but NumPy. It
# trusts the evidence, not the solver: a forged verdict does not pass.

# %%
can = jg.wrench_resistance(grasp)
print(jg.Status(int(can.status)).sentence)
print(f"margin in [{float(can.margin):.9f}, {float(can.margin + can.gap):.9f}], rank {int(can.rank)}")
print("internal force, contact by contact (f_x, f_y, f_n):")
print(np.asarray(can.internal_force).reshape(3, 3).round(6) + 0.0)
print("checked:", bool(jg.check(grasp, can)))

forged = dataclasses.replace(result, status=np.full(200, jg.Status.RESISTANT))
assert jg.check(many, result).all()
accepted = jg.check(many, forged)
print(f"all 200 called resistant: {accepted.sum()} accepted, as many as are resistant: {resistant.sum()}")
assert (accepted == resistant).all()

# %% [markdown]
# ## 7. How the mug escapes
#
# The candidates of `jaxgrasp screen mug --fingers 3`, without the file: points drawn on the built-in mug's
# surface. We pick row 185, which falls short by little, and draw the motion by which the mug gets away:
# grey before, yellow after.
#
# Marginal grasps are no accident of rounding here: two fingers hold each other, the third cannot press, and
# the margin is exactly 0.

# %%
mug = make_object("mug")
position, inward = SurfaceSampler(mug, fingers=3, seed=0).rows(0, 2000)
on_mug = jg.Grasp(position - mug.center_mass, inward, jg.HardFinger(friction=0.5))
screened = jg.wrench_resistance(on_mug)
for status in jg.Status:
    print(f"{status.name:14s} {int((np.asarray(screened.status) == status).sum()):5d}")
assert jg.check(on_mug, screened).all()

# %%
row = 185
escaping = Verdict(
    position=position[row],
    normal=inward[row],
    friction=np.full(3, 0.5),
    torsion=np.zeros(3),
    active=np.ones(3, bool),
    centre_of_mass=np.asarray(mug.center_mass),
    model="hard",
    status=jg.Status(int(screened.status[row])),
    margin=float(screened.margin[row]),
    upper=float(screened.margin[row] + screened.gap[row]),
    rank=int(screened.rank[row]),
    force=np.asarray(screened.internal_force[row]).reshape(3, 3),
    twist=np.asarray(screened.escape_twist[row]),
)
print(explain(escaping))
assert escaping.status is jg.Status.NOT_RESISTANT
with tempfile.TemporaryDirectory() as folder:
    picture = Path(folder) / "escape.png"
    draw(escaping, picture, mug)
    display(Image(picture.read_bytes(), width=560))

# %% [markdown]
# How much friction would it take? One call answers for a whole range of $\mu$. The margin never falls as
# friction grows, and the verdict changes where it passes zero.

# %%
mu = np.linspace(0, 1.5, 151)
same = (151, 3, 3)
swept = jg.wrench_resistance(
    jg.Grasp(
        np.broadcast_to(position[row] - mug.center_mass, same),
        np.broadcast_to(inward[row], same),
        jg.HardFinger(friction=np.broadcast_to(mu[:, None], (151, 3))),
    )
)
holds = np.asarray(swept.status) == jg.Status.RESISTANT
assert (np.diff(swept.margin) > -1e-7).all()
enough = mu[holds][0]

fig, axes = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
finite = np.isfinite(swept.margin)
for chosen, colour, label in ((holds, BLUE, "resistant"), (finite & ~holds, RED, "not resistant")):
    axes.plot(mu[chosen], swept.margin[chosen], ".-", color=colour, label=label)
axes.axhline(0, color="k", linewidth=0.8)
axes.set(
    xlabel="friction coefficient $\\mu$",
    ylabel="margin $t^\\star$",
    ylim=(-3, 1),
    title=f"holds from $\\mu$ = {enough:.2f} on",
)
axes.legend(loc="lower right")
plt.show()
