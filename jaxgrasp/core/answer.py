"""What every answer can do: say its status in words, give one lane or a part of the batch, print a summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Self

import equinox as eqx
import numpy as np
from jax.core import Tracer

from .arrays import Array, Index, Int
from .select import part_of
from .status import Status

__all__ = ["Answer"]


class Answer(eqx.Module):
    """Base of all answers: a pytree of arrays with the batch axes in front.

    status          (*batch) int32, a ``Status``
    answer[i]       a part of the batch, as NumPy indexes it: ``answer[3]``, ``answer[answer.status == 1]``
    sentence(i)     one lane's status in words
    str(answer)     a summary of all lanes

    A bracketed value is ``lower`` and ``upper``: the true value lies between them. Transformations of JAX see arrays.
    """

    status: eqx.AbstractVar[Int[Array, "*batch"]]

    # What a word of ``Status`` means in this answer, where that is more than its own sentence says.
    SENTENCES: ClassVar[Mapping[Status, str]] = {}

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Axes of the batch: those of ``status``."""
        return tuple(np.shape(self.status))

    def __getitem__(self, index: Index) -> Self:
        """The answers at ``index`` of the batch. IndexError where there is no batch axis."""
        if not self.batch_shape:
            raise IndexError("a single answer has no batch axis to index")
        return part_of(self, index)

    def sentence(self, index: int | tuple[int, ...] = ()) -> str:
        """The status of the lane at ``index`` in words: one sentence."""
        status = Status(int(np.asarray(self.status)[index]))
        return self.SENTENCES.get(status, status.sentence)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The numbers of one lane that a person reads first, in words; empty where there are none."""
        return ""

    def __str__(self) -> str:
        """Summary: one lane in words, or how many lanes ended with which status."""
        name = type(self).__name__
        if isinstance(self.status, Tracer):
            return f"{name} of shape {self.batch_shape}, being traced"
        if not self.batch_shape:
            values = self.values()
            return f"{self.sentence()} {values}".rstrip()
        status = np.asarray(self.status).reshape(-1)
        lines = [f"{name} of {len(status)} lanes, shape {self.batch_shape}"]
        found, first, counts = np.unique(status, return_index=True, return_counts=True)
        for value, lane, count in sorted(zip(found, first, counts, strict=True), key=lambda row: -row[2]):
            word = Status(int(value))
            where = np.unravel_index(lane, self.batch_shape)
            place = int(where[0]) if len(where) == 1 else tuple(int(i) for i in where)
            sentence = self.SENTENCES.get(word, word.sentence)
            lines.append(
                f"{count:>10}  {count / len(status):6.1%}  {word.name}, first at {place}: {sentence}"
            )
        return "\n".join(lines)
