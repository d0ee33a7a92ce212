"""Defer Ctrl-C and SIGTERM to the end of an iteration, so that the state saved then is consistent."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType


@dataclass
class Interrupt:
    """Whether the run was asked to stop."""

    requested: bool = False

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True


@contextmanager
def deferred_interrupts() -> Iterator[Interrupt]:
    """Hold back SIGINT and SIGTERM: they only set ``requested``, and the body raises KeyboardInterrupt itself.

    Signals can only be handled in the main thread; elsewhere nothing is held back.
    """
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        if handler is not None and handler != signal.SIG_IGN:
            signal.signal(number, interrupt)
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
