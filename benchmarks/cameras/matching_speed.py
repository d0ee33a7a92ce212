"""Compare COLMAP's matching and verification with ours on finished runs: ``matching_speed OUT … [--photos 24]``.

Both match the pairs of a run's stage `matches`, or those among the first so many photos, in turn, each in a process of
its own on one thread. Printed are CPU seconds a pair (start-up not counted), raw matches, verified pairs and their
inliers, how many pairs the other way does not verify, and the most inliers of one of these.

OpenBLAS and numpy as on a processor without AVX-512: ``OPENBLAS_CORETYPE=Haswell NPY_DISABLE_CPU_FEATURES=X86_V4``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pycolmap
from commands import benchmark
from sfm_speed import database_of
from tables import Row, print_table

from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.children import ONE_THREAD
from splatpipe.pipeline.sfm.matching.matching_process import match_listed
from splatpipe.pipeline.sfm.matching.reduction import copy_photos

HOWS = ("COLMAP", "ours")
BLOCK_PAIRS = 64  # COLMAP keeps as many photos' search trees in memory
COLUMNS = {
    "capture": "capture:",
    "matcher": "how:",
    "pairs": "pairs:",
    "CPU s a pair": "cpu_s:.4f",
    "matches": "matches:,",
    "verified": "verified:",
    "inliers": "inliers:,",
    "only here": "only:",
    "most inliers": "most:",
}


def colmap_match(database: Path, listing: Path) -> None:
    """Match and verify with COLMAP's options, as the pipeline once did."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pairing.block_size = BLOCK_PAIRS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.set_random_seed(0)
    pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)


def write_share(out: Path, photos: int | None, database: Path, listing: Path) -> None:
    """Write a database of the first photos, named by number, and the list of their pairs."""
    matches = database_of(out).parent
    features = sorted(out.glob("stages/features-*/database.db"), key=lambda each: each.stat().st_mtime)[-1]
    with pycolmap.Database.open(features) as source, pycolmap.Database.open(database) as target:
        numbers = {image.name: image.image_id for image in source.read_all_images()}
        wanted = set(sorted(numbers.values())[:photos])
        copy_photos(source, target, wanted)
        for number in sorted(wanted):
            target.write_descriptors(number, source.read_descriptors(number))
        for image in target.read_all_images():
            image.name = str(image.image_id)
            target.update_image(image)
    listed = [tuple(sorted((numbers[a], numbers[b]))) for a, b, _ in read_json(matches / "pairs.json")["pairs"]]
    pairs = sorted((pair for pair in listed if wanted.issuperset(pair)), key=lambda pair: pair[::-1])
    listing.write_text("".join(f"{i} {j}\n" for i, j in pairs), encoding="ascii")


def run_apart(how: str, out: Path, photos: int | None) -> Row:
    """Match in a child process that uses one thread."""
    words = benchmark("matching_speed", out, "--apart", how, *(["--photos", photos] if photos else []))
    done = subprocess.run(
        [sys.executable, *words],
        check=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **ONE_THREAD},
    )
    row: Row = json.loads(done.stdout)
    return row


def match(how: str, out: Path, photos: int | None) -> Row:
    """Match a run's pairs; return the figures, and the inliers of each pair."""
    with tempfile.TemporaryDirectory() as folder:
        database, listing = Path(folder) / "database.db", Path(folder) / "pairs.txt"
        write_share(out, photos, database, listing)
        start = time.process_time()
        if how == "ours":
            match_listed(database, listing, 0)
        else:
            colmap_match(database, listing)
        spent = time.process_time() - start
        pairs = len(listing.read_text(encoding="ascii").splitlines())
        with pycolmap.Database.open(database) as matched:
            numbers, geometries = matched.read_two_view_geometries()
            raw = int(matched.num_matches())
    found = {str(number): len(each.inlier_matches) for number, each in zip(numbers, geometries, strict=True)}
    inliers = {number: count for number, count in found.items() if count}
    figures = {"verified": len(inliers), "inliers": sum(inliers.values()), "inliers_of": inliers}
    return {"capture": out.name, "how": how, "pairs": pairs, "cpu_s": spent / max(pairs, 1), "matches": raw, **figures}


def compare(out: Path, photos: int | None) -> list[Row]:
    """Match both ways, and count the pairs that only one of them verifies."""
    rows = [run_apart(how, out, photos) for how in HOWS]
    of = [row.pop("inliers_of") for row in rows]
    for row, mine, theirs in zip(rows, of, reversed(of), strict=True):
        only = [count for number, count in mine.items() if number not in theirs]
        row |= {"only": len(only), "most": max(only, default=0)}
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--photos", type=int, help="only the pairs among the first so many photos")
    parser.add_argument("--apart", choices=HOWS, help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.apart:
        print(json.dumps(match(wanted.apart, wanted.runs[0], wanted.photos)))
        return
    rows = [row for out in wanted.runs for row in compare(out, wanted.photos)]
    print_table("Matching and verification of the same pairs, one thread", rows, COLUMNS)


if __name__ == "__main__":
    main()
