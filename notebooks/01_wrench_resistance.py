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
# Fingers touch an object. Can they, by squeezing, balance every push and turn from outside? A grasp that can is
# *wrench resistant*; others say *force closure*. This notebook goes from one contact to a verdict with its proof, and
# ends with the way a mug leaves three fingers that do not hold it.
#
# Lengths are in m, forces in N, torques in N m. The body frame has its origin at the centre of mass.

# %%
import dataclasses

import jax
import numpy as np
from IPython.display import Image, display

import jaxgrasp as jg
from jaxgrasp.objects import SurfaceSampler, make_object
from jaxgrasp.report import explain, plots

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32

# %% [markdown]
# ## 1. What a contact can do
#
# A contact model says which force components exist and which of them are feasible. Three models, one inequality:
#
# $$\psi(f) = \left\| \left( \frac{f_x}{\mu}, \frac{f_y}{\mu}, \frac{\tau_n}{\gamma} \right) \right\| \le f_n$$
#
# - `Frictionless`: $f = (f_n)$;
# - `HardFinger`: a point with Coulomb friction, $f = (f_x, f_y, f_n)$;
# - `SoftFinger`: also a torque about the normal, $f = (f_x, f_y, f_n, \tau_n)$; $\gamma$ is a length.
#
# Left: the friction cone of a hard finger, cut through its axis, for three values of $\mu$. Right: what a soft finger
# can do at once sideways and in torsion. The ellipse is the edge of the feasible forces.

# %%
models = [jg.Frictionless(), jg.HardFinger(friction=0.5), jg.SoftFinger(friction=0.5, torsion=0.01)]
for model in models:
    names = ", ".join(c.value for c in model.components(3))
    print(
        f"{type(model).__name__:13s} f = ({names:20s})  f = s * {np.asarray(model.scaling(3))}, |s_t| <= s_n"
    )
figure = plots.contact_cones((0.3, 0.6, 1.0), models[2])

# %% [markdown]
# ## 2. The grasp map
#
# Three fingers, 120 degrees apart, on a can of 4 cm radius. `grasp_map` takes contact forces to the wrench they apply
# to the object: $w = G f$. Its null space holds the *internal forces*, which squeeze and do nothing else.

# %%
turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)  # inward
grasp = jg.Grasp(-0.04 * normal, normal, jg.HardFinger(friction=0.5))

G, V = jg.grasp_map(grasp), jg.null_space(grasp)
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
# A force is feasible exactly when a symmetric matrix $P(f)$, linear in $f$, is positive semidefinite. For a hard
# finger
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
figure = plots.eigenvalues_of_the_cone(sideways, np.linalg.eigvalsh(jax.vmap(P)(forces)), mu=0.5)

# %% [markdown]
# ## 4. The margin, by two roads
#
# How far inside their cones can all contacts press at once, with a mean normal force of 1 and no net wrench?
#
# $$t^\star = \max t \quad\text{subject to}\quad G f = 0,\quad f_{n,i} - \psi_i(f_i) \ge t,\quad \sum_i f_{n,i} = k$$
#
# The grasp is wrench resistant if and only if the folded map has full rank and $t^\star > 0$. `wrench_resistance`
# solves this with a structured interior-point method, thousands of grasps at a time. `lmi_margin` solves the same
# problem as a general LMI: slower, and written independently. Here on 200 random grasps of a ball.

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
print(result)
figure = plots.margins_by_two_roads(result, by_lmi)

# %% [markdown]
# ## 5. One grasp, iteration by iteration
#
# `trace` shows every iteration of one grasp. Lower and upper bound hold from the first row on; the solver only has to
# bring them together.

# %%
trace = jg.trace(many[int(np.argmax(result.iterations))])
print(trace)
figure = plots.bracket_of_the_margin(trace)

# %% [markdown]
# ## 6. A verdict and its proof
#
# A yes comes with an internal force strictly inside every cone. A no comes with an *escape twist*: a motion in which
# every contact draws away from its finger at too steep an angle for friction to follow, so that no finger force
# opposes it. `jg.check` proves each verdict again in float64, with nothing but NumPy. It trusts the evidence, not the
# solver: a forged verdict does not pass.

# %%
can = jg.wrench_resistance(grasp)
print(can)
print("internal force, contact by contact (f_x, f_y, f_n):")
print(np.asarray(can.internal_force).reshape(3, 3).round(6) + 0.0)
print("checked:", bool(jg.check(grasp, can)))

resistant = np.asarray(result.status) == jg.Status.RESISTANT
forged = dataclasses.replace(result, status=np.full(200, jg.Status.RESISTANT))
assert jg.check(many, result).all()
accepted = jg.check(many, forged)
print(f"all 200 called resistant: {accepted.sum()} accepted, as many as are resistant: {resistant.sum()}")
assert (accepted == resistant).all()

# %% [markdown]
# ## 7. How the mug escapes
#
# The candidates of `jaxgrasp screen mug --fingers 3`, without the file: points drawn on the built-in mug's surface.
# We pick row 185, which falls short by little, and draw the motion by which the mug gets away: grey before, yellow
# after.
#
# Marginal grasps are no accident of rounding here: two fingers hold each other, the third cannot press, and the
# margin is exactly 0.

# %%
mug = make_object("mug")
position, inward = SurfaceSampler(mug, fingers=3, seed=0).rows(0, 2000)
on_mug = jg.Grasp(position - mug.center_mass, inward, jg.HardFinger(friction=0.5))
screened = jg.wrench_resistance(on_mug)
print(screened)
assert jg.check(on_mug, screened).all()

escaping = plots.verdict_of(on_mug[185], screened[185], mug.center_mass)
print(explain(escaping))
assert escaping.status is jg.Status.NOT_RESISTANT
display(Image(plots.grasp_picture(escaping, mug), width=560))

# %% [markdown]
# How much friction would it take? One call answers for a whole range of $\mu$. The margin never falls as friction
# grows, and the verdict changes where it passes zero.

# %%
mu = np.linspace(0, 1.5, 151)
swept = jg.quality.friction_sweep(on_mug[185], mu / 0.5)
assert (np.diff(swept.margin) > -1e-7).all()
figure = plots.margin_by_friction(mu, swept)
