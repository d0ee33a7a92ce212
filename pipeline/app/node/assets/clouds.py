"""The point cloud of a run on its way to clients: opened before it is packed."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.surface.levels.cloud_file import open_cloud

PROBE_POINTS = 1000
HEADER_BYTES = 375  # of LAS 1.4 (its specification, section 2.4)
MAX_RECORDS = 1000  # variable length records; ours have three


class UnusableCloud(Exception):
    """A cloud that clients could not open; its text is the reason."""


@dataclass(frozen=True, eq=False)
class CloudFacts:
    """What a cloud's header says.

    Attributes:
        count: Its points.
        box: Least and largest x, y, z in its CRS.
    """

    count: int
    box: Float64[np.ndarray, "2 3"]


def check_cloud(path: Path) -> CloudFacts:
    """Open a LAZ file and read some of its points.

    Args:
        path: The file.

    Raises:
        UnusableCloud: if it cannot be read, or has no points.
    """
    try:
        _check_header(path)
        with open_cloud(path) as file:
            header = file.header
            points = file.read_points(PROBE_POINTS)
            count, box = int(header.point_count), np.stack([header.mins, header.maxs]).astype(np.float64)
    except (SplatpipeError, OSError, ValueError, RuntimeError, MemoryError) as error:
        raise UnusableCloud(f"it cannot be read: {error}") from error
    if count < 1 or len(points) != min(count, PROBE_POINTS) or not np.isfinite(box).all():
        raise UnusableCloud("it has no points")
    return CloudFacts(count, box)


def _check_header(path: Path) -> None:
    """Check what laspy believes: it would read four billion records, or wait for them, if a header said so.

    Raises:
        UnusableCloud: if it is not LAS 1.4, or its records cannot be in the file.
        OSError: if it cannot be read.
    """
    with open_regular(path) as file:
        data, size = file.read(HEADER_BYTES), os.fstat(file.fileno()).st_size
    if len(data) < HEADER_BYTES or data[:4] != b"LASF" or data[24:26] != bytes((1, 4)):
        raise UnusableCloud("it is not LAS 1.4")
    header, points, records = struct.unpack_from("<HLL", data, 94)
    later, more = struct.unpack_from("<QL", data, 235)
    if header != HEADER_BYTES or not header <= points <= size or later > size or max(records, more) > MAX_RECORDS:
        raise UnusableCloud("its header does not fit the file")
