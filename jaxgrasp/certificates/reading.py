"""Fields of an answer that may be anything: read as float64 of the right shape, or refused."""

from __future__ import annotations

import math

import numpy as np

__all__ = ["Fields", "Malformed"]


class Malformed(Exception):
    """The answer is no answer to this question: a field is missing, of another shape, or no numbers."""


class Fields:
    """The arrays of ``answer``, each with axes ``batch`` in front, flattened to lanes."""

    def __init__(self, answer, batch: tuple[int, ...]):
        self.answer, self.batch = answer, tuple(batch)

    def numbers(self, name: str, *own: int) -> np.ndarray:
        """(N, *own) float64. Malformed where the field is not real numbers of shape (*batch, *own)."""
        array = self.array(name)
        real = array.dtype.kind in "fiu" or (array.dtype.kind == "V" and array.dtype.name == "bfloat16")
        if not real or array.shape != (*self.batch, *own):
            raise Malformed(name)
        return array.astype(np.float64).reshape(math.prod(self.batch), *own)

    def integers(self, name: str) -> np.ndarray:
        """(N,) float64, of whole numbers alone."""
        if self.array(name).dtype.kind not in "iu":
            raise Malformed(name)
        return self.numbers(name)

    def array(self, name: str) -> np.ndarray:
        """The field as it stands; Malformed where it is no array."""
        try:
            return np.asarray(getattr(self.answer, name))
        except Exception as error:
            raise Malformed(name) from error
