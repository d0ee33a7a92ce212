"""CRSs, worlds and georef.json, against published points, PROJ's own direct transforms and the demo's truth."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.crs.crs import (
    from_geodetic,
    open_operation,
    parse_crs,
    parse_vertical,
    same_datum,
    to_geodetic,
    undulation,
    utm_of,
)
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.crs.georeference import georeference, scene_box
from splatpipe.pipeline.survey.crs.world import in_crs, open_world

MILLIMETRE = 1e-3
HALLSTATT = Origin(47.8412, 13.5127, 512.0)  # where the demo's house is
BOX = np.array([[-1000.0, -1000.0, -30.0], [1000.0, 1000.0, 60.0]])
# One UTM on WGS 84, one Gauss-Krüger on another datum and northing first, one conic, one of a neighbouring zone.
CRSS = ["EPSG:32633", "EPSG:31255", "EPSG:3034", "EPSG:25832"]


def frame(crs: str = "", vertical: str = "ellipsoidal", origin: Origin = HALLSTATT) -> Frame:
    return Frame("enu", Similarity.identity(), origin, vertical, crs=crs)


def far_points(count: int = 40) -> np.ndarray:
    """Up to a kilometre and more from the origin."""
    return np.random.default_rng(0).uniform(BOX[0], BOX[1], (count, 3))


@pytest.mark.parametrize(
    ("text", "stated", "vertical"),
    [
        ("EPSG:32633", "EPSG:32633", "unknown"),
        ("  epsg : 32633 ", "EPSG:32633", "unknown"),
        ("WGS84 UTM 33N", "EPSG:32633", "unknown"),
        ("WGS 84 / UTM zone 21S", "EPSG:32721", "unknown"),
        ("EPSG:25832+7837", "EPSG:25832+7837", "EPSG:7837"),
        ("EPSG:25832+EPSG:7837", "EPSG:25832+7837", "EPSG:7837"),
        ("EPSG:5555", "EPSG:5555", "EPSG:5783"),
        ("EPSG:4326", "EPSG:4326", "unknown"),
        ("EPSG:4979", "EPSG:4979", "ellipsoidal"),
        ("WGS 84", "EPSG:4326", "unknown"),  # as Emlid names it
        ("wgs84", "EPSG:4326", "unknown"),
        ("+init=epsg:32633", "EPSG:32633", "unknown"),
        ("+proj=utm +zone=33 +datum=WGS84 +units=m", "+proj=utm +zone=33 +datum=WGS84 +units=m +no_defs", "unknown"),
    ],
)
def test_a_crs_is_read_in_every_form_including_its_own_output(text: str, stated: str, vertical: str) -> None:
    crs = parse_crs(text)
    assert (crs.text, crs.vertical) == (stated, vertical)
    assert parse_crs(crs.text) == crs


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x" * 100_000,
        "EPSG:" + "9" * 5000,
        "EPSG:999999",
        "EPSG:32633\x00",
        "EPSG:３２６３３",
        "EPSG:6360",  # heights only
        "EPSG:4978",  # earth-centred
        "EPSG:5555+7837",  # has heights
        "EPSG:25832+5336",  # a depth
        "WGS84 UTM 61N",
        "WGS84 UTM 0N",
        "+proj=pipeline +step +proj=utm +zone=33",
        "+proj=longlat +datum=WGS84 +geoidgrids=/etc/passwd",
        "+proj=longlat +ellps=bessel +nadgrids=/etc/passwd",
        "+proj=utm +zone=33 +datum=WGS84 +units=league",
        "+proj=utm +zone=900 +datum=WGS84",
        "+proj=utm +zone=33 +datum=WGS84 ; rm -rf /",
        "PROJCS[]",
        '{"type": "ProjectedCRS"}',
        "/etc/passwd",
    ],
)
def test_an_invalid_crs_is_refused_with_a_hint(text: str) -> None:
    with pytest.raises(SplatpipeError) as raised:
        parse_crs(text)
    assert raised.value.hint and len(str(raised.value)) < 400


@pytest.mark.parametrize("text", ["EPSG:32633", "sea level", "EPSG:5783+5783", "EPSG:5336", "", "EPSG:" + "1" * 900])
def test_an_invalid_vertical_datum_is_refused(text: str) -> None:
    with pytest.raises(SplatpipeError):
        parse_vertical(text)


def test_vertical_datums_in_metres_and_feet_are_the_same() -> None:
    assert parse_vertical("epsg:5703") == "EPSG:5703" and parse_vertical("Ellipsoidal") == "ellipsoidal"
    assert same_datum("EPSG:5703", "EPSG:6360") and not same_datum("EPSG:5703", "EPSG:5773")
    assert not same_datum("ellipsoidal", "EPSG:5703")


@pytest.mark.parametrize(
    ("text", "point", "latitude", "longitude", "off_m"),
    [
        # LV95's origin, the old observatory of Bern; swisstopo states its WGS 84 position.
        ("EPSG:2056", (2_600_000.0, 1_200_000.0, 0.0), 46.951083, 7.438632, 0.2),
        # The false origin of UTM: the equator at the central meridian.
        ("EPSG:32633", (500_000.0, 0.0, 0.0), 0.0, 15.0, 1e-6),
        # RD New's base point, Onze Lieve Vrouwetoren in Amersfoort: 52°09'18.62" N, 5°23'13.94" E in ETRS89.
        ("EPSG:28992", (155_000.0, 463_000.0, 0.0), 52.155172, 5.387206, 0.3),
        # New Zealand Transverse Mercator: its false origin.
        ("EPSG:2193", (1_600_000.0, 10_000_000.0, 0.0), 0.0, 173.0, None),
    ],
)
def test_published_points_have_their_published_coordinates(
    text: str, point: tuple[float, float, float], latitude: float, longitude: float, off_m: float | None
) -> None:
    crs = parse_crs(text)
    if off_m is None:
        with pytest.raises(SplatpipeError, match="km outside the area"):
            to_geodetic(np.array([point]), crs)
        return
    (lat, lon, _), *_ = to_geodetic(np.array([point]), crs).geodetic
    assert math.hypot(lat - latitude, (lon - longitude) * math.cos(math.radians(lat))) * 111_200.0 < off_m


def test_the_demos_control_file_agrees_with_its_truth() -> None:
    truth = json.loads((capture_path().parent / "truth.json").read_text())
    origin = Origin(**truth["frame"]["origin"])
    utm = np.array([point["utm_m"] for point in truth["points"]])
    local = origin.enu_from_geodetic(to_geodetic(utm, parse_crs("EPSG:32633")).geodetic)
    np.testing.assert_allclose(local, [point["xyz_m"] for point in truth["points"]], atol=2e-5)  # as rounded there


@pytest.mark.parametrize("text", [*CRSS, "EPSG:4326", "EPSG:4979", "+proj=utm +zone=33 +ellps=GRS80 +units=m"])
@pytest.mark.parametrize("vertical", ["ellipsoidal", "unknown"])
def test_local_to_crs_and_back_at_a_kilometre(text: str, vertical: str) -> None:
    if text == "EPSG:4979" and vertical == "unknown":
        with pytest.raises(SplatpipeError, match="not known"):
            open_world(frame(text, vertical))
        return
    world = open_world(frame(text, vertical))
    local = far_points()
    np.testing.assert_allclose(world.local_from_crs(world.crs_from_local(local)), local, atol=1e-6)


@pytest.mark.parametrize("text", CRSS)
def test_georef_json_alone_agrees_with_proj(text: str) -> None:
    """Transform by the file and PROJ, compare with PROJ's direct geocentric transform, and invert by our World."""
    stored = json.loads(json.dumps(georeference(frame(text), BOX)))
    local = far_points()
    earth = np.c_[local, np.ones(len(local))] @ np.array(stored["exact_path"]["matrix"])[:3].T
    lon, lat, height = pyproj.Transformer.from_crs(4978, 4979, always_xy=True).transform(*earth.T)
    pipeline = pyproj.Transformer.from_pipeline(stored["crs"]["operation"]["pipeline"])
    x, y, _ = pipeline.transform(lon, lat, height, direction="INVERSE")
    topocentric = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=47.8412 +lon_0=13.5127 +h_0=512"
    )
    truth = np.stack(topocentric.transform(*local.T), axis=1)
    direct = pyproj.Transformer.from_crs("EPSG:4978", parse_crs(text).horizontal, always_xy=True, allow_ballpark=False)
    theirs = np.stack(direct.transform(*truth.T)[:2], axis=1)
    np.testing.assert_allclose(np.stack([x, y], axis=1), theirs, atol=MILLIMETRE)
    back = open_world(frame(text)).local_from_crs(np.stack([x, y, height], axis=1))
    assert np.linalg.norm(back - local, axis=1).max() <= MILLIMETRE


