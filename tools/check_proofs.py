"""Checks proofs of grasps that ``jaxgrasp prove`` wrote, with the standard library of Python and exact arithmetic.

    python check_proofs.py proofs.jsonl

A line is the proof of one grasp, JSON. Its numbers are hexadecimal floats ("0x1.8p-4"); where a number needs more than
53 bits it is a list of floats, whose exact sum is meant. Everything is then a fraction, and nothing is rounded:

    position p_i, normal n_i (any length), friction mu_i, torsion gamma_i   contact i of a rigid body, about its centre of mass
    force F_i, spin s_i     a contact force, and a torque s_i n_i about the normal
    twist (v; w)            a motion of the body: contact i moves at u_i = v + w x p_i

A contact can only push, with tangential forces up to friction: F . n > 0 and, with f_n = F . n / |n|,

    |f_t|^2 / mu^2 + |s n|^2 / gamma^2 <= f_n^2                                               (1)

RESISTANT      sum F_i = 0 and sum p_i x F_i + s_i n_i = 0, (1) holds strictly at every contact, and the contact forces
               span all six directions of force and torque (three in the plane): then every load can be held.
NOT_RESISTANT  at every contact u . n >= 0 and (u . n)^2 >= mu^2 |u_t|^2 |n|^2 + gamma^2 (w . n)^2: no admissible force
               does negative work on the twist, so no load that does positive work can be held. "to rounding": not these
               numbers but some within ``within`` of them (of the largest |p_i|; of 1 for mu; in radians for normals).
MARGINAL       the margin t* is within [lower, upper], both near 0
margin         [lower, upper] around t* = max t with f_n,i - |tangential, scaled as in (1)| >= t for balanced forces of
               mean normal force 1. The forces show t* >= lower; ``bound_twist`` shows t* <= upper, as
               upper T + (1 - upper) k (x_i - y_i) >= 0 with x_i = u_i . n_i / |n_i|, y_i = |(mu u_t, gamma w_n)|,
               T = sum x_i > 0. Square roots are enclosed between fractions. null: nothing is claimed.
"""

import json
import math
import re
import sys
from fractions import Fraction as Q

LONGEST_LINE, MOST_CONTACTS, MOST_PARTS = 1_000_000, 1000, 100
NUMBER = re.compile(r"-?0x[01](\.[0-9a-f]{1,13})?p[+-][0-9]{1,4}")
DIGITS = 60


class Refused(Exception):
    pass


def require(holds, why):
    if not holds:
        raise Refused(why)


def number(value):
    """The exact value of a hexadecimal float, or of a list of them."""
    parts = value if isinstance(value, list) else [value]
    require(len(parts) <= MOST_PARTS, "a number of too many parts")
    total = Q(0)
    for part in parts:
        require(isinstance(part, str) and NUMBER.fullmatch(part), f"no hexadecimal float: {str(part)[:40]!r}")
        x = float.fromhex(part)
        require(math.isfinite(x), "a number that is not finite")
        total += Q(x)
    return total


def numbers(values, count, what):
    require(isinstance(values, list) and len(values) == count, f"{what}: {count} entries are wanted")
    return [number(x) for x in values]


def vectors(values, count, size, what):
    require(isinstance(values, list) and len(values) == count, f"{what}: {count} vectors are wanted")
    return [numbers(x, size, what) for x in values]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def root(x, up):
    """sqrt(x) rounded down, or up, to about DIGITS digits."""
    if x == 0:
        return Q(0)
    shift = max(0, 4 * DIGITS - x.numerator.bit_length() + x.denominator.bit_length())
    whole = (x.numerator << 2 * shift) // x.denominator
    return Q(math.isqrt(whole) + (1 if up else 0), 1 << shift)


def rank(rows):
    rows, found = [list(r) for r in rows], 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(found, len(rows)) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[found], rows[pivot] = rows[pivot], rows[found]
        for i in range(found + 1, len(rows)):
            factor = rows[i][column] / rows[found][column]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[found])]
        found += 1
    return found


