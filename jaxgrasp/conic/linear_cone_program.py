"""The cone program with a linear cost: data, and the residuals that define its solution.

    minimise    c_0 + <c, u>   subject to   B u = b,  u in K            (primal)
    maximise    c_0 + <b, y>   subject to   z = c - B^T y in K          (dual)

K is a product of k second-order cones of dimension d. A solution makes ``optimality`` vanish.
"""

from __future__ import annotations

from typing import NamedTuple

from ..core import Array
from .cone import Cone, cone_sum, inner, jordan_product
from .products import matvec, rmatvec

__all__ = ["LinearConeProgram"]


class LinearConeProgram(NamedTuple):
    """One tile of cone programs, lanes on the last axis.

    columns  d arrays (m, k, L): B, split by cone component
    rhs      (m, L): b
    cost     d arrays (k, L): c
    exists   (k, L) of zeros and ones: cones that are padding take no part
    constant c_0, a number
    """

    columns: Cone
    rhs: Array
    cost: Cone
    exists: Array
    constant: float = 0.0

    def primal_value(self, u: Cone) -> Array:
        """``c_0 + <c, u>``."""
        return self.constant + cone_sum(inner(self.cost, u))

    def dual_value(self, y: Array) -> Array:
        """``c_0 + <b, y>``."""
        total = self.constant + self.rhs[0] * y[0]
        for i in range(1, y.shape[0]):
            total = total + self.rhs[i] * y[i]
        return total

    def slack(self, y: Array) -> Cone:
        """``z = c - B^T y``."""
        return tuple(c - v for c, v in zip(self.cost, rmatvec(self.columns, y), strict=True))

    def residual(self, u: Cone) -> Array:
        """``b - B u``."""
        return self.rhs - matvec(self.columns, u)

    def optimality(self, y: Array, u: Cone) -> tuple[Array, Cone]:
        """``(b - B u, u o z)``: zero exactly at a primal-dual solution with u and z in K."""
        return self.residual(u), jordan_product(u, self.slack(y))
