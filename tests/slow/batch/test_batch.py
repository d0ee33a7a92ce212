"""A batch of captures on Snakemake: each in the right state, nothing repeated or left behind, honest reports."""

import ast
import csv
import json
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

from batch_captures import call_of, demo, job, link, planned
from repository import ROOT
from timeouts import wait_until

from splatpipe.pipeline.app.batch.jobs.attempts import NO_MESSAGE, AttemptLog
from splatpipe.pipeline.app.batch.jobs.plan import Call, PlannedCapture
from splatpipe.pipeline.app.batch.jobs.snakemake_process import open_profile, snakemake_command
from splatpipe.pipeline.app.batch.jobs.workflow import workflow_text
from splatpipe.pipeline.app.batch.monitor import BatchMonitor
from splatpipe.pipeline.engine.errors import EXIT_MACHINE
from splatpipe.stages.line import LINE

SLOW = ("--until", "features", "--set", "features.extractor=sift")


def command(captures: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "batch", str(captures), str(out), *more, "--json"]


def batch(captures: Path, out: Path, *more: str) -> dict[str, object]:
    done = subprocess.run(command(captures, out, *more), capture_output=True, text=True, check=False)
    output: dict[str, object] = json.loads(done.stdout)
    assert done.returncode == output["exit_code"], done.stderr
    return output


def states(output: dict[str, object]) -> dict[str, str]:
    return {capture["name"]: capture["state"] for capture in output["captures"]}  # type: ignore[index,attr-defined]


def events(out: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in out.glob("*/events.jsonl")}


def test_a_failed_capture_stops_no_other_and_finished_ones_are_not_touched(tmp_path: Path) -> None:
    """One broken capture, one with wrong options, one without a folder; a rerun; then one added, changed, removed."""
    captures, out = tmp_path / "captures", tmp_path / "out"
    link(captures / "house", demo()[:2])
    broken = link(captures / "broken", [])
    for photo in demo()[:2]:
        (broken / photo.name).write_bytes(photo.read_bytes()[:9000])
    listed = tmp_path / "night.csv"
    rows = ["name,photos,train.iterations", "house,captures/house,", "broken,captures/broken,"]
    listed.write_text("\n".join([*rows, "wrong,captures/house,-5", "nowhere,captures/none,"]))
    notice = 'echo "$SPLATPIPE_STATE $SPLATPIPE_CAPTURE" >> notices'
    night = ("--until", "ingest", "--retries", "1", "--notify", notice)
    os.chdir(tmp_path)

    output = batch(listed, out, *night)
    bad = dict.fromkeys(("broken", "wrong", "nowhere"), "failed")
    assert states(output) == {"house": "done", **bad} and output["exit_code"] == 1
    of = {capture["name"]: capture for capture in output["captures"]}  # type: ignore[attr-defined]
    assert "is truncated" in of["broken"]["reason"] and of["broken"]["hint"] and of["broken"]["tries"] == 1
    assert "train.iterations" in of["wrong"]["reason"] and "There is no folder" in of["nowhere"]["reason"]
    assert json.loads((out / "batch.json").read_text())["captures"] == output["captures"]
    table = {row["capture"]: row for row in csv.DictReader((out / "batch.csv").read_text().splitlines())}
    assert {name: row["state"] for name, row in table.items()} == states(output)
    assert "broken" in (out / "batch.html").read_text()
    notices = ["done house", "failed broken", "failed nowhere", "failed out", "failed wrong"]
    assert sorted((tmp_path / "notices").read_text().splitlines()) == notices
    assert (out / "notices").exists() is False

    before = events(out)
    output = batch(listed, out, *night)
    assert states(output) == {"house": "reused", **bad} and output["exit_code"] == 1
    assert "--retry-failed" in {each["name"]: each["hint"] for each in output["captures"]}["broken"]  # type: ignore[attr-defined]
    assert events(out) == before and not list((out / ".batch" / "call").glob("tries/*"))
    assert not (out / ".batch" / "call" / "Snakefile").exists()  # Snakemake was not even started

    link(captures / "barn", demo()[5:7])
    (captures / "house" / demo()[9].name).symlink_to(demo()[9])
    listed.write_text("\n".join([*rows[:2], "barn,captures/barn,"]))
    output = batch(listed, out, *night)
    assert states(output) == {"house": "done", "barn": "done"} and output["exit_code"] == 0
    assert output["unlisted"] == ["broken"] and events(out)["broken"] == before["broken"]


