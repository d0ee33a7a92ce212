"""Extract more, fainter keypoints for a few photos on larger images, appended to the existing ones."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import UInt8

from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.matching.keypoints import extract, single_threaded_opencv
from splatpipe.pipeline.sfm.matching.matching import match_pairs
from splatpipe.pipeline.sfm.matching.reduction import copy_photos
from splatpipe.pipeline.sfm.options import FeaturesConfig
from splatpipe.pipeline.sfm.pairing.pairs import Pair
from splatpipe.pipeline.sfm.recovery.ladder_pairs import take_verified

STRONGER = FeaturesConfig(extractor="opencv-sift", max_image_size=2400, max_features=12_288)
"""Larger images and one and a half times the keypoints of `standard`. COLMAP's SIFT placed the same photos on two
captures (docs/measurements/mapping.md) and took 1.6 and twice the time."""
FAINT = 0.015  # contrast: some three times the keypoints of OpenCV's default
THREAD_SHARE = 0.5  # share of the threads used: a photo takes up to twice the memory that it did in `features`


@dataclass(frozen=True)
class ExtendedDatabase:
    """A database with added keypoints.

    Attributes:
        database: All keypoints: the existing ones, with their indices unchanged, then the new ones.
        colours: (n, 3) RGB of all of them, image after image.
        keypoints: Number of keypoints added.
    """

    database: Path
    colours: UInt8[np.ndarray, "_ 3"]
    keypoints: int


def reextract(
    capture: MappingInput,
    found: MappingResult,
    photos: Sequence[int],
    pairs: Sequence[Pair],
    seed: int,
    report: Reporter,
) -> ExtendedDatabase:
    """Extract new keypoints in some photos, and match them among these photos.

    New keypoints are matched only with new ones: an old and a new keypoint at the same spot have nearly the same
    descriptor, and each would make the other fail the ratio test.

    Args:
        capture: The photos' files.
        found: The database so far, and its view graph; only read.
        photos: COLMAP's numbers of the photos to extract again.
        pairs: Pairs of these photos to match.
        seed: For the verification.
        report: Receives progress.
    """
    folder = Path(tempfile.mkdtemp(prefix="keypoints-", dir=capture.scratch))
    target, fresh, work = folder / "database.db", folder / "fresh.db", folder / "work.db"
    shutil.copyfile(found.database, target)
    ordered = sorted(photos)
    starts = {number: len(found.verified.keypoints[number]) for number in ordered}
    ends = np.cumsum([len(found.verified.keypoints[number]) for number in sorted(found.verified.keypoints)])
    parts = np.split(found.colours, ends[:-1])
    extract_photo = partial(
        extract,
        config=STRONGER,
        part=capture.photos_part,
        photos_dir=capture.photos_dir,
        scratch=capture.scratch,
        contrast=FAINT,
    )
    added = 0
    with (
        single_threaded_opencv(),
        pycolmap.Database.open(found.database) as source,
        pycolmap.Database.open(fresh) as database,
        pycolmap.Database.open(target) as grown,
    ):
        copy_photos(source, database)
        kind = pycolmap.FeatureExtractorType.SIFT
        threads = max(1, int(THREAD_SHARE * capture.threads))
        extracted = ordered_map(extract_photo, [capture.photos.photos[number - 1] for number in ordered], threads)
        for done, (number, features) in enumerate(zip(ordered, extracted, strict=True), start=1):
            database.update_keypoints(number, features.keypoints)
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, features.descriptors))
            before = np.asarray(source.read_keypoints(number), np.float32).reshape(-1, features.keypoints.shape[1])
            grown.update_keypoints(number, np.concatenate([before, features.keypoints]))
            parts[number - 1] = np.concatenate([parts[number - 1], features.colours])
            added += len(features.keypoints)
            report.progress(done, len(ordered), "more keypoints for the remaining photos", "photos")
    return_free_heap()  # of the threads that extracted: half a gigabyte
    match_pairs(fresh, work, [(i - 1, j - 1) for i, j in sorted(pairs)], seed, capture.threads, report)
    take_verified(work, target, starts)
    for path in (fresh, work):
        path.unlink()
    return ExtendedDatabase(target, np.concatenate(parts), added)
