"""Where a batch stands: what the page, the table, ``batch.json`` and ``--json`` all tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

from splatpipe.pipeline.engine.stage import JSON

State = Literal["waiting", "running", "done", "reused", "failed", "stopped"]
Level = Literal["", "good", "doubt", "bad"]

FINISHED: tuple[State, ...] = ("done", "reused")
RENEWED_EVERY_S = 15.0  # at work what is told is written anew at least that often, so an older one tells that nobody is
STALE_S = 60.0  # four of those missed: a busy machine misses one, never four


@dataclass(frozen=True)
class CaptureState:
    """Where a capture stands.

    Attributes:
        name: The capture's; its results lie in the folder of that name in the batch's folder.
        state: ``waiting`` for its turn, ``running``, ``done`` in this batch, ``reused``: it was finished before,
            ``failed``, or ``stopped`` before its end with the batch.
        stage: The stage that runs, failed, was stopped or comes next; empty where all are done.
        progress: Of the whole capture, 0 to 1; by the forecast, so by time and not by the number of stages.
        verdict: The report's headline; empty while there is none.
        level: How good that is; empty while there is none.
        reason: Why it failed or was stopped, one sentence; empty else.
        hint: What to do about it.
        tries: How often the stage was begun in this batch; once all are done, the one that was begun most often.
        earlier: Why earlier tries ended, with their stages, also where a later one went well.
        seconds: That its stages took together, by their manifests, with what runs now.
        left_s: About what it still takes once it runs, by the forecast; None where nothing tells.
        photos: How many it has; None while nobody has counted.
        figures: For the table: registered, gaussians, psnr, ssim, the root mean square at check points.
        picture: Best picture of it, relative to the batch's folder; empty while there is none.
        report: Its report, relative to the batch's folder; empty where there is none.
        viewer: Its viewer, relative to the batch's folder; empty where there is none.
    """

    name: str
    state: State = "waiting"
    stage: str = ""
    progress: float = 0.0
    verdict: str = ""
    level: Level = ""
    reason: str = ""
    hint: str = ""
    tries: int = 0
    earlier: tuple[str, ...] = ()
    seconds: float = 0.0
    left_s: float | None = None
    photos: int | None = None
    figures: Mapping[str, float | int] = field(default_factory=dict)
    picture: str = ""
    report: str = ""
    viewer: str = ""


@dataclass(frozen=True)
class BatchState:
    """Where a batch stands.

    Attributes:
        name: The batch's folder's name.
        captures: In the order of the list.
        as_of_s: When this was so, seconds since the epoch.
        began_s: When the command began.
        ended_s: When it ended; None while it is at work, or when its end was never told (a power cut).
        exit_code: What it ended with; None while it is at work.
        message: What ended it before its captures were through; empty else.
        left_s: About what is still to come, by the forecast; None where nothing tells.
        free_bytes: On the disk of the batch's folder.
        needed_bytes: That what is still to run takes there, by the forecast.
        warnings: What whoever comes in the morning should read first.
        unlisted: Captures of earlier calls that the list no longer names; their results are left as they are.
    """

    name: str
    captures: tuple[CaptureState, ...]
    as_of_s: float
    began_s: float
    ended_s: float | None = None
    exit_code: int | None = None
    message: str = ""
    left_s: float | None = None
    free_bytes: int | None = None
    needed_bytes: int | None = None
    warnings: tuple[str, ...] = ()
    unlisted: tuple[str, ...] = ()

    @property
    def at_work(self) -> bool:
        """Whether it had not ended by ``as_of_s``; ``STALE_S`` later nobody renewed it, so nobody is at work."""
        return self.ended_s is None

    @property
    def counts(self) -> dict[State, int]:
        """How many captures are in each state, those in none left out."""
        return dict(Counter(capture.state for capture in self.captures))

    @property
    def all_succeeded(self) -> bool:
        return all(capture.state in FINISHED for capture in self.captures)


def as_json(state: BatchState) -> dict[str, JSON]:
    """What ``batch.json`` and ``--json`` say."""
    return {**asdict(state), "at_work": state.at_work, "counts": state.counts}
