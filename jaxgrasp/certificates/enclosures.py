"""Square roots between two rationals, to as many digits as are asked for. Standard library only."""

from __future__ import annotations

import math
from fractions import Fraction

__all__ = ["DIGITS", "root_above", "root_below"]

DIGITS = (40, 200)  # decimal digits of the first and of the last attempt


def _shift(value: Fraction, digits: int) -> int:
    """An even power of two that leaves ``digits`` digits in front of the point of the root."""
    size = value.numerator.bit_length() - value.denominator.bit_length()
    return 2 * (math.ceil(digits * 3.33) - size // 2)


def root_below(value: Fraction, digits: int) -> Fraction:
    """A rational not above ``sqrt(value)``, within 10^-digits of it relatively; value >= 0."""
    if value == 0:
        return Fraction(0)
    shift = _shift(value, digits)
    scaled = _times_power(value, shift)
    return _times_power(Fraction(math.isqrt(scaled.numerator // scaled.denominator)), -shift // 2)


def root_above(value: Fraction, digits: int) -> Fraction:
    """A rational not below ``sqrt(value)``, within 10^-digits of it relatively; value >= 0."""
    if value == 0:
        return Fraction(0)
    shift = _shift(value, digits)
    scaled = _times_power(value, shift)
    whole = -(-scaled.numerator // scaled.denominator)
    root = math.isqrt(whole)
    return _times_power(Fraction(root if root * root == whole else root + 1), -shift // 2)


def _times_power(value: Fraction, exponent: int) -> Fraction:
    return value * (1 << exponent) if exponent >= 0 else value / (1 << -exponent)