class Grasp:
    """The contacts of a line, as fractions; planar ones lie in the plane z = 0."""

    def __init__(self, line):
        self.dimension = d = line.get("dimension")
        require(d in (2, 3), "dimension: 2 or 3")
        require(isinstance(line.get("position"), list), "position is missing")
        self.k = k = len(line["position"])
        require(1 <= k <= MOST_CONTACTS, "1 to 1000 contacts")
        flat = [Q(0)] * (3 - d)
        self.p = [x + flat for x in vectors(line["position"], k, d, "position")]
        self.n = [x + flat for x in vectors(line.get("normal"), k, d, "normal")]
        self.mu, self.gamma = (numbers(line.get(name), k, name) for name in ("friction", "torsion"))
        require(all(any(n) for n in self.n), "a normal of length 0")
        require(min(*self.mu, *self.gamma) >= 0, "negative friction")

    def columns(self):
        """Wrenches of all that the contacts can press, rub and twist with, either way."""
        for p, n, mu, gamma in zip(self.p, self.n, self.mu, self.gamma):
            axes = [[Q(i == j) for j in range(3)] for i in range(self.dimension)] if mu else [n]
            yield from (a + cross(p, a) for a in axes)
            if gamma:
                yield [Q(0)] * 3 + n

    def forces(self, line):
        d, flat = self.dimension, [Q(0)] * (3 - self.dimension)
        force = [x + flat for x in vectors(line.get("force"), self.k, d, "force")]
        spin = numbers(line.get("spin"), self.k, "spin")
        total = [Q(0)] * 6
        for p, n, f, s in zip(self.p, self.n, force, spin):
            moment = [a + s * b for a, b in zip(cross(p, f), n)]
            total = [a + b for a, b in zip(total, f + moment)]
        require(not any(total), "the forces do not balance")
        return force, spin

    def cone(self, i, f, s):
        """F . n and |n| times the left side's root of (1), both squared below; None for a force that cannot be."""
        n, nn, mu, gamma = self.n[i], dot(self.n[i], self.n[i]), self.mu[i], self.gamma[i]
        h = dot(f, n)
        rub = dot(f, f) * nn - h * h
        require((mu or not rub) and (gamma or not s), "a force that the contact cannot have")
        return h, (rub / mu**2 if rub else 0) + ((s * nn / gamma) ** 2 if s else 0), nn

    def twist(self, line, name):
        d = self.dimension
        values = numbers(line.get(name), 6 if d == 3 else 3, name)
        require(any(values), f"{name} is no motion")
        return (values[:3], values[3:]) if d == 3 else ([*values[:2], Q(0)], [Q(0), Q(0), values[2]])

    def motion(self, i, twist):
        """u . n, |u_t|^2 |n|^2, w . n, |u|^2, |n|^2 of contact i."""
        v, w = twist
        n, u = self.n[i], [a + b for a, b in zip(v, cross(w, self.p[i]))]
        h, uu, nn = dot(u, n), dot(u, u), dot(n, n)
        return h, uu * nn - h * h, dot(w, n), uu, nn


def check_resistant(grasp, line):
    for i, (f, s) in enumerate(zip(*grasp.forces(line))):
        h, square, _ = grasp.cone(i, f, s)
        require(h > 0 and square < h * h, f"contact {i}: the force is not inside the cone")
    require(
        rank(grasp.columns()) == (6 if grasp.dimension == 3 else 3), "the contacts do not span all wrenches"
    )


def check_escape(grasp, line):
    twist, within = grasp.twist(line, "twist"), Q(0)
    if line.get("proof") == "to rounding":
        within = number(line.get("within"))
        require(0 <= within < Q(1, 10**4), "within is no rounding")
    length = max(dot(p, p) for p in grasp.p) or 1
    for i in range(grasp.k):
        h, slide, about, uu, nn = grasp.motion(i, twist)
        mu, gamma, ww = grasp.mu[i], grasp.gamma[i], dot(twist[1], twist[1])
        if h >= 0 and h * h >= mu**2 * slide + (gamma * about) ** 2:
            continue
        # Numbers nearby, each within ``within``: sin(a) >= a / 1.6 up to a right angle.
        turned = (about * Q(8, 5)) ** 2 <= within**2 * ww * nn or gamma**2 <= within**2 * length
        moved = dot(*twist) == 0 and uu <= within**2 * length * ww and turned and ww > 0
        less = max(mu - within, Q(0))
        slides = h >= 0 and h * h >= less**2 * slide and gamma**2 <= within**2 * length
        smooth = (h * Q(8, 5)) ** 2 <= within**2 * uu * nn and mu <= within and gamma**2 <= within**2 * length
        require(within and (moved or slides or smooth), f"contact {i} can oppose the twist")


