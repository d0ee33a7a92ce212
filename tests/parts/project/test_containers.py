"""The examples for containers and clusters: their commands exist, and their limits hold."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command import splatpipe
from repository import ROOT
from timeouts import TIMEOUT_S, wait_until

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.batch.jobs.plan import Call
from splatpipe.pipeline.app.batch.jobs.snakemake_process import snakemake_environment

DOCKER = ROOT / "docker"
SLURM = DOCKER / "slurm.sh"
REASONS = (
    "There is no folder",
    "Name a folder of capture folders",
    "does not contain a run",
    "CUDA does not work here",
    "everybody could use this node",
)
COMMAND = re.compile(r"^ +(?:command|args): \[([^]]+)\]", re.MULTILINE)


def commands() -> list[list[str]]:
    """The commands of the compose file and of the Job, with their variables' defaults."""
    texts = ((DOCKER / name).read_text() for name in ("compose.yaml", "kubernetes-job.yaml"))
    lists = (re.sub(r"\$\{\w+:-(\w+)\}", r"\1", listed) for text in texts for listed in COMMAND.findall(text))
    return [[word.strip(' "') for word in listed.split(",")] for listed in lists]


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_the_examples_call_splatpipe_with_valid_options(tmp_path: Path, command: list[str]) -> None:
    """None is refused for its arguments, although the container's folders do not exist here."""
    here = [word.replace("/", f"{tmp_path}/", 1) if word.startswith("/") else word for word in command]
    done = splatpipe(*here[1:] if here[0] == "splatpipe" else here)
    refused = " ".join(done.stderr.replace("│", " ").split())
    assert any(reason in refused for reason in REASONS), refused


def slurm(tmp_path: Path, *arguments: object) -> subprocess.Popen[str]:
    """The job's script with this splatpipe on PATH, as Slurm starts it."""
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "splatpipe").write_text(f'#!/bin/sh\nexec {sys.executable} -m splatpipe.pipeline.app.cli.main "$@"\n')
    (programs / "splatpipe").chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    (programs / "scontrol").write_text('#!/bin/sh\necho "$@" >> "$SUBMITTED"\n')
    (programs / "scontrol").chmod(0o755)
    environment |= {"SLURM_JOB_ID": "7", "PATH": f"{programs}:{os.environ['PATH']}", "SPLATPIPE_IMAGE": ""}
    command = ["bash", str(SLURM), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def test_the_slurm_job_ends_with_the_exit_code_of_its_command(tmp_path: Path) -> None:
    process = slurm(tmp_path, tmp_path / "none", tmp_path / "out", "--preset", "preview")
    _, output = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1, output
    assert "There is no folder" in output


@pytest.mark.parametrize(("image", "sentence"), [("splatpipe.sif", "set SPLATPIPE_IMAGE= (empty)"), ("", "on PATH")])
def test_the_slurm_job_says_what_to_set_where_it_finds_no_splatpipe(tmp_path: Path, image: str, sentence: str) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("realpath", "mkdir", "hostname"):
        (programs / name).symlink_to(str(shutil.which(name)))
    command = [str(shutil.which("bash")), str(SLURM), str(tmp_path), str(tmp_path / "out")]
    environment = {"PATH": str(programs), "SPLATPIPE_IMAGE": image}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 4 and sentence in done.stderr, done.stderr


@pytest.mark.parametrize(("number", "queued"), [(signal.SIGUSR1, "requeue 7\n"), (signal.SIGTERM, "")])
def test_the_slurm_job_forwards_the_signal_waits_for_the_end_and_is_requeued_unless_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, queued: str
) -> None:
    out, submitted = tmp_path / "out", tmp_path / "submitted"
    monkeypatch.setenv("SUBMITTED", str(submitted))
    process = slurm(tmp_path, capture_path(), out, "--preset", "preview")
    wait_until(lambda: (out / "events.jsonl").exists() or process.poll() is not None, "the run")
    process.send_signal(number)  # Slurm's B: the shell only
    _, output = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 143, output
    assert "Finished work is kept" in output, output
    assert (submitted.read_text() if submitted.exists() else "") == queued


def test_a_batch_of_a_user_without_home_or_name_gets_both_below_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Snakemake requires both at its start; existing ones are kept."""
    for name in ("HOME", "LOGNAME"):
        monkeypatch.delenv(name, raising=False)
    call = Call(Path("/out/.batch/call"))
    without = snakemake_environment(call)
    assert Path(without["HOME"]) == call.folder and without["LOGNAME"]
    monkeypatch.setenv("HOME", "/home/anna")
    monkeypatch.setenv("LOGNAME", "anna")
    assert snakemake_environment(call).items() >= {"HOME": "/home/anna", "LOGNAME": "anna"}.items()
