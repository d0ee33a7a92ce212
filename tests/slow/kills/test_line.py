"""The whole pipeline on a few photos of the demo capture: kills, stops and numbers of threads leave the same bits."""

import signal
import subprocess
import sys
from itertools import cycle
from pathlib import Path

import pytest
from command import answered, ran
from quick_line import QUICK, STAGES, part_digests, sets, sha256
from timeouts import TIMEOUT_S, wait_until

PRODUCTS = (  # what no run makes unasked, but the mesh, which takes open3d
    *("splat_depths.enabled=true", "facades.enabled=true", "facades.gsd_m=0.2"),
    *("cloud.enabled=true", "cloud.spacing_m=0.3"),
)


KILLED_RUN = Path(__file__).with_name("killed_run.py")


def test_one_thread_and_two_leave_the_same_bits(photos: Path, undisturbed: Path, tmp_path: Path) -> None:
    answered("run", photos, tmp_path / "out", *sets(*QUICK), "--threads", 1)
    mine, theirs = part_digests(tmp_path / "out"), part_digests(undisturbed)
    timed = {"export.metrics"}  # seconds and bytes of this very run
    assert {name for name in theirs if mine[name] != theirs[name]} <= timed
    assert sha256(tmp_path / "out" / "splat.ply") == sha256(undisturbed / "splat.ply")


def test_kill_9_in_every_stage_loses_nothing(photos: Path, undisturbed: Path, tmp_path: Path) -> None:
    """By turns the stage's process alone and its whole process group."""
    out, every = tmp_path / "out", (*QUICK, *PRODUCTS)
    for stage, how in zip(STAGES, cycle(("alone", "group"))):
        command = [sys.executable, KILLED_RUN, photos, out, stage, how, *every]
        died = subprocess.run(command, check=False, start_new_session=True, capture_output=True)
        log = (out / "events.jsonl").read_text().splitlines()
        of_stage = "\n".join(line for line in log if f'"{stage}"' in line)
        assert died.returncode == -signal.SIGKILL, (
            f"{stage} was not hit: {died.stderr.decode()[-2000:]}{of_stage[-4000:]}"
        )
        assert not list((out / "stages").glob(f"{stage}-*")), f"{stage} was left in spite of the kill"
    result = answered("run", photos, out, *sets(*every))
    assert ran(result) == [STAGES[-1]]
    assert sha256(out / "splat.ply") == sha256(undisturbed / "splat.ply")


def test_kill_9_while_depths_are_found_beside_training_loses_nothing(
    photos: Path, undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, KILLED_RUN, photos, out, "depths", "beside", *QUICK]
    died = subprocess.run(command, check=False, start_new_session=True, capture_output=True)
    assert died.returncode == -signal.SIGKILL, died.stderr.decode()[-2000:]
    assert '"ahead": true' in (out / "events.jsonl").read_text()
    assert not list((out / "stages").glob("depths-*"))
    ran(answered("run", photos, out, *sets(*QUICK)))
    mine, theirs = part_digests(out), part_digests(undisturbed)
    timed = {"export.metrics"}  # seconds and bytes of this very run
    assert {name for name in theirs if mine[name] != theirs[name]} <= timed


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_command_says_so_and_goes_on_later(
    photos: Path, copy_of_run: Path, number: signal.Signals, code: int
) -> None:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "run", photos, copy_of_run]
    longer = sets(*QUICK, "train.iterations=100000")
    told_before = len((copy_of_run / "events.jsonl").read_text())
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, *longer], **pipes) as running:
        events = copy_of_run / "events.jsonl"
        wait_until(lambda: '"what": "training"' in events.read_text()[told_before:] or running.poll() is not None)
        assert running.poll() is None, running.stderr and running.stderr.read()
        running.send_signal(number)
        _, said = running.communicate(timeout=TIMEOUT_S)
    assert running.returncode == code
    assert "Stopped" in said
    assert "Traceback" not in said
    assert ran(answered("run", photos, copy_of_run, *sets(*QUICK))) == []
