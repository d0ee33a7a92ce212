"""Write a control file for a capture without scale: some of its own sparse points at an assumed scale, upright.

``assumed_scale OUT --distance 50 > control.csv``, for a run that got as far as `georef`, then
``splatpipe run PHOTOS OUT --set georef.control=$PWD/control.csv``. Products need metres, and captures such as ochota
and castle have neither positions nor control. Their scale is set so that the median distance from cameras to the points
that they see is the assumed one; place and heading are arbitrary: zone 33 of UTM, near its central meridian.

Points are taken from the most often seen and best fitting, each the farthest from those taken before.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.stages.line import GEOREF, LINE

CRS = "EPSG:32633"
ORIGIN = np.array([500_000.0, 5_000_000.0, 100.0])  # easting, northing, height of the model's zero
POINTS = 12
MARKS = 8  # at most, for each point
GOOD_SHARE = 0.05  # share of the points that are candidates: those of the longest tracks
COLUMNS = ("name", "x", "y", "z", "photo", "pixel_x", "pixel_y")


def spread_rows(places: Float64[np.ndarray, "n 3"], count: int) -> Int64[np.ndarray, " k"]:
    """Return rows of places, each the farthest from those before; the first is the farthest from the median."""
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    found: list[int] = []
    for _ in range(min(count, len(places))):
        row = int(np.argmax(away))
        found.append(row)
        from_row = np.linalg.norm(places - places[row], axis=1)
        away = from_row if len(found) == 1 else np.minimum(away, from_row)
    return np.array(found, np.int64)


def control_rows(out: Path, distance_m: float) -> list[tuple[str, ...]]:
    """Return the rows of the control file, one per mark.

    Args:
        out: OUT of a run.
        distance_m: Assumed median distance from cameras to the points that they see, metres.

    Raises:
        UsageError: if the run has no georeferenced model.
    """
    parts = open_run_folder(out, LINE).lineage(GEOREF)
    if "georef.model" not in parts:
        raise UsageError(f"{out} has no model.", hint="Run it with --until georef.")
    model = read_reconstruction(parts["georef.model"].path)
    turn = load_frame(parts["georef.frame"].path).world_from_model
    points = list(model.points3D.values())
    upright = turn.apply(np.array([point.xyz for point in points]))
    centres = {key: turn.apply(image.projection_center()[None])[0] for key, image in model.images.items()}
    first = [centres[point.track.elements[0].image_id] for point in points]
    scale = distance_m / float(np.median(np.linalg.norm(upright - np.array(first), axis=1)))
    lengths, errors = (np.array(each) for each in zip(*((p.track.length(), p.error) for p in points), strict=True))
    good = np.flatnonzero(errors <= np.median(errors))
    good = good[np.argsort(-lengths[good], kind="stable")][: max(POINTS, int(GOOD_SHARE * len(points)))]
    rows = []
    for number, row in enumerate(good[spread_rows(upright[good], POINTS)], 1):
        place = [f"{value:.4f}" for value in ORIGIN + scale * upright[row]]
        marks = {element.image_id: element for element in points[row].track.elements}  # a photo marks a point once
        for element in list(marks.values())[:MARKS]:
            image = model.images[element.image_id]
            pixel = [f"{value:.2f}" for value in image.points2D[element.point2D_idx].xy]
            rows.append((f"P{number:02d}", *place, image.name, *pixel))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="OUT of a run that got as far as georef")
    parser.add_argument("--distance", type=float, default=50.0, help="assumed distance to the points, metres")
    arguments = parser.parse_args()
    rows = control_rows(arguments.out, arguments.distance)
    print(CRS)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main()
