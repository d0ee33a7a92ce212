"""What `check` says of flights whose lens, and with it heights, remain unknown."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
from accurate_flights import CAMERA, SINGLE_M, flight

from splatpipe.pipeline.app.preflight.findings import Finding
from splatpipe.pipeline.app.preflight.heights import height_findings
from splatpipe.pipeline.app.preflight.intake import Intake
from splatpipe.pipeline.sfm.pairing.layout import make_layout
from splatpipe.pipeline.survey.adjustment.predicted_flight import predict_accuracy
from splatpipe.pipeline.survey.positions.photo_positions import Position, PositionList


def said(photos: Sequence[Position], controlled: bool = False) -> list[Finding]:
    stated = PositionList(tuple(photos), {}, None, {})
    intake = Intake((), (), (), {}, stated, make_layout([], []))
    predicted = predict_accuracy(photos, {each.name: CAMERA for each in photos}, {})
    return height_findings(intake, predicted, controlled)


def codes(photos: Sequence[Position], controlled: bool = False) -> list[str]:
    return [finding.code for finding in said(photos, controlled)]


def test_accurate_positions_straight_down_get_figures_and_places() -> None:
    (finding,) = said(flight())
    assert (finding.code, finding.severity) == ("heights-uncertain", "warning")
    assert "uncertain by about ±0.87 m together (95 %): all photos look straight down from" in finding.message
    assert finding.hint.startswith("One control point with a surveyed height near P00")
    assert finding.hint.count(".JPG") == 3 and finding.hint.count("±") == 3 and "(47.000" in finding.hint
    assert codes(flight(), controlled=True) == []


def test_other_heights_and_oblique_photos_raise_nothing() -> None:
    assert codes(flight(lift=8.0)) == codes(flight(pitches=(-90.0, -45.0))) == []


@pytest.mark.parametrize("sigmas", [SINGLE_M, (0.4, 0.4)])
def test_poorer_positions_get_no_figures(sigmas: tuple[float, float]) -> None:
    (finding,) = said(flight(sigmas=sigmas))
    assert finding.code == "nadir-only" and "±" not in finding.message
    assert codes(flight(sigmas=sigmas, lift=8.0)) == codes(flight(sigmas=sigmas, pitches=(-90.0, -45.0))) == []


def test_a_single_heading_is_told() -> None:
    by_code = {finding.code: finding for finding in said(flight(yaws=(90.0,)))}
    assert set(by_code) == {"heights-uncertain", "one-heading"}
    assert "All photos have one heading" in by_code["one-heading"].message
    assert "±1.4 m" in by_code["one-heading"].message
    assert codes(flight(yaws=(90.0,), sigmas=SINGLE_M)) == ["nadir-only"]


def test_what_is_assumed_is_said() -> None:
    unstated = [replace(each, yaw_deg=None, pitch_deg=None, relative_altitude_m=None) for each in flight(12, 25)]
    (finding,) = said(unstated)
    assert finding.severity == "note" and "their angles are not stated" in finding.message
    assert "from a part, 120 of 300 photos" in finding.hint and "guessed from the photos' spacing" in finding.hint
