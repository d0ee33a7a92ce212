"""Control files written by another convention: named where it can be tested, and never used in silence."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from surveyed import HEIGHT, POINTS, TRUTH, WIDTH, Row, capture_parts, gcp_list, positions, rows, true_model

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.sfm.model.sparse_model import write_model
from splatpipe.pipeline.survey.crs.coordinate_readings import SHAPES, nearer_reading, shape_reading
from splatpipe.pipeline.survey.crs.crs import parse_crs
from splatpipe.pipeline.survey.crs.readings import Evidence, Reading, plausible
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.model import SparseModel, read_model
from splatpipe.pipeline.survey.points.surveyed_points import Survey, load_survey
from splatpipe.stages.georef import run

PHOTOS = {photo["name"]: Photo(photo["name"], "0" * 64, WIDTH, HEIGHT, 0) for photo in TRUTH["photos"]}
ALL = rows(tuple(POINTS))
PLANE = np.array([POINTS[name]["utm_m"][:2] for name in POINTS])
STATED = np.array([[r["latitude"], r["longitude"], r["altitude_m"]] for r in positions("gps", (3.0, 5.0))])
UTM = parse_crs("EPSG:32633")
ZONE_IN_FRONT = np.array([33e6, 0.0])


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


def georef(folder: Path, lift: float = 0.0, **options: str | bool) -> Notes:
    """The notes of georeferencing by five points and RTK positions that are lifted against them."""
    control = gcp_list(rows(("P01", "P03", "P05", "P07", "P16")))
    parts = capture_parts(folder, true_model(points=300), positions("rtk", (0.02, 0.03), lift), control)
    (folder / "out").mkdir()
    notes = Notes()
    run(GeorefConfig(adjust="off", **options), Inputs(parts, folder / "photos"), folder / "out", notes)
    return notes


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> SparseModel:
    folder = tmp_path_factory.mktemp("capture") / "model"
    write_model(true_model(points=300), folder)
    return read_model(folder, PHOTOS)


def load(folder: Path, model: SparseModel, lines: list[Row], **options: str) -> tuple[Survey, Notes]:
    path, notes = folder / "gcp_list.txt", Notes()
    path.write_text(gcp_list(lines))
    return load_survey(path, GeorefConfig(**options), PHOTOS, model, notes), notes


@pytest.mark.parametrize(
    ("written", "cause"),
    [
        (lambda x, y: (x, HEIGHT - y), "count from the bottom"),
        (lambda x, y: (x, -y), "QGIS"),
        (lambda x, y: (y, x), "columns and rows are swapped"),
        (lambda x, y: (WIDTH - x, y), "from the right"),
        (lambda x, y: (WIDTH - x, HEIGHT - y), "180°"),
        (lambda x, y: (HEIGHT - y, x), "turned by 90°"),
        (lambda x, y: (y, WIDTH - x), "turned by 270°"),
        (lambda x, y: (x / WIDTH, y / HEIGHT), "shares of the photo"),
        (lambda x, y: (x - WIDTH / 2.0, HEIGHT / 2.0 - y), "middle of the photo, upwards"),
        (lambda x, y: (2.0 * x, 2.0 * y), "2 times as wide"),
        (lambda x, y: (x / 4.0, y / 4.0), "1/4"),
    ],
)
def test_marks_by_another_convention_stop_control_which_names_it(
    tmp_path: Path, model: SparseModel, written: Callable[[float, float], tuple[float, float]], cause: str
) -> None:
    lines = [replace(row, pixel=written(*row.pixel)) for row in ALL]
    with pytest.raises(SplatpipeError, match=r"contradict each other|outside their photos") as caught:
        load(tmp_path, model, lines)
    assert cause in caught.value.hint
    assert "georef.control=none" in caught.value.hint


def test_marks_of_no_convention_stop_control_without_a_cause(tmp_path: Path, model: SparseModel) -> None:
    rng = np.random.default_rng(1)
    lines = [replace(row, pixel=tuple(rng.uniform(0.0, [WIDTH, HEIGHT]).tolist())) for row in ALL]
    with pytest.raises(SplatpipeError, match="contradict each other") as caught:
        load(tmp_path, model, lines)
    assert "looks like" not in caught.value.hint


def test_marks_a_third_of_which_are_wrong_are_sorted_out(tmp_path: Path, model: SparseModel) -> None:
    rng = np.random.default_rng(2)
    lines = [
        replace(row, pixel=tuple(rng.uniform(0.0, [WIDTH, HEIGHT]).tolist())) if k % 3 == 0 else row
        for k, row in enumerate(ALL)
    ]
    survey, _ = load(tmp_path, model, lines)
    assert all(point.found is not None for point in survey.points)


def test_names_that_lost_their_leading_zeros_are_said_to_have(tmp_path: Path, model: SparseModel) -> None:
    lines = [replace(row, photo=row.photo.replace("DJI_00", "DJI_").replace("DJI_0", "DJI_")) for row in ALL]
    with pytest.raises(SplatpipeError, match="None of the photos") as caught:
        load(tmp_path, model, lines)
    assert "spreadsheet" in caught.value.hint
    zeros = [replace(row, name=row.name.removeprefix("P0").removeprefix("P")) for row in ALL]
    with pytest.raises(SplatpipeError, match="not in the control file: 001, 002") as caught:
        load(tmp_path, model, zeros, check_points="001,002")
    assert "spreadsheet" in caught.value.hint


@pytest.mark.parametrize(
    ("xy", "crs", "cause"),
    [
        (PLANE + ZONE_IN_FRONT, "EPSG:32633", "zone number in front of the eastings (33)"),
        (PLANE[:, ::-1], "EPSG:32633", "swapped"),
        ((PLANE + ZONE_IN_FRONT)[:, ::-1], "EPSG:32633", "swapped (east comes first) and without the zone number"),
        (PLANE / 0.3048, "EPSG:32633", "in feet"),
        (PLANE * 3937.0 / 1200.0, "EPSG:32633", "in feet"),
        (PLANE * [1.0, -1.0], "EPSG:32633", "sign of the second"),
        (PLANE, "EPSG:32632", "as EPSG:32633"),
        (PLANE, "EPSG:32618", "as EPSG:32633"),
        (PLANE, "EPSG:31255", "as EPSG:32633"),
        (PLANE % 1e5, "EPSG:32633", "leading digits"),
        (STATED[:, :2], "EPSG:4326", "swapped"),
        (STATED[:, 1::-1] * [-1.0, 1.0], "EPSG:4326", "sign of the first"),
    ],
)
def test_coordinates_far_from_the_photos_are_read_as_what_brings_them_there(
    xy: np.ndarray, crs: str, cause: str
) -> None:
    assert cause in nearer_reading(xy, parse_crs(crs), STATED)


def test_coordinates_without_positions_are_read_by_their_area_and_sound_ones_are_not() -> None:
    nowhere = np.zeros((0, 3))
    assert "zone number in front" in nearer_reading(PLANE + ZONE_IN_FRONT, UTM, nowhere)
    assert "swapped" in nearer_reading(PLANE[:, ::-1], UTM, nowhere)
    assert nearer_reading(PLANE, UTM, STATED) == nearer_reading(PLANE, UTM, nowhere) == ""


WRITTEN: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
    lambda enu: enu[:, [1, 0, 2]],
    lambda enu: enu * [-1.0, 1.0, 1.0],
    lambda enu: enu * [1.0, -1.0, 1.0],
    lambda enu: enu * [1.0, 1.0, -1.0],
    lambda enu: enu / [1.0, 1.0, 0.3048],
    lambda enu: np.roll(enu, -1, axis=0),
    lambda enu: np.roll(enu, 1, axis=0),
)


@pytest.mark.parametrize("k", range(len(SHAPES)))
def test_points_in_another_shape_are_read_as_what_gives_them_the_models(k: int) -> None:
    """A frame of consumer positions: turned by a degree, three percent too large, and bent by a metre."""
    enu = np.array([POINTS[name]["xyz_m"] for name in POINTS])
    turn = np.array([[np.cos(0.02), -np.sin(0.02), 0.0], [np.sin(0.02), np.cos(0.02), 0.0], [0.0, 0.0, 1.0]])
    found = 1.03 * enu @ turn.T + [0.0, 0.0, 1.0] * (enu[:, :1] / 20.0) ** 2
    known = np.ones(len(enu), dtype=bool)
    assert shape_reading(found, enu, known) is None
    assert shape_reading(found[:0], enu[:0], known[:0]) is None  # nothing is marked yet
    cause = shape_reading(found, WRITTEN[k](enu), known)
    assert cause is not None
    assert cause[0] == SHAPES[k][0]


def test_a_reading_is_named_only_if_it_explains_nearly_all_and_the_stated_one_little() -> None:
    reading = Reading("", "")
    assert plausible(Evidence(3, 10), [(reading, Evidence(8, 10))]) is not None
    assert plausible(Evidence(4, 10), [(reading, Evidence(8, 10))]) is None
    assert plausible(Evidence(0, 10), [(reading, Evidence(7, 10))]) is None
    assert plausible(Evidence(0, 5), [(reading, Evidence(5, 5))]) is None


def test_swapped_file_in_a_datum_apart_is_told_of_its_place() -> None:
    """Not that PROJ knew no transformation, which it does where the points should be."""
    from splatpipe.pipeline.survey.crs.crs import from_geodetic, open_operation, to_geodetic

    crs = parse_crs("EPSG:31255")
    place = from_geodetic(open_operation(crs, *STATED[0, :2].tolist(), True), crs, STATED)
    with pytest.raises(SplatpipeError, match="outside the area of EPSG:31255"):
        to_geodetic(np.ascontiguousarray(place[:, [1, 0, 2]]), crs, True)


@pytest.mark.parametrize(
    ("lift", "pole", "geoid"), [(-2.0, True, False), (47.0, False, True), (-105.0, False, True), (0.0, False, False)]
)
def test_heights_a_pole_above_accurate_positions_are_reported_and_a_geoid_is_named_as_possible(
    tmp_path: Path, lift: float, pole: bool, geoid: bool
) -> None:
    result = georef(tmp_path, lift)
    assert any("Was a pole of that length" in text for text in result.warnings) == pole
    assert any("possibly one is above the geoid" in text for text in result.notes) == geoid


@pytest.mark.parametrize(("crs", "warned"), [("EPSG:5513", True), ("EPSG:5514", False)])
def test_crs_that_counts_west_is_told_to_be_unsuitable_for_rasters(tmp_path: Path, crs: str, warned: bool) -> None:
    done = georef(tmp_path, crs=crs, approximate_crs=True)
    assert any(f"{crs} " in text and "EPSG:32633" in text for text in done.warnings) == warned
