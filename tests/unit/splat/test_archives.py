"""NumPy archives of others: never more memory than their size justifies."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.splat.containers import archives
from splatpipe.pipeline.splat.containers.archives import open_archive, read_archive


def test_arrays_read_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, depth=np.zeros((500, 500), np.float32), facts=np.arange(3))
    with open_archive(path) as archive:
        assert archive["depth"].shape == (500, 500)
    assert list(read_archive(path)["facts"]) == [0, 1, 2]


def test_an_archive_that_expands_too_far_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "FREE_BYTES", 1 << 20)
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("means.npy", bytes(20 << 20))
    with pytest.raises(ValueError, match="its arrays would take 20,971,520 bytes"):
        read_archive(path)


def test_pipes_and_pickles_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(OSError, match="it is a named pipe"):
        read_archive(tmp_path / "pipe.npz")
    np.savez(tmp_path / "a.npz", facts=np.array([print], object))
    with pytest.raises(ValueError, match="Object arrays cannot be loaded"):
        read_archive(tmp_path / "a.npz")
