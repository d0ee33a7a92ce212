"""A boundary is read from anyone's GeoJSON and placed on the model by its coordinates, or rejected with a reason."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpipe.demo import capture_path
from splatpipe.demo.photography.geodesy import Origin as DemoOrigin
from splatpipe.pipeline.app.library.requests import overrides
from splatpipe.pipeline.app.preflight.boundary import boundary_findings
from splatpipe.pipeline.app.terminal.parameters import CaptureSettings
from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.geometry.plan_area import PlanArea, read_model_area, read_world_area
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.photos.files.scan import Candidate
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.survey.boundary import write_boundary
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.files import boundary_file
from splatpipe.pipeline.survey.files.boundary_file import crossing_of, read_boundary
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.positions.photo_positions import Position, read_positions

DEMO = DemoOrigin()
WORLD_FROM_MODEL = Similarity(6.5, rotation_from_vector(np.array([1.9, -0.7, 0.4])), np.array([12.0, -7.0, 3.0]))
FRAME = Frame("enu", WORLD_FROM_MODEL, Origin(DEMO.latitude, DEMO.longitude, DEMO.height_m), crs="EPSG:32633")
OUTLINE = np.array([[-9.0, -8.0], [12.0, -8.0], [12.0, 8.0], [-9.0, 8.0]])  # east and north, metres
HOLE = np.array([[-2.0, -2.0], [-2.0, 2.0], [2.0, 2.0], [2.0, -2.0]])
POINTS = np.random.default_rng(4).uniform(-30.0, 30.0, (4000, 3))  # in the world


class Notes:
    def __init__(self) -> None:
        self.notes: list[str] = []
        self.warnings: list[str] = []

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(f"{message} {hint}")


def degrees(ring: np.ndarray) -> list[list[float]]:
    places = DEMO.geodetic(np.column_stack([ring, np.zeros(len(ring))]))
    return [[x, y] for y, x in [*places[:, :2].tolist(), places[0, :2].tolist()]]


def metres(ring: np.ndarray) -> list[list[float]]:
    places = DEMO.utm(np.column_stack([ring, np.zeros(len(ring))]))
    return [[*place, 512.0] for place in [*places[:, :2].tolist(), places[0, :2].tolist()]]


def polygon(as_stated: Callable[[np.ndarray], list[list[float]]], *rings: np.ndarray) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": [as_stated(ring) for ring in rings]}


def named(name: str) -> dict[str, Any]:
    return {"crs": {"type": "name", "properties": {"name": name}}}


def written(folder: Path, value: Any) -> Path:
    path = folder / "boundary.geojson"
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def laid(folder: Path, value: Any, frame: Frame = FRAME, points: np.ndarray = POINTS) -> tuple[PlanArea, Notes]:
    """Return the result in the world frame, after checking that the model's frame agrees."""
    notes, out = Notes(), folder / "boundary.json"
    in_model = frame.world_from_model.inverse().apply(points)
    summary = write_boundary(written(folder, value), frame, in_model, out, notes)
    world, model = read_world_area(out), read_model_area(out)
    assert world is not None and model is not None
    np.testing.assert_array_equal(model.contains(in_model), world.contains(points))
    assert summary["boundary_m2"] == pytest.approx(world.size(), abs=0.01)
    return world, notes


def winding(points: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Return winding numbers by summing the angles that the edges subtend: independent of the area's definition."""
    to_ring = ring[None] - points[:, None, :2]
    angles = np.arctan2(to_ring[..., 1], to_ring[..., 0])
    turns = np.diff(np.concatenate([angles, angles[:, :1]], axis=1), axis=1)
    return np.abs(((turns + np.pi) % (2 * np.pi) - np.pi).sum(axis=1)) > np.pi


def test_inside_is_where_the_outline_winds_around_and_no_hole_does() -> None:
    turns = np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False)
    star = (12.0 + 8.0 * np.cos(7.0 * turns))[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    island = np.array([[20.0, 20.0], [28.0, 21.0], [24.0, 27.0]])
    area = PlanArea.seen_from_above([(star, HOLE), (island,)])
    expected = (winding(POINTS, star) & ~winding(POINTS, HOLE)) | winding(POINTS, island)
    np.testing.assert_array_equal(area.contains(POINTS), expected)
    assert 0.05 < expected.mean() < 0.5
    assert not area.contains(np.array([[np.nan, 0.0, 0.0], [5.0, np.inf, 0.0]])).any()
    assert PlanArea.seen_from_above([(OUTLINE, HOLE)]).size() == pytest.approx(21.0 * 16.0 - 16.0)


def test_neighbouring_polygons_share_no_point_and_omit_none() -> None:
    left = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [4.0, 8.0], [0.0, 8.0]])
    right = np.array([[4.0, 0.0], [8.0, 0.0], [8.0, 8.0], [4.0, 8.0], [4.0, 2.0]])
    x, y = np.meshgrid(np.arange(0.0, 8.0, 0.5), np.arange(0.0, 8.0, 0.5))
    points = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    both = [PlanArea.seen_from_above([(ring,)]).contains(points) for ring in (left, right)]
    assert np.array_equal(both[0], ~both[1])


