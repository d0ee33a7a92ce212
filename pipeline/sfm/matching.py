"""Descriptors of pairs of photos matched, their geometry verified, and what holds written in one fixed order."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import UInt8

from splatpipe.pipeline.engine.parallel import watched
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.pairs import Costs, Pair
from splatpipe.pipeline.sfm.reduction import copy_photos
from splatpipe.pipeline.sfm.retrieval import PER_PHOTO, look_alike_costs

TILE = 16  # photos; pairs are matched tile by tile, so that a block needs few photos' descriptors
BLOCK_PAIRS = 64  # COLMAP keeps as many photos' search trees in memory


class StoredDescriptors(Sequence[UInt8[np.ndarray, "_ 128"]]):
    """Those of each photo's largest keypoints, read when asked for, so that one photo's are in memory at a time."""

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
    """Costs from the descriptors that a database of features has."""
    with pycolmap.Database.open(features) as database:
        return look_alike_costs(StoredDescriptors(database), seed)


def match_pairs(features: Path, work: Path, pairs: Sequence[Pair], seed: int, threads: int, report: Reporter) -> None:
    """Match and verify pairs in a copy of the database.

    COLMAP works in a thread of its own, so that this one can tell of the progress and hear of interruptions.
    """
    shutil.copyfile(features, work)
    listing = work.with_name("pairs.txt")
    with pycolmap.Database.open(work) as database:
        for image in database.read_all_images():
            image.name = str(image.image_id)  # the list of pairs has no way to quote a name with blanks
            database.update_image(image)
        tiled = sorted(pairs, key=lambda pair: (pair[0] // TILE, pair[1] // TILE, pair))
        listing.write_text("".join(f"{i + 1} {j + 1}\n" for i, j in tiled), encoding="ascii")
        stop = pycolmap.CancellationToken()
        watched(
            lambda: _match_pairs(work, listing, seed, threads, stop),
            lambda: report.progress(database.num_matched_image_pairs(), len(pairs), "matching", "pairs"),
            stop.cancel,
        )


def _match_pairs(work: Path, listing: Path, seed: int, threads: int, stop: pycolmap.CancellationToken) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pairing.block_size = BLOCK_PAIRS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    pycolmap.match_image_pairs(work, matching, pairing, verification, pycolmap.Device.cpu, stop)


def write_verified(work: Path, features: Path, target: Path) -> dict[Pair, int]:
    """Write a new database in one fixed order, since threads leave theirs in the order in which they end.

    Descriptors and raw matches are not carried along: mapping needs the verified ones alone.

    Args:
        work: Where pairs were matched.
        features: Where the cameras, images and keypoints are.
        target: The database to write.

    Returns:
        Verified inliers of each pair (i, j) of photos, counted from 0, i < j.
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