def test_the_demos_truth_comes_back_through_georef_json_in_three_crss() -> None:
    """Its survey points and points a kilometre off, stated in a CRS by PROJ, to the splat's metres and back."""
    truth = json.loads((capture_path().parent / "truth.json").read_text())
    origin = Origin(**truth["frame"]["origin"])
    local = np.concatenate([[point["xyz_m"] for point in truth["points"]], far_points()])
    geodetic = origin.geodetic_from_enu(local)
    for text in ("EPSG:32633", "EPSG:31255", "EPSG:3034"):
        crs = parse_crs(text)
        to_crs = pyproj.Transformer.from_crs(4979, crs.horizontal, always_xy=True)
        x, y, _ = to_crs.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2])
        surveyed = np.stack([x, y, geodetic[:, 2]], axis=1)
        elsewhere = Origin(round(origin.latitude, 3), round(origin.longitude, 3), 500.0)  # another run's origin
        world = open_world(frame(text, origin=elsewhere))
        splat = world.local_from_crs(surveyed)
        np.testing.assert_allclose(splat, elsewhere.enu_from_geodetic(geodetic), atol=MILLIMETRE)
        np.testing.assert_allclose(world.crs_from_local(splat), surveyed, atol=MILLIMETRE)


def test_tangent_approximation_has_its_stated_error() -> None:
    tangent = georeference(frame("EPSG:32633"), BOX)["crs_from_local_tangent"]
    matrix = np.array(tangent["matrix"])
    world = open_world(frame("EPSG:32633"))
    for box, most in ((BOX, 1.0), (BOX / 20.0, 0.0025)):  # quadratic: a twentieth of the size, a 400th of the error
        corners = np.array([[e, n, u] for e in box[:, 0] for n in box[:, 1] for u in box[:, 2]])
        off = (corners @ matrix[:3, :3].T + matrix[:3, 3]) - world.crs_from_local(corners)
        assert np.linalg.norm(off[:, :2], axis=1).max() <= 1.05 * most * tangent["largest_error_m"]
    # The height's error is the earth's curvature, d² / 2R at 1,414 m.
    assert tangent["largest_height_error_m"] == pytest.approx(2e6 / (2.0 * 6.38e6), rel=0.01)


