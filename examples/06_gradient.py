"""How should the fingers move so that the grasp gets better? Uphill along the gradient of the margin, on a ball."""

import jax

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32


def grasp_at(directions):
    outward = directions / jax.numpy.linalg.norm(directions, axis=-1, keepdims=True)
    return jg.Grasp(0.04 * outward, -outward, jg.HardFinger(friction=0.5))


@jax.jit
def step(directions):
    margin, slope = jax.value_and_grad(lambda d: jg.wrench_resistance(grasp_at(d)).margin)(directions)
    moved = directions + 0.05 * slope / jax.numpy.linalg.norm(slope)
    return moved / jax.numpy.linalg.norm(moved, axis=-1, keepdims=True), margin


directions = jax.numpy.array([[1.0, 0.2, 0.1], [-0.4, 0.9, 0.2], [0.3, 0.6, -0.8]])
margins = []
for _ in range(31):
    directions, margin = step(directions)
    margins.append(margin)
for i in (0, 10, 20, 30):
    print(f"step {i:2d}: margin {margins[i]:7.4f}")
print("holds now:", bool(jg.wrench_resistance(grasp_at(directions)).status == jg.Status.RESISTANT))

# prints:
# step  0: margin -0.7162
# step 10: margin  0.1721
# step 20: margin  0.7011
# step 30: margin  0.9010
# holds now: True
