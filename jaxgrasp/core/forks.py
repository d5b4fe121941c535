"""A child made by ``fork`` has JAX's locks but not its threads: its first call would wait for ever. So it is told."""

from __future__ import annotations

import os

__all__ = ["check_process"]

_state = {"used": False, "forked": False}  # whether we have put numbers on a device, here or in a parent


def _in_child() -> None:
    _state["forked"] = _state["used"] or _state["forked"]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)


def check_process() -> None:
    """RuntimeError in a child that was forked after its parent used JAX."""
    if _state["forked"]:
        raise RuntimeError(
            "this process was forked from one that had used JAX, whose threads do not survive that: the call would "
            "hang. Start it afresh, with multiprocessing.get_context('spawn')"
        )
    _state["used"] = True