def test_grid_scale_and_convergence_are_the_projections() -> None:
    """Against PROJ's own factors, and the height's by the ellipsoid's radius."""
    for text, origin in (
        ("EPSG:32633", HALLSTATT),
        ("EPSG:31255", HALLSTATT),
        ("EPSG:2264", Origin(35.2, -79.4, 90.0)),
    ):
        world = open_world(replace(frame(text, origin=origin), approximate_crs=True))
        factors = pyproj.Proj(world.crs.horizontal).get_factors(origin.longitude, origin.latitude)
        scale = world.grid_scale()
        assert scale is not None
        assert scale.projection == pytest.approx(factors.meridional_scale, abs=2e-5)  # datums differ by such shares
        assert scale.convergence_deg == pytest.approx(factors.meridian_convergence, abs=5e-3)
        assert scale.ground / scale.projection == pytest.approx(6.38e6 / (6.38e6 + origin.height_m), abs=1e-6)
    assert open_world(frame("EPSG:4326")).grid_scale() is None


def test_ellipsoidal_heights_place_exactly_and_unknown_ones_are_labelled() -> None:
    exact, unsure = (georeference(frame(vertical=name), BOX)["ecef_from_local"] for name in ("ellipsoidal", "unknown"))
    x, y, z = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(13.5127, 47.8412, 512.0)
    np.testing.assert_allclose(np.array(exact["matrix"])[:3, 3], [x, y, z], atol=1e-6)
    assert not exact["approximate"] and exact["largest_error_m"] == 0.0
    assert unsure["approximate"] and "not known" in unsure["note"]
    missing = georeference(frame("EPSG:25833+5773", "EPSG:5773"), BOX)["ecef_from_local"]
    assert missing["approximate"] and "us_nga_egm96_15.tif" in missing["note"]


