"""Shared by readers of untrusted files: clear errors, and memory bounded by the file's size."""

from __future__ import annotations

import os
import shlex
import zlib
from collections.abc import Callable
from io import BufferedIOBase, BufferedReader
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.splat.model.gaussians import Gaussians

MAX_EXPANSION = 10.0
"""Splats hardly compress: SPZ to a third, with zero SH to a sixth. A file that expands more is a decompression bomb."""
FREE_BYTES = 1 << 25
"""Expansion allowed for files of any size: with little or uniform content, they may be very small."""
MAX_LOG_SCALE, MAX_COORDINATE = 40.0, 1e18  # float32 holds the squares of what is smaller
CheckValues = Callable[[Path, Gaussians], None]
"""What a reader does about unusable values: ``check_values``, or ``keep_unusable``."""
_READ_BYTES = 1 << 16
_AGAIN = "Copy or export it again."


def open_file(path: Path) -> BufferedReader:
    """Open a user's file to read its bytes.

    Raises:
        SplatpipeError: if it cannot be opened, or is not a regular file.
    """
    try:
        return open_regular(path)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise SplatpipeError(f"Cannot read {path}: {_reason(error)}.", hint="Check the path.") from error


def file_bytes(file: BufferedIOBase) -> int:
    """An open file's size."""
    return os.fstat(file.fileno()).st_size


def read_exactly(path: Path, file: BufferedIOBase, count: int) -> bytes:
    """Read exactly the next bytes of a file.

    Args:
        path: For the error message.
        file: The open file.
        count: Number of bytes; bounded by what fits in memory, never taken unchecked from a header.

    Raises:
        SplatpipeError: if the file ends before, or cannot be read.
    """
    data = _read(path, file, count)
    if len(data) != count:
        raise SplatpipeError(f"{path} is cut off.", hint=_AGAIN)
    return data


def check_expansion(path: Path, expanded_bytes: int, stored_bytes: int, most: float = MAX_EXPANSION) -> None:
    """Refuse a file that would take far more memory than its size justifies, before any is allocated.

    Args:
        path: For the error message.
        expanded_bytes: Size that the header states.
        stored_bytes: Size of the stored data.
        most: Largest expansion factor for the format.

    Raises:
        SplatpipeError: if the header states more than that.
    """
    if expanded_bytes > FREE_BYTES + most * stored_bytes:
        raise SplatpipeError(
            f"{path} is damaged or cut off: {stored_bytes:,} bytes cannot hold {expanded_bytes:,} as promised.",
            hint=_AGAIN,
        )


def check_values(path: Path, gaussians: Gaussians) -> None:
    """Refuse Gaussians with unusable values.

    Args:
        path: For the error message.
        gaussians: The Gaussians read.

    Raises:
        SplatpipeError: if a value is not a number, or so large that its square overflows float32.
    """
    if not all_finite(gaussians):
        bad = torch.nonzero(~gaussians.finite())
        raise SplatpipeError(
            f"{path} has values that are not numbers in {len(bad)} of {len(gaussians)} Gaussians "
            f"(the first is number {int(bad[0])}).",
            hint=f"Remove them: {_cleaning(path)}",
        )
    if not len(gaussians):
        return
    if float(gaussians.log_scales.max()) > MAX_LOG_SCALE:
        raise SplatpipeError(
            f"{path}: scales as large as exp({float(gaussians.log_scales.max()):.6g}) are not valid for a splat.",
            hint="A splat file holds the scales' logarithms; this file appears to hold something else. If it is only a "
            f"few Gaussians, remove them: {_cleaning(path)}",
        )
    if max(float(gaussians.means.max()), -float(gaussians.means.min())) > MAX_COORDINATE:
        far = int((gaussians.means.abs().amax(1) > MAX_COORDINATE).sum())
        raise SplatpipeError(
            f"{path} has coordinates beyond {MAX_COORDINATE:g} in {far} of {len(gaussians)} Gaussians.",
            hint=f"Remove them: {_cleaning(path)}",
        )


def _cleaning(path: Path) -> str:
    """The command that drops a file's unusable values, for a shell, whatever the file is called."""
    return f"splatpipe edit {shlex.quote(str(path))} cleaned.ply --clean"


def keep_unusable(path: Path, gaussians: Gaussians) -> None:
    """Accept any values: in place of ``check_values`` where they are removed afterwards."""


def usable(gaussians: Gaussians) -> Bool[Tensor, " n"]:
    """Which Gaussians ``check_values`` would not refuse."""
    if not len(gaussians):
        return torch.ones(0, dtype=torch.bool)
    small = (gaussians.log_scales.amax(1) <= MAX_LOG_SCALE) & (gaussians.means.abs().amax(1) <= MAX_COORDINATE)
    return gaussians.finite() & small


def all_finite(gaussians: Gaussians) -> bool:
    """Whether all parameters are finite; faster than finding which."""
    tensors = [tensor.detach() for tensor in gaussians.tensors().values() if tensor.numel()]
    return all(bool(torch.isfinite(torch.stack(torch.aminmax(tensor))).all()) for tensor in tensors)


class InflatedFile:
    """Sequential reader of a gzip stream, with memory bounded by the caller and not by the file.

    Args:
        path: For error messages.
        file: Positioned at the start of the stream.
    """

    def __init__(self, path: Path, file: BufferedIOBase) -> None:
        self._path, self._file = path, file
        self._inflate = zlib.decompressobj(31)  # 15 bits of window, with gzip's header and check sum

    def exactly(self, count: int) -> bytes:
        """The next bytes, all of them.

        Args:
            count: How many: at most what is held in memory at a time.

        Raises:
            SplatpipeError: if the stream ends before, or is damaged.
        """
        data = self.at_most(count)
        if len(data) != count:
            raise SplatpipeError(f"{self._path} is cut off: its data end early.", hint=_AGAIN)
        return data

    def at_most(self, count: int) -> bytes:
        """The next bytes; fewer at the stream's end, after verifying its checksum.

        Raises:
            SplatpipeError: if the stream is cut off or damaged.
        """
        parts: list[bytes] = []
        left = count
        while left and not self._inflate.eof:
            stored = self._inflate.unconsumed_tail or _read(self._path, self._file, _READ_BYTES)
            try:
                part = self._inflate.decompress(stored, left)
            except zlib.error as error:
                raise SplatpipeError(f"{self._path} is damaged: its gzip stream is broken.", hint=_AGAIN) from error
            if not stored and not part:
                raise SplatpipeError(f"{self._path} is cut off: its gzip stream does not end.", hint=_AGAIN)
            parts.append(part)
            left -= len(part)
        return b"".join(parts)


def _read(path: Path, file: BufferedIOBase, count: int) -> bytes:
    try:
        return file.read(count)
    except OSError as error:  # a folder opens on some systems and fails here
        raise SplatpipeError(f"Cannot read {path}: {_reason(error)}.", hint="Check the path.") from error


def _reason(error: OSError | ValueError) -> str:
    return getattr(error, "strerror", None) or str(error)
