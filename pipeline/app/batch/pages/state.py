"""The state of a batch, as shown in the page, the table, ``batch.json`` and ``--json``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

from splatpipe.pipeline.engine.stage import JSON

State = Literal["waiting", "running", "done", "reused", "failed", "stopped"]
Level = Literal["", "good", "doubt", "bad"]

FINISHED: tuple[State, ...] = ("done", "reused")
UPDATE_INTERVAL_S = 15.0  # longest interval between updates of a running batch
STALE_S = 60.0  # older means that nobody is working: four missed updates, where a busy machine misses one


@dataclass(frozen=True)
class CaptureState:
    """The state of a capture.

    Attributes:
        name: The capture's name, also that of its results folder in the batch's folder.
        state: ``waiting``, ``running``, ``done`` in this batch, ``reused`` (finished before), ``failed``, or
            ``stopped`` with the batch.
        stage: The stage that is running, failed, was stopped or comes next; empty if all are done.
        progress: Progress of the whole capture, 0 to 1, by forecast time.
        verdict: The report's headline; empty if there is none yet.
        level: The verdict's level; empty if there is none yet.
        reason: Why it failed, was stopped or is waiting in another machine's queue, in one sentence; else empty.
        hint: What to do about it.
        tries: Attempts at the stage in this batch; once all are done, of the stage with the most.
        earlier: Why earlier attempts failed, with their stages, even if a later one succeeded.
        seconds: Total duration of its stages from their manifests, including the current one.
        left_s: Forecast time left once it runs; None if unknown.
        photos: Number of photos; None if not known yet.
        figures: For the table: registered, gaussians, psnr, ssim, RMSE at check points.
        picture: The best image of it, relative to the batch's folder; empty if there is none yet.
        report: Its report, relative to the batch's folder; empty if there is none.
        viewer: Its viewer, relative to the batch's folder; empty if there is none.
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
    """The state of a batch.

    Attributes:
        name: The name of the batch's folder.
        captures: The captures, in the order of the list.
        as_of_s: Time of this state, seconds since the epoch.
        began_s: When the command started.
        ended_s: When it ended; None while it is running, or if its end was never recorded (a power cut).
        exit_code: Its exit code; None while it is running.
        message: Why it ended before its captures were finished; else empty.
        left_s: Forecast time left; None if unknown.
        free_bytes: Free space on the disk of the batch's folder.
        needed_bytes: Forecast disk space of what remains to be run.
        warnings: What to read first in the morning.
        unlisted: Captures of earlier calls that are no longer listed; their results are kept.
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
        """Whether it was running at ``as_of_s``; if not updated within ``STALE_S``, it no longer is."""
        return self.ended_s is None

    @property
    def counts(self) -> dict[State, int]:
        """The number of captures by state, without empty states."""
        return dict(Counter(capture.state for capture in self.captures))

    @property
    def all_succeeded(self) -> bool:
        return all(capture.state in FINISHED for capture in self.captures)


def as_json(state: BatchState) -> dict[str, JSON]:
    """The content of ``batch.json`` and ``--json``."""
    return {**asdict(state), "at_work": state.at_work, "counts": state.counts}