@pytest.mark.parametrize(
    ("text", "vertical", "origin", "reason"),
    [
        ("EPSG:32650", "ellipsoidal", HALLSTATT, "km outside the area of EPSG:32650"),
        ("EPSG:27700", "ellipsoidal", HALLSTATT, "km outside the area of EPSG:27700"),
        ("+proj=utm +zone=50 +datum=WGS84", "ellipsoidal", HALLSTATT, "another part of the earth"),
        ("EPSG:27700", "ellipsoidal", Origin(51.48, -0.01, 60.0), "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
        ("EPSG:31467", "ellipsoidal", Origin(50.1, 9.1, 150.0), "de_adv_BETA2007.tif"),
        ("EPSG:25832+7837", "ellipsoidal", Origin(50.1, 9.1, 150.0), "de_bkg_gcg2016.tif"),
        ("EPSG:25832+7837", "unknown", Origin(50.1, 9.1, 150.0), "not known"),
        ("EPSG:4979", "EPSG:5773", HALLSTATT, "us_nga_egm96_15.tif"),
    ],
)
def test_a_distant_crs_and_a_missing_grid_are_refused_with_the_reason(
    text: str, vertical: str, origin: Origin, reason: str
) -> None:
    with pytest.raises(SplatpipeError) as raised:
        in_crs(frame(vertical=vertical, origin=origin), text)
    assert reason in raised.value.message and raised.value.hint


def test_a_missing_grid_is_replaced_with_a_note_if_the_user_accepts_that() -> None:
    greenwich = frame(origin=Origin(51.48, -0.01, 60.0))
    placed = in_crs(greenwich, "EPSG:27700", approximate=True)
    operation = georeference(placed, BOX)["crs"]["operation"]
    assert not operation["best"] and operation["accuracy_m"] == 2.0
    there = open_world(placed).crs_from_local(np.zeros((1, 3)))[0]
    assert np.hypot(*(there[:2] - [538_250.0, 177_600.0])) < 1000.0  # Greenwich, roughly, in the national grid


def test_a_modern_datum_without_an_operation_is_wgs84_only_if_the_user_accepts_that() -> None:
    """CGCS2000 has none in EPSG; MGI's, outside its area of use, is hundreds of metres off and still refused."""
    wuhan = frame("EPSG:4547", origin=Origin(30.5, 114.3, 30.0))
    with pytest.raises(SplatpipeError, match="has no transformation") as raised:
        open_world(wuhan)
    assert "approximate_crs" in raised.value.hint
    operation = georeference(replace(wuhan, approximate_crs=True), BOX)["crs"]["operation"]
    assert operation["accuracy_m"] is None and "treated as" in operation["note"]
    with pytest.raises(SplatpipeError, match="has no transformation"):
        open_operation(parse_crs("EPSG:31277"), 44.0, 21.0, approximate=True)
    with pytest.raises(SplatpipeError, match="has no transformation"):
        open_operation(parse_crs("EPSG:2985"), -66.5, 140.0, approximate=True)
    unstated = open_operation(parse_crs("+proj=utm +zone=33 +ellps=GRS80 +units=m"), 47.8, 13.5)
    assert "not stated" in unstated.note


def test_heights_use_the_geoid_grid_if_it_is_present(tmp_path: Path) -> None:
    """An invented EGM96 grid: 40 m at 47° N, decreasing northwards by 2 m per degree."""
    rows, columns = 721, 1440
    latitudes = -90.0 + 0.25 * np.arange(rows)
    undulations = np.repeat((40.0 - 2.0 * (latitudes - 47.0)).astype(">f4")[:, None], columns, axis=1)
    header = struct.pack(">4d2i", -90.0, -180.0, 0.25, 0.25, rows, columns)
    (tmp_path / "egm96_15.gtx").write_bytes(header + undulations.tobytes())
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(tmp_path))
    try:
        raised = undulation("EPSG:5773", np.array([47.0, 47.8412]), np.array([13.5, 13.5127]))
        np.testing.assert_allclose(raised, [40.0, 40.0 - 2.0 * 0.8412], atol=1e-4)
        entry = georeference(frame("EPSG:32633+5773", "EPSG:5773"), BOX)["ecef_from_local"]
        earth = HALLSTATT.ecef_from_enu()
        lifted = (np.array(entry["matrix"])[:3, 3] - earth[:3, 3]) @ earth[:3, 2]
        assert not entry["approximate"] and lifted == pytest.approx(raised[1], abs=1e-4)
        assert 0.005 < entry["largest_error_m"] < 0.05  # the slope, 2 m per 111 km, at 1.4 km; and 7 mm of scale
        world = open_world(frame("EPSG:4979", "EPSG:5773"))  # orthometric within, ellipsoidal without
        local = far_points()
        np.testing.assert_allclose(world.local_from_crs(world.crs_from_local(local)), local, atol=1e-6)
        assert world.crs_from_local(np.zeros((1, 3)))[0, 2] == pytest.approx(512.0 + raised[1], abs=1e-4)
    finally:
        pyproj.datadir.set_data_dir(before)


