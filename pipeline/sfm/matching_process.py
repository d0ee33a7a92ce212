"""A matching process: matches and verifies a list of pairs in its own database, on one thread."""

from __future__ import annotations

import sys
from pathlib import Path

import pycolmap

from splatpipe.pipeline.engine.children import die_with_parent

BLOCK_PAIRS = 64  # COLMAP keeps as many photos' search trees in memory


def match_listed(database: Path, listing: Path, seed: int) -> None:
    """Match and verify the pairs of a list, and write raw matches and geometries to the database.

    Args:
        database: Photos, named by their numbers, with keypoints and descriptors.
        listing: Text file with two photo numbers per line.
        seed: For the verification.
    """
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pairing.block_size = BLOCK_PAIRS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)


if __name__ == "__main__":
    die_with_parent(int(sys.argv[1]))
    match_listed(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
