"""Measure each mapper and each rung: ``ladder OUT PHOTOS [OUT PHOTOS …] [--mapper NAME] [--json FILE]``.

OUT is the folder of a run that got as far as `matches`. Its keypoints and verified matches are reused; mapping and the
ladder are the stage's own library code, on one thread. ``--left`` first degrades the capture so that many photos stay
unregistered: every second pair of every third photo is dropped, and every sixth photo keeps only 200 keypoints.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from tables import Row, print_table

from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.sfm.capture import MappingInput, MappingResult
from splatpipe.pipeline.sfm.options import SparseConfig
from splatpipe.pipeline.sfm.reconstruct import reconstruct
from splatpipe.pipeline.sfm.recovery.ladder import run_ladder

COLUMNS = {
    "capture": "capture:",
    "what": "what:",
    "photos": "photos:",
    "of": "of:",
    "points": "points:,",
    "error px": "error_px:.2f",
    "focal px": "focal_px:.0f",
    "pairs added": "pairs:",
    "keypoints added": "keypoints:,",
    "CPU s": "cpu_s:.1f",
    "": "note:",
}
WEAK_KEYPOINTS = 200


class SilentReporter:
    """A Reporter that discards everything."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...
    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def note(self, message: str) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...


def read_capture(out: Path, photos_dir: Path, scratch: Path) -> MappingInput:
    """Read a run's capture from the artifacts of its stages."""
    ingest, features, matches = (
        next((out / "stages").glob(f"{stage}-*")) for stage in ("ingest", "features", "matches")
    )
    photos = load_photo_list(ingest / "photos")
    numbers = {photo.name: number for number, photo in enumerate(photos.photos, start=1)}
    pairs = json.loads((matches / "pairs.json").read_text(encoding="utf-8"))["pairs"]
    return MappingInput(
        database=matches / "database.db",
        features=features / "database.db",
        colours=np.load(features / "colours.npy"),
        photos=photos,
        photos_part=ingest / "photos",
        photos_dir=photos_dir,
        positions=json.loads((ingest / "positions.json").read_text(encoding="utf-8"))["positions"],
        cameras=json.loads((ingest / "cameras.json").read_text(encoding="utf-8"))["cameras"],
        scratch=scratch,
        tried=frozenset((numbers[first], numbers[second]) for first, second, _ in pairs),
    )


def with_photos_left(capture: MappingInput) -> MappingInput:
    """Return the same capture with pairs dropped, and with photos that have hardly any keypoints."""
    target = capture.scratch / "left.db"
    forgotten = set()
    with pycolmap.Database.open(capture.database) as source:
        geometries = dict(zip(*source.read_two_view_geometries(), strict=True))
    target.write_bytes(capture.database.read_bytes())
    with pycolmap.Database.open(target) as database:
        for order, (number, geometry) in enumerate(sorted(geometries.items())):
            i, j = pycolmap.pair_id_to_image_pair(number)
            rows = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
            if (i % 3 == 0 or j % 3 == 0) and order % 2 == 0:
                forgotten.add((min(i, j), max(i, j)))
                database.delete_two_view_geometry(i, j)
                continue
            weak = np.array([number % 6 == 5 for number in (i, j)])
            kept = rows[(rows[:, weak] < WEAK_KEYPOINTS).all(axis=1)]
            if len(kept) < len(rows):
                database.delete_two_view_geometry(i, j)
                geometry.inlier_matches = kept
                if len(kept) >= 15:
                    database.write_two_view_geometry(i, j, geometry)
    return replace(capture, database=target, tried=capture.tried - forgotten)


def measured(name: str, capture: MappingInput, mapper: str) -> list[Row]:
    """Return the rows of one capture."""
    began = time.process_time()
    config = SparseConfig(mapper=mapper)  # type: ignore[arg-type]
    found = run_ladder(capture, reconstruct(capture, config, SilentReporter()), config, SilentReporter())
    total = time.process_time() - began
    rows: list[Row] = []
    for one in found.tried:
        focal = one.get("focal_px") or [None]
        note = ("taken" if one["chosen"] else "not taken") + (f"; {one['why']}" if one.get("why") else "")
        rows.append({"what": one["how"], "photos": one["placed"], "points": one.get("points3d"), "note": note})
        rows[-1] |= {"error_px": one.get("error_px"), "focal_px": focal[0], "cpu_s": one["cpu_s"]}
    for rung in found.rungs:
        row = {"what": f"rung: {rung['rung']}", "photos": rung["photos"], "points": rung["points"]}
        row |= {"pairs": rung["verified_pairs_added"], "keypoints": rung["keypoints_added"], "cpu_s": rung["cpu_s"]}
        rows.append({**row, "note": f"{rung['placed']} of {rung['left']} that were left"})
    rows.append(_end(found, total))
    return [{"capture": name, "of": len(capture.photos), **row} for row in rows]


def _end(found: MappingResult, cpu_s: float) -> Row:
    model = found.model
    focal = next(iter(model.cameras.values())).mean_focal_length()
    return {
        "what": "answer",
        "photos": model.num_reg_images(),
        "points": model.num_points3D(),
        "error_px": model.compute_mean_reprojection_error(),
        "focal_px": focal,
        "cpu_s": cpu_s,
    }


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("runs", nargs="+", type=Path, metavar="OUT PHOTOS")
    arguments.add_argument("--mapper", default="auto", choices=("auto", "incremental", "global"))
    arguments.add_argument("--left", action="store_true", help="make captures of which much is left")
    arguments.add_argument("--json", type=Path, help="write the rows here, too")
    options = arguments.parse_args()
    pycolmap.logging.minloglevel = 2
    rows: list[Row] = []
    for out, photos in zip(options.runs[::2], options.runs[1::2], strict=True):
        with tempfile.TemporaryDirectory(prefix="ladder-") as scratch:
            capture = read_capture(out, photos, Path(scratch))
            rows += measured(out.name, with_photos_left(capture) if options.left else capture, options.mapper)
        print_table(out.name, [row for row in rows if row["capture"] == out.name], COLUMNS)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