def test_feet_are_feet() -> None:
    crs = parse_crs("EPSG:2264")
    assert crs.unit_m == crs.height_unit_m == pytest.approx(1200.0 / 3937.0)
    world = open_world(replace(frame("EPSG:2264", "unknown", Origin(35.2, -79.4, 90.0)), approximate_crs=True))
    at, above = world.crs_from_local(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3048]]))
    assert at[2] == pytest.approx(90.0 * 3937.0 / 1200.0) and above[2] - at[2] == pytest.approx(1.0, abs=1e-5)
    mixed = parse_crs("+proj=utm +zone=33 +datum=WGS84 +units=m +vunits=ft")
    assert (mixed.unit_m, mixed.height_unit_m) == (1.0, 0.3048)


def test_points_without_a_height_keep_none_and_their_horizontal_position() -> None:
    points = np.array([[388_710.5, 5_299_705.2, np.nan], [388_710.5, 5_299_705.2, 0.0]])
    located = to_geodetic(points, parse_crs("EPSG:32633")).geodetic
    assert np.isnan(located[0, 2])
    np.testing.assert_allclose(located[0, :2], located[1, :2])


def test_coordinates_of_another_crs_are_named() -> None:
    with pytest.raises(SplatpipeError, match="look like degrees"):
        to_geodetic(np.array([[13.5127, 47.8412, 512.0]]), parse_crs("EPSG:32633"))
    with pytest.raises(SplatpipeError, match="km outside"):
        to_geodetic(np.array([[5_299_705.2, 388_710.5, 512.0]]), parse_crs("EPSG:31255"))
    with pytest.raises(SplatpipeError, match="not defined at"):
        to_geodetic(np.array([[1e12, 1e12, 0.0]]), parse_crs("EPSG:31255"))
    with pytest.raises(SplatpipeError, match="not defined at"):
        to_geodetic(np.array([[np.nan, 0.0, 0.0]]), parse_crs("EPSG:32633"))


