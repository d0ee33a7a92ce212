"""A matching process: matches and verifies a list of pairs in its own database, on one thread."""

from __future__ import annotations

import sys
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8

from splatpipe.pipeline.engine.runs.children import die_with_parent
from splatpipe.pipeline.sfm.matching.nearest_descriptors import group_descriptors, match_descriptors

# RANSAC's. COLMAP's maximum of 10,000 costs ten times as much in a pair that shows nothing in common, and hardly finds
# more pairs: with a third of the matches right, one of 1,000 samples of five is good with 98 % certainty. COLMAP's
# minimum of 100 is several times what a pair needs of which most matches are right.
MAX_TRIALS = 1000
MIN_TRIALS = 30


def match_listed(database: Path, listing: Path, seed: int) -> None:
    """Match and verify the pairs of a list, and write raw matches and the verified pairs' geometries to the database.

    Args:
        database: Photos, by number, with keypoints and descriptors.
        listing: Text file with two photo numbers per line, ordered by the second.
        seed: For the verification.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = MAX_TRIALS
    options.ransac.min_num_trials = MIN_TRIALS
    pairs = [(int(i), int(j)) for i, j in (line.split() for line in listing.read_text(encoding="ascii").splitlines())]
    with pycolmap.Database.open(database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        camera_of = {image.image_id: cameras[image.camera_id] for image in opened.read_all_images()}
        for second, partners in groupby(pairs, key=itemgetter(1)):
            cells = group_descriptors(_descriptors(opened, second))
            there = _places(opened, second)
            for first, _ in partners:
                rows = match_descriptors(_descriptors(opened, first), cells)
                geometry = pycolmap.estimate_two_view_geometry(
                    camera_of[first], _places(opened, first), camera_of[second], there, rows, options
                )
                if len(geometry.inlier_matches):
                    opened.write_two_view_geometry(first, second, geometry)
                opened.write_matches(first, second, rows)  # last: the parent counts these


def _descriptors(database: pycolmap.Database, number: int) -> UInt8[np.ndarray, "n 128"]:
    return np.asarray(database.read_descriptors(number).data, np.uint8).reshape(-1, 128)


def _places(database: pycolmap.Database, number: int) -> Float64[np.ndarray, "n 2"]:
    return np.asarray(database.read_keypoints(number), np.float64).reshape(-1, 6)[:, :2]


if __name__ == "__main__":
    die_with_parent(int(sys.argv[1]))
    match_listed(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
