"""How long tests wait for an event: longer than anything but a hang takes, even on a busy machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

TIMEOUT_S = 60.0
POLL_INTERVAL_S = 0.05

Result = TypeVar("Result")


def wait_until(condition: Callable[[], Result], what: str = "it") -> Result:
    """Poll ``condition`` until its result is true, and return that result.

    Raises:
        AssertionError: if that takes longer than ``TIMEOUT_S``; the message names ``what``.
    """
    deadline_s = time.monotonic() + TIMEOUT_S
    while not (result := condition()):
        assert time.monotonic() < deadline_s, f"{what} did not happen within {TIMEOUT_S:.0f} s"
        time.sleep(POLL_INTERVAL_S)
    return result