CASES: dict[str, Any] = {
    "wgs 84": polygon(degrees, OUTLINE, HOLE),
    "a feature": {"type": "Feature", "properties": None, "geometry": polygon(degrees, OUTLINE, HOLE)},
    "crs84": polygon(degrees, OUTLINE, HOLE) | named("urn:ogc:def:crs:OGC:1.3:CRS84"),
    "epsg 4326": polygon(degrees, OUTLINE, HOLE) | named("urn:ogc:def:crs:EPSG::4326"),
    "the run's": polygon(metres, OUTLINE, HOLE),
    "no crs": polygon(metres, OUTLINE, HOLE) | {"crs": None},
    "utm": polygon(metres, OUTLINE, HOLE) | named("EPSG:32633"),
    "utm by urn": polygon(metres, OUTLINE, HOLE) | named("urn:ogc:def:crs:EPSG:9.9.1:32633"),
    "utm by http": polygon(metres, OUTLINE, HOLE) | named("http://www.opengis.net/def/crs/EPSG/0/32633"),
    "utm by name": polygon(metres, OUTLINE, HOLE) | named("WGS84 UTM 33N"),
    "several": {
        "type": "FeatureCollection",
        "features": [
            {"type": "Feature", "properties": {}, "geometry": None},
            {
                "type": "Feature",
                "properties": {},
                "geometry": {"type": "MultiPolygon", "coordinates": [polygon(degrees, OUTLINE, HOLE)["coordinates"]]},
            },
        ],
    },
    "a collection": {"type": "GeometryCollection", "geometries": [polygon(degrees, OUTLINE, HOLE)]},
}


@pytest.mark.parametrize("case", CASES)
def test_all_forms_and_reference_systems_give_the_same_area(tmp_path: Path, case: str) -> None:
    area, notes = laid(tmp_path, CASES[case])
    for ring, wanted in zip(area.polygons[0], (OUTLINE, HOLE), strict=True):
        np.testing.assert_allclose(ring, wanted, atol=0.002)  # the demo's own geodesy, independent of PROJ
    assert not notes.warnings and "320 m²" in notes.notes[0]


def test_without_a_file_the_part_does_not_depend_on_the_frame(tmp_path: Path) -> None:
    texts = []
    for frame in (FRAME, Frame("arbitrary", Similarity.identity())):
        assert write_boundary(tmp_path / "none", frame, POINTS, tmp_path / "out.json", Notes()) == {}
        texts.append((tmp_path / "out.json").read_bytes())
    assert texts[0] == texts[1]
    assert read_model_area(tmp_path / "out.json") is read_world_area(tmp_path / "out.json") is None
    (tmp_path / "out.json").write_text('{"world": {"axes": 3}}')
    with pytest.raises(StageError, match="cannot be read"):
        read_world_area(tmp_path / "out.json")


def ring_of(vertices: int) -> list[list[float]]:
    turns = np.linspace(0.0, 2.0 * np.pi, vertices)
    return np.stack([13.5 + 0.001 * np.cos(turns), 47.8 + 0.001 * np.sin(turns)], axis=1).tolist()


