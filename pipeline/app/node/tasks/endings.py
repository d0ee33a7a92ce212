"""What becomes of a job whose process ended: it failed for good, or is tried again.

An input that cannot be reconstructed fails at once. A crash is tried again: the engine resumes, and a training that ran
out of memory takes less. What this machine lacks for the moment, such as disk, is waited for.
"""

from __future__ import annotations

import signal
from dataclasses import dataclass

from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_MACHINE, EXIT_USAGE

CRASH_TRIES = 2  # further ones after a crash, as in a batch
MACHINE_TRIES = 8  # with the delays below: two hours and a half
FIRST_DELAY_S, MOST_DELAY_S = 30.0, 1800.0
CRASH_DELAY_S = 5.0


@dataclass(frozen=True)
class Verdict:
    """What becomes of a job.

    Attributes:
        text: The reason, a sentence or two.
        final: Whether it has failed.
        delay_s: Seconds until it is tried again.
    """

    text: str
    final: bool = False
    delay_s: float = 0.0


def judge_run(code: int, message: str, last_line: str, tries: int) -> Verdict:
    """Judge the end of a process with an error.

    Args:
        code: Its exit code; negative if it was killed by a signal.
        message: What the run said of it; empty if it said nothing.
        last_line: The last line that it printed, for that case.
        tries: How often the job has been tried again already.
    """
    text = message or last_line or f"It ended with exit code {code}."
    if code in (EXIT_INPUT, EXIT_USAGE):
        return Verdict(text, final=True)
    if code == EXIT_MACHINE:
        delay_s = min(MOST_DELAY_S, FIRST_DELAY_S * 2.0**tries)
        return Verdict(text, final=tries >= MACHINE_TRIES, delay_s=delay_s)
    if code == -signal.SIGKILL and not message:
        text = "Killed, most likely by the system for lack of memory."
    return Verdict(text, final=tries >= CRASH_TRIES, delay_s=CRASH_DELAY_S)
