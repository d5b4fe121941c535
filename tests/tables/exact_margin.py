"""The margin t* of a grasp between two numbers, in 70 decimal digits, from any forces and twist: weak duality alone.

    lower   forces s, corrected to A s = 0: k min_i (s_0,i - |s_t,i|) / sum s_0,i
    upper   a twist xi with x_i = A_i^T xi, d = min_i x_0,i - |x_t,i|, T = sum x_0,i > 0: -k d / (T - k d)

Shares no code with jaxgrasp: own map, own arithmetic (``decimal``). Lengths over the largest |p_i|.
"""

from __future__ import annotations

import decimal
from decimal import Decimal

import numpy as np

__all__ = ["DIGITS", "ExactMap", "exact", "norm"]

DIGITS = 70
NOTHING = Decimal("Infinity")


def exact(array) -> np.ndarray:
    """The numbers as they are, as decimals."""
    return np.array([Decimal(float(x)) for x in np.ravel(array)], object).reshape(np.shape(array))


def _root(x: Decimal) -> Decimal:
    return x.sqrt()


def norm(v) -> Decimal:
    return _root(sum((x * x for x in v), Decimal(0)))


def _cross(a, b) -> list[Decimal]:
    if len(a) == 2:
        return [a[0] * b[1] - a[1] * b[0]]
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


class ExactMap:
    """The folded map of one grasp, contacts that count only: positions and normals (k, d), mu and gamma (k,).

    components  the names of the force components, in the order of the answer's forces
    """

    def __init__(self, position, normal, friction, torsion, components):
        self.components, self.dimension = components, np.shape(position)[1]
        with decimal.localcontext() as context:
            context.prec = DIGITS
            p, n = exact(position), exact(normal)
            self.mu, self.gamma = exact(friction), exact(torsion)
            self.length = max((norm(row) for row in p), default=Decimal(1)) or Decimal(1)
            self.blocks = [
                self._block(*contact) for contact in zip(p / self.length, n, self.mu, self.gamma, strict=True)
            ]
            self.A = np.concatenate(self.blocks, 1)
            self.inverse = self._inverse(self.A @ self.A.T)

    def _block(self, p, n, mu, gamma) -> np.ndarray:
        """(m, n), components in the order of the answer."""
        n = [x / norm(n) for x in n]
        zero = [Decimal(0)] * len(n)
        if len(n) == 2:
            tangents = {"f_x": [n[1], -n[0]]}
        else:
            x, y, z = n
            sign = Decimal(1) if z >= 0 else Decimal(-1)
            a = -1 / (sign + z)
            b = x * y * a
            tangents = {"f_x": [1 + sign * x * x * a, sign * b, -sign * x], "f_y": [b, sign + y * y * a, -y]}
        columns = []
        for name in self.components:
            if name == "f_n":
                columns.append(n + _cross(p, n))
            elif name == "tau_n":
                columns.append(zero + [gamma / self.length * v for v in n])
            else:
                t = tangents[name]
                columns.append([mu * v for v in t + _cross(p, t)])
        return np.array(columns, object).T

    @staticmethod
    def _inverse(gram: np.ndarray) -> np.ndarray | None:
        """None where the rank is not full, to 1e-20."""
        m = len(gram)
        rows = np.concatenate([gram, exact(np.eye(m))], 1)
        size = max(gram[i, i] for i in range(m))
        for i in range(m):
            pivot = max(range(i, m), key=lambda r: abs(rows[r, i]))
            if abs(rows[pivot, i]) <= size * Decimal("1e-20"):
                return None
            rows[[i, pivot]] = rows[[pivot, i]]
            rows[i] = rows[i] / rows[i, i]
            for r in range(m):
                if r != i:
                    rows[r] = rows[r] - rows[r, i] * rows[i]
        return rows[:, m:]

    @property
    def full_rank(self) -> bool:
        return self.inverse is not None

    def scaled(self, force) -> np.ndarray | None:
        """Forces (k, n) over mu and gamma; None where a component is asked for that does not exist."""
        scales = {"f_n": np.full(len(self.mu), Decimal(1)), "tau_n": self.gamma}
        s = exact(force)
        for j, name in enumerate(self.components):
            scale = scales.get(name, self.mu)
            if any(x and not c for x, c in zip(s[:, j], scale, strict=True)):
                return None
            s[:, j] = [x / c if x else x for x, c in zip(s[:, j], scale, strict=True)]
        return s

    def balanced(self, s: np.ndarray, load: np.ndarray | int = 0) -> np.ndarray:
        """The nearest s (k, n) with ``A s + load = 0``, where the rank is full."""
        flat = s.ravel()
        for _ in range(2):
            flat = flat - self.A.T @ (self.inverse @ (self.A @ flat + load))
        return flat.reshape(s.shape)

    def depths(self, s: np.ndarray) -> list[Decimal]:
        """s_0,i - |s_t,i| of each contact."""
        head = self.components.index("f_n")
        return [row[head] - norm(np.delete(row, head)) for row in s]

    def lower(self, force) -> Decimal:
        """t* is at least this, by forces (k, n) in the answer's components and order; -inf where they show nothing."""
        if not (np.isfinite(force).all() and self.full_rank):
            return -NOTHING
        with decimal.localcontext() as context:
            context.prec = DIGITS
            s = self.scaled(force)
            largest = Decimal(0) if s is None else max(abs(x) for x in s.ravel())
            if s is None or not largest:
                return -NOTHING
            s = self.balanced(s / largest)
            total = sum(s[:, self.components.index("f_n")], Decimal(0))
            if total <= Decimal("1e-30"):
                return -NOTHING
            return len(s) * min(self.depths(s)) / total

    def _velocities(self, twist) -> tuple[Decimal, Decimal, Decimal] | None:
        """d, T and |xi| of a twist (m,), lengths over the largest |p_i|; None where it is none."""
        if not np.isfinite(twist).all() or not np.any(twist):
            return None
        xi = exact(twist)
        xi[self.dimension :] = xi[self.dimension :] * self.length
        xi = xi / max(abs(x) for x in xi)
        head, depth, total = self.components.index("f_n"), NOTHING, Decimal(0)
        for block in self.blocks:
            x = block.T @ xi
            depth = min(depth, x[head] - norm(np.delete(x, head)))
            total += x[head]
        return depth, total, norm(xi)

    def upper(self, twist) -> Decimal:
        """t* is at most this, by a twist (m,); 1 where it shows nothing (it is never more)."""
        with decimal.localcontext() as context:
            context.prec = DIGITS
            found = self._velocities(twist)
            if found is None:
                return Decimal(1)
            depth, total, _ = found
            least = len(self.blocks) * depth
            if total <= 0:
                return Decimal(1)
            if total - least <= total * Decimal("1e-50"):  # it moves all contacts alike: nothing balances
                return -NOTHING
            return min(-least / (total - least), Decimal(1))

    def escape_depth(self, twist) -> Decimal:
        """min_i x_0,i - |x_t,i| over |xi|: negative where some contact opposes the twist; -inf for none."""
        with decimal.localcontext() as context:
            context.prec = DIGITS
            found = self._velocities(twist)
            return -NOTHING if found is None else found[0] / found[2]
