"""Control and check points against the demo's truth: accuracy, the adjustment to them, and mistakes in them."""

import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
import pytest
from surveyed import (
    LENS,
    NADIR,
    PLACE,
    POINTS,
    TRUTH,
    Row,
    adjusted,
    capture_parts,
    gcp_list,
    positions,
    rows,
    true_model,
)

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Summary
from splatpipe.pipeline.sfm.lenses.focal import UNOBSERVED, focal_sigmas
from splatpipe.pipeline.survey.control.residuals import chi_squared_quantile, rmse_interval
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.survey.files.scale_bars import ScaleBar
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.targets.target_finds import WantedTargets, save_wanted
from splatpipe.stages.georef import run

GROUND_AND_ROOF = ("P01", "P02", "P03", "P04", "P05", "P06", "P07", "P08", "P15", "P16", "P17", "P18")
FIVE = ("P01", "P03", "P05", "P07", "P16")
OTHERS = tuple(name for name in POINTS if name not in FIVE)
CONSUMER, RTK = ("gps", (3.0, 5.0)), ("rtk", (0.02, 0.03))


@dataclass
class Notes:
    """A reporter that records."""

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(f"{message} {hint}")


@dataclass(frozen=True)
class Result:
    """Return georef's output."""

    out: Path
    parts: dict[str, Path]
    summary: Summary
    notes: Notes

    def read(self, name: str) -> Any:
        return json.loads((self.out / name).read_text(encoding="utf-8"))

    def table(self, name: str) -> Any:
        return self.read("accuracy.json")["tables"][name]

    def roles(self) -> dict[str, str]:
        return {point["name"]: point["role"] for point in self.read("control.json")["points"]}

    @property
    def gsd_m(self) -> float:
        return float(self.read("accuracy.json")["gsd_m"])

    def is_model_untouched(self) -> bool:
        before, after = self.parts["sparse.model"], self.out / "sparse" / "0"
        return {p.name: p.read_bytes() for p in before.iterdir()} == {p.name: p.read_bytes() for p in after.iterdir()}


@pytest.fixture(scope="module")
def whole() -> pycolmap.Reconstruction:
    """All forty photos, adjusted freely: structure from motion at its best."""
    return adjusted(true_model())


def georef(
    folder: Path,
    model: pycolmap.Reconstruction,
    control: str,
    stated: tuple[str, tuple[float, float]] | None = CONSUMER,
    lift: float = 0.0,
    bars: tuple[ScaleBar, ...] = (),
    **options: Any,
) -> Result:
    names = {image.name for image in model.images.values()}
    records = [] if stated is None else [r for r in positions(*stated, lift) if r["name"] in names]
    parts = capture_parts(folder, model, records, control)
    if bars:
        save_wanted(WantedTargets("", (), bars), parts["control.points"])
    (folder / "out").mkdir()
    notes = Notes()
    summary = run(GeorefConfig(**options), Inputs(parts, folder / "photos"), folder / "out", notes)
    return Result(folder / "out", parts, summary, notes)


def checks(*names: str) -> str:
    return ",".join(names)


def independent_rmse(result: Result, names: tuple[str, ...]) -> tuple[float, float]:
    """Horizontal and vertical RMSE of points by other means: linear triangulation of the marks with the model's
    cameras as placed in the frame, transformed to the truth's frame by PROJ, against the truth's coordinates."""
    frame = load_frame(result.out / "frame.json")
    model = pycolmap.Reconstruction(result.out / "sparse" / "0")
    by_name = {image.name: image for image in model.images.values()}
    origin = frame.origin
    assert origin is not None
    topocentric = "+proj=topocentric +lat_0={} +lon_0={} +h_0={}"
    ours, theirs = (
        pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=cart +ellps=WGS84 +step "
            + (topocentric + " +ellps=WGS84").format(o.latitude, o.longitude, o.height_m)
        )
        for o in (origin, PLACE)
    )
    errors = []
    for point in result.read("control.json")["points"]:
        if point["name"] not in names:
            continue
        equations = []
        for seen in point["observations"]:
            image = by_name[seen["photo"]]
            x, y = np.asarray(model.cameras[image.camera_id].cam_from_img(np.array([seen["pixel"]])))[0]
            pose = np.asarray(image.cam_from_world().matrix())
            equations += [x * pose[2] - pose[0], y * pose[2] - pose[1]]
        place = np.linalg.svd(np.array(equations))[2][-1]
        local = frame.world_from_model.apply((place[:3] / place[3])[None])[0]
        geodetic = ours.transform(*local, direction="INVERSE")
        errors.append(np.array(theirs.transform(*geodetic)) - POINTS[point["name"]]["xyz_m"])
    off = np.array(errors)
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())), float(np.sqrt((off[:, 2] ** 2).mean()))


