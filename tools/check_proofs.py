"""Checks proofs of grasps that ``jaxgrasp prove`` wrote: Python's standard library, exact arithmetic.

    python check_proofs.py proofs.jsonl

A line is the proof of one grasp, JSON. Its numbers are hexadecimal floats ("0x1.8p-4"); a number of more bits is a list
of floats whose exact sum is meant. All of them become fractions, and nothing is rounded:

    position p_i, normal n_i (any length), friction mu_i, torsion gamma_i: contact i of a rigid body, about its centre
    force F_i, spin s_i: a contact force, and a torque s_i n_i about the normal; twist (v; w): u_i = v + w x p_i

A contact pushes, and rubs up to friction: F . n > 0 and, with f_n = F . n / |n|,

    |f_t|^2 / mu^2 + |s n|^2 / gamma^2 <= f_n^2                                               (1)

RESISTANT      sum F_i = 0 and sum p_i x F_i + s_i n_i = 0, (1) holds strictly at every contact, and the contact forces
               span all six directions of force and torque (three in the plane): then every load can be held.
NOT_RESISTANT  at every contact u . n >= 0 and (u . n)^2 >= mu^2 |u_t|^2 |n|^2 + gamma^2 (w . n)^2: no force does
               negative work on the twist, so no load that does positive work can be held. "to rounding": this is true
               of numbers within ``within`` of the given ones (positions and gamma over the largest |p_i|, mu, angles)
MARGINAL       the margin t* lies in [lower, upper], both near 0
margin         t* = max t with f_n,i - sqrt(left side of (1)) >= t for balanced forces of mean normal force 1. Forces
               show t* >= lower; ``bound_twist`` shows t* <= upper: upper T + (1 - upper) k (x_i - y_i) >= 0 with
               x_i = u_i . n_i / |n_i|, y_i = |(mu u_t, gamma w_n)|, T = sum x_i > 0. Roots lie between fractions.
"""

import json
import math
import os
import re
import sys
from fractions import Fraction as Q

LONGEST_LINE, MOST_CONTACTS, MOST_PARTS, DIGITS = 1_000_000, 1000, 100, 60
NUMBER = re.compile(r"-?0x[01](\.[0-9a-f]{1,13})?p[+-][0-9]{1,4}")


class Refused(Exception):
    pass


def require(holds, why):
    if not holds:
        raise Refused(why)


def number(value):
    """The exact value of a hexadecimal float, or of a list of them."""
    parts, total = value if isinstance(value, list) else [value], Q(0)
    require(len(parts) <= MOST_PARTS, "a number of too many parts")
    for part in (x if isinstance(x, str) else type(x).__name__ for x in parts):
        require(NUMBER.fullmatch(part), f"no hexadecimal float: {part[:40]!a}")
        exponent = int(part.split("p")[1])
        require(-1023 < exponent < 1024 and float.fromhex(part).hex() == part, f"{part} is no float64")
        total += Q(float.fromhex(part))
    return total


def numbers(values, count, what):
    require(isinstance(values, list) and len(values) == count, f"{what}: {count} numbers are wanted")
    return [number(x) for x in values]


def vectors(values, count, size, what):
    require(isinstance(values, list) and len(values) == count, f"{what}: {count} vectors are wanted")
    return [numbers(x, size, what) + [Q(0)] * (3 - size) for x in values]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def root(x, up):
    """sqrt(x) rounded down, or up, to about DIGITS digits."""
    shift = max(0, 4 * DIGITS - x.numerator.bit_length() + x.denominator.bit_length())
    whole = (x.numerator << 2 * shift) // x.denominator
    return Q(math.isqrt(whole) + (1 if up and x else 0), 1 << shift)


def rank(rows):
    rows, found = list(rows), 0
    for column in range(6):
        pivot = next((i for i in range(found, len(rows)) if rows[i][column]), None)
        if pivot is not None:
            rows[found], rows[pivot] = rows[pivot], rows[found]
            for i in range(found + 1, len(rows)):
                factor = rows[i][column] / rows[found][column]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[found])]
            found += 1
    return found