HOSTILE: dict[str, tuple[Any, str]] = {
    "nothing": ("", "not valid GeoJSON"),
    "a list": ([1, 2], "not valid GeoJSON"),
    "no text": ("\udcff\x00", "not valid GeoJSON"),
    "a tower": ("[" * 200_000, "not valid GeoJSON"),
    "a tower of numbers": ('{"type": "Polygon", "coordinates": ' + "[" * 900 + "]" * 900 + "}", "no list|out of range"),
    "a long number": ('{"type": "Polygon", "coordinates": [[[' + "9" * 5000 + ", 1]]]}", "not valid GeoJSON"),
    "NaN": ('{"type": "Polygon", "coordinates": [[[NaN, 1], [2, 1], [2, 2]]]}', "not valid GeoJSON"),
    "infinity": (
        '{"type": "Polygon", "coordinates": [[[1e999, 1], [2, 1], [2, 2]]]}',
        "coordinate that is out of range",
    ),
    "a truth": ('{"type": "Polygon", "coordinates": [[[true, 1], [2, 1], [2, 2]]]}', "coordinate that is out of range"),
    "a text": ('{"type": "Polygon", "coordinates": [[["13", 1], [2, 1], [2, 2]]]}', "coordinate that is out of range"),
    "one coordinate": ('{"type": "Polygon", "coordinates": [[[1], [2, 1], [2, 2]]]}', "two coordinates"),
    "a line": ({"type": "Polygon", "coordinates": [[[1, 1], [2, 2], [1, 1]]]}, "without an area"),
    "flat": ({"type": "Polygon", "coordinates": [[[1, 1], [2, 2], [3, 3], [1, 1]]]}, "without an area"),
    "an object": ({"type": "Polygon", "coordinates": {"a": 1}}, "no list"),
    "points alone": ({"type": "Point", "coordinates": [1, 2]}, "no polygon"),
    "no features": ({"type": "FeatureCollection", "features": []}, "no polygon"),
    "features of none": ({"type": "FeatureCollection"}, "no list"),
    "another kind": ({"type": "Topology", "objects": {}}, "an unknown type"),
    "deep": (
        '{"type": "GeometryCollection", "geometries": [' * 20 + "]}" * 20,
        "collections within collections",
    ),
    "a link": (polygon(degrees, OUTLINE) | {"crs": {"type": "link", "properties": {"href": "http://x"}}}, "its CRS"),
    "fine": ({"type": "Polygon", "coordinates": [ring_of(boundary_file.MAX_VERTICES + 2)]}, "more than 20,000 vert"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_an_invalid_boundary_is_refused_by_name_and_with_what_to_do(tmp_path: Path, case: str) -> None:
    value, reason = HOSTILE[case]
    path = tmp_path / "boundary.geojson"
    path.write_bytes((value if isinstance(value, str) else json.dumps(value)).encode("utf-8", "surrogateescape"))
    with pytest.raises(SplatpipeError, match=reason) as caught:
        read_boundary(path)
    assert "boundary.geojson" in caught.value.message and caught.value.hint
    assert len(caught.value.message) < 300


def test_a_large_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "boundary.geojson"
    with path.open("wb") as file:
        file.truncate(boundary_file.MAX_FILE_BYTES + 1)
    with pytest.raises(SplatpipeError, match="more than 8 MiB"):
        read_boundary(path)


def test_the_finest_allowed_boundary_is_read_correctly(tmp_path: Path) -> None:
    value = {"type": "Polygon", "coordinates": [ring_of(boundary_file.MAX_VERTICES)]}
    drawing = read_boundary(written(tmp_path, value))
    assert len(drawing.polygons[0][0]) == boundary_file.MAX_VERTICES - 1 and drawing.crossing == ()


def test_polygons_have_their_features_names(tmp_path: Path) -> None:
    def feature(geometry: dict[str, Any], properties: Any) -> dict[str, Any]:
        return {"type": "Feature", "geometry": geometry, "properties": properties}

    one = {"type": "Polygon", "coordinates": [ring_of(5)]}
    two = {"type": "MultiPolygon", "coordinates": [[ring_of(5)], [ring_of(6)]]}
    nested = {"type": "GeometryCollection", "geometries": [one]}
    named = [
        (one, {"name": "Heap A"}),
        (two, {"name": " a\nb "}),
        (one, None),
        (one, {"name": 7}),
        (nested, {"name": "in"}),
    ]
    half, long = json.loads('"\\ud800"'), "x" * 10_000
    named += [(one, {"name": half}), (one, {"name": long})]
    features = {"type": "FeatureCollection", "features": [feature(*pair) for pair in named]}
    names = read_boundary(written(tmp_path, features)).names
    assert names == ("Heap A", "a b", "a b", "", "", "in", "?", "x" * boundary_file.MAX_NAME_CHARACTERS)


def test_the_place_where_an_outline_crosses_itself_is_reported(tmp_path: Path) -> None:
    bow = np.array([[-9.0, -8.0], [9.0, 8.0], [9.0, -8.0], [-9.0, 8.0]])
    np.testing.assert_allclose(crossing_of(bow), [0.0, 0.0], atol=1e-12)
    assert crossing_of(OUTLINE) == crossing_of(HOLE) == ()
    _, notes = laid(tmp_path, polygon(degrees, bow))
    assert f"crosses itself near {DEMO.longitude:.4f}" in notes.warnings[0] and "outside" in notes.warnings[0]


def test_points_and_lines_beside_the_polygon_are_reported(tmp_path: Path) -> None:
    line = {"type": "LineString", "coordinates": degrees(OUTLINE)}
    _, notes = laid(tmp_path, {"type": "GeometryCollection", "geometries": [line, polygon(degrees, OUTLINE)]})
    assert "are ignored" in notes.warnings[0]


def test_few_points_inside_are_reported(tmp_path: Path) -> None:
    _, notes = laid(tmp_path, polygon(degrees, OUTLINE), points=POINTS[:200])
    assert "sparse model lie inside" in notes.warnings[0]


@pytest.mark.parametrize(
    ("offset", "text"),
    [((0.0, 9_000.0), "9.0 km north of"), ((-400.0, 0.0), "m west of"), ((5e4, -5e4), "south-east")],
)
def test_a_boundary_elsewhere_is_refused_with_distance_and_direction(
    tmp_path: Path, offset: tuple[float, float], text: str
) -> None:
    with pytest.raises(SplatpipeError, match="No part of the capture lies inside") as caught:
        laid(tmp_path, polygon(metres, OUTLINE + np.array(offset)))
    assert text in caught.value.message and "UTM zone 33N" in caught.value.hint
    assert "georef.boundary=none" in caught.value.hint


def test_swapped_coordinates_are_recognised(tmp_path: Path) -> None:
    swapped = {"type": "Polygon", "coordinates": [[[y, x] for x, y in degrees(OUTLINE)]]}
    with pytest.raises(SplatpipeError, match="No part of the capture") as caught:
        laid(tmp_path, swapped)
    assert "swapped" in caught.value.hint


def test_a_model_without_coordinates_accepts_no_boundary(tmp_path: Path) -> None:
    frame = Frame("arbitrary", WORLD_FROM_MODEL, note="no photo states a position")
    with pytest.raises(SplatpipeError, match="not georeferenced: no photo states a position") as caught:
        laid(tmp_path, polygon(degrees, OUTLINE), frame)
    assert "geo.txt" in caught.value.hint and "georef.boundary=none" in caught.value.hint


def test_projected_numbers_need_a_projected_run(tmp_path: Path) -> None:
    frame = Frame("enu", WORLD_FROM_MODEL, FRAME.origin, crs="EPSG:4326")
    with pytest.raises(SplatpipeError, match="states no CRS, and its coordinates are not degrees"):
        laid(tmp_path, polygon(metres, OUTLINE), frame)


def test_degrees_of_a_projected_system_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match="look like degrees"):
        laid(tmp_path, polygon(degrees, OUTLINE) | named("EPSG:32633"))


def test_boundary_sets_the_option_and_set_takes_precedence() -> None:
    def resolved(assignments: list[str], boundary: str | None) -> str:
        settings = CaptureSettings(assignments, boundary=boundary)
        return overrides(None, settings.assignments(), None).resolve().georef.boundary

    assert resolved([], None) == "auto"
    assert resolved(["train.seed=3"], "site plan = 2.geojson") == "site plan = 2.geojson"
    assert resolved(["georef.boundary=none"], "site.geojson") == "none"


@pytest.fixture(scope="module")
def stated() -> tuple[Position, ...]:
    """Return the stated positions of some of the demo's photos."""
    names = [f"DJI_00{number:02d}.JPG" for number in (1, 8, 16, 24)]
    checked = [check_photo(Candidate(name, capture_path() / name), PictureLimits(320, 10**8)) for name in names]
    return read_positions([photo for photo in checked if isinstance(photo, CheckedPhoto)]).positions


def test_the_preflight_reports_problems_of_the_boundary(tmp_path: Path, stated: tuple[Position, ...]) -> None:
    def findings(
        value: Any, positions: tuple[Position, ...] = stated, controlled: bool = False
    ) -> list[tuple[str, str]]:
        found = boundary_findings(written(tmp_path, value), GeorefConfig(), positions, controlled)
        assert all(finding.hint for finding in found)
        return [(finding.code, finding.message) for finding in found]

    assert len(stated) == 4
    assert findings(polygon(degrees, OUTLINE)) == findings(polygon(metres, OUTLINE)) == []
    assert findings(polygon(degrees, 1000.0 * OUTLINE)) == []  # around all of it
    assert "9.0 km north" in findings(polygon(degrees, np.add(OUTLINE, (0.0, 9000.0))))[0][1]
    assert "not valid GeoJSON" in findings("{")[0][1]
    assert findings(polygon(degrees, OUTLINE[[0, 2, 1, 3]]))[0][0] == "boundary-crossing"
    assert "have no positions" in findings(polygon(degrees, OUTLINE), ())[0][1]
    assert findings(polygon(degrees, OUTLINE), (), controlled=True) == []


def test_any_datum_gives_the_same_area_on_the_ground(tmp_path: Path) -> None:
    """The same outline in Web Mercator and in the Austrian Lambert of EPSG, made by PROJ alone."""
    from pyproj import Transformer

    stated = np.array(degrees(OUTLINE))
    for code, tolerance in ((3857, 0.01), (3416, 0.01)):
        x, y = Transformer.from_crs(4326, code, always_xy=True).transform(*stated.T)
        value = {"type": "Polygon", "coordinates": [np.stack([x, y], axis=1).tolist()]} | named(f"EPSG:{code}")
        area, _ = laid(tmp_path, value)
        np.testing.assert_allclose(area.polygons[0][0], OUTLINE, atol=tolerance)
