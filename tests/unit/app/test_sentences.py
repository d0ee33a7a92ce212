"""Each stage's line on the terminal: a sentence with units that omits the expected."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from splatpipe.pipeline.app.report.facts.run_history import RunHistory, StageHistory, StageMessages
from splatpipe.pipeline.app.report.verdict import Verdict, VerdictLine, judge
from splatpipe.pipeline.app.terminal.console import show_verdict
from splatpipe.pipeline.app.terminal.sentences import SENTENCES, sentence
from splatpipe.stages.line import LINE

PLACED = {"photos": 40, "registered": 40, "mean_reprojection_error_px": 0.3225, "points3d": 23143}
SEEN = {"photos": 40, "cameras": 1, "positions": 40, "masks": 0, "left_out": 0, "sigma_horizontal_m": 0.02}
SURVEYED = {"rmse_horizontal_m": 0.006701, "rmse_up_m": 0.009899, "count": 6}
GEOREF = {"kind": "enu", "note": "From 12 control points.", "positions_left_out": 0, "points_left_out": 1}
SAID = [
    ("ingest", SEEN, "40 photos of 1 camera, all with positions accurate to 0.02 m"),
    (
        "ingest",
        SEEN | {"cameras": 2, "positions": 38, "sigma_horizontal_m": 3.0, "sigma_vertical_m": 5.0, "left_out": 1},
        "40 photos of 2 cameras, 38 with positions accurate to 3 m (5 m in height), 1 file left out",
    ),
    ("sparse", PLACED, "all 40 photos placed, reprojection error 0.32 px, 23,143 tie points"),
    ("sparse", PLACED | {"registered": 37}, "37 of 40 photos placed, reprojection error 0.32 px, 23,143 tie points"),
    (
        "georef",
        GEOREF | {"tables": {"check": SURVEYED, "control": None}, "model_bent": False},
        "From 12 control points; 6 check points off by 6.7 mm horizontally and 9.9 mm in height (RMSE); "
        "1 point left out",
    ),
    (
        "train",
        {"gaussians": 103138, "iterations": 2500, "planned_iterations": 2500},
        "103,138 Gaussians after 2,500 iterations",
    ),
    ("clean", {"gaussians": 900, "removed": 100}, "100 of 1,000 Gaussians removed (10.0 %)"),
    ("clean", {"removed": 0}, "nothing removed"),
    ("evaluate", {"test_views": 5, "psnr": 29.006, "ssim": 0.8797}, "5 held-out photos: PSNR 29.0 dB, SSIM 0.88"),
    (
        "evaluate",
        {"test_views": 8, "held_out_views": 37, "psnr": 29.006, "ssim": 0.8797},
        "8 of 37 held-out photos: PSNR 29.0 dB, SSIM 0.88",
    ),
    ("flythrough", {"frames": 0}, "no film"),
    ("dsm", {"cells": 0}, "no surface model"),
    ("dtm", {"cells": 0}, "no terrain model"),
    (
        "dtm",
        {"cells": 9, "ground_share": 0.84, "building_share": 0.063},
        "terrain model, 84% of it seen, 6% under buildings",
    ),
]


@pytest.mark.parametrize(("stage", "summary", "said"), SAID)
def test_a_summary_is_formatted_as_a_sentence(stage: str, summary: dict[str, Any], said: str) -> None:
    assert sentence(stage, summary) == said


def test_every_stage_has_a_sentence_and_none_fails_on_unknown_summaries() -> None:
    assert {stage.name for stage in LINE} == set(SENTENCES)
    for stage in LINE:
        assert sentence(stage.name, {}) in ("", "none needed")
        assert sentence(stage.name, dict.fromkeys(["photos", "note", "frames", "points", "positions"], "x")) is not None


def test_the_verdict_starts_with_what_is_doubtful(capsys: pytest.CaptureFixture[str]) -> None:
    doubt = VerdictLine("doubt", "Floaters", "Floaters in front of [bold]5[/] photos")
    show_verdict(Verdict("doubt", "Finished; 1 point to look at", "The run ended.", [doubt]))
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:] == [
        "! Finished; 1 point to look at.  The run ended.",
        "  ! Floaters  Floaters in front of [bold]5[/] photos",
    ]


def test_the_verdict_states_a_doubtful_focal_length_once() -> None:
    text = "The focal length went from 1035 to 702 pixels, -32 %."
    reason = {"level": "doubt", "kind": "focal", "text": text, "hint": ""}
    messages = StageMessages(warnings=[(text, ""), ("2 of 40 photos could not be placed: a.jpg, b.jpg.", "")])
    camera = {"has_prior": True, "prior_focal_px": 1035.0, "focal_px": 702.0}
    inputs = SimpleNamespace(
        history=RunHistory(stages={"sparse": StageHistory("sparse", "finished", messages=messages)}),
        artifacts={},
        read={"sparse.summary": {"verdict": {"level": "doubt", "reasons": [reason]}}}.get,
        summary=lambda stage: {"sparse": PLACED | {"cameras": [camera]}}.get(stage, {}),
    )
    texts = {finding.title: finding.text for finding in judge(inputs).findings}  # type: ignore[arg-type]
    assert texts["Cameras"] == text and "Focal length" not in texts
    assert texts["Warnings"] == "The run gave 1 other warning."
