"""Common rules of readers: broken, truncated and lying files end in our error and use little memory."""

import gzip
import io
from pathlib import Path

import pytest
import torch

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.bounded import (
    FREE_BYTES,
    InflatedFile,
    check_expansion,
    check_values,
    file_bytes,
    open_file,
    read_exactly,
)
from splatpipe.pipeline.splat.model.gaussians import Gaussians

PATH = Path("a.spz")
CONTENT = bytes(range(256)) * 1000


def test_a_stream_is_read_as_it_was_written_in_any_steps() -> None:
    for step in (1000, 99_991, 1 << 20):
        stream = InflatedFile(PATH, io.BytesIO(gzip.compress(CONTENT)))
        parts = []
        while part := stream.at_most(step):
            assert len(part) <= step
            parts.append(part)
        assert b"".join(parts) == CONTENT
    stream = InflatedFile(PATH, io.BytesIO(gzip.compress(CONTENT)))
    assert stream.exactly(300) == CONTENT[:300]
    with pytest.raises(SplatpipeError, match="end early"):
        stream.exactly(len(CONTENT))


def test_a_cut_or_damaged_stream_is_an_error_wherever_it_is() -> None:
    whole = gzip.compress(CONTENT)
    for end in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        with pytest.raises(SplatpipeError, match="cut off"):
            InflatedFile(PATH, io.BytesIO(whole[:end])).at_most(len(CONTENT) + 1)
    for at in (0, 3, 20, len(whole) - 6):  # its name, its header, its codes, its check sum
        broken = whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]
        with pytest.raises(SplatpipeError):
            InflatedFile(PATH, io.BytesIO(broken)).at_most(len(CONTENT) + 1)


def test_invalid_files_end_in_our_error(tmp_path: Path) -> None:
    for path in (tmp_path / "none", tmp_path, tmp_path / "a\0b"):
        with pytest.raises(SplatpipeError, match="Cannot read"), open_file(path):
            pass
    (tmp_path / "file").write_bytes(b"12345")
    with open_file(tmp_path / "file") as file:
        assert file_bytes(file) == 5
        assert read_exactly(tmp_path / "file", file, 4) == b"1234"
        with pytest.raises(SplatpipeError, match="cut off"):
            read_exactly(tmp_path / "file", file, 4)


def test_an_implausible_declared_size_is_refused() -> None:
    check_expansion(PATH, FREE_BYTES, 10)
    check_expansion(PATH, 300_000_000, 30_000_000)
    with pytest.raises(SplatpipeError, match="promised"):
        check_expansion(PATH, 2 * FREE_BYTES, 1000)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("means", float("nan"), "not numbers"),
        ("sh", float("inf"), "not numbers"),
        ("log_scales", 88.0, "scales as large"),
        ("means", -1e30, "coordinates"),
    ],
)
def test_values_that_cannot_be_computed_with_are_refused(name: str, value: float, said: str) -> None:
    made = Gaussians.empty(5, 1)
    check_values(PATH, made)
    check_values(PATH, Gaussians.empty(0, 1))
    made.tensors()[name].view(-1)[3] = torch.tensor(value)
    with pytest.raises(SplatpipeError, match=said):
        check_values(PATH, made)
