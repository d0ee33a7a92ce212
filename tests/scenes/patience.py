"""How long tests wait for something that takes a moment: only a hang takes longer, even on a busy machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE_S = 60.0
STEP_S = 0.05

Found = TypeVar("Found")


def wait_until(happened: Callable[[], Found], what: str = "it") -> Found:
    """Poll until the answer is true, and return it.

    Raises:
        AssertionError: naming what did not happen in ``PATIENCE_S``.
    """
    deadline_s = time.monotonic() + PATIENCE_S
    while not (found := happened()):
        assert time.monotonic() < deadline_s, f"{what} did not happen within {PATIENCE_S:.0f} s"
        time.sleep(STEP_S)
    return found
