"""One writer a file: a lock that the system holds, so that it goes with the run however that ends."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # not there on Windows: no lock, all else the same
    fcntl = None

from .errors import UserError

__all__ = ["claimed"]


@contextmanager
def claimed(output: Path, option: str = "-o") -> Generator[None]:
    """While inside, no other run writes ``output``; what killed ones left beside it, ``.NAME.*.tmp``, is removed first.

    option  of the command line that names another file

    UserError where another run is inside, and where nothing can be written there. The lock is ``.NAME.lock`` beside the
    output. A killed run leaves that file, but not the lock; the next run removes it.
    """
    if output.is_dir():
        raise UserError(f"{output} is a directory; name a file with {option}")
    if output.exists() and not output.is_file():
        raise UserError(f"{output} is a pipe or a device, not a file; name another with {option}")
    lock = output.with_name(f".{output.name}.lock")
    try:
        if output.exists() and not os.access(output, os.W_OK):
            raise PermissionError(13, "Permission denied")
        held = _held(output, lock)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"{output} cannot be written: {reason}; name another file with {option}") from error
    try:
        for leftover in os.listdir(lock.parent):
            if leftover.startswith(f".{output.name}.") and leftover.endswith(".tmp"):
                lock.with_name(leftover).unlink(missing_ok=True)
        yield
    finally:
        with suppress(OSError):
            lock.unlink()  # while it is held: nobody else's
        os.close(held)


def _held(output: Path, lock: Path) -> int:
    """The open lock file, locked."""
    while True:
        file = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            there = os.stat(lock)
            if fcntl is None or os.path.samestat(os.fstat(file), there):
                os.truncate(file, 0)
                os.write(file, f"{os.getpid()}".encode())
                return file
        except FileNotFoundError:
            pass  # the run that held it has just ended and removed it
        except BlockingIOError as error:
            who = os.read(file, 20).decode("ascii", "replace")
            os.close(file)
            raise UserError(
                f"{output} is being written by another run (process {who or 'unknown'}): wait for it, "
                "or name another file"
            ) from error
        except OSError:  # a file system without locks
            return file
        os.close(file)
