"""Limits of stages: what is counted in a run's records, and what ceilings make of it."""

import json
import sqlite3
from collections import defaultdict
from pathlib import Path

import line_limits
import line_speed
import pytest
from line_limits import limits

from splatpipe.pipeline.engine.runs.store import Artifact

CORE = {
    "operations": 1e9,
    "products": 1e10,
    "copied": 1e9,
    "skimmed": 2e8,
    "read": 1e8,
    "decoded": 1e8,
    "jpeg": 5e7,
    "png": 1e7,
}


def artifact(folder: Path, summary: dict[str, object], **options: object) -> Artifact:
    return Artifact(folder, {"summary": summary, "inputs": {"config": options}, "parts": {}})


def test_limits_are_sums_of_what_is_counted_over_the_ceilings() -> None:
    assert limits({"read_pixels": 1e8}, CORE) == {"ingest": pytest.approx(0.5)}
    found = limits({"read_pixels": 1e8, "searched_pixels": 1e6, "keypoints": 1000}, CORE)
    octave = 2 * (11 + 13 + 17 + 21 + 27) + 5
    assert found["features"] == pytest.approx(1.0 + (4e6 * (4 / 3 * octave + 22) + 1000 * 55_000) / 1e9)
    assert limits({"products": 5e9}, CORE) == {"matches": pytest.approx(0.5)}
    resampled = {"undistorted_from": 1e8, "resampling": 1e9, "undistorted": 5e7}
    assert limits(resampled, CORE) == {"undistort": pytest.approx(1.0 + 1.0 + 1.0)}
    assert limits({"dense_windows": 1e6, "depth_windows": 2e6}, CORE) == {
        "initialize": pytest.approx(1.216),
        "depths": pytest.approx(2.432),
    }
    assert limits({"exported_bytes": 1e9}, CORE) == {"export": pytest.approx(2.0)}


def test_training_is_limited_by_pairs_loss_gaussians_and_the_slower_of_adams_operations_and_bytes() -> None:
    numbers = {"trained_pixels": 1e6, "pairs_a_pixel": 10.0, "stepped": 1e6, "decoded_to_train": 1e7}
    pixels, projected = 1e6 * (10.0 * (24 + 43) + 582), 1e6 * 930
    by_bytes = 1e6 * 59 * 28 / 1e9
    assert limits(numbers, CORE)["train"] == pytest.approx(0.1 + (pixels + projected) / 1e9 + by_bytes)
    in_cache = CORE | {"copied": 1e12}
    assert limits(numbers, in_cache)["train"] == pytest.approx(0.1 + (pixels + projected + 1e6 * 59 * 11) / 1e9)


def test_renders_of_cleaning_and_evaluation_count_the_pairs_of_their_pixels() -> None:
    cleaned = {"visibility_pixels": 1e6, "suspects_pixels": 2e6, "decoded_to_clean": 1e7, "pairs_a_pixel": 10.0}
    assert limits(cleaned, CORE) == {"clean": pytest.approx(0.1 + 10.0 * (1e6 * (32 + 43) + 2e6 * (24 + 43)) / 1e9)}
    judged = {"decoded_to_judge": 1e7, "judged_pixels": 1e6, "floater_pixels": 2e6, "pairs_a_pixel": 10.0}
    renders = 10.0 * (1e6 * 24 + 2e6 * 32) / 1e9
    assert limits(judged, CORE) == {"evaluate": pytest.approx(0.1 + 0.3 + renders + 1e6 * 375 / 1e9)}


def test_stages_whose_counts_are_unknown_or_zero_have_no_limit() -> None:
    assert limits({}, CORE) == {} and limits({"dense_windows": 0.0}, CORE) == {}
    costs = line_speed.LineCosts("a", {"ingest": 1.0, "matches": 2.0, "sparse": 4.0}, photos=4, megapixels=8.0, pairs=5)
    rows = {row["stage"]: row for row in line_speed.limit_table(costs, {"matches": 0.5, "depths": 9.0})}
    assert list(rows) == ["ingest", "matches", "sparse", "all stages"]
    assert rows["sparse"]["limit s"] is None and rows["sparse"]["times"] is None
    matches = {"CPU s": 2.0, "limit s": 0.5, "times": 4.0, "ms a photo": 500.0, "ms a megapixel": 250.0}
    assert rows["matches"] == {"stage": "matches", **matches, "ms a pair": 400.0}
    assert rows["all stages"]["limit s"] == 0.5 and rows["all stages"]["times"] == 4.0  # of those that have a limit
    assert line_speed.limit_table(costs, {})[-1]["times"] is None


