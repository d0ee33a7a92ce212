"""What a result is held against before the verdict: wrong places are named, and what is known stops the clearest."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from odd_sites import ALPS, Outcome, Site, Warnings, joined, orbit, place, strips

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.plausibility.last_look import _agreement, report_contradictions

MINNESOTA = Origin(46.84, -91.99, 199.0)
BARE = ("place",)


def signed(site: Site, latitude: float = 1.0, longitude: float = 1.0, **fields: object) -> Outcome:
    """The outcome with other signs of latitude and longitude."""
    changed = replace(site, **fields)
    return place(changed, changed.photos(changed.geodetic() * [latitude, longitude, 1.0]))


def test_a_sound_flight_contradicts_nothing() -> None:
    for site in (strips(), orbit()):
        found = place(site)
        assert found.stopped == found.says == "" and not found.warnings


def test_both_signs_missing_turn_the_result_and_the_headings_tell() -> None:
    found = signed(replace(orbit(), place=Origin(-34.6, -58.4, 20.0)), -1.0, -1.0)
    assert "180° off the headings" in found.says or "179° off" in found.says
    assert "S and W" in found.says


@pytest.mark.parametrize("heading", [30.0, 90.0, 60.0])
def test_a_mirrored_survey_of_which_only_the_headings_are_known_stops(heading: float) -> None:
    """The ground's side is one witness; the direction of flight against the headings is the second."""
    site = replace(strips(heading, height=50.0), place=MINNESOTA, tags=("nose", "place"))
    if heading == 60.0:  # strips to and fro do not turn: another flight across makes them
        site = replace(joined(site, strips(heading + 50.0)), place=MINNESOTA, tags=("nose", "place"))
    assert place(site).says == place(site).stopped == ""
    found = signed(site, longitude=-1.0)
    assert "upside down or mirrored" in found.stopped and "direction of flight" in found.stopped
    assert ("position-mirrored" in found.issues) == (
        heading != 30.0
    )  # 60° askew is a contradiction with the ground only


def test_both_signs_missing_are_told_by_the_flight_if_the_gimbal_says_nothing() -> None:
    found = signed(replace(strips(30.0), place=Origin(-34.6, -58.4, 20.0)), -1.0, -1.0, tags=("nose", "place"))
    assert "against the aircraft's headings" in found.says and "position-mirrored" in found.issues


def test_a_mirrored_survey_without_any_angle_is_the_first_line() -> None:
    found = signed(strips(90.0), longitude=-1.0, tags=BARE)
    assert found.stopped == "" and "upside down or mirrored" in found.says


