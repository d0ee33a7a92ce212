"""Files are replaced completely or not at all."""

import os
from pathlib import Path
from typing import IO

import pytest

from splatpipe.pipeline.engine.files.durable import copy_durably, remove_unfinished, write_durably


def test_written_file_has_the_new_content_and_the_old_permissions(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("old")
    path.chmod(0o640)
    write_durably(path, "Höhe")
    assert path.read_bytes() == "Höhe".encode() and path.stat().st_mode & 0o777 == 0o640
    write_durably(path, lambda file: file.write(b"\0\1"))
    assert path.read_bytes() == b"\0\1" and list(tmp_path.iterdir()) == [path]


def test_file_that_cannot_be_written_completely_is_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.npz"
    path.write_text("old")

    def full(file: IO[bytes]) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write_durably(path, full)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_partial_files_of_another_running_process_are_kept(tmp_path: Path) -> None:
    killed, other = (tmp_path / f".report.html.{process}.new" for process in (12, 123))
    for aside in (killed, other):
        aside.write_text("half")
    remove_unfinished(tmp_path, "report.html", 12)
    assert list(tmp_path.iterdir()) == [other]


def test_copy_has_the_times_and_permissions_and_a_failed_one_changes_nothing(tmp_path: Path) -> None:
    source, path = tmp_path / "artifact.ply", tmp_path / "splat.ply"
    source.write_bytes(b"new")
    source.chmod(0o640)
    os.utime(source, ns=(10**18, 10**18 + 7))
    path.write_bytes(b"older")
    with pytest.raises(OSError, match="No such file"):
        copy_durably(tmp_path / "gone", path)
    assert path.read_bytes() == b"older" and sorted(tmp_path.iterdir()) == [source, path]
    copy_durably(source, path)
    assert path.read_bytes() == b"new" and sorted(tmp_path.iterdir()) == [source, path]
    assert (path.stat().st_mtime_ns, path.stat().st_mode & 0o777) == (10**18 + 7, 0o640)
