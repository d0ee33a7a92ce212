"""Captures of a batch, its jobs and calls."""

import time
from collections.abc import Iterable
from pathlib import Path

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.batch.driver import fresh_call
from splatpipe.pipeline.app.batch.jobs.plan import BatchPlan, Call, PlannedCapture, StageJob


def link(folder: Path, photos: Iterable[Path]) -> Path:
    folder.mkdir(parents=True)
    for photo in photos:
        (folder / photo.name).symlink_to(photo)
    return folder


def demo() -> list[Path]:
    return sorted(capture_path().glob("*.JPG"))


def job(stage: str, threads: int = 2) -> StageJob:
    return StageJob(stage, threads, 900_000_000, 120.0, 50_000_000)


def planned(name: str, *stages: str) -> PlannedCapture:
    return PlannedCapture(
        name, f"0001-{name}", "/photos", "preview", tuple(map(job, stages)), {"ingest": 1.0, "train": 3.0}
    )


def call_of(out: Path, *captures: PlannedCapture, retries: int = 1) -> Call:
    call = fresh_call(out)
    call.write_plan(BatchPlan(str(out), time.time(), captures, retries=retries))
    return call
