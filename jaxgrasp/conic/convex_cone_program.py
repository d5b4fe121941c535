"""The cone program with a convex cost: cones, a level, limits, fixed barriers.

    minimise    <c, u_0> + <u, D u> / 2 + g xi - sum_i (phi_i / 2 log det u_i + psi_i log u_0,i)
    subject to  B u = b,  u in K,  u_0,i <= xi,  u_0,i <= cap_i,  |E u| <= bound

K is a product of k second-order cones. Every term but the first two constraints is optional; what is absent is None
and costs nothing. With multipliers y of ``B u - b``, z of the cones and a price for every scalar inequality, a point is
optimal where ``stationarity`` gives its z and every product of a slack and its price is 0 (or its floor phi_i, psi_i).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from ..core import Array
from .cone import Cone, cone_sum, inner
from .products import matvec, rmatvec

# An array, or None where a program has no such part. A checker of types would ask for the same case distinction in
# every formula, so it is told nothing.
OptionalArray = Any

__all__ = ["Bounds", "ConvexConeProgram", "ConvexPoint", "Curvature", "OptionalArray", "map_bounds"]


class Curvature(NamedTuple):
    """D = diag(head, tail, .., tail, last) per cone, (k, L) each; ``last`` None: like the other tails."""

    head: Array
    tail: Array
    last: OptionalArray

    def apply(self, u: Cone) -> Cone:
        """``D u``."""
        end = len(u) - 1
        tails = [self.tail if self.last is None or j < end else self.last for j in range(1, end + 1)]
        return (self.head * u[0], *(c * x for c, x in zip(tails, u[1:], strict=True)))


class Bounds(NamedTuple):
    """One entry for each family of scalar inequalities; None where the program has no such family.

    level  (k, L): xi - u_0,i >= 0      cap           (k, L): cap_i - u_0,i >= 0
    head   (k, L): u_0,i >= 0           upper, lower  (q, L): bound - E u >= 0, bound + E u >= 0
    """

    level: OptionalArray
    cap: OptionalArray
    head: OptionalArray
    upper: OptionalArray
    lower: OptionalArray

    def net(self) -> Array | float:
        """What prices add to the gradient in u_0: level + cap - head."""
        total: Array | float = 0.0
        if self.level is not None:
            total = self.level
        if self.cap is not None:
            total = total + self.cap
        return total if self.head is None else total - self.head

    def sum_on_head(self) -> OptionalArray:
        """level + cap + head, of rates: how prices on u_0 answer to u_0; None where there are none."""
        present = [x for x in (self.level, self.cap, self.head) if x is not None]
        total = present[0] if present else None
        for x in present[1:]:
            total = total + x
        return total


def map_bounds(function: Callable, *bounds: Bounds) -> Bounds:
    """``function`` on the families that exist."""
    return Bounds(*(None if parts[0] is None else function(*parts) for parts in zip(*bounds, strict=True)))


class ConvexPoint(NamedTuple):
    """A primal-dual point strictly inside every inequality; y (m, L), xi (L,), u and z d arrays (k, L)."""

    y: Array
    xi: OptionalArray
    u: Cone
    z: Cone
    slack: Bounds
    price: Bounds

    def rows(self) -> Array:
        """Multipliers of all rows of (B; E): y, and upper less lower prices."""
        if self.price.upper is None or self.price.lower is None:
            return self.y
        return jnp.concatenate([self.y, self.price.upper - self.price.lower])


class ConvexConeProgram(NamedTuple):
    """One tile of programs, lanes on the last axis; k cones of dimension d, m equations, q two-sided rows.

    columns     d arrays (m + q, k, L): B over E
    rhs         (m, L): b                  exists     (k, L) of zeros and ones
    price       (k, L): c, or None         curvature  D, or None
    level       (L,): g, or None           cap        (k, L), infinite where there is none, or None
    bound       (q, L), or None
    cone_floor  (k, L): phi, or None       head_floor (k, L): psi, or None (both or neither)
    smoothing   (L,): a floor under every product, or None; the solution is then a point of the central path
    """

    columns: Cone
    rhs: Array
    exists: Array
    price: OptionalArray
    curvature: Curvature | None
    level: OptionalArray
    cap: OptionalArray
    bound: OptionalArray
    cone_floor: OptionalArray
    head_floor: OptionalArray
    smoothing: OptionalArray = None

    def masks(self) -> Bounds:
        """Ones where an inequality exists."""
        cap = None
        if self.cap is not None:
            cap = jnp.where(jnp.isfinite(self.cap), self.exists, jnp.zeros_like(self.exists))
        head = None if self.head_floor is None else self.exists
        rows = None if self.bound is None else jnp.ones_like(self.bound)
        return Bounds(None if self.level is None else self.exists, cap, head, rows, rows)

    def floors(self) -> Bounds:
        """What each slack times its price aims at."""
        masks = self.masks()
        base = map_bounds(jnp.zeros_like, masks)
        if self.head_floor is not None:
            base = base._replace(head=self.head_floor)
        if self.smoothing is None:
            return base
        return map_bounds(lambda floor: floor + self.smoothing, base)

    def cone_target(self) -> OptionalArray:
        """What <u_i, z_i> aims at, or None for 0."""
        if self.smoothing is None:
            return self.cone_floor
        return self.exists * self.smoothing if self.cone_floor is None else self.cone_floor + self.smoothing

    def products(self, u: Cone) -> tuple[Array, Any]:
        """``B u`` and ``E u``."""
        applied, m = matvec(self.columns, u), self.rhs.shape[0]
        return applied[:m], None if self.bound is None else applied[m:]

    def bound_residuals(self, u: Cone, product: OptionalArray, slack: Bounds) -> Bounds:
        """What the slacks still lack: ``cap - u_0 - slack``, ``bound -+ E u - slack``; 0 elsewhere."""
        masks = self.masks()
        zero = map_bounds(jnp.zeros_like, masks)
        if self.cap is not None and masks.cap is not None:
            cap = jnp.where(masks.cap > 0, self.cap, jnp.zeros_like(self.cap))
            zero = zero._replace(cap=masks.cap * (cap - u[0] - slack.cap))
        if self.bound is not None and product is not None:
            zero = zero._replace(
                upper=self.bound - product - slack.upper, lower=self.bound + product - slack.lower
            )
        return zero

    def slack_changes(self, masks: Bounds, missing: Bounds, du: Cone, dxi: OptionalArray) -> Bounds:
        """Changes of the slacks that remove ``missing`` while u moves by du and the level by dxi."""
        slack = missing
        if slack.level is not None and masks.level is not None:
            slack = slack._replace(level=masks.level * (dxi - du[0]))
        if slack.cap is not None:
            slack = slack._replace(cap=slack.cap - masks.cap * du[0])
        if slack.head is not None:
            slack = slack._replace(head=du[0])
        if slack.upper is not None:
            _, product = self.products(du)
            slack = slack._replace(upper=slack.upper - product, lower=slack.lower + product)
        return slack

    def rates(self, masks: Bounds, point: ConvexPoint) -> Bounds:
        """``price / slack`` of every inequality: its share of the Newton matrix."""
        return map_bounds(lambda m, s, p: m * p / s, masks, point.slack, point.price)

    def gradient(self, u: Cone, rows: Array, head: Array | float) -> Cone:
        """``D u + B^T y + E^T beta + head e_0`` with ``rows`` = (y; beta)."""
        total = rmatvec(self.columns, rows)
        total = (total[0] + head, *total[1:])
        if self.curvature is not None:
            total = tuple(a + b for a, b in zip(total, self.curvature.apply(u), strict=True))
        return total

    def stationarity(self, point: ConvexPoint) -> Cone:
        """What z must be: the gradient of the Lagrangian without its cone term."""
        masks = self.masks()
        price = map_bounds(jnp.multiply, masks, point.price)
        head = price.net() if self.price is None else self.price + price.net()
        return self.gradient(point.u, point.rows(), head)

    def size(self, point: ConvexPoint) -> Array:
        """(L,) the objective without its barriers, which is positive: what gaps are relative to."""
        total = jnp.zeros_like(self.exists[0])
        if self.price is not None:
            total = total + cone_sum(self.price * point.u[0])
        if self.curvature is not None:
            total = total + cone_sum(self.exists * inner(point.u, self.curvature.apply(point.u))) / 2
        if self.level is not None:
            total = total + self.level * point.xi
        return total