def test_pairs_count_the_keypoints_of_both_photos(tmp_path: Path) -> None:
    base = sqlite3.connect(tmp_path / "database.db")
    base.execute("CREATE TABLE images (image_id, name)")
    base.execute("CREATE TABLE keypoints (image_id, rows)")
    base.executemany("INSERT INTO images VALUES (?, ?)", [(1, "a.jpg"), (2, "b.jpg")])
    base.executemany("INSERT INTO keypoints VALUES (?, ?)", [(1, 100), (2, 400)])
    base.commit()
    base.close()
    (tmp_path / "pairs.json").write_text(json.dumps({"pairs": [["a.jpg", "b.jpg", 30]]}))
    found = line_limits._pairs(defaultdict(lambda: artifact(tmp_path, {})))
    assert found == {"pairs": 1, "products": 128 * (100 * 20 * 7 + 30 * 500)}


def test_photos_are_searched_at_the_size_of_the_options(tmp_path: Path) -> None:
    groups = [{"photos": 2, "size": [4000, 3000]}, {"photos": 1, "size": [1000, 500]}]
    ingest = artifact(tmp_path, {"camera_groups": groups, "megapixels": 24.5})
    features = artifact(tmp_path, {"keypoints": 7}, max_image_size=2000)
    found = line_limits._photos({"ingest": ingest, "features": features})
    assert found == {"read_pixels": 24.5e6, "searched_pixels": 6.5e6, "keypoints": 7}


def test_samples_of_undistortion_follow_the_reduction(tmp_path: Path) -> None:
    ingest = artifact(tmp_path, {"photos": 10, "megapixels": 60.0})
    reduced = line_limits._resampled(
        {"ingest": ingest, "undistort": artifact(tmp_path, {"photos": 5, "megapixels": 10.0})}
    )
    assert reduced == {"undistorted_from": 30e6, "undistorted": 10e6, "resampling": 10e6 * 15 * 4}  # 1.7: two a side
    whole = line_limits._resampled(
        {"ingest": ingest, "undistort": artifact(tmp_path, {"photos": 5, "megapixels": 29.0})}
    )
    assert whole["resampling"] == 29e6 * 60  # a cubic


def test_windows_of_patch_match_are_of_all_sizes_and_photos(tmp_path: Path) -> None:
    assert line_limits._windows(8) == (6 / 16 + 3 / 4 + 1) * (8 + 6 * 4)
    assert line_limits._windows(3) == (6 / 16 + 3 / 4 + 1) * (3 + 6 * 3)
    made = artifact(tmp_path, {"photos": 100, "megapixels": 200.0})
    for photos, used in (("all", 90), ("covering", 66)):
        options = {"dense": True, "max_megapixels": 0.05, "photos": photos}
        found = {"undistort": made, "split": artifact(tmp_path, {"trained_on": 90})}
        found["initialize"] = artifact(tmp_path, {}, **options)
        assert line_limits._dense(found) == {"dense_windows": pytest.approx(used * 5e4 * line_limits._windows(8))}


def test_suspects_of_cleaning_count_only_where_floaters_were_found(tmp_path: Path) -> None:
    made = {"undistort": artifact(tmp_path, {"photos": 10, "megapixels": 20.0})}
    made["split"] = artifact(tmp_path, {"trained_on": 8})
    clean = artifact(tmp_path, {"reasons": {"floating": 3}}, photos="covering")
    found = line_limits._cleaned({**made, "clean": clean})
    assert found == {"visibility_pixels": 2.4e6, "suspects_pixels": 4.8e6, "decoded_to_clean": 16e6}
    nothing = line_limits._cleaned({**made, "clean": artifact(tmp_path, {"reasons": {"floating": 0}}, photos="all")})
    assert nothing == {"visibility_pixels": 2.4e6, "suspects_pixels": 0, "decoded_to_clean": 0}
