"""Determines a call's state from the disk alone, so that any surviving process can report it after a kill."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from splatpipe.pipeline.app.batch.jobs.attempts import Attempt, as_engine_knows, read_attempts
from splatpipe.pipeline.app.batch.jobs.job_errors import read_errors
from splatpipe.pipeline.app.batch.jobs.plan import BATCH_FOLDER, Call, PlannedCapture, StageJob, workflow_jobs
from splatpipe.pipeline.app.batch.jobs.slurm_queue import read_queue
from splatpipe.pipeline.app.batch.pages.pictures import capture_picture
from splatpipe.pipeline.app.batch.pages.state import BatchState, CaptureState, Level
from splatpipe.pipeline.app.report import REPORT_FILE
from splatpipe.pipeline.app.report.facts.overlap import overlap_s
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs, read_report_inputs
from splatpipe.pipeline.app.report.facts.run_history import read_history
from splatpipe.pipeline.app.report.verdict import judge
from splatpipe.pipeline.engine.errors import EXIT_INTERRUPTED, EXIT_TERMINATED, SplatpipeError
from splatpipe.pipeline.engine.machine import available_cores
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, shard_events
from splatpipe.pipeline.engine.stage import stage_name

VIEWER_FILE = "viewer.html"
STOPPED = "It was stopped with the batch."
# States of parallel shards, by precedence: the stage has the first that any of its shards has.
STATE_PRIORITY = ("running", "waiting", "failed", "stopped", "done", "reused")
RESUME_HINT = "Repeat the command to resume: finished work is reused."


@dataclass(frozen=True)
class CaptureFacts:
    """Facts read from a capture's results folder; the fields are those of ``CaptureState``."""

    verdict: str = ""
    level: Level = ""
    seconds: float = 0.0
    figures: Mapping[str, float | int] = field(default_factory=dict)
    picture: str = ""
    report: str = ""
    viewer: str = ""


