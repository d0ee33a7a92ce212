"""Batches on the cluster, and three captures compared with a local run."""

from __future__ import annotations

import copy
import csv
import hashlib
import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from daemons import Cluster, Problem

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE, shard_events

ROOT = Path(__file__).resolve().parents[2]
PROFILE = ROOT / "configs" / "batch" / "slurm"
SPLATPIPE = (sys.executable, "-m", "splatpipe.pipeline.app.cli.main")
# The plugin, its second part, and what else it imports that the environment lacks.
PLUGINS = (
    "snakemake-executor-plugin-slurm==2.8.0",
    "snakemake-executor-plugin-slurm-jobstep==0.6.1",
    "pandas>=2.3.3,<4",
)
PRESET = ("--preset", "preview", "--set", "train.iterations=100")
BLOCKS = "blocks.least=2"  # of one capture, whose training then has two jobs of its own
MAX_MEMORY = "2G"  # of that capture: blocks are as large as the memory allows, which differs between machines
PHOTOS = 6
BROKEN_BYTES = 9000  # length of a damaged photo, which ends before its last pixel
TIMEOUT_S = 1500.0
POLL_S = 0.5
MAX_OVERHEAD_S = 180.0  # a capture, between its stages
SUBMITTED = re.compile(r"has been submitted with SLURM jobid (\d+) \(log: \S*/\d+-([a-z]+)(?:_\d+)?/\d+\.log\)")


