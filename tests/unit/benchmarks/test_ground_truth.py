"""benchmarks: the terrain and the classes of the made slope keep the bounds, and the figures notice errors."""

import numpy as np
from ground_truth import class_rows, measure_slope, rmse_row, within_row

GSD_M = 0.056  # twice the demo's, so that it takes a CPU second


def test_the_slope_keeps_every_bound() -> None:
    tables = measure_slope(GSD_M, 56.0)
    rows = [*tables["heights"], *tables["classes"]]
    assert len(rows) == 6 and all(row["holds"] for row in rows), rows


def test_shares_count_what_is_wrong() -> None:
    truth = np.repeat([0, 1, 2, 3], 10)  # ground, house, foliage, a car
    classes = np.array([2] * 9 + [5] + [6] * 9 + [1] + [5] * 8 + [6, 2] + [1] * 9 + [7], np.uint8)
    rows = class_rows(truth == 0, truth == 1, truth == 2, classes, (0.05, 0.10))
    shares = {row["what"]: (round(float(row["share"]), 3), row["holds"]) for row in rows}
    assert shares == {
        "ground taken for object": (0.1, False),
        "objects taken for ground": (0.033, True),
        "house in class 6": (0.9, True),
        "trees and hedges in class 6": (0.1, True),
    }


def test_missing_heights_are_beyond_every_bound() -> None:
    errors = np.array([0.5, -0.5, 0.5, np.nan])
    assert not within_row("open", errors, 0.9, 4.0)["holds"] and within_row("open", errors, 0.7, 4.0)["holds"]
    row = rmse_row("open", errors, 1.0)
    assert row["holds"] and row["rmse"] == 0.5 and row["complete"] == 0.75
