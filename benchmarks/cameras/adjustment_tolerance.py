"""What the tolerance of mapping's last adjustments costs and saves: ``adjustment_tolerance OUT …``.

The same cameras, mapped from each photo's best keypoints, are completed with all verified matches and adjusted until a
step changes the cost by less than 1e-6, and than 1e-5. The distances are those of the camera centres from the first
result adjusted on until 1e-10, after a similarity fit, as a share of the cameras' RMS distance from their mean. OUT is
a run's folder or a database of the stage `matches`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap
from mapped_apart import centre_errors, centres
from sfm_speed import database_of
from tables import Row, print_table

from splatpipe.pipeline.sfm.mapping import completion
from splatpipe.pipeline.sfm.mapping.mapping import (
    BEST_KEYPOINTS,
    MappingOptions,
    incremental_options,
    largest_first,
)
from splatpipe.pipeline.sfm.matching.reduction import best_keypoints, write_reduced
from splatpipe.pipeline.sfm.model.pixel_tolerance_scale import pixel_tolerance_scale
from splatpipe.pipeline.sfm.model.view_graph import read_verified

TOLERANCES = (1e-6, 1e-5)
EXACT = 1e-10
FURTHER = 3  # adjustments until EXACT
COLUMNS = {
    "capture": "capture:",
    "tolerance": "tolerance:",
    "CPU s": "cpu_s:.1f",
    "photos": "placed:",
    "error px": "error_px:.4f",
    "distance, 1e-4": "distance:.3f",
}


def compare(path: Path) -> list[Row]:
    """A row for each tolerance."""
    database = database_of(path)
    verified = read_verified(database)
    options = MappingOptions(pixel_tolerance_scale=pixel_tolerance_scale(verified.cameras.values()))
    settings = incremental_options(options)
    with tempfile.TemporaryDirectory() as folder:
        reduced = Path(folder) / "best.db"
        write_reduced(database, reduced, best_keypoints(verified, BEST_KEYPOINTS))
        pycolmap.set_random_seed(options.seed)
        start = largest_first(pycolmap.incremental_mapping(reduced, folder, folder, settings))[0]
    found = []
    for tolerance in TOLERANCES:
        completion.FINE_TOLERANCE = tolerance
        model = pycolmap.Reconstruction(start)
        began_s = time.process_time()
        completion.complete(model, database, settings, pycolmap.CancellationToken())
        found.append((tolerance, time.process_time() - began_s, model))
    exact = pycolmap.Reconstruction(found[0][2])
    adjustment = completion.adjustment_options(settings, options.pixel_tolerance_scale, rough=False)
    adjustment.ceres.solver_options.function_tolerance = EXACT
    for _ in range(FURTHER):
        pycolmap.bundle_adjustment(exact, adjustment)
    return [
        {
            "capture": path.name,
            "tolerance": f"{tolerance:.0e}",
            "cpu_s": cpu_s,
            "placed": model.num_reg_images(),
            "error_px": model.compute_mean_reprojection_error(),
            "distance": 1e4 * _distance(model, exact),
        }
        for tolerance, cpu_s, model in found
    ]


def _distance(model: pycolmap.Reconstruction, exact: pycolmap.Reconstruction) -> float:
    """RMS distance of the centres of the photos that both have placed, over the extent of the exact ones."""
    places = [dict(zip(*centres(each), strict=True)) for each in (model, exact)]
    both = sorted(set(places[0]) & set(places[1]))
    ours, true = (np.array([each[number] for number in both]) for each in places)
    errors, _ = centre_errors(ours, true)
    extent = np.sqrt(((true - true.mean(axis=0)) ** 2).sum(axis=1).mean())
    return float(np.sqrt((errors**2).mean()) / extent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("outs", nargs="+", type=Path)
    wanted = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    print_table("Mapping's last adjustments", [row for path in wanted.outs for row in compare(path)], COLUMNS)


if __name__ == "__main__":
    main()