class Batch:
    """A running `splatpipe batch`.

    Args:
        command: Its command line.
        out: Its OUT.
        environment: Its environment.
    """

    def __init__(self, command: Sequence[str], out: Path, environment: dict[str, str]) -> None:
        self.out = out
        self.notices = out.with_suffix(".notices")
        self._log = out.with_suffix(".txt")
        notify = f'echo "$SPLATPIPE_CAPTURE $SPLATPIPE_STATE" >> {self.notices}'
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--notify", notify], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
            )

    def state(self) -> dict[str, Any]:
        """Its ``batch.json``."""
        return json.loads((self.out / "batch.json").read_text(encoding="utf-8"))

    def capture(self, name: str = "house") -> dict[str, Any]:
        """A capture's state."""
        return next(capture for capture in self.state()["captures"] if capture["name"] == name)

    def output(self) -> str:
        """What it has printed."""
        return self._log.read_text(encoding="utf-8", errors="replace")[-3000:]

    def end(self, code: int, patience_s: float = TIMEOUT_S) -> None:
        """Wait for its end with that exit code."""
        try:
            found = self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.process.terminate()
            self.process.wait()
            raise Problem(f"It did not end within {patience_s:.0f} s.\n{self.output()}") from None
        if found != code:
            raise Problem(f"It ended with {found}, not {code}.\n{self.output()}")

    def wait_for(self, what: str, holds: Callable[[], object], patience_s: float = TIMEOUT_S) -> Any:
        """Wait while it is running, and return what the function found."""
        until_s = time.monotonic() + patience_s
        while time.monotonic() < until_s:
            ended = self.process.poll() is not None
            if found := holds():
                return found
            if ended:
                raise Problem(f"It ended before {what}.\n{self.output()}")
            time.sleep(POLL_S)
        raise Problem(f"Waited for {what} in vain.\n{self.output()}")

    def begun(self, stage: str, times: int = 1) -> bool:
        """Whether an attempt at a stage has begun, as often as given."""
        return sum(attempt["stage"] == stage for attempt in self.attempts()) >= times

    def attempts(self) -> list[dict[str, Any]]:
        """The attempts that have begun."""
        files = sorted((self.out / ".batch" / "call" / "tries").glob("*.jsonl"))
        records = [json.loads(line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]
        return [record["begun"] for record in records if "begun" in record]


class Night:
    """Starts batches on a cluster.

    Args:
        cluster: The cluster, running.
        work: Folder for captures and results.
        say: Prints a line.
    """

    def __init__(self, cluster: Cluster, work: Path, say: Callable[[str], None]) -> None:
        self.cluster, self.work, self.say = cluster, work, say
        self._environment = dict(os.environ)
        self._batches: list[Batch] = []
        if importlib.util.find_spec("snakemake_executor_plugin_slurm") is None:
            self._add_plugins(work / "plugins")

    def _add_plugins(self, folder: Path) -> None:
        if not folder.is_dir():
            pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "-q", "--no-deps"]
            subprocess.run([*pip, "--target", str(folder), *PLUGINS], check=True)
        places = [*filter(None, [os.environ.get("PYTHONPATH")]), str(folder)]
        self._environment["PYTHONPATH"] = os.pathsep.join(places)

    def profile(self, name: str, more: str) -> Path:
        """A copy of the shipped profile with more in it."""
        folder = self.work / "profiles" / name
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(PROFILE, folder)
        with (folder / "config.yaml").open("a", encoding="utf-8") as file:
            file.write(more + "\n")
        return folder

    def captures(self, name: str, counts: dict[str, int], broken: Sequence[str] = ()) -> Path:
        """A folder of captures of the demo's photos, each with that number; the broken ones' are truncated."""
        folder = self.work / "captures" / name
        shutil.rmtree(folder, ignore_errors=True)
        photos = sorted(capture_path().glob("*.JPG"))
        for capture, count in counts.items():
            (folder / capture).mkdir(parents=True)
            for photo in photos[:count]:
                if capture in broken:
                    (folder / capture / photo.name).write_bytes(photo.read_bytes()[:BROKEN_BYTES])
                else:
                    (folder / capture / photo.name).symlink_to(photo)
        return folder

    def start(self, name: str, captures: Path, *more: str, profile: Path = PROFILE, again: bool = False) -> Batch:
        """Start a batch.

        Args:
            name: Of its OUT.
            captures: The folder of captures.
            more: Options of the command.
            profile: The profile.
            again: Whether it goes on in the OUT of an earlier one.
        """
        out = self.work / "out" / name
        if not again:
            shutil.rmtree(out, ignore_errors=True)
            out.parent.mkdir(parents=True, exist_ok=True)
            for file in (out.with_suffix(".notices"), out.with_suffix(".txt")):
                file.unlink(missing_ok=True)
        command = [*SPLATPIPE, "batch", str(captures), str(out), "--profile", str(profile), *more]
        self._batches.append(Batch(command, out, self._environment))
        return self._batches[-1]

    def between_jobs(self, batch: Batch, name: str) -> tuple[int, float]:
        """The number of a capture's jobs, and the seconds between the first and the last during which none ran."""
        log = (batch.out / ".batch" / "call" / "snakemake.log").read_text(encoding="utf-8")
        numbers = [number for number, capture in SUBMITTED.findall(log) if capture == name]
        words = ["sacct", "--allocations", "--noheader", "--parsable2", "--format=Start,End", "-j", ",".join(numbers)]
        times = [map(datetime.fromisoformat, line.split("|")) for line in self.cluster.run(*words).split()]
        spans = [(began.timestamp(), ended.timestamp()) for began, ended in times]
        return len(spans), idle_s(spans)

    def saying(self, say: Callable[[str], None]) -> Night:
        """The same with another way to print."""
        other = copy.copy(self)
        other.say = say
        return other

    def end(self) -> None:
        """End what is still running."""
        for batch in self._batches:
            if batch.process.poll() is None:
                batch.process.terminate()
                batch.process.wait()

    def run_locally(self, photos: Path, out: Path, *more: str) -> None:
        """Run a capture on this machine."""
        shutil.rmtree(out, ignore_errors=True)
        command = [*SPLATPIPE, "run", str(photos), str(out), *more]
        done = subprocess.run(command, capture_output=True, text=True, env=self._environment, check=False)
        if done.returncode:
            raise Problem(f"The local run ended with {done.returncode}.\n{done.stderr[-2000:]}")

    def job_of(self, batch: Batch) -> str:
        """Slurm's number of a batch's only running job; empty if none is running."""
        lines = self.cluster.run("squeue", "-h", "--states=RUNNING", "-o", "%i %Z").splitlines()
        found = [line.split()[0] for line in lines if line.split()[-1] == str(batch.out / ".batch" / "call")]
        return found[0] if len(found) == 1 else ""