def enclosed(cones):
    """Of (h, y^2, |n|^2): h / |n| between two fractions, and y / |n| rounded up."""
    heads, tails = [], []
    for h, square, nn in cones:
        low, high = root(h * h / nn, False), root(h * h / nn, True)
        heads.append((low, high) if h >= 0 else (-high, -low))
        tails.append(root(square / nn, True))
    return heads, tails


def check_margin(grasp, line):
    ends = line.get("margin", [None, None])
    require(isinstance(ends, list) and len(ends) == 2, "margin: two numbers or null")
    lower, upper = (None if x is None else number(x) for x in ends)
    if lower is not None:
        cones = (grasp.cone(i, f, s) for i, (f, s) in enumerate(zip(*grasp.forces(line))))
        heads, tails = enclosed(cones)
        total = [sum(x) for x in zip(*heads)]
        require(total[0] > 0, "the forces do not press")
        most = lower * total[1 if lower >= 0 else 0]
        require(
            all(grasp.k * (h[0] - t) >= most for h, t in zip(heads, tails)), "the forces do not show lower"
        )
    if upper is not None and upper < 1:
        twist, cones = grasp.twist(line, "bound_twist"), []
        for i, (mu, gamma) in enumerate(zip(grasp.mu, grasp.gamma)):
            h, slide, about, _, nn = grasp.motion(i, twist)
            cones.append((h, mu**2 * slide + (gamma * about) ** 2, nn))
        heads, tails = enclosed(cones)
        require(sum(h[0] for h in heads) > 0, "the bound twist shows nothing")
        total = sum(h[0 if upper >= 0 else 1] for h in heads)
        each = (upper * total + (1 - upper) * grasp.k * (h[0] - t) for h, t in zip(heads, tails))
        require(min(each) >= 0, "the bound twist does not show upper")
    return lower, upper


def check(text):
    """What the line proves, in a few words; Refused where it does not."""
    try:
        line = json.loads(text, parse_constant=lambda x: require(False, f"{x} is no number here"))
    except (ValueError, RecursionError):
        raise Refused("no JSON") from None
    require(isinstance(line, dict), "no JSON object")
    claim, grasp = line.get("claim"), Grasp(line)
    require(line.get("proof") in ("exactly", "to rounding"), "proof: exactly or to rounding")
    require(claim == "NOT_RESISTANT" or line["proof"] == "exactly", "only NOT_RESISTANT may hold to rounding")
    lower, upper = check_margin(grasp, line)
    if claim == "RESISTANT":
        check_resistant(grasp, line)
    elif claim == "NOT_RESISTANT":
        check_escape(grasp, line)
    else:
        require(
            claim == "MARGINAL" and None not in (lower, upper), "claim: RESISTANT, NOT_RESISTANT or MARGINAL"
        )
        require(max(abs(lower), abs(upper)) < Q(1, 1000), "the margin is not small")
        require(
            rank(grasp.columns()) == (6 if grasp.dimension == 3 else 3),
            "the contacts do not span all wrenches",
        )
    return f"{claim} {line['proof']}"


def lines_of(file):
    """The lines; of one that is too long its beginning, and no more is kept."""
    while line := file.readline(LONGEST_LINE + 1):
        rest = line
        while rest and not rest.endswith(b"\n"):
            rest = file.readline(LONGEST_LINE)
        yield line.decode("utf-8", "replace")


def main(paths):
    if len(paths) != 1:
        print(__doc__.split("\n\n")[1].strip())
        return 2
    counts, bad = {}, 0
    with open(paths[0], "rb") as file:
        for place, text in enumerate(lines_of(file), 1):
            try:
                require(len(text) <= LONGEST_LINE, f"longer than {LONGEST_LINE} characters")
                told = check(text)
                counts[told] = counts.get(told, 0) + 1
            except Refused as why:
                bad += 1
                print(f"line {place}: REFUSED: {why}")
    for told, count in sorted(counts.items()):
        print(f"{count:>10}  {told}")
    print(f"{bad:>10}  REFUSED")
    return 1 if bad or not counts else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