def descendants(process: int) -> dict[int, str]:
    """Command lines of a process's descendants, by process ID."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
    found, front = {}, [process]
    while front:
        front = [child for child, parent in parents.items() if parent in front]
        found.update({child: words(child) for child in front})
    return found


def words(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")
    except OSError:
        return ""


def alive(processes: dict[int, str]) -> list[str]:
    return [command for process, command in processes.items() if words(process) == command]


def worker_of(running: subprocess.Popen[str], out: Path, but: int = 0) -> int:
    """Wait until the stage features runs; return the ID of its process."""

    def found() -> int:
        assert running.poll() is None
        if b'"stage_started", "stage": "features"' not in events(out).get("house", b""):
            return 0
        workers = (child for child, output in descendants(running.pid).items() if "engine.runs.worker" in output)
        return next((child for child in workers if child != but), 0)

    return wait_until(found, "the stage features")


def test_a_killed_stage_is_restarted_and_ctrl_c_ends_everything_cleanly(tmp_path: Path) -> None:
    link(tmp_path / "captures" / "house", demo()[:3])
    out = tmp_path / "out"
    with subprocess.Popen(command(tmp_path / "captures", out, *SLOW), stdout=subprocess.PIPE, text=True) as running:
        first = worker_of(running, out)
        os.kill(first, signal.SIGKILL)
        worker_of(running, out, but=first)
        others = descendants(running.pid)
        running.send_signal(signal.SIGINT)
        output = json.loads(running.communicate()[0])
    assert alive(others) == []
    assert running.returncode == output["exit_code"] == 130
    filed = json.loads((out / "batch.json").read_text())
    (house,) = filed["captures"]
    assert (house["state"], house["stage"], house["tries"], filed["at_work"]) == ("stopped", "features", 2, False)
    assert "features: The stage features was killed by SIGKILL" in house["earlier"][0]


def test_a_killed_batch_leaves_no_process_and_no_false_report(tmp_path: Path) -> None:
    link(tmp_path / "captures" / "house", demo()[:3])
    out = tmp_path / "out"
    with subprocess.Popen(command(tmp_path / "captures", out, *SLOW), stdout=subprocess.PIPE, text=True) as running:
        worker_of(running, out)
        others = descendants(running.pid)
        assert json.loads((out / "batch.json").read_text())["at_work"]
        running.kill()
    wait_until(lambda: not alive(others), "the end of what it had started")
    summary = json.loads((out / "batch.json").read_text())
    assert states(summary) == {"house": "stopped"} and not summary["at_work"] and "killed" in summary["message"]
    assert states(batch(tmp_path / "captures", out, "--until", "ingest")) == {"house": "reused"}


def test_a_job_whose_process_is_gone_does_not_run(tmp_path: Path) -> None:
    call = call_of(tmp_path, planned("house", "ingest", "train"), retries=0)
    log = AttemptLog(call.attempts_file("0001-house"))
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    begun = log.begin("ingest")
    call.attempts_file("0001-house").write_text(json.dumps({"begun": {**vars(begun), "process": process.pid}}) + "\n")
    (house,) = BatchMonitor(call).state().captures
    assert (house.state, house.reason) == ("failed", NO_MESSAGE)


def run_job(call: Call, stage: str) -> int:
    words = [sys.executable, "-m", "splatpipe.pipeline.app.batch.jobs.job", str(call.folder), "0001-house", stage, "1"]
    return subprocess.run([*words, str(call.folder / "marker"), "1"], check=False).returncode


def test_a_job_without_disk_space_is_not_started_and_a_hopeless_one_is_not_repeated(tmp_path: Path) -> None:
    large = replace(planned("house"), jobs=(replace(job("ingest"), disk_bytes=10**18),))
    call = call_of(tmp_path, large, retries=5)
    assert run_job(call, "ingest") == run_job(call, "ingest") == EXIT_MACHINE
    (house,) = BatchMonitor(call).state().captures
    assert (house.state, house.tries) == ("failed", 1) and "GB free" in house.reason
    assert not (tmp_path / "house").exists() and not (call.folder / "marker").exists()
    assert any("will not start" in said for said in call_warnings(call, large))
    call.stop_file.touch()
    assert run_job(call, "ingest") == 143


def call_warnings(call: Call, capture: PlannedCapture) -> tuple[str, ...]:
    """Before anything has run."""
    call.attempts_file(capture.key).unlink()
    return BatchMonitor(call).state().warnings


def test_a_folder_of_any_name_is_one_word_of_the_workflows_command(tmp_path: Path) -> None:
    call = call_of(tmp_path / "a\nb \"c\" \\n {d} 'e' $(f) é😀", planned("house", "georef"))
    (line,) = [line for line in workflow_text(call, call.plan(), LINE).splitlines() if line.startswith('        "exec')]
    command = ast.literal_eval(line.strip()).format(
        wildcards=SimpleNamespace(capture=Plain("x")),
        threads=1,
        output=Plain("y"),
        resources=SimpleNamespace(attempt=1),
    )
    assert shlex.split(command)[5] == str(call.folder)


class Plain(str):
    """A string that Snakemake inserts with ``:q``."""

    def __format__(self, _form: str) -> str:
        return str(self)


def test_a_profile_decides_where_jobs_run_and_without_one_memory_does(tmp_path: Path) -> None:
    call = call_of(tmp_path, planned("house", "train"))
    alone = snakemake_command(call, call.plan(), open_profile(None))
    assert "--resources" in alone and any(word.startswith("mem_mb=") for word in alone)
    for name in ("slurm", "kubernetes"):
        profile = open_profile(ROOT / "configs" / "batch" / name)
        elsewhere = snakemake_command(call, call.plan(), profile)
        assert not profile.local and "--resources" not in elsewhere
        assert elsewhere[elsewhere.index("--cores") + 1] == "2"  # no job gets more