def compare_with_local(night: Night) -> None:
    """Three captures, one broken, with the profile as shipped; bits and overhead."""
    began_s = time.monotonic()
    captures = night.captures("three", {"house": PHOTOS, "barn": PHOTOS, "broken": 3}, broken=("broken",))
    listed = captures.with_suffix(".toml")
    entries = {name: f'[[capture]]\nphotos = "three/{name}"\n' for name in ("house", "barn", "broken")}
    listed.write_text(
        "\n".join(
            (entries["house"], f'{entries["barn"]}set = ["{BLOCKS}"]\nmax_memory = "{MAX_MEMORY}"\n', entries["broken"])
        )
    )
    batch = night.start("three", listed, *PRESET)
    batch.end(1)
    night.say(f"exit code 1 after {time.monotonic() - began_s:.0f} s")
    states = {capture["name"]: capture["state"] for capture in batch.state()["captures"]}
    if states != {"house": "done", "barn": "done", "broken": "failed"}:
        raise Problem(f"The states are {states}.\n{batch.output()}")
    with (batch.out / "batch.csv").open(encoding="utf-8") as file:
        rows = {row["capture"]: row["state"] for row in csv.DictReader(file)}
    notices = sorted(batch.notices.read_text(encoding="utf-8").splitlines())
    if notices != ["barn done", "broken failed", "house done", "three failed"]:
        raise Problem(f"The notices are {notices}.")
    if "is truncated" not in (reason := batch.capture("broken")["reason"]):
        raise Problem(f"The broken capture's reason is: {reason}")
    page = (batch.out / "batch.html").read_text(encoding="utf-8")
    if rows != states or "is truncated" not in page or "1 of 3 captures failed" not in page:
        raise Problem(f"batch.csv or batch.html is wrong: {rows}.")
    for name, options in (("house", ()), ("barn", ("--set", BLOCKS, "--max-memory", MAX_MEMORY))):
        local = night.work / "out" / "local" / name
        night.run_locally(captures / name, local, *PRESET, *options)
        if digest(local) != digest(batch.out / name):
            raise Problem(f"The bits of the splat of {name} are not those of a local run.")
    night.say(f"batch.html, batch.csv and batch.json agree: {states}; the splats' bits are those of local runs")
    for name in ("house", "barn"):
        spans = stage_spans(batch.out / name)
        jobs, engine_s = night.between_jobs(batch, name)
        summary = f"{name}: {len(spans)} stages and shards in {jobs} jobs, {idle_s(spans):.0f} s between them"
        night.say(f"{summary}, of which {engine_s:.0f} s from a job's end to the next one's start")
        if idle_s(spans) > MAX_OVERHEAD_S:
            raise Problem(f"More than {MAX_OVERHEAD_S:.0f} s pass between the stages of {name}.")


def digest(out: Path) -> str:
    """SHA-256 of a run's splat."""
    return hashlib.sha256((out / "splat.ply").read_bytes()).hexdigest()


def stage_spans(out: Path) -> list[tuple[float, float]]:
    """When each stage and shard of a run began and ended."""
    began: dict[str, float] = {}
    spans = []
    for path in (out / EVENTS_FILE, *out.glob(shard_events(out, "*").relative_to(out).as_posix())):
        for line in path.read_text(encoding="utf-8").splitlines():
            event = json.loads(line)
            if event["kind"] == "stage_started":
                began[event["stage"]] = event["time_s"]
            elif event["kind"] == "stage_finished":
                spans.append((began[event["stage"]], event["time_s"]))
    return spans


def idle_s(spans: Sequence[tuple[float, float]]) -> float:
    """Seconds between the first beginning and the last end that are in no span."""
    idle, until_s = 0.0, math.inf
    for began_s, ended_s in sorted(spans):
        idle += max(0.0, began_s - until_s)
        until_s = ended_s if until_s == math.inf else max(until_s, ended_s)
    return idle
