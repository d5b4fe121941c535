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
# # Moving contacts until the grasp is good
#
# A random grasp of an object seldom holds. The margin of wrench resistance has a gradient with respect to the
# contacts, even where the grasp does not hold: following it over the surface makes a grasp better. This notebook does
# that for three fingers on an ellipsoid, draws their way, and says how good the grasp became.
#
# Lengths are in m.

# %%
import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg
from jaxgrasp import surfaces
from jaxgrasp.placement import Apart, Search, place_contacts
from jaxgrasp.report import plots

jax.config.update("jax_enable_x64", True)  # without it JAX computes in float32

# %% [markdown]
# ## The surface
#
# An ellipsoid; `surfaces.of("mug")` or a mesh file would do as well. `contact` gives the nearest point of the surface
# and the inward normal there; both are differentiable.

# %%
surface = surfaces.Ellipsoid(jnp.array([0.03, 0.04, 0.06]))
friction = 0.4
model = jg.HardFinger(friction)


def grasp_at(points):
    position, normal = surface.contact(points)
    return jg.Grasp(position - surface.centre, normal, model)


# %% [markdown]
# ## One way uphill
#
# Twelve random starts. Each step moves the contacts along the gradient of the margin and back onto the surface.

# %%
start, _ = surface.sample(3, 12 * 3)
points = jnp.asarray(start).reshape(12, 3, 3)


@jax.jit
def step(points):
    def total(points):
        return jnp.sum(jnp.maximum(jg.wrench_resistance(grasp_at(points)).margin, -10.0))

    slope = jax.grad(total)(points)
    size = jnp.linalg.norm(slope, axis=(1, 2), keepdims=True)
    return surface.project(points + 0.002 * slope / jnp.maximum(size, 1e-9))


ways = [points]
for _ in range(40):
    ways.append(step(ways[-1]))
ways = np.asarray(jnp.stack(ways))  # (41, 12, 3, 3)
margins = np.stack([np.asarray(jg.wrench_resistance(grasp_at(jnp.asarray(w))).margin) for w in ways[::5]])
figure = plots.climb(np.arange(0, 41, 5), margins)
assert (margins[-1] > 0).mean() > (margins[0] > 0).mean()

# %% [markdown]
# The way of the start that gained most, drawn on the surface: from the open circles to the filled ones.

# %%
gain = np.argmax(margins[-1] - np.maximum(margins[0], -1.5))
print(f"margin {margins[0, gain]:.2f} -> {margins[-1, gain]:.2f}")
figure = plots.way_on_an_ellipsoid((0.03, 0.04, 0.06), ways[:, gain])

# %% [markdown]
# ## Many starts at once
#
# `place_contacts` does the same with an optimiser from optax, requirements, early stops, and returns the best
# distinct grasps, each solved again and proved by the independent checker.

# %%
placed = place_contacts(
    surface, fingers=3, model=model, requirements=[Apart(0.02)], search=Search(64, steps=100)
)
print(
    f"resistant: {np.mean(placed.before > 0):.0%} of the starts, {np.mean(placed.resistant):.0%} of the ends"
)
print(f"median margin: {np.median(placed.before):.3f} -> {np.median(placed.after):.3f}")
assert placed.proved.all()
assert np.mean(placed.resistant) > 0.9

# %% [markdown]
# ## How good did it become?
#
# The Ferrari-Canny quality between its two proven bounds, the friction it needs, and how far contacts may be off.

# %%
radius = float(surface.radius)
origin = grasp_at(points)
for name, grasp in (("random", origin), ("placed", placed.grasp)):
    quality = jg.epsilon_quality(grasp, torque_scale=radius)
    print(
        f"{name}: epsilon {np.max(np.asarray(quality.lower)):.4f} to {np.max(np.asarray(quality.upper)):.4f} at best, "
        f"median {np.median(np.asarray(quality.upper)):.4f}"
    )

best = placed.grasp[:1]
quality = jg.epsilon_quality(best, torque_scale=radius, certificate=True)
assert jg.check(best, quality).all()
print("proved:", float(quality.lower[0]), "<= epsilon <=", float(quality.upper[0]))
print("holds down to", float(jg.critical_friction(best).factor[0]) * friction, "of friction")
print("contacts may be off by", 1e3 * float(jg.guaranteed_radius(best).radius[0]) * radius, "mm")