class BatchMonitor:
    """Reports a call's state repeatedly; what cannot have changed is not read again.

    Args:
        call: The call, whose plan is written already.
    """

    def __init__(self, call: Call) -> None:
        self._call = call
        self._plan = call.plan()
        self._facts: dict[str, tuple[object, CaptureFacts]] = {}

    def state(self) -> BatchState:
        """The current state."""
        end = self._call.end()
        ended = bool(end)
        captures, left_s = [], {}
        for planned in self._plan.captures:
            capture = self._capture(planned, ended=ended)
            captures.append(capture)
            if capture.left_s:
                left_s[capture.name] = capture.left_s
        free = self._free_bytes()
        needed = self._needed_bytes(captures)
        return BatchState(
            name=self._call.out.name,
            captures=tuple(captures),
            as_of_s=time.time(),
            began_s=self._plan.began_s,
            ended_s=end.get("ended_s"),
            exit_code=end.get("exit_code"),
            message=str(end.get("message", "")),
            left_s=None if ended or not left_s else self._left_s(left_s),
            free_bytes=free,
            needed_bytes=needed,
            warnings=(*self._plan.warnings, *_disk_warning(free, needed)),
            unlisted=self._plan.unlisted,
        )

    def _capture(self, planned: PlannedCapture, *, ended: bool) -> CaptureState:
        if planned.message:
            failed = CaptureState(planned.name, "failed", planned.stage, reason=planned.message, hint=planned.hint)
            return self._with_facts(failed, planned, ())
        if not planned.jobs:
            return self._with_facts(CaptureState(planned.name, "reused", progress=1.0), planned, ())
        attempts = self._attempts(planned, ended=ended)
        return self._with_facts(self._capture_state(planned, attempts, ended=ended), planned, attempts)

    def _attempts(self, planned: PlannedCapture, *, ended: bool) -> list[Attempt]:
        """A capture's attempts; those elsewhere as their engine knows them."""
        attempts = read_attempts(self._call.attempts_files(planned.key))
        if self._plan.local:
            return attempts
        errors = read_errors(self._call.folder)
        found = []
        for name, of_job in workflow_jobs(self._call.jobs(planned)).items():
            stages = [job.stage for job in of_job]
            own = [each for each in attempts if each.stage in stages]
            found += as_engine_knows(own, errors.get((planned.key, name), ()), stages, running=not ended)
        return found

    def _capture_state(self, planned: PlannedCapture, attempts: Sequence[Attempt], *, ended: bool) -> CaptureState:
        """A capture's state from its jobs' attempts; for parallel shards, the first of ``STATE_PRIORITY``."""
        done = {each.stage for each in attempts if each.succeeded}
        jobs = self._call.jobs(planned)
        rest = [job for job in jobs if job.stage not in done]
        if jobs[-1].stage in done:
            most = max(Counter(each.stage for each in attempts).values())
            return CaptureState(planned.name, "done", progress=1.0, tries=most, earlier=_reasons(attempts))
        first = stage_name(rest[0].stage)
        beside = [job for job in rest if job.stage != first and stage_name(job.stage) == first] or rest[:1]
        each = [self._job(planned, job.stage, attempts, ended=ended) for job in beside]
        state = min(each, key=lambda state: STATE_PRIORITY.index(state.state))
        fractions = {state.stage: state.progress for state in each}
        return replace(
            state,
            progress=_progress(planned, jobs, rest, fractions),
            left_s=None if state.state in ("failed", "stopped") else _left_s(rest, fractions),
        )

    def _job(self, planned: PlannedCapture, stage: str, attempts: Sequence[Attempt], *, ended: bool) -> CaptureState:
        """The capture's state judged by one job only; ``progress`` is the job's."""
        own = [each for each in attempts if each.stage == stage]
        state = CaptureState(planned.name, "waiting", stage, tries=len(own), earlier=_reasons(attempts))
        if own and own[-1].alive and not ended:
            return replace(state, state="running", progress=self._fraction(planned, stage))
        if own and not own[-1].alive and self._is_final(own):
            earlier = tuple(reason for reason in _reasons(attempts) if reason != _reasons(own[-1:])[0])
            return replace(state, state="failed", reason=own[-1].reason, hint=own[-1].hint, earlier=earlier)
        if ended:
            return replace(state, state="stopped", reason=STOPPED, hint=RESUME_HINT)
        return state if self._plan.local else replace(state, reason=self._queue_reason(planned, stage))

    def _queue_reason(self, planned: PlannedCapture, stage: str) -> str:
        """Why the engine does not start the job that runs a stage; empty if it does not say."""
        for name, of_job in workflow_jobs(self._call.jobs(planned)).items():
            if any(job.stage == stage for job in of_job):
                return read_queue(self._call.folder).get(f"{planned.key}/{name}", "")
        return ""

    def _is_final(self, own: Sequence[Attempt]) -> bool:
        """Whether a failed stage will not be retried."""
        last = own[-1]
        if self._call.stop_file.exists() and last.exit_code in (None, EXIT_INTERRUPTED, EXIT_TERMINATED):
            return False  # it was ended with the batch
        return last.final or max(len(own), last.number) > self._plan.retries

    def _fraction(self, planned: PlannedCapture, stage: str) -> float:
        """The progress of a running stage from its events, 0 to 1."""
        out = self._call.out / planned.name
        path = out / EVENTS_FILE if stage == stage_name(stage) else shard_events(out, stage)
        history = read_history(path, running=True)
        found = history.stages.get(stage)
        if found is None or found.state != "running" or not found.messages.progress:
            return 0.0
        with suppress(KeyError, TypeError, ValueError, ZeroDivisionError):
            return min(1.0, max(0.0, float(found.messages.progress["done"]) / float(found.messages.progress["total"])))
        return 0.0

    def _with_facts(self, state: CaptureState, planned: PlannedCapture, attempts: Sequence[Attempt]) -> CaptureState:
        known = (state.state, state.stage, len(attempts), attempts[-1].ended_s if attempts else None)
        if self._facts.get(planned.key, (None,))[0] != known:
            self._facts[planned.key] = (known, self._read(planned, state))
        facts = self._facts[planned.key][1]
        began_s = max((each.began_s for each in attempts), default=0.0)
        under_way = time.time() - began_s if state.state == "running" else 0.0
        return replace(
            state,
            verdict="" if state.state == "failed" else facts.verdict,  # it would add nothing
            level="bad" if state.state == "failed" else facts.level,
            seconds=round(facts.seconds + under_way, 1),
            photos=planned.photo_count,
            figures=facts.figures,
            picture=facts.picture,
            report=facts.report,
            viewer=facts.viewer,
        )

    def _read(self, planned: PlannedCapture, state: CaptureState) -> CaptureFacts:
        """The facts from its results folder, with an image."""
        facts = read_facts(self._call.out, planned.name, state.state in ("done", "reused", "failed"))
        try:
            folder = self._call.out
            picture = capture_picture(folder / planned.name, Path(planned.photos), folder / BATCH_FOLDER / "pictures")
        except OSError:  # the disk is full
            return facts
        return facts if picture is None else replace(facts, picture=picture.relative_to(folder).as_posix())

    def _left_s(self, left_s: Mapping[str, float]) -> float:
        """Time left for the whole batch, s: as many captures run in parallel as the machine has threads for."""
        threads = max((job.threads for capture in self._plan.captures for job in capture.jobs), default=1)
        beside = max(1, available_cores() // threads) if self._plan.local else len(left_s)
        return max(*left_s.values(), sum(left_s.values()) / beside)

    def _free_bytes(self) -> int | None:
        try:
            return shutil.disk_usage(self._call.out).free
        except OSError:
            return None

    def _needed_bytes(self, captures: Sequence[CaptureState]) -> int:
        """Bytes of disk space still needed."""
        over = {capture.name for capture in captures if capture.state in ("done", "reused", "failed", "stopped")}
        needed = 0
        for planned in self._plan.captures:
            if planned.name not in over:
                done = {each.stage for each in read_attempts(self._call.attempts_files(planned.key)) if each.succeeded}
                needed += sum(job.disk_bytes for job in planned.jobs if job.stage not in done)
        return needed


def read_facts(out: Path, name: str, judged: bool) -> CaptureFacts:
    """Read the facts from a capture's results folder, as far as they are readable.

    Args:
        out: The batch's folder.
        name: The capture's name.
        judged: Whether to include the verdict, which makes no sense while it is running.
    """
    folder = out / name
    facts = CaptureFacts(
        report=_link(name, REPORT_FILE, folder),
        viewer=_link(name, VIEWER_FILE, folder),
    )
    try:
        inputs = read_report_inputs(folder)
        verdict = judge(inputs) if judged else None
        manifests = [artifact.manifest for artifact in inputs.artifacts.values()]
        seconds = sum(float(manifest["seconds"]) for manifest in manifests) - overlap_s(manifests)
        facts = replace(facts, seconds=seconds, figures=_figures(inputs))
    except (
        SplatpipeError,
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
    ):  # damaged: its own report says so
        return facts
    return facts if verdict is None else replace(facts, verdict=verdict.headline, level=verdict.level)


def _link(name: str, file: str, folder: Path) -> str:
    return f"{name}/{file}" if (folder / file).is_file() else ""


_SUMMARIES = (
    ("sparse", ("registered",)),
    ("train", ("gaussians",)),
    ("clean", ("gaussians",)),  # those that are delivered
    ("evaluate", ("psnr", "ssim")),
)


def _figures(inputs: ReportInputs) -> dict[str, float | int]:
    """The key figures."""
    found: dict[str, float | int] = {}
    for stage, names in _SUMMARIES:
        summary = inputs.summary(stage)
        found |= {name: summary[name] for name in names if isinstance(summary.get(name), int | float)}
    with suppress(OSError, ValueError, KeyError, TypeError):
        found["check_rmse_3d_m"] = float(inputs.read("georef.accuracy")["tables"]["check"]["rmse_3d_m"])
    return found


def _reasons(attempts: Sequence[Attempt]) -> tuple[str, ...]:
    """Why attempts failed, each with its stage."""
    return tuple(f"{each.stage}: {each.reason}" for each in attempts if each.reason)


def _progress(
    planned: PlannedCapture, jobs: Sequence[StageJob], rest: Sequence[StageJob], fractions: Mapping[str, float]
) -> float:
    """Progress of the whole capture, including reused stages. A stage's weight is shared equally by its jobs."""
    total = sum(planned.weights.values())
    if not total:
        return 0.0
    parts = Counter(stage_name(job.stage) for job in jobs)
    left = 0.0
    for job in rest:
        name = stage_name(job.stage)
        left += planned.weights.get(name, 0.0) / parts[name] * (1.0 - fractions.get(job.stage, 0.0))
    return round(min(1.0, max(0.0, 1.0 - left / total)), 3)


def _left_s(rest: Sequence[StageJob], fractions: Mapping[str, float]) -> float:
    return sum(job.seconds * (1.0 - fractions.get(job.stage, 0.0)) for job in rest)


def _disk_warning(free: int | None, needed: int) -> tuple[str, ...]:
    if free is None or free >= needed:
        return ()
    return (
        f"The disk has {free / 1e9:.1f} GB free, and the remaining stages need about {needed / 1e9:.1f} GB: "
        "a stage that does not fit will not start.",
    )