class Grasp:
    """The contacts of a line."""

    def __init__(self, line):
        self.d, position = line.get("dimension"), line.get("position")
        require(type(self.d) is int and self.d in (2, 3), "dimension: 2 or 3")
        require(isinstance(position, list), "positions are wanted")
        self.k = len(position)
        require(1 <= self.k <= MOST_CONTACTS, f"1 to {MOST_CONTACTS} contacts are read")
        self.p = vectors(position, self.k, self.d, "position")
        self.n = vectors(line.get("normal"), self.k, self.d, "normal")
        self.mu, self.gamma = (numbers(line.get(name), self.k, name) for name in ("friction", "torsion"))
        require(all(any(n) for n in self.n), "a normal of length 0")
        require(min(self.mu + self.gamma) >= 0, "negative friction")
        require(self.d == 3 or not any(self.gamma), "there is no torsion in the plane")

    def spans(self):
        rows = []
        for p, n, mu, gamma in zip(self.p, self.n, self.mu, self.gamma):
            axes = [[Q(i == j) for j in range(3)] for i in range(self.d)] if mu else [n]
            rows += [a + cross(p, a) for a in axes] + ([[Q(0)] * 3 + n] if gamma else [])
        return rank(rows) == (6 if self.d == 3 else 3)

    def cones(self, line):
        """(h, y^2, |n|^2) of each contact: h = F . n, and y = |n| times the root of the left side of (1)."""
        total, out = [Q(0)] * 6, []
        forces = vectors(line.get("force"), self.k, self.d, "force")
        spins = numbers(line.get("spin"), self.k, "spin")
        for p, n, mu, gamma, f, s in zip(self.p, self.n, self.mu, self.gamma, forces, spins):
            total = [a + b for a, b in zip(total, f + [a + s * b for a, b in zip(cross(p, f), n)])]
            h, nn = dot(f, n), dot(n, n)
            rub = dot(f, f) * nn - h * h
            require((mu or not rub) and (gamma or not s), "a force that the contact cannot have")
            out.append((h, (rub / mu**2 if rub else 0) + ((s * nn / gamma) ** 2 if s else 0), nn))
        require(not any(total), "the forces do not balance")
        return out

    def twist(self, line, name):
        values = numbers(line.get(name), 6 if self.d == 3 else 3, name)
        require(any(values), f"{name} is no motion")
        return (values[:3], values[3:]) if self.d == 3 else ([*values[:2], Q(0)], [Q(0), Q(0), values[2]])

    def motions(self, twist):
        """(u . n, |u_t|^2 |n|^2, w . n, |u|^2, |n|^2) of each contact."""
        for p, n in zip(self.p, self.n):
            u = [a + b for a, b in zip(twist[0], cross(twist[1], p))]
            h, uu, nn = dot(u, n), dot(u, u), dot(n, n)
            yield h, uu * nn - h * h, dot(twist[1], n), uu, nn


def check_resistant(grasp, line):
    for i, (h, square, _) in enumerate(grasp.cones(line)):
        require(h > 0 and square < h * h, f"contact {i}: the force is not inside the cone")
    require(grasp.spans(), "the contacts do not span all wrenches")


