"""Accurate positions in the adjustment: bent models, honest heights, what control adds, and what stays as it was."""

from pathlib import Path
from typing import Any

import pycolmap
import pytest
from surveyed import LENS, NADIR, adjusted, capture_parts, gcp_list, positions, rows, true_model
from threadpoolctl import threadpool_limits

from splatpipe.pipeline.engine.runs.source import ABSENT
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.stages.georef import run

from .test_control import CONSUMER, FIVE, GROUND_AND_ROOF, RTK, Notes, Result, checks, georef


@pytest.fixture(scope="module")
def bowl() -> pycolmap.Reconstruction:
    """Two strips straight down, mapped with a focal length 3 % too long and without distortion."""
    return adjusted(true_model(NADIR), LENS[0] * 1.03, 0.0)


def placed(folder: Path, model: pycolmap.Reconstruction, stated: Any = RTK, **options: Any) -> Result:
    """Return georef's output with all points as check points."""
    control = gcp_list(rows(GROUND_AND_ROOF, NADIR))
    return georef(folder, model, control, stated, check_points=checks(*GROUND_AND_ROOF), **options)


def alone(
    folder: Path,
    model: pycolmap.Reconstruction,
    stated: tuple[str, tuple[float, float]] = RTK,
    settings: dict[str, str] | None = None,
) -> Result:
    """Return georef's output without control."""
    names = {image.name for image in model.images.values()}
    records = [record for record in positions(*stated) if record["name"] in names]
    parts = capture_parts(folder, model, records, "") | {"source.control": ABSENT}
    (folder / "out").mkdir()
    notes = Notes()
    inputs = Inputs(parts, folder / "photos", settings=settings or {})
    summary = run(GeorefConfig(), inputs, folder / "out", notes)
    return Result(folder / "out", parts, summary, notes)


def test_positions_take_the_bowl_out_of_a_flight_straight_down(tmp_path: Path, bowl: pycolmap.Reconstruction) -> None:
    found, without = placed(tmp_path / "with", bowl), placed(tmp_path / "without", bowl, adjust="off")
    assert not found.is_model_untouched()
    assert without.is_model_untouched()
    assert found.table("gps")["rmse_up_m"] < 0.7 * without.table("gps")["rmse_up_m"]
    assert found.table("check")["rmse_horizontal_m"] < 0.5 * without.table("check")["rmse_horizontal_m"]
    together = found.read("accuracy.json")["adjustment"]["heights"]["together_sigma_m"][2]
    assert abs(found.table("check")["mean_m"][2]) < 3.0 * together


def test_uncertain_heights_are_said_with_what_settles_them(tmp_path: Path, bowl: pycolmap.Reconstruction) -> None:
    result = alone(tmp_path, bowl)
    heights = result.read("accuracy.json")["adjustment"]["heights"]
    assert "one control point" in heights["sentence"]
    assert any("together (95 %)" in warning and "One control point" in warning for warning in result.notes.warnings)
    assert any(note.startswith("Camera positions that the fit did not use") for note in result.notes.notes)
    remedies = heights["remedies"]
    assert remedies["control_3"]["height_sigma_m"] <= remedies["control_1"]["height_sigma_m"]
    assert remedies["control_1"]["height_sigma_m"] < 0.3 * heights["together_sigma_m"][2]
    assert result.read("frame.json")["residuals"]["uncertainty"]["heights"] == heights["sentence"]


def test_a_held_lens_is_no_surer_than_what_it_comes_from(tmp_path: Path) -> None:
    held = alone(tmp_path, adjusted(true_model(NADIR)), settings={"sparse.lens": "held"})
    (lens,) = held.read("accuracy.json")["adjustment"]["lenses"]
    assert lens["names"] == ["f"]
    assert 0.001 < lens["sigmas"][0] / lens["values"][0] < 0.03
    assert "one control point" in held.read("accuracy.json")["adjustment"]["heights"]["sentence"]


def test_one_control_point_settles_the_heights(tmp_path: Path, bowl: pycolmap.Reconstruction) -> None:
    control = gcp_list(rows(GROUND_AND_ROOF, NADIR))
    others = [name for name in GROUND_AND_ROOF if name != FIVE[1]]
    result = georef(tmp_path, bowl, control, RTK, check_points=checks(*others))
    assert result.roles()[FIVE[1]] == "control"
    assert abs(result.table("check")["mean_m"][2]) < 0.06
    assert result.read("accuracy.json")["adjustment"]["heights"]["together_sigma_m"][2] < 0.12


def test_a_sound_model_stays_as_it_is(tmp_path: Path) -> None:
    result = alone(tmp_path, adjusted(true_model()))
    adjustment = result.read("accuracy.json")["adjustment"]
    assert result.is_model_untouched()
    assert not adjustment["adopted"]
    assert adjustment["heights"]["sentence"] is None
    assert max(adjustment["predicted_m"]) < 0.06


def test_poor_positions_are_not_in_the_adjustment(tmp_path: Path, bowl: pycolmap.Reconstruction) -> None:
    result = alone(tmp_path, bowl, CONSUMER)
    assert result.is_model_untouched()
    assert "adjustment" not in result.read("accuracy.json")


def test_positions_stated_accurate_that_are_not_leave_the_model(tmp_path: Path, bowl: pycolmap.Reconstruction) -> None:
    result = alone(tmp_path, bowl, ("gps", (0.02, 0.03)))
    assert result.is_model_untouched()
    assert any("inaccurate" in warning for warning in result.notes.warnings)


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_no_bit(tmp_path: Path, bowl: pycolmap.Reconstruction, threads: int) -> None:
    written = []
    for number in (1, threads):
        with threadpool_limits(limits=number):
            out = placed(tmp_path / str(number), bowl).out
        written.append({path.name: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()})
    assert written[0] == written[1]
