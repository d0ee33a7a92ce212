"""The report on an adjustment to camera positions: residuals, lens and heights from any ``accuracy.json``."""

import json
import math
import random
import re
from types import SimpleNamespace
from typing import Any

import jinja2
import numpy as np
import pytest

from splatpipe.pipeline.app.report.chapters import adjustment
from splatpipe.pipeline.app.report.chapters.adjustment import adjustment_section
from splatpipe.pipeline.app.report.charts.adjustment_charts import strip_ends
from splatpipe.pipeline.app.report.charts.drawing import styled
from splatpipe.pipeline.app.report.facts.adjustment_results import adopted_focals_px, read_adjustment
from splatpipe.pipeline.app.report.facts.run_history import RunHistory, StageHistory, StageMessages
from splatpipe.pipeline.app.report.facts.wording import two_digits
from splatpipe.pipeline.app.report.page import TEMPLATES
from splatpipe.pipeline.app.report.verdict import judge
from splatpipe.pipeline.survey.adjustment.adjusted_positions import height_sentence
from splatpipe.pipeline.survey.adjustment.block_accuracy import CONTROL_SIGMAS_M, CROSS_STRIP_RISE, MARK_SIGMA_PX
from splatpipe.pipeline.survey.adjustment.position_adjustment import ALL, ALL_FISHEYE
from splatpipe.pipeline.survey.placing.uncertainty import NORMAL_95, metres_in_words

HOSTILE = '<script>alert("x")</script>'
ORIGIN = {"latitude": 45.0315, "longitude": 7.62064, "height_m": 350.0}
STRIP = 8  # photos of a strip
SENTENCE = height_sentence(0.445, 0.024, 0.014)
CAMERA = {"id": 1, "name": "DJI FC6360", "placed": 32, "focal_px": 1780.5, "prior_focal_px": 1949.9, "has_prior": True}
PLACED = {"photos": 32, "registered": 32, "mean_reprojection_error_px": 0.47, "cameras": [CAMERA]}


def made_up(photos: int = 32, flights: int = 1) -> dict[str, Any]:
    """An adjustment as ``accuracy.json`` has it."""
    chance = random.Random(1)
    names = ["f", "aspect", "cx", "cy", "k1"]
    correlations = [[1.0 if a == b else 0.1 for b in range(5)] for a in range(5)]
    correlations[0][4] = correlations[4][0] = -0.949
    residuals = [[chance.gauss(0.0, 0.01) for _ in range(3)] for _ in range(photos)]
    points = [[chance.uniform(-40, 40), chance.uniform(-30, 30), chance.uniform(0.40, 0.46)] for _ in range(300)]
    one, three = [[8.3, 3.5, -48.0]], [[8.3, 3.5, -48.0], [-39.7, -21.0, -48.0], [-26.9, 17.3, -47.0]]
    return {
        "moved_px": 12.1,
        "adopted": True,
        "positions": [
            {"photo": f"P{k:04d}.JPG", "flight": k * flights // photos, "residual_m": residual}
            for k, residual in enumerate(residuals)
        ],
        "left_out": [],
        "predicted_m": [0.026, 0.0083],
        "sentence": "camera positions that the fit did not use are predicted to 2.6 cm along each horizontal axis",
        "noise": [{"of": f"flight {k + 1}, fixed", "factors": [0.9, 0.49]} for k in range(flights)],
        "lens_judged": {"tie_points_px": [0.67, 0.5], "positions_m": [[0.092, 0.049], [0.026, 0.0083]], "whole": True},
        "lenses": [
            {
                "names": names,
                "values": [1965.8, 0.0006, 789.5, 660.6, -0.42],
                "sigmas": [18.8, 0.0015, 0.9, 0.8, 0.0085],
                "correlations": correlations,
            }
        ],
        "heights": {
            "together_sigma_m": [0.018, 0.026, 0.445],
            "typical_sigma_m": [0.028, 0.036, 0.462],
            "map": points,
            "remedies": {
                "control_1": {"height_sigma_m": 0.0319, "places_m": one},
                "control_3": {"height_sigma_m": 0.028, "places_m": three},
                "cross_strip": {"height_sigma_m": 0.0423, "places_m": []},
            },
            "sentence": SENTENCE,
        },
    }


def places(photos: int = 32) -> dict[str, list[float]]:
    """Cameras in strips, to and fro."""
    found = {}
    for k in range(photos):
        row, along = divmod(k, STRIP)
        found[f"P{k:04d}.JPG"] = [5.0 * (along if row % 2 == 0 else STRIP - 1 - along), 6.0 * row, 48.0]
    return found


def page(content: object, *, drawn: bool = True, photos: int = 32) -> str:
    """The part of the report, as it is shown; without line breaks."""
    found = read_adjustment({"adjustment": content})
    assert found is not None
    with styled():
        section = adjustment_section(found, [CAMERA], ORIGIN, places(photos) if drawn else None)
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, trim_blocks=True)
    html = environment.get_template("adjustment.html.j2").render(georeferencing={"adjustment": section})
    return " ".join(html.split())