def check_escape(grasp, line):
    twist, within = grasp.twist(line, "twist"), Q(0)
    if line["proof"] == "to rounding":
        within = number(line.get("within"))
        require(0 < within <= Q(1, 2**17), "within is more than 64 eps of float32")
    ww, uw, length = dot(twist[1], twist[1]), dot(*twist), max(dot(p, p) for p in grasp.p) or 1
    for i, (mu, gamma, (h, slide, about, uu, nn)) in enumerate(zip(grasp.mu, grasp.gamma, grasp.motions(twist))):
        if h >= 0 and h * h >= mu**2 * slide + (gamma * about) ** 2:
            continue
        # Which numbers nearby give way: p moves to where u = 0 and n turns across w; or mu and gamma shrink; or n turns
        # across u, and mu and gamma vanish; or n turns across u and w, and mu vanishes. An angle a is <= 1.6 sin a.
        frail = gamma**2 <= within**2 * length
        turned = frail or (about * Q(8, 5)) ** 2 <= within**2 * ww * nn
        moved = ww > 0 and uw == 0 and uu <= within**2 * length * ww and turned
        slides = h >= 0 and h * h >= max(mu - within, Q(0)) ** 2 * slide and frail
        smooth = (h * Q(8, 5)) ** 2 <= within**2 * uu * nn and mu <= within and frail
        area, off = uu * ww - uw**2, h * h * ww + about**2 * uu - 2 * h * about * uw
        both = area > 0 and off * Q(64, 25) <= within**2 * nn * area and mu <= within
        require(within and (moved or slides or smooth or both), f"contact {i} can oppose the twist")


def enclosed(cones):
    """Of (h, y^2, |n|^2): h / |n| between two fractions, y / |n| rounded up."""
    heads, tails = [], []
    for h, square, nn in cones:
        low, high = root(h * h / nn, False), root(h * h / nn, True)
        heads.append((low, high) if h >= 0 else (-high, -low))
        tails.append(root(square / nn, True))
    return heads, tails


def check_margin(grasp, line):
    ends = line.get("margin")
    require(isinstance(ends, list) and len(ends) == 2, "margin: two numbers or null")
    lower, upper = (None if x is None else number(x) for x in ends)
    if lower is not None:
        heads, tails = enclosed(grasp.cones(line))
        total = [sum(x) for x in zip(*heads)]
        require(total[0] > 0, "the forces do not press")
        most = lower * total[lower >= 0]
        require(all(grasp.k * (h[0] - t) >= most for h, t in zip(heads, tails)), "the forces do not show lower")
    if upper is not None and upper < 1:
        cones = []
        for mu, gamma, motion in zip(grasp.mu, grasp.gamma, grasp.motions(grasp.twist(line, "bound_twist"))):
            h, slide, about, _, nn = motion
            cones.append((h, mu**2 * slide + (gamma * about) ** 2, nn))
        heads, tails = enclosed(cones)
        total = [sum(x) for x in zip(*heads)]
        least = min(h[0] - t for h, t in zip(heads, tails))
        shown = upper * total[upper < 0] + (1 - upper) * grasp.k * least >= 0
        require(total[0] > 0 and shown, "the bound twist does not show upper")
    return lower, upper


def check(text):
    """What the line proves, in a few words; Refused where it does not."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        raise Refused("no JSON") from None
    require(isinstance(line, dict), "no JSON object")
    claim, how, grasp = line.get("claim"), line.get("proof"), Grasp(line)
    require(how == "exactly" or (how, claim) == ("to rounding", "NOT_RESISTANT"), "proof: exactly or to rounding")
    lower, upper = check_margin(grasp, line)
    if claim == "RESISTANT":
        check_resistant(grasp, line)
    elif claim == "NOT_RESISTANT":
        check_escape(grasp, line)
    else:
        require(claim == "MARGINAL" and None not in (lower, upper), "claim: RESISTANT, NOT_RESISTANT or MARGINAL")
        require(max(abs(lower), abs(upper)) < Q(1, 1000) and grasp.spans(), "the margin is not small, or no rank")
    return f"{claim} {how}"


def main(paths):
    if len(paths) != 1 or not os.path.isfile(paths[0]):
        print("one file is wanted: python check_proofs.py proofs.jsonl")
        return 2
    counts, place, bad = {}, 0, 0
    with open(paths[0], "rb") as file:
        while text := file.readline(LONGEST_LINE + 1):
            rest, place = text, place + 1
            while rest and rest[-1:] != b"\n":
                rest = file.readline(LONGEST_LINE)
            try:
                require(len(text) <= LONGEST_LINE, f"longer than {LONGEST_LINE} bytes")
                told = check(text.decode("utf-8", "replace"))
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
