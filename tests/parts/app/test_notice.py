"""Notices: what a command finds in its environment, and that neither contents nor failures of notices do harm."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from splatpipe.pipeline.app.notice import check_command, notify
from splatpipe.pipeline.engine.errors import UsageError

HOSTILE = "$(touch pwned) `touch pwned`; touch pwned\n\"' & touch pwned #"
WRITE = 'printf "%s\\0" "$SPLATPIPE_STATE" "$SPLATPIPE_CAPTURE" "$SPLATPIPE_REPORT" "$SPLATPIPE_OUT" > notice'


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def notified() -> list[str]:
    return os.fsdecode(Path("notice").read_bytes()).split("\0")[:-1]


def test_the_command_finds_the_outcome_in_its_environment(tmp_path: Path) -> None:
    report = tmp_path / "out" / "report.html"
    assert notify(WRITE, "done", "church", report) == ""
    assert notified() == ["done", "church", str(report), str(report.parent)]


def test_no_name_becomes_a_part_of_the_command(tmp_path: Path) -> None:
    for name in (HOSTILE, os.fsdecode(b"\xff\xfe")):
        assert notify(WRITE, "failed", name, None, tmp_path / name.replace("/", "")) == ""
        assert notified()[:3] == ["failed", name, ""]
    assert not Path("pwned").exists()


def test_a_command_that_fails_is_reported_without_its_output() -> None:
    said = notify("exit 7 # token=hunter2", "done", "church", None)
    assert "exit code 7" in said and "hunter2" not in said
    assert "127" in notify("/no/such/command --token hunter2", "done", "church", None)


def test_a_command_that_hangs_is_terminated_with_its_children() -> None:
    began_s = time.monotonic()
    said = notify("sh -c 'echo $$ > child; exec sleep 300' & sleep 300", "done", "church", None, time_limit_s=1.0)
    assert "did not end within 1 s" in said
    assert time.monotonic() - began_s < 60  # and not the 300 of its own
    child = int(Path("child").read_text())
    deadline = time.monotonic() + 30
    while Path(f"/proc/{child}/stat").exists() and Path(f"/proc/{child}/stat").read_text().split()[2] != "Z":
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_command_reads_nothing_and_writes_to_stderr(capfd: pytest.CaptureFixture[str]) -> None:
    assert notify("cat; echo hello", "stopped", "church", None) == ""
    assert capfd.readouterr() == ("", "hello\n")


@pytest.mark.parametrize("command", ["", "  \n", "a\0b", "x" * 10_000])
def test_an_invalid_command_is_refused_beforehand(command: str) -> None:
    with pytest.raises(UsageError, match="--notify"):
        check_command(command)
