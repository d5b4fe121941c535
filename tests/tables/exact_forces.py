"""The cost of optimal forces between two numbers, in 70 decimal digits, from any forces and twist: weak duality alone.

    above   forces s, corrected to A s + w = 0 and led into all cones along an internal force t that lies inside them
    below   a twist y, x_i = A_i^T y, rho_i = (|x_t,i| - x_0,i)+: y.w / max rho (smallest sum), y.w / sum rho (gentlest)

Shares no code with jaxgrasp, as ``exact_margin``, whose map it uses.
"""

from __future__ import annotations

import decimal
from decimal import Decimal

import numpy as np
from exact_margin import DIGITS, ExactMap, exact, norm

__all__ = ["ExactForces"]

NOTHING = Decimal("Infinity")


class ExactForces:
    """One grasp and its load (m,); criterion "gentlest" or "smallest sum", without limits."""

    def __init__(self, grasp: ExactMap, wrench, criterion: str):
        self.grasp, self.criterion = grasp, criterion
        self.head = grasp.components.index("f_n")
        with decimal.localcontext() as context:
            context.prec = DIGITS
            self.load = exact(wrench)
            self.load[grasp.dimension :] = self.load[grasp.dimension :] / grasp.length

    def above(self, force, internal) -> Decimal:
        """The optimum costs at most this, by forces (k, n) near it; infinite where they show nothing."""
        if not (np.isfinite(force).all() and np.isfinite(internal).all() and self.grasp.full_rank):
            return NOTHING
        with decimal.localcontext() as context:
            context.prec = DIGITS
            s, inner = self.grasp.scaled(force), self.grasp.scaled(internal)
            if s is None or inner is None:
                return NOTHING
            s, inner = self.grasp.balanced(s, self.load), self.grasp.balanced(inner)
            missing, room = self.grasp.depths(s), self.grasp.depths(inner)
            if min(missing) < 0:
                if min(room) <= 0:
                    return NOTHING
                share = max(max(-x, Decimal(0)) / r for x, r in zip(missing, room, strict=True))
                s = s + share * (1 + Decimal("1e-40")) * inner
                if min(self.grasp.depths(s)) < 0:
                    return NOTHING
            heads = [row[self.head] for row in s]
            return max(heads) if self.criterion == "gentlest" else sum(heads, Decimal(0))

    def below(self, twist) -> Decimal:
        """No admissible forces cost less than this, by a twist (m,); infinite where it shows that there are none."""
        if not np.isfinite(twist).all():
            return Decimal(0)
        with decimal.localcontext() as context:
            context.prec = DIGITS
            y = exact(twist)
            y[self.grasp.dimension :] = y[self.grasp.dimension :] * self.grasp.length
            gain = sum(y * self.load, Decimal(0))
            rho = []
            for block in self.grasp.blocks:
                x = block.T @ y
                rho.append(max(norm(np.delete(x, self.head)) - x[self.head], Decimal(0)))
            if gain <= 0:
                return Decimal(0)
            price = sum(rho, Decimal(0)) if self.criterion == "gentlest" else max(rho)
            return gain / price if price else NOTHING