@pytest.mark.parametrize("text", ["+proj=tmerc +R=1e300", "+proj=laea +R=298.257", "+proj=laea +over=bessel +a=33"])
def test_a_crs_of_another_planet_is_refused(text: str) -> None:
    with pytest.raises(SplatpipeError, match=r"has no transformation|not defined at"):
        to_geodetic(np.array([[388_710.5, 5_299_705.2, 512.0]]), parse_crs(text))


def test_utm_zones_hemispheres_and_poles() -> None:
    assert utm_of(47.8, 13.5).text == "EPSG:32633" and utm_of(-33.9, 18.4).text == "EPSG:32734"
    assert utm_of(0.0, 180.0).text == "EPSG:32601" and utm_of(0.0, -180.0).text == "EPSG:32601"
    assert utm_of(0.0, 179.999).text == "EPSG:32660" and utm_of(89.0, 3.0).text == "EPSG:5041"
    for origin in (Origin(-78.0, 166.7, 10.0), Origin(-17.8, 179.99, 5.0), Origin(-89.9, 10.0, 2800.0)):
        world = open_world(frame(origin=origin))
        local = far_points()
        np.testing.assert_allclose(world.local_from_crs(world.crs_from_local(local)), local, atol=1e-6)


def test_axis_order_is_east_first_whatever_the_crs_prescribes() -> None:
    """Gauss-Krüger states northing first, geographic CRSs latitude first."""
    for text in ("EPSG:31255", "EPSG:4326", "EPSG:32633"):
        world = open_world(frame(text))
        there = world.crs_from_local(np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]]))
        east, north = there[1] - there[0], there[2] - there[0]
        assert east[0] > 10 * abs(east[1]) and north[1] > 10 * abs(north[0])


def test_the_crs_is_the_control_files_or_else_the_utm_zone() -> None:
    assert in_crs(frame(), "auto").crs == "EPSG:32633"
    assert in_crs(frame(), "auto", "EPSG:31255").crs == "EPSG:31255"
    assert in_crs(frame(), "EPSG:3034", "EPSG:31255").crs == "EPSG:3034"
    assert in_crs(frame(vertical="EPSG:5773"), "auto", "EPSG:25833+5773").crs == "EPSG:25833+5773"
    assert in_crs(frame(vertical="unknown"), "auto", "EPSG:25833+5773").crs == "EPSG:32633"
    arbitrary = Frame("arbitrary", Similarity.identity())
    assert in_crs(arbitrary, "auto") is arbitrary
    assert georeference(arbitrary, BOX)["origin"] is None


def test_an_operation_is_named_with_its_accuracy() -> None:
    operation = open_operation(parse_crs("EPSG:31255"), 47.84, 13.51)
    assert "MGI to WGS 84" in operation.name and operation.accuracy_m == 1.5 and operation.best
    back = from_geodetic(operation, parse_crs("EPSG:31255"), np.array([[47.84, 13.51, 500.0]]))
    assert np.isfinite(back).all()


def test_scene_box_excludes_points_kilometres_away() -> None:
    points = np.concatenate([np.random.default_rng(1).uniform(-10, 10, (1000, 3)), [[5000.0, 0.0, 0.0], [np.nan] * 3]])
    box = scene_box(points, np.array([[0.0, 0.0, 40.0]]))
    assert box[1, 0] < 11.0 and box[1, 2] == 40.0
    np.testing.assert_array_equal(scene_box(points[:0], points[:0]), np.zeros((2, 3)))