def inputs_of(
    accuracy: object, sparse: dict[str, Any] | None = None, warnings: tuple[str, ...] = (), **georef: object
) -> Any:
    messages = StageMessages(warnings=[(text, "") for text in warnings])
    read = {"georef.accuracy": accuracy, "georef.frame": {"kind": "enu"}, "sparse.summary": sparse or {}}
    return SimpleNamespace(
        history=RunHistory(stages={"georef": StageHistory("georef", "finished", messages=messages)}),
        artifacts={"georef": None},
        read=lambda name: read.get(name, {}),
        summary=lambda name: {"sparse": PLACED, "georef": georef}.get(name, {}),
    )


def test_the_page_has_heights_remedies_residuals_and_lens() -> None:
    text = page(made_up())
    assert text.count("<svg role=") == 3
    assert "Heights of the ground are uncertain by ±0.87 m together (95 %)" in text
    for title, bound in (("the flight as it is", "±0.87 m"), ("one control point", "±6.3 cm"), ("three", "±5.5 cm")):
        assert re.search(rf"{title}[^<]*</th><td>{bound}", text), title
    assert re.search("cross strip at another height</th><td>±8.3 cm", text)
    assert "1: 8 m east and 4 m north of the origin (45.03153" in text and "2: 40 m west and 21 m south" in text
    assert "Camera positions that the fit did not use are predicted to 2.6 cm" in text
    assert "proves neither the focal length nor the height" in text and "leaves no residual" in text
    assert '1,966 px</td><td>19 px (0.96 %)</td><td class="word">radial k1 (-0.95)' in text
    assert "aspect (fy / fx − 1)" in text and "DJI FC6360" in text
    assert "times as long; the longest is" in text
    assert "nan" not in text.replace("nance", "")


def test_without_images_it_has_the_figures() -> None:
    text = page(made_up(), drawn=False)
    assert "<svg" not in text and "±0.87 m" in text and "1: 8 m east and 4 m north of the origin;" in text


def test_what_the_page_says_of_the_remedies_is_what_was_computed() -> None:
    text = page(made_up(), drawn=False)
    across, _, height = (100.0 * sigma for sigma in CONTROL_SIGMAS_M)
    assert f"surveyed to {across:g} cm, and {height:g} cm in height" in text
    assert (MARK_SIGMA_PX, CROSS_STRIP_RISE) == (0.5, 0.25) and "half a pixel" in text and "a quarter higher" in text
    assert round(NORMAL_95, 2) == adjustment.NORMAL_95
    for value in (0.00512, 0.0349, 0.0994, 0.0996, 0.445, 3.26, 99.0, 1234.0):
        assert two_digits(value) == metres_in_words(value)
    assert set(ALL) | set(ALL_FISHEYE) <= set(adjustment.PARAMETERS)


def test_with_control_there_are_lens_and_heights_without_remedies() -> None:
    content = made_up()
    content = {"lenses": content["lenses"], "heights": content["heights"] | {"remedies": {}, "sentence": None}}
    text = page(content)
    assert "Heights of the ground are known to ±0.87 m together (95 %)" in text
    assert text.count("<svg role=") == 1 and "proposed control" not in text and "the flight as it is" not in text
    assert "Camera positions in the adjustment" not in text and "leaves no residual" not in text


def damaged(content: Any, chance: random.Random) -> Any:
    """The same with some values lost or replaced by others."""
    if chance.random() < 0.08:
        return chance.choice([None, "x", HOSTILE, [], {}, True, -1, math.inf, [None], {"names": None}])
    if isinstance(content, dict):
        return {key: damaged(value, chance) for key, value in content.items() if chance.random() > 0.08}
    if isinstance(content, list):
        return [damaged(value, chance) for value in content if chance.random() > 0.02]
    return content


@pytest.mark.parametrize("seed", range(12))
def test_damaged_entries_are_left_out(seed: int) -> None:
    chance = random.Random(seed)
    content = damaged(
        made_up(12) | {"heights": made_up()["heights"] | {"map": [[0.0, 0.0, 0.4], [9.0, 1.0, 0.4]]}}, chance
    )
    content = json.loads(json.dumps(content if isinstance(content, dict) else {}))
    text = page(content, drawn=seed % 3 == 0)
    assert HOSTILE not in text
    judge(inputs_of({"adjustment": content}))


@pytest.mark.parametrize("content", [{}, {"heights": {}}, {"heights": None, "lenses": None, "positions": None}])
def test_an_adjustment_may_say_nothing(content: dict[str, Any]) -> None:
    assert "<svg" not in page(content) and "<table" not in page(content)
    assert (
        read_adjustment({"adjustment": None}) is None and read_adjustment(None) is None and read_adjustment([]) is None
    )