@pytest.mark.parametrize("lift", [0.0, -47.0])
def test_five_control_points_make_the_check_points_right_whatever_the_datum_of_gps(
    tmp_path: Path, whole: pycolmap.Reconstruction, lift: float
) -> None:
    """The lift: control heights 47 m above GPS heights. Not more than the receivers' mean error of 3 m / sqrt(40)."""
    result = georef(tmp_path, whole, gcp_list(rows(tuple(POINTS))), lift=lift, check_points=checks(*OTHERS))
    table = result.table("check")
    assert table["count"] == 13
    assert table["rmse_horizontal_m"] <= result.gsd_m
    assert table["rmse_up_m"] <= 1.5 * result.gsd_m
    offset = result.table("gps")["flights"][0]["offset_m"]
    assert offset[2] == pytest.approx(lift, abs=3.0 * 3.0 / np.sqrt(40))
    assert result.is_model_untouched()
    assert result.summary["moved_px"] < 0.1
    assert result.notes.warnings == []


def test_figures_are_those_computed_independently_from_the_truth(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    """To 1 %, or a tenth of a millimetre: the linear triangulation weights marks differently."""
    result = georef(tmp_path, whole, gcp_list(rows(tuple(POINTS))), check_points=checks(*OTHERS))
    horizontal, vertical = independent_rmse(result, OTHERS)
    assert result.table("check")["rmse_horizontal_m"] == pytest.approx(horizontal, rel=0.01, abs=2e-4)
    assert result.table("check")["rmse_up_m"] == pytest.approx(vertical, rel=0.01, abs=2e-4)


def test_rtk_alone_makes_check_points_right(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    result = georef(tmp_path, whole, gcp_list(rows(tuple(POINTS))), RTK, check_points=checks(*POINTS))
    table = result.table("check")
    assert table["count"] == 18
    assert table["rmse_horizontal_m"] <= result.gsd_m
    assert table["rmse_up_m"] <= 1.5 * result.gsd_m


def test_residuals_to_consumer_gps_are_what_was_injected(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    result = georef(tmp_path, whole, gcp_list(rows(FIVE)))
    table = result.table("gps")
    for axis, sigma in zip(("east", "north", "up"), TRUTH["sigmas"]["gps_m"], strict=True):
        assert table[f"rmse_{axis}_m"] == pytest.approx(sigma, rel=0.2)


def test_check_points_in_another_datum_than_the_positions_are_reported(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    result = georef(tmp_path, whole, gcp_list(rows(FIVE)), RTK, lift=47.0, check_points=checks(*FIVE))
    assert [w for w in result.notes.warnings if "+47.0 m" in w and "vertical datum" in w]


def test_control_places_a_model_without_positions(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    result = georef(tmp_path, whole, gcp_list(rows(tuple(POINTS))), None, check_points=checks(*OTHERS))
    assert result.table("gps") is None
    assert result.table("check")["rmse_3d_m"] <= 1.5 * result.gsd_m


def test_doming_of_a_wrong_lens_is_straightened_by_control(tmp_path: Path) -> None:
    """Two nadir strips, focal length 3 % too long and no distortion, both held in structure from motion."""
    domed = adjusted(true_model(NADIR), LENS[0] * 1.03, 0.0)
    others = [name for name in GROUND_AND_ROOF if name not in FIVE]
    control = gcp_list(rows(GROUND_AND_ROOF, NADIR) + made_up(domed))
    vertical = {}
    for adjust in ("off", "auto"):
        result = georef(tmp_path / adjust, domed, control, check_points=checks(*others, "Q1"), adjust=adjust)
        vertical[adjust] = result.table("check")["rmse_up_m"]
        assert result.table("check")["count"] == 8
        assert result.is_model_untouched() == (adjust == "off")
    assert any("adjusted to it" in note for note in result.notes.notes)
    assert result.summary["model_bent"]
    assert vertical["off"] >= 3.0 * vertical["auto"]
    horizontal, up = independent_rmse(result, tuple(others))
    assert up < vertical["off"] / 3.0
    assert horizontal < result.gsd_m
    focal = pycolmap.Reconstruction(result.out / "sparse" / "0").cameras[1].params[0]
    assert focal == pytest.approx(LENS[0], rel=0.01)
    assert result.summary["focal_held"] == []


def test_scale_bars_take_part_in_the_adjustment(tmp_path: Path) -> None:
    """Poor control, its distances 1 % too long: the bars, good to 2 mm, decide about lengths."""
    domed = adjusted(true_model(NADIR), LENS[0] * 1.03, 0.0)
    lines = rows(GROUND_AND_ROOF, NADIR)
    middle = np.mean([row.place for row in lines], axis=0)

    def stretched(row: Row) -> Row:
        east, north, up = (middle + [1.01, 1.01, 1.0] * (np.array(row.place) - middle)).tolist()
        return replace(row, place=(east, north, up))

    control = gcp_list([stretched(row) for row in lines])
    places = {name: np.array(POINTS[name]["xyz_m"]) for name in POINTS}
    pairs = (("P01", "P03"), ("P03", "P05"), ("P05", "P07"), ("P01", "P07"))
    bars = tuple(ScaleBar(a, b, float(np.linalg.norm(places[a] - places[b])), 0.002) for a, b in pairs)
    errors = {}
    for adjust in ("off", "auto"):
        result = georef(tmp_path / adjust, domed, control, None, bars=bars, adjust=adjust, control_sigma_m=0.2)
        scale = result.read("accuracy.json")["scale"]
        assert [bar["used"] for bar in scale["bars"]] == [True] * 4
        errors[adjust] = max(abs(bar["error_m"]) for bar in scale["bars"])
    assert errors["off"] > 0.1
    assert errors["auto"] < 0.02
    assert any("After the adjustment, which 4 scale bars" in note for note in result.notes.notes)
    assert not result.is_model_untouched()


def made_up(model: pycolmap.Reconstruction) -> list[Row]:
    """Another point on the ground, Q1, where the true cameras show it."""
    xyz = np.array([2.0, -13.0, 0.0])
    geodetic = PLACE.geodetic_from_enu(xyz[None])[0]
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
    place = (*utm.transform(geodetic[1], geodetic[0]), float(geodetic[2]))
    found = []
    for photo in TRUTH["photos"]:
        x, y, z = (np.array(photo["cam_from_world"])[:3] @ np.append(xyz, 1.0)).tolist()
        u, v = x / z, y / z
        factor = LENS[0] * (1.0 + LENS[3] * (u * u + v * v))
        pixel = (factor * u + LENS[1], factor * v + LENS[2])
        if photo["name"] in NADIR and 0.0 < pixel[0] < 1200.0 and 0.0 < pixel[1] < 900.0:
            found.append(Row("Q1", place, photo["name"], pixel))
    return found


def test_blunder_that_doming_hides_is_found_by_the_adjustment(tmp_path: Path) -> None:
    """A similarity misses every point by decimetres; the adjustment only the wrong one."""
    domed = adjusted(true_model(NADIR), LENS[0] * 1.03, 0.0)
    lines = [
        replace(row, place=(*row.place[:2], row.place[2] + 0.5)) if row.name == "P05" else row
        for row in rows(GROUND_AND_ROOF, NADIR)
    ]
    control = ("P01", "P03", "P05", "P07", "P16", "P08")
    result = georef(
        tmp_path, domed, gcp_list(lines), check_points=checks(*(n for n in GROUND_AND_ROOF if n not in control))
    )
    assert result.roles()["P05"] == "left_out"
    assert [w for w in result.notes.warnings if "Control point P05 is left out" in w and "field book" in w]
    assert result.table("check")["rmse_up_m"] <= 1.5 * result.gsd_m


def flat_nadir() -> pycolmap.Reconstruction:
    """The nadir strips over ground without relief: a longer lens at a greater height gives the same photos."""
    return adjusted(true_model(NADIR, flat=True))


def test_posterior_shows_which_photos_determine_their_focal_length(whole: pycolmap.Reconstruction) -> None:
    before = np.array(whole.cameras[1].params)
    assert focal_sigmas(whole)[1] < 0.1 * UNOBSERVED
    assert focal_sigmas(flat_nadir())[1] > UNOBSERVED
    np.testing.assert_array_equal(whole.cameras[1].params, before)


def test_undetermined_focal_length_is_held_near_the_metadata(tmp_path: Path) -> None:
    """Control on the flat ground does not determine it either; the metadata state 853 pixels, the model 10 % more."""
    flat = adjusted(true_model(NADIR, flat=True), LENS[0] * 1.1, LENS[3])
    ground = ("P01", "P02", "P03", "P04", "P05", "P06", "P07", "P08")
    result = georef(tmp_path, flat, gcp_list(rows(ground, NADIR)), check_points="none")
    assert [w for w in result.notes.warnings if "determine the focal length" in w]
    assert result.summary["focal_held"] == [1]
    if result.summary["model_bent"]:
        focal = pycolmap.Reconstruction(result.out / "sparse" / "0").cameras[1].params[0]
        assert focal == pytest.approx(853.0, rel=0.031)


def test_bent_model_is_the_same_bits_again(tmp_path: Path) -> None:
    domed = adjusted(true_model(NADIR, 600), LENS[0] * 1.03, 0.0)
    control = gcp_list(rows(GROUND_AND_ROOF, NADIR))
    first, again = (georef(tmp_path / name, domed, control) for name in ("a", "b"))
    for path in sorted(first.out.rglob("*.*")):
        assert path.read_bytes() == (again.out / path.relative_to(first.out)).read_bytes(), path.name


@pytest.mark.parametrize("stated", [CONSUMER, None])
def test_control_point_half_a_metre_off_is_named_and_left_out(
    tmp_path: Path, whole: pycolmap.Reconstruction, stated: tuple[str, tuple[float, float]] | None
) -> None:
    shifted = [
        replace(row, place=(row.place[0] + 0.5, *row.place[1:])) if row.name == "P05" else row
        for row in rows(tuple(POINTS))
    ]
    result = georef(tmp_path, whole, gcp_list(shifted), stated, check_points=checks(*OTHERS))
    assert result.roles()["P05"] == "left_out"
    (warning,) = result.notes.warnings
    assert re.search(r"Control point P05 is left out: .*0\.(48|49|50|51|52) m .*east -0\.[45].*field book", warning)
    assert result.table("check")["rmse_up_m"] <= 1.5 * result.gsd_m


def test_check_point_that_is_off_is_named_and_stays_in_the_table(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    shifted = [
        replace(row, place=(*row.place[:2], row.place[2] - 0.5)) if row.name == "P08" else row
        for row in rows(tuple(POINTS))
    ]
    result = georef(tmp_path, whole, gcp_list(shifted), check_points=checks(*OTHERS))
    assert [w for w in result.notes.warnings if "Check point P08" in w and "up +0.5" in w]
    assert result.roles()["P08"] == "check"
    assert result.table("check")["rmse_up_m"] > 0.1


@pytest.mark.parametrize("pair", [("P03", "P07"), ("P15", "P08")])
def test_swapped_names_are_reported(tmp_path: Path, whole: pycolmap.Reconstruction, pair: tuple[str, str]) -> None:
    """Two control points; one of each kind; two check points."""
    places = {row.name: row.place for row in rows(tuple(POINTS))}
    other = dict(zip(pair, reversed(pair), strict=True))
    swapped = [replace(row, place=places[other.get(row.name, row.name)]) for row in rows(tuple(POINTS))]
    result = georef(tmp_path, whole, gcp_list(swapped), check_points=checks(*OTHERS))
    a, b = sorted(pair)
    assert [w for w in result.notes.warnings if f"{a} and {b} look swapped" in w and "Swap" in w]
    assert {result.roles()[name] for name in pair} == {"left_out"}
    assert result.table("check")["rmse_3d_m"] < 2.0 * result.gsd_m


@pytest.mark.parametrize(
    ("crs", "swap", "message", "hint"),
    [
        ("EPSG:32632", False, "km from the photos|outside", "EPSG:32633"),
        ("EPSG:32733", False, "km", "EPSG:32633"),
        ("EPSG:32633", True, "km|not defined", "swapped"),
        ("EPSG:4326", False, "not defined|km", "EPSG:32633"),
    ],
)
def test_file_in_the_wrong_crs_is_refused_with_the_right_one(
    tmp_path: Path, whole: pycolmap.Reconstruction, crs: str, swap: bool, message: str, hint: str
) -> None:
    lines = rows(FIVE)
    if swap:
        lines = [replace(row, place=(row.place[1], row.place[0], row.place[2])) for row in lines]
    with pytest.raises(SplatpipeError, match=message) as caught:
        georef(tmp_path, whole, gcp_list(lines, crs))
    assert hint in caught.value.hint
    assert "georef.control=none" in caught.value.hint


def test_file_of_other_photos_is_refused_and_some_missing_ones_are_named(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    strange = [replace(row, photo=f"IMG_{row.photo}") for row in rows(FIVE)]
    with pytest.raises(SplatpipeError, match=r"None of the photos.*IMG_DJI") as caught:
        georef(tmp_path / "a", whole, gcp_list(strange))
    assert "listed by their file names" in caught.value.hint
    some = [replace(row, photo="GONE.JPG") if row.photo == "DJI_0020.JPG" else row for row in rows(FIVE)]
    result = georef(tmp_path / "b", whole, gcp_list(some))
    assert [w for w in result.notes.warnings if "1 photo that is not found in this capture: GONE.JPG" in w]
    assert result.table("control")["count"] == 5


def test_file_without_a_crs_or_with_one_place_for_all_is_refused_by_name(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    with pytest.raises(SplatpipeError, match=r"CRS of gcp_list.txt.*EPSG:999999"):
        georef(tmp_path / "a", whole, gcp_list(rows(FIVE), "EPSG:999999"))
    lines = rows(FIVE)
    with pytest.raises(SplatpipeError, match=r"All control points of gcp_list.txt have the same coordinates"):
        georef(tmp_path / "b", whole, gcp_list([replace(row, place=lines[0].place) for row in lines]))


def test_control_on_a_line_is_reported_and_well_distributed_control_is_not(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    control = gcp_list(rows(tuple(POINTS)))
    for name, kept, weak in (("line", ("P06", "P12", "P14"), True), ("site", FIVE, False)):
        others = checks(*(point for point in POINTS if point not in kept))
        warnings = georef(tmp_path / name, whole, control, None, check_points=others, adjust="off").notes.warnings
        assert any("spread over the site" in warning for warning in warnings) == weak, name


def test_coordinates_beyond_their_crs_are_of_a_named_file(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    swapped = [replace(row, place=(row.place[1], row.place[0], row.place[2])) for row in rows(FIVE)]
    with pytest.raises(SplatpipeError, match=r"^gcp_list.txt: ") as caught:
        georef(tmp_path, whole, gcp_list(swapped), None)
    assert "east" in caught.value.hint


def test_heights_in_feet_are_reported(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    feet = [replace(row, place=(*row.place[:2], row.place[2] / 0.3048)) for row in rows(FIVE)]
    result = georef(tmp_path, whole, gcp_list(feet), check_points="none", adjust="off")
    assert [w for w in result.notes.warnings if "more than vertical datums can differ" in w and "feet" in w]


def test_mark_on_the_wrong_pixel_is_named_and_left_out(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    lines = rows(FIVE)
    wrong = next(k for k, row in enumerate(lines) if row.name == "P03")
    lines[wrong] = replace(lines[wrong], pixel=(lines[wrong].pixel[0], 40.0))
    result = georef(tmp_path, whole, gcp_list(lines))
    assert [w for w in result.notes.warnings if "Marks of P03" in w and lines[wrong].photo in w]
    point = next(p for p in result.read("control.json")["points"] if p["name"] == "P03")
    assert [o["photo"] for o in point["observations"] if not o["used"]] == [lines[wrong].photo]
    assert np.abs(point["residual_m"]).max() < 0.03


def test_marks_made_in_larger_photos_are_refused(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    large = [replace(row, pixel=(4.0 * row.pixel[0], 4.0 * row.pixel[1])) for row in rows(FIVE)]
    with pytest.raises(SplatpipeError, match="outside their photos") as caught:
        georef(tmp_path, whole, gcp_list(large))
    assert "made in photos 4 times as wide and high" in caught.value.hint


def test_point_seen_once_is_named(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    lines = [row for row in rows(FIVE) if row.name != "P03"] + rows(("P03",))[:1]
    result = georef(tmp_path, whole, gcp_list(lines))
    assert [w for w in result.notes.warnings if "P03" in w and "marked in one photo only" in w]
    assert result.roles()["P03"] == "left_out"


def test_control_without_heights_controls_horizontally(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    """Without positions, the cameras' usual attitude levels the model; with them, heights are the positions'."""
    flat = [replace(row, place=(*row.place[:2], 0.0)) for row in rows(GROUND_AND_ROOF)]
    alone = georef(tmp_path / "alone", whole, gcp_list(flat), None)
    assert any("0.0 is treated as unknown" in note for note in alone.notes.notes)
    assert alone.table("check")["rmse_up_m"] is None
    assert alone.table("check")["rmse_horizontal_m"] < 2.0 * alone.gsd_m
    frame = load_frame(alone.out / "frame.json")
    assert frame.vertical_datum == "unknown"
    both = georef(tmp_path / "both", whole, gcp_list(flat))
    assert both.table("check")["rmse_horizontal_m"] < 2.0 * both.gsd_m
    found = load_frame(both.out / "frame.json")
    assert found.origin is not None
    centres = [i.projection_center() for i in pycolmap.Reconstruction(both.out / "sparse" / "0").images.values()]
    heights = found.world_from_model.apply(np.array(centres))[:, 2] + found.origin.height_m
    true = np.array([photo["centre_m"][2] for photo in TRUTH["photos"]]) + PLACE.height_m
    assert np.median(heights) == pytest.approx(float(np.median(true)), abs=3.0)


def test_hand_held_control_is_weighted_by_its_agreement(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    """Errors of 0.8 m: no blunder, no bending, and a sigma of that order."""
    rng = np.random.default_rng(5)
    errors = {name: rng.normal(size=3) * 0.8 for name in POINTS}
    rough = [
        replace(row, place=tuple((np.array(row.place) + errors[row.name]).tolist())) for row in rows(tuple(POINTS))
    ]
    result = georef(tmp_path, whole, gcp_list(rough), None)
    assert result.is_model_untouched()
    assert "left_out" not in result.roles().values()
    assert [w for w in result.notes.warnings if "hand-held" in w]
    assert 0.4 < result.table("check")["rmse_horizontal_m"] < 2.5


def test_sixth_control_point_leaves_the_model_unchanged(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    five = georef(tmp_path / "five", whole, gcp_list(rows(FIVE)))
    six = georef(tmp_path / "six", whole, gcp_list(rows((*FIVE, "P12"))), check_points="none")
    assert five.is_model_untouched()
    assert six.is_model_untouched()
    assert six.table("control")["count"] == 6
    assert (five.out / "frame.json").read_bytes() != (six.out / "frame.json").read_bytes()


def test_every_third_of_six_points_is_a_check_point_by_default(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    names = ("P01", "P02", "P03", "P04", "P05", "P06")
    auto = georef(tmp_path / "auto", whole, gcp_list(rows(names)))
    assert [name for name, role in auto.roles().items() if role == "check"] == ["P03", "P06"]
    named = georef(tmp_path / "named", whole, gcp_list(rows(names)), check_points="P01, P02")
    assert [name for name, role in named.roles().items() if role == "check"] == ["P01", "P02"]
    with pytest.raises(SplatpipeError, match="P99"):
        georef(tmp_path / "wrong", whole, gcp_list(rows(names)), check_points="P99")


def test_option_takes_precedence_over_roles_in_the_file_and_says_so(
    tmp_path: Path, whole: pycolmap.Reconstruction
) -> None:
    names = ("P01", "P02", "P03", "P04", "P05", "P06")
    lines = ["EPSG:32633", "name,x,y,z,photo,pixel_x,pixel_y,role"]
    for row in rows(names):
        role = "check" if row.name in {"P02", "P05"} else "control"
        lines.append(",".join(map(str, (row.name, *row.place, row.photo, *row.pixel, role))))
    control = "\n".join(lines) + "\n"
    notes_of = {}
    for k, option in enumerate(("auto", "P02,P05", "P01", "none")):
        result = georef(tmp_path / str(k), whole, control, check_points=option)
        checks = [name for name, role in result.roles().items() if role == "check"]
        assert checks == {"auto": ["P02", "P05"], "none": []}.get(option, option.split(","))
        notes_of[option] = [note for note in result.notes.notes if "georef.check_points=" in note]
    assert not notes_of["auto"] + notes_of["P02,P05"]
    assert all("which has P02, P05 as check points" in " ".join(notes_of[option]) for option in ("P01", "none"))


def test_pixels_may_count_from_the_centre_of_the_first(tmp_path: Path, whole: pycolmap.Reconstruction) -> None:
    centred = [replace(row, pixel=(row.pixel[0] - 0.5, row.pixel[1] - 0.5)) for row in rows(FIVE)]
    corner = georef(tmp_path / "corner", whole, gcp_list(rows(FIVE)))
    centre = georef(tmp_path / "centre", whole, gcp_list(centred), pixel_origin="centre")
    for ours, theirs in zip(corner.read("control.json")["points"], centre.read("control.json")["points"], strict=True):
        np.testing.assert_allclose(ours["estimated_m"], theirs["estimated_m"], atol=1e-6)
        np.testing.assert_allclose(ours["observations"][0]["pixel"], theirs["observations"][0]["pixel"], atol=1e-9)


@pytest.mark.parametrize(("degrees", "tail"), [(1, 5.023886), (2, 7.377759), (10, 20.483177), (100, 129.561197)])
def test_intervals_follow_the_chi_squared_distribution(degrees: int, tail: float) -> None:
    """Tabulated 97.5 % quantiles; and a simulation: 95 % of the intervals hold the true sigma."""
    assert chi_squared_quantile(0.975, degrees) == pytest.approx(tail, rel=1e-6)
    rng = np.random.default_rng(degrees)
    rms = np.sqrt((rng.normal(size=(200, degrees)) ** 2).mean(axis=1))
    held = [low <= 1.0 <= high for low, high in (rmse_interval(float(each), degrees) for each in rms)]
    assert np.mean(held) == pytest.approx(0.95, abs=0.05)
