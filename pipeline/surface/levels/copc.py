"""A point cloud as COPC: a LAZ file that every LAS program reads, and that viewers read by place and by level.

Specification: "COPC Specification 1.0" (copc.io). It is LAS 1.4 whose LAZ chunks are the nodes of an octree, found by
the "copc" records: the first of the header's (the octree's cube and spacing) and one at the end (each node's chunk).
Written with lazrs, which laspy uses, too; other writers take nodes that are already in order, so they would save only
the two records. All other fields of the points and all of the source's records (CRS, extra bytes) are carried over.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr
from laspy.vlrs.vlr import VLR

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.surface.levels.cloud_file import cloud_pieces, open_cloud
from splatpipe.pipeline.surface.levels.point_octree import (
    CELLS,
    Cube,
    NodeKey,
    Piles,
    PointCounts,
    PointOctree,
    Records,
    keys_above,
    lowest_and_highest,
)

POINT_FORMATS = (6, 7, 8)  # those of LAS 1.4 that COPC allows
_INFO = struct.Struct("<5d2Q2d88x")  # centre, half side, spacing, the root page's place and size, GPS times
_EXTENDED = struct.Struct("<H16sHQ32s")  # header of a record at the end of the file
_ENTRY = struct.Struct("<iiiiQii")  # level, x, y, z; its chunk's place, bytes and points
_OWNER = "copc"
_INFO_NUMBER, _HIERARCHY_NUMBER = 1, 1000


@dataclass(frozen=True)
class CopcSummary:
    """What a COPC file holds.

    Attributes:
        points: Number of points.
        nodes: Number of nodes with points.
        levels: Number of levels.
    """

    points: int
    nodes: int
    levels: int


def write_copc(source: Path, path: Path, work: Path, progress: Callable[[int, int], None]) -> CopcSummary:
    """Write a LAZ file again as COPC; the file is complete, or absent if that fails.

    Memory is bounded by ``MAX_PILE_POINTS``; the work folder takes the points uncompressed, some 40 bytes each.

    Args:
        source: LAS 1.4 with points of format 6, 7 or 8.
        path: Output file, ending in .copc.laz.
        work: Folder for intermediate files, emptied first and removed afterwards.
        progress: Called with the points written so far, and all.

    Raises:
        SplatpipeError: if the source is no such file.
        MachineError: if the disk is full.
        OSError: if it is not writable.
    """
    shutil.rmtree(work, ignore_errors=True)  # of a killed run
    work.mkdir(parents=True)
    try:
        with open_cloud(source) as reader:
            header = reader.header
        if header.point_format.id not in POINT_FORMATS:
            raise SplatpipeError(f"{source.name} has points of format {header.point_format.id}, not of LAS 1.4.")
        lowest, highest = lowest_and_highest(_records(source))
        cube = Cube.around(*((lowest, highest) if header.point_count else (np.zeros(3, np.int64),) * 2))
        counts = PointCounts(cube)
        for records in _records(source):
            counts.add(records)
        piles = Piles(cube, counts, work)
        for records in _records(source):
            piles.add(records)
        octree = PointOctree(cube, counts, piles, header.point_format.dtype())
        with whole_file(path) as aside, new_file(aside) as file:
            return _write(file, header, cube, octree.nodes(), progress)
    except lazrs.LazrsError as error:
        raise MachineError(f"{path} cannot be written: {error}", "Is there space on the disk?") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _records(source: Path) -> Iterator[Records]:
    for points in cloud_pieces(source):
        yield points.array


def _write(
    file: BinaryIO,
    header: laspy.LasHeader,
    cube: Cube,
    nodes: Iterator[tuple[NodeKey, Records]],
    progress: Callable[[int, int], None],
) -> CopcSummary:
    laszip = lazrs.LazVlr.new_for_compression(header.point_format.id, header.point_format.num_extra_bytes, True)
    info = VLR(_OWNER, _INFO_NUMBER, "COPC info", bytes(_INFO.size))
    _replace_records(header, info, LasZipVlr(laszip.record_data()))
    header.are_points_compressed, header.evlrs = True, None
    header.number_of_evlrs, header.start_of_first_evlr = 1, 0
    header.write_to(file)
    start, total, done = file.tell(), header.point_count, 0
    compressor = lazrs.LasZipCompressor(file, laszip)
    compressor.reserve_offset_to_chunk_table()
    written: list[tuple[NodeKey, int]] = []
    times = [np.inf, -np.inf]
    for key, records in nodes:
        if len(records):
            if written:
                compressor.finish_current_chunk()  # not after the last: ``done`` would add one without points
            compressor.compress_many(records.tobytes())
            written.append((key, len(records)))
            done += len(records)
            times = [min(times[0], records["gps_time"].min()), max(times[1], records["gps_time"].max())]
        progress(done, total)
    compressor.done()
    end = file.seek(0, 2)
    file.flush()
    hierarchy = _hierarchy(written, _chunk_sizes(Path(file.name), start, laszip), start)
    file.write(_EXTENDED.pack(0, _OWNER.encode(), _HIERARCHY_NUMBER, len(hierarchy), b"EPT hierarchy"))
    file.write(hierarchy)
    side = cube.side * header.scales
    centre = (cube.lowest + cube.side / 2.0) * header.scales + header.offsets
    page = (end + _EXTENDED.size, len(hierarchy))
    info.record_data = _INFO.pack(*centre, side[0] / 2.0, side[0] / CELLS, *page, *(times if done else (0.0, 0.0)))
    header.start_of_first_evlr = end
    file.seek(0)
    header.write_to(file, ensure_same_size=True)
    return CopcSummary(done, len(written), 1 + max((key.level for key, _ in written), default=-1))


def _replace_records(header: laspy.LasHeader, info: VLR, packing: LasZipVlr) -> None:
    """Put the records of COPC and LAZ before and after the source's own, in place: laspy would make those anew."""
    records = header.vlrs
    for record in [each for each in records if each.user_id in (_OWNER, packing.user_id)]:
        records.remove(record)
    records.insert(0, info)
    records.append(packing)


def _chunk_sizes(path: Path, start: int, laszip: lazrs.LazVlr) -> list[tuple[int, int]]:
    """Points and bytes of each chunk, from the table that lazrs wrote."""
    with path.open("rb") as file:
        file.seek(start)
        return [(int(points), int(size)) for points, size in lazrs.read_chunk_table(file, laszip)]


def _hierarchy(written: list[tuple[NodeKey, int]], chunks: list[tuple[int, int]], start: int) -> bytes:
    """The nodes' entries in one page: 32 bytes each, 100 kB for a hundred million points."""
    chunks = [chunk for chunk in chunks if chunk[0]]  # the only one of a cloud without points has none
    assert [points for _, points in written] == [points for points, _ in chunks], "lazrs wrote other chunks"
    entries, at = {}, start + 8  # after the offset of the chunk table
    for (key, points), (_, size) in zip(written, chunks, strict=True):
        entries[key] = (at, size, points)
        at += size
    keys = keys_above(list(entries))
    return b"".join(_ENTRY.pack(key.level, key.x, key.y, key.z, *entries.get(key, (0, 0, 0))) for key in keys)