def test_control_that_turns_the_model_upside_down_stops() -> None:
    placed = place(orbit()).placed
    assert placed is not None
    overturned = Similarity(1.0, np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    frame = replace(placed.frame, world_from_model=overturned.compose(placed.world_from_model))
    turned = replace(placed, frame=frame)
    control = SimpleNamespace(survey=SimpleNamespace(name="gcp_list.txt"))
    object.__setattr__(turned, "controlled", control)  # past the types that tests check: only the name is read
    with pytest.raises(SplatpipeError, match=r"control of gcp_list.txt places the model upside down or mirrored"):
        report_contradictions(turned, Warnings())


def test_positions_of_the_photo_before_are_named() -> None:
    site = strips(30.0)
    moved = np.roll(site.geodetic(), 1, axis=0)
    found = place(replace(site, tags=("angles", "nose")), replace(site, tags=("angles", "nose")).photos(moved))
    assert "each position is that of 1 photo earlier" in found.says and "Match names" in found.says


def test_a_clock_that_is_off_is_named_in_seconds() -> None:
    site = replace(strips(30.0, each=12), tags=("angles", "nose"), noise_m=0.2)
    way = site.geodetic()
    late = way + 1.5 * (np.roll(way, -1, axis=0) - way) * [1.0, 1.0, 0.0]
    found = place(site, site.photos(late))
    assert "s too late" in found.says and "clock" in found.says


def test_speeds_that_nobody_flies_are_told() -> None:
    fast = replace(strips(), centres=strips().centres * [30.0, 30.0, 30.0], ground=strips().ground * 30.0)
    assert "m/s" in place(replace(fast, step_s=1.0)).says
    assert place(replace(fast, step_s=60.0)).says == ""


def test_xmp_elsewhere_than_the_exif_that_is_used() -> None:
    site = orbit()
    photos = replace(site, tags=("angles",)).photos(np.add(site.geodetic(), [0.0, 0.004, 0.0]))
    own = site.photos()
    both = [replace(each, xmp=other.xmp) for each, other in zip(photos, own, strict=True)]
    assert "The positions in the drone's XMP lie 29" in place(site, both).says
    near = replace(site, tags=("angles",)).photos(np.add(site.geodetic(), [0.0, 0.0001, 0.0]))
    assert place(site, [replace(a, xmp=b.xmp) for a, b in zip(near, own, strict=True)]).says == ""


def test_a_crs_far_outside_its_area_is_told_and_the_neighbours_zone_is_not() -> None:
    assert "outside the area of use of EPSG:32632" in place(orbit(), crs="EPSG:32632").says
    at_the_border = replace(orbit(), place=replace(ALPS, longitude=12.4))
    assert place(at_the_border, crs="EPSG:32632").says == ""


def test_climbs_that_the_barometer_does_not_know_are_told() -> None:
    ring = orbit()
    site = joined(ring, replace(ring, centres=np.add(ring.centres, [0.0, 0.0, 30.0])))
    assert place(site).says == ""
    flat = [
        replace(each, xmp={**each.xmp, "drone-dji:RelativeAltitude": f"{k % 2 * 40.0}"})
        for k, each in enumerate(site.photos())
    ]
    assert "heights above take-off" in place(site, flat).says


def test_altitudes_that_sink_where_the_drone_climbs_are_told() -> None:
    """AltitudeRef 1 above the sea: a fit whose scale comes from the horizontal positions takes them for noise."""
    ring = orbit()
    site = replace(
        ring,
        place=replace(ring.place, height_m=90.0),
        centres=ring.centres + [[0.0, 0.0, 12.0 * (k % 2)] for k in range(len(ring.centres))],
    )
    assert place(site).says == ""
    placed = place(site).placed
    assert placed is not None
    records = placed.positions.by_name
    below = {name: {**record, "altitude_m": -record["altitude_m"]} for name, record in records.items()}
    sunk = replace(placed, positions=replace(placed.positions, by_name=below))
    found = " ".join(each.text for each in report_contradictions(sunk, Warnings()))
    assert "above the sea instead of below it, 100% of the altitudes agree" in found


def test_positions_of_the_photo_before_on_a_loop_turn_the_result_and_the_gimbal_tells() -> None:
    """A loop takes the lag for a turn: by shape alone it fits."""
    site = replace(orbit(16), tags=("angles", "height"))
    compass = replace(site, compass_deg=5.0)
    assert place(site).says == place(compass).says == ""
    found = place(site, site.photos(np.roll(site.geodetic(), 1, axis=0)))
    assert "each position is that of 1 photo earlier" in found.says
    assert "off the headings of the gimbal" in found.says


def test_a_receiver_slower_than_the_camera_is_told_and_a_hover_is_not() -> None:
    site = replace(orbit(32), tags=("angles", "height"))
    slow = place(site, site.photos(np.repeat(site.geodetic()[::4], 4, axis=0)))
    assert "24 of 32 photos state the position of the photo before" in slow.says
    assert "position-repeated" in slow.issues
    hover = replace(site, centres=np.repeat(site.centres[::4], 4, axis=0), noise_m=0.0)
    assert "photo before" not in place(hover).says


def test_half_of_the_positions_at_another_place_is_told() -> None:
    site = replace(orbit(32), tags=("angles", "height"))
    away = site.geodetic() + [[0.0455 * (k % 2), 0.0, 0.0] for k in range(32)]
    found = place(site, site.photos(away))
    assert "two places, 5.0 km apart (16 and 16 photos)" in found.issues["position-two-places"]
    assert found.stopped or "do not fit the others" in found.says


def test_a_copied_coordinate_is_told() -> None:
    site = replace(orbit(), tags=("angles", "height"))
    copied = site.geodetic()
    copied[:, 1] = copied[0, 1]
    assert "one and the same longitude" in place(site, site.photos(copied)).issues["position-copied"]


@pytest.mark.parametrize(("factor", "reported"), [(157.0, True), (40.0, False)])
def test_control_that_has_not_the_shape_of_the_model_is_told(factor: float, reported: bool) -> None:
    placed = place(orbit()).placed
    assert placed is not None
    points = [SimpleNamespace(role="control", surveyed=SimpleNamespace(z=1.0)) for _ in range(6)]
    targets = SimpleNamespace(enu=np.arange(18.0).reshape(6, 3), sigmas=np.full((6, 3), 0.02))
    control = SimpleNamespace(
        survey=SimpleNamespace(name="gcp_list.txt", points=points),
        site=SimpleNamespace(targets=targets),
        sigma_factor=factor,
    )
    bent = replace(placed)
    object.__setattr__(bent, "controlled", control)  # past the types that tests check
    found = [each.text for each in _agreement(bent)]
    assert found == (
        ["The control points of gcp_list.txt agree with the photos to 3.1 m only, 15% of the width of their area."]
        if reported
        else []
    )
