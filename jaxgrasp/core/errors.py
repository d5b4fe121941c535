"""The error of people, as opposed to the error of programs."""

from __future__ import annotations

__all__ = ["UserError"]


class UserError(ValueError):
    """Something a user can put right; the message is one line that says how."""
