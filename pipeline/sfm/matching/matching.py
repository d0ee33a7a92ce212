"""Match descriptors of pairs of photos, verify their geometry, and write the result in a fixed order."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import UInt8

from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.runs.children import CHILDREN_MEMORY, run_children
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.matching.reduction import copy_photos
from splatpipe.pipeline.sfm.pairing.pairs import Costs, Pair
from splatpipe.pipeline.sfm.pairing.retrieval import PER_PHOTO, look_alike_costs

PAIRS_A_PROCESS = 24  # at least: a process takes a CPU second to start, a pair 0.01 to 0.1
PROCESS_BYTES = 400_000_000  # memory of a matching process at most: 0.16 to 0.27 GB on six captures
MATCHER = "splatpipe.pipeline.sfm.matching.matching_process"


class StoredDescriptors(Sequence[UInt8[np.ndarray, "_ 128"]]):
    """Descriptors of each photo's largest keypoints, read on access so that only one photo's are in memory."""

    def __init__(self, database: pycolmap.Database) -> None:
        self._database = database
        self._count = int(database.num_images())

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, at: int) -> UInt8[np.ndarray, "_ 128"]:  # type: ignore[override]
        if not 0 <= at < self._count:
            raise IndexError(at)
        stored = np.asarray(self._database.read_descriptors(at + 1).data, np.uint8)
        return stored.reshape(-1, 128)[:PER_PHOTO]


def look_alike(features: Path, seed: int) -> Costs:
    """Return pair costs from the descriptors in a database of features."""
    with pycolmap.Database.open(features) as database:
        return look_alike_costs(StoredDescriptors(database), seed)


def match_pairs(features: Path, work: Path, pairs: Sequence[Pair], seed: int, threads: int, report: Reporter) -> None:
    """Match and verify pairs in up to ``threads`` single-threaded processes, which hold two photos' descriptors each.

    Threads of one process must not verify concurrently: the linear algebra in pycolmap's wheels (OpenBLAS built for
    one thread, without locks) occasionally gives two of them the same buffer, and both pairs lose many matches.

    Args:
        features: The database with keypoints and descriptors; only read.
        work: The database to write: photos, and the verified geometry of each pair that was matched.
        pairs: (i, j) of photos, counted from 0.
        seed: For the verification.
        threads: Maximum number of concurrent processes.
        report: Receives progress.
    """
    ordered = sorted(pairs, key=lambda pair: (pair[1], pair[0]))  # a process prepares each second photo once
    count = max(1, min(threads, len(ordered) // PAIRS_A_PROCESS))
    shares = [ordered[len(ordered) * k // count : len(ordered) * (k + 1) // count] for k in range(count)]
    places = [work.with_name(f"{work.stem}-{k}.db") for k in range(count)]
    try:
        for place, share in zip(places, shares, strict=True):
            _write_share(features, place, share)
        with ExitStack() as stack:
            opened = [stack.enter_context(pycolmap.Database.open(place)) for place in places]

            def poll() -> None:
                done = sum(int(database.num_matched_image_pairs()) for database in opened)
                report.progress(done, len(pairs), "matching", "pairs")

            commands = [(MATCHER, str(place), str(_list_of(place)), str(seed)) for place in places]
            report.metric(CHILDREN_MEMORY, run_children(commands, poll, "matching photos"))
        _join(features, places, work)
    finally:
        for place in places:
            _list_of(place).unlink(missing_ok=True)
            place.unlink(missing_ok=True)


def _list_of(place: Path) -> Path:
    return place.with_suffix(".txt")


def _write_share(features: Path, place: Path, share: Sequence[Pair]) -> None:
    """Write the database of one process: the photos of its pairs."""
    wanted = sorted({number + 1 for pair in share for number in pair})
    with pycolmap.Database.open(features) as source, pycolmap.Database.open(place) as database:
        copy_photos(source, database, set(wanted))
        for number in wanted:
            database.write_descriptors(number, source.read_descriptors(number))
    write_file(_list_of(place), "".join(f"{i + 1} {j + 1}\n" for i, j in share))


def _join(features: Path, places: Sequence[Path], work: Path) -> None:
    with pycolmap.Database.open(features) as source, pycolmap.Database.open(work) as database:
        copy_photos(source, database)
        for place in places:
            with pycolmap.Database.open(place) as share:
                numbers, geometries = share.read_two_view_geometries()
            for pair_id, geometry in zip(numbers, geometries, strict=True):
                database.write_two_view_geometry(*pycolmap.pair_id_to_image_pair(pair_id), geometry)


def write_verified(work: Path, features: Path, target: Path) -> dict[Pair, int]:
    """Write the verified matches to a new database in a fixed order, independent of which process finished first.

    Descriptors and raw matches are not copied: mapping needs only the verified matches.

    Args:
        work: The database in which pairs were matched.
        features: The database of cameras, images and keypoints.
        target: The database to write.

    Returns:
        Number of verified inliers of each pair (i, j) of photos, counted from 0, i < j.
    """
    inliers: dict[Pair, int] = {}
    with (
        pycolmap.Database.open(features) as source,
        pycolmap.Database.open(work) as matched,
        pycolmap.Database.open(target) as database,
    ):
        copy_photos(source, database)
        numbers, geometries = matched.read_two_view_geometries()
        for pair_id, geometry in sorted(zip(numbers, geometries, strict=True), key=lambda entry: entry[0]):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            inliers[first - 1, second - 1] = len(geometry.inlier_matches)
            database.write_two_view_geometry(first, second, geometry)
    return inliers
