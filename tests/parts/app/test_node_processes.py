"""Processes of the node: they end with all that they started, and leave nothing behind."""

import os
from pathlib import Path

import pytest
from timeouts import wait_until

from splatpipe.pipeline.app.node.page.check_process import SCRATCH
from splatpipe.pipeline.app.node.page.checks import Checks, Upload
from splatpipe.pipeline.app.node.tasks.child import Child


def test_a_group_whose_processes_are_gone_is_not_signalled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its ID may be that of somebody else's group by then."""
    child = Child("platform", [], tmp_path / "log")
    assert wait_until(lambda: child.poll() is not None)
    signalled: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "killpg", lambda group, number: signalled.append((group, number)))
    assert child.poll() == 0
    child.end()
    assert signalled == []


def test_a_check_that_is_stopped_leaves_no_frames_of_its_film(tmp_path: Path) -> None:
    photos, folder, checks = tmp_path / "upload", tmp_path / "check", Checks(1)
    photos.mkdir()
    checks.ask("task", Upload(photos, {}, {}), folder)
    checks.advance()
    assert wait_until(lambda: (folder / SCRATCH).is_dir() or (folder / "progress.txt").stat().st_size)
    (folder / SCRATCH).mkdir(exist_ok=True)
    (folder / SCRATCH / "frame.jpg").write_bytes(b"x")
    checks.stop("task")
    assert not (folder / SCRATCH).exists()
    checks.close()
