"""Chunks worked on side by side, and their results in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

__all__ = ["in_order", "thread_count"]

T = TypeVar("T")


def thread_count(asked: int | None) -> int:
    """What was asked for; 2, or 1 on one core, where nothing was."""
    return min(2, os.cpu_count() or 1) if asked is None else asked


def in_order(tasks: Iterator[Callable[[], T]], threads: int) -> Generator[T]:
    """The results of the tasks in their order, ``threads`` of them at work at a time; tasks are drawn as needed.

    Close it (``contextlib.closing``): when it ends, however it does, no thread of it works any more.
    """
    pending: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for task in tasks:
                pending.append(pool.submit(task))
                if len(pending) > threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