def test_equal_residuals_and_sigmas_and_few_places_can_be_drawn() -> None:
    content = made_up(2)
    for entry in content["positions"]:
        entry["residual_m"] = [0.0, 0.0, 0.0]
    content["heights"]["map"] = [[0.0, 0.0, 0.0]]
    assert page(content, photos=2).count("<svg role=") == 3
    content["positions"] = content["positions"][:1]
    assert page(content, photos=2).count("<svg role=") == 3


def test_a_thousand_photos_of_many_flights_stay_small() -> None:
    text = page(made_up(1000, flights=9), photos=1000)
    assert text.count("<svg role=") == 2 + adjustment.MAX_FLIGHTS
    assert "3 shorter flights are only in accuracy.json" in text
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert len(text) < 1_000_000


def test_strips_end_where_the_flight_turns() -> None:
    flown = np.array(list(places(3 * STRIP).values()))[:, :2]
    assert strip_ends(flown) == [STRIP + 0.5, 2 * STRIP + 0.5]
    around = np.linspace(0.0, 2.0 * np.pi, 24)
    assert strip_ends(np.stack([np.cos(around), np.sin(around)], axis=1)) == []
    assert strip_ends(flown[:1]) == [] and strip_ends(np.zeros((5, 2))) == []


def test_the_verdict_starts_with_uncertain_heights_and_counts_their_warning_once() -> None:
    assert SENTENCE is not None
    warning = f"H{SENTENCE[1:].partition('; ')[0]}."
    findings = judge(inputs_of({"adjustment": made_up()}, warnings=(warning, "Another one."))).findings
    assert (findings[0].level, findings[0].title) == ("doubt", "Heights")
    assert findings[0].text.startswith("Heights of the ground are uncertain by ±0.87 m together (95 %): ")
    assert findings[0].text.endswith("would settle it.")
    assert findings[-1].text == "The run gave 1 other warning."
    content = made_up()
    content["heights"]["sentence"] = None
    assert "Heights" not in [finding.title for finding in judge(inputs_of({"adjustment": content})).findings]


def test_a_contradiction_is_the_first_line_of_the_verdict() -> None:
    turned = {"text": "North in the result is 180° off the headings of the gimbal.", "hint": "Check the signs."}
    inputs = inputs_of({"adjustment": made_up()}, warnings=(turned["text"], "Another one."), contradictions=[turned])
    verdict = judge(inputs)
    assert (verdict.level, verdict.headline) == ("bad", "The result contradicts what else is known of its place")
    assert verdict.findings[0].text == f"{turned['text']} {turned['hint']}"
    assert verdict.findings[-1].text == "The run gave 1 other warning."
    damaged_ones = inputs_of({"adjustment": made_up()}, contradictions=[3, {}])
    assert "Place" not in [finding.title for finding in judge(damaged_ones).findings]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "Calibrated within 0.8 %"),
        ({"adopted": False}, "Calibrated 8.7 % away"),
        ({"adopted": None}, "Calibrated 8.7 % away"),
        ({"lenses": []}, "Calibrated 8.7 % away"),
        ({"lenses": [{"names": [], "values": [], "sigmas": [], "correlations": []}]}, "Calibrated 8.7 % away"),
    ],
)
def test_the_verdict_judges_the_focal_length_that_the_model_has(change: dict[str, Any], said: str) -> None:
    texts = {finding.title: finding.text for finding in judge(inputs_of({"adjustment": made_up() | change})).findings}
    assert texts["Focal length"].startswith(said)


def test_control_that_bent_the_model_replaces_the_focal_length() -> None:
    accuracy = {"adjustment": {"lenses": made_up()["lenses"]}}
    assert adopted_focals_px(inputs_of(accuracy, model_bent=True), [CAMERA]) == {0: pytest.approx(1966.4, abs=0.1)}
    assert adopted_focals_px(inputs_of(accuracy, model_bent=False), [CAMERA]) == {}


def test_lenses_belong_to_the_cameras_by_number() -> None:
    first = made_up()["lenses"][0]
    accuracy = {"adjustment": made_up() | {"lenses": [first, first | {"values": [900.0, *first["values"][1:]]}]}}
    cameras = [CAMERA | {"id": 3}, CAMERA | {"id": 2, "placed": 0}, CAMERA | {"id": 1}]
    found = adopted_focals_px(inputs_of(accuracy), cameras)
    assert found == {2: pytest.approx(1966.4, abs=0.1), 0: pytest.approx(900.3, abs=0.1)}


def test_a_doubtful_focal_length_is_settled_by_the_one_adopted() -> None:
    text = "The focal length went from 1950 to 1780 pixels, -9 %."
    reason = {"level": "doubt", "kind": "focal", "text": text, "hint": ""}
    sparse = {"verdict": {"level": "doubt", "reasons": [reason]}}
    titles = [it.title for it in judge(inputs_of({"adjustment": made_up()}, sparse, (text,))).findings]
    assert "Focal length" in titles and "Cameras" not in titles and "Warnings" not in titles
    titles = [it.title for it in judge(inputs_of({}, sparse, (text,))).findings]
    assert "Cameras" in titles and "Focal length" not in titles
