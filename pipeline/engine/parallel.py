"""Processes many photos with threads: results in order, and only a few photos in memory at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_WAITING = 2  # finished results that may wait for a slower one before them
POLL_S = 0.3


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Apply a function to each item in threads, and yield the results in the items' order.

    Only ``threads + MAX_WAITING`` results exist at a time. If the caller stops or fails, pending items are dropped and
    running ones are not waited for, so that an interrupted stage ends at once.

    Args:
        function: Called from several threads at once; should spend its time outside the GIL.
        items: Taken one by one.
        threads: At least 1.
    """
    pool = ThreadPoolExecutor(max(1, threads))
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) >= threads + MAX_WAITING:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def run_in_thread(function: Callable[[], Result], poll: Callable[[], None], cancel: Callable[[], None]) -> Result:
    """Run one long call in a thread of its own and return its result; the caller can report progress meanwhile.

    Args:
        function: Should spend its time outside the GIL.
        poll: Called a few times a second while it runs.
        cancel: Called when this thread is interrupted or ``poll`` fails; the call is then not waited for.
    """
    pool = ThreadPoolExecutor(1)
    job = pool.submit(function)
    try:
        while not job.done():
            wait([job], POLL_S)
            poll()
        return job.result()
    except BaseException:
        cancel()
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
