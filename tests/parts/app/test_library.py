"""splatpipe from Python: the same runs as by the command line, renders of finished ones, one class of errors."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command import answered, ran

import splatpipe
from splatpipe.demo import capture_path
from splatpipe.pipeline.app.render_request import RenderRequest
from splatpipe.pipeline.app.renders import render_run
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.run_folder import EVENTS_FILE
from splatpipe.stages.line import LINE

pytestmark = pytest.mark.usefixtures("plain_reports")  # what scripts call in processes of their own writes whole ones

UNCHANGED = ("splat.ply", "metrics.json", "cameras.json", "georef.json")


def named(demo_options: list[str]) -> dict[str, Any]:
    """The options of the demo's run by their names."""
    pairs = (text.partition("=") for text in demo_options if text != "--set")
    return {name: value if name == "features.extractor" else json.loads(value) for name, _, value in pairs}


def test_a_finished_run_is_reused_as_by_the_command_line(demo_copy: Path, demo_options: list[str]) -> None:
    before = {name: (demo_copy / name).read_bytes() for name in UNCHANGED}
    events: list[Event] = []
    run = splatpipe.run_capture(capture_path(), str(demo_copy), options=named(demo_options), on_event=events.append)
    kinds = [event.kind for event in events]
    assert kinds.count("stage_reused") == len(LINE) and "stage_started" not in kinds
    assert (kinds[-1], events[-1].data["exit_code"]) == ("run_finished", 0)
    assert run.out == demo_copy
    assert {name: (demo_copy / name).read_bytes() for name in UNCHANGED} == before
    assert ran(answered("run", capture_path(), demo_copy, *demo_options)) == []  # and the other way round


def test_one_stage_is_run_again_with_other_options(demo_copy: Path) -> None:
    events: list[Event] = []
    run = splatpipe.run_stage("split", demo_copy, options={"split.every": 5}, on_event=events.append)
    assert [event.stage for event in events if event.kind == "stage_finished"] == ["split"]
    assert "every = 5" in (demo_copy / "config.toml").read_text()
    assert run.products["report.html"].stat().st_mtime >= events[0].time_s  # the report was written again


@pytest.mark.parametrize("raised", [KeyError("enough"), OSError("enough")], ids=["KeyError", "OSError"])
def test_a_callback_that_raises_stops_the_run_which_can_be_resumed(tmp_path: Path, raised: Exception) -> None:
    def stop(event: Event) -> None:
        if event.kind == "stage_finished":
            raise raised

    with pytest.raises(type(raised), match="enough"):
        splatpipe.run_capture(capture_path(), tmp_path / "out", until="control", on_event=stop)
    events: list[Event] = []
    splatpipe.run_capture(capture_path(), tmp_path / "out", until="control", on_event=events.append)
    assert [event.stage for event in events if event.kind == "stage_reused"] == ["control"]


def test_a_script_without_a_main_guard_runs_a_capture(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import splatpipe\n"
        f"run = splatpipe.run_capture({str(capture_path())!r}, 'out', preset='preview', until='control', threads=1)\n"
        "print(run, len(run.products))\n"
    )
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Run('/")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"preset": "fast"}, "no preset"),
        ({"device": "tpu"}, "no device"),
        ({"threads": -1}, "-1 threads"),
        ({"until": "finish"}, "no stage"),
        ({"rerun": ["finish"]}, "no stage"),
        ({"options": {"train.iteration": 9}}, r"Did you mean train\.iterations\?"),
        ({"options": {"train.iterations": 0}}, r"train\.iterations = 0: "),
        ({"options": {"iterations": 9}}, 'Cannot understand the option "iterations"'),
        ({"options": {"train.iterations": object()}}, r"train\.iterations = "),
        ({"config": "missing.toml"}, "Cannot read"),
        ({"photos": "missing"}, "There is no folder"),
        ({"out": "/proc/out"}, "Cannot write"),
    ],
)
def test_what_is_wrong_is_said_as_by_the_command_line(tmp_path: Path, given: Mapping[str, Any], message: str) -> None:
    call = {"photos": capture_path(), "out": tmp_path / "out", **given}
    with pytest.raises(splatpipe.SplatpipeError, match=message) as caught:
        splatpipe.run_capture(**call)
    assert caught.value.hint
    assert not (tmp_path / "out" / "stages").exists()


def test_no_run_no_stage_no_training_are_errors_with_a_hint(tmp_path: Path) -> None:
    splatpipe.run_capture(capture_path(), tmp_path / "out", until="control")
    early = splatpipe.open_run(tmp_path / "out")
    assert set(early.products) == {"report.html"}
    view = splatpipe.look_at((0.0, 0.0, 10.0), (0.0, 0.0, 0.0))
    calls = (
        lambda: splatpipe.open_run(tmp_path),
        lambda: splatpipe.open_run(tmp_path / "out", device="tpu"),
        lambda: splatpipe.open_run(tmp_path / "out", threads=-3),
        lambda: splatpipe.run_stage("trains", tmp_path / "out"),
        lambda: splatpipe.run_stage("train", tmp_path / "out", shard=1, options={"train.iterations": 1}),
        lambda: splatpipe.run_stage("train", tmp_path / "out"),
        lambda: early.cameras,
        lambda: early.sparse_points,
        lambda: early.metrics,
        lambda: early.render(view),
    )
    for call in calls:
        with pytest.raises(splatpipe.SplatpipeError) as caught:
            call()
        assert caught.value.hint


def test_a_run_has_its_cameras_points_figures_and_files(demo_run: Path) -> None:
    run = splatpipe.open_run(demo_run)
    listed = json.loads((demo_run / "cameras.json").read_text())
    assert [camera.name for camera in run.cameras] == [entry["img_name"] for entry in listed]
    for camera, entry in zip(run.cameras, listed, strict=True):
        assert camera.centre() == pytest.approx(entry["position"], abs=1e-9)
        assert pytest.approx(np.array(entry["rotation"]), abs=1e-9) == camera.cam_from_world[:3, :3].T
    assert len(run.sparse_points.xyz) == len(run.sparse_points.rgb) == run.metrics["points3d"]
    seen = [len(camera.in_view(run.sparse_points.xyz)[0]) for camera in run.cameras]
    assert min(seen) > 100
    assert run.georeference["crs"]["id"] == "EPSG:32633"
    assert {"splat.ply", "report.html", "viewer.html", "ortho.tif"} <= set(run.products)
    assert all(path.is_file() for path in run.products.values())


def test_renders_are_those_of_the_command_line(demo_run: Path, tmp_path: Path) -> None:
    run = splatpipe.open_run(demo_run, device="cpu")
    for what in ("colour", "depth", "normals"):
        render_run(demo_run, RenderRequest(what=what, stills=True, size="160x120", to=tmp_path / what), 1, "cpu")
        camera = run.cameras[3].scaled(160, 120)
        shown = run.render(camera, what)  # type: ignore[arg-type]
        stem = tmp_path / what / Path(camera.name).stem
        if what != "depth":  # whose colours depend on all images of the path
            picture = cv2.imread(str(stem.with_suffix(".png")))
            assert np.abs(picture[:, :, ::-1].astype(int) - shown.pixels).max() <= 1
        if what == "colour":
            assert shown.values is None
        else:
            values = cv2.imread(str(stem.with_suffix(".tif")), cv2.IMREAD_UNCHANGED)
            values = values if what == "depth" else values[:, :, ::-1]
            assert shown.values is not None and np.abs(values - shown.values).max() < 1e-3


def test_a_notebook_shows_a_render(demo_run: Path, tmp_path: Path) -> None:
    run = splatpipe.open_run(demo_run)
    middle = run.sparse_points.xyz.mean(axis=0)
    for away in ([0.0, -25.0, 12.0], [0.0, 0.0, 40.0]):  # from the south, and straight down
        shown = run.render(splatpipe.look_at(middle + away, middle, width=160, height=96))
        assert shown.pixels.shape == (96, 160, 3) and shown.pixels.std() > 20.0
    data = shown._repr_png_()
    assert data.startswith(b"\x89PNG")
    shown.save(tmp_path / "render.png")
    assert np.array_equal(cv2.imread(str(tmp_path / "render.png"))[:, :, ::-1], shown.pixels)
    with pytest.raises(splatpipe.SplatpipeError):
        shown.save(tmp_path / "missing" / "render.png")


def test_a_view_has_its_target_in_the_middle_and_is_upright() -> None:
    camera = splatpipe.look_at((3.0, -2.0, 5.0), (1.0, 1.0, 0.5), width=640, height=480, angle_deg=90.0)
    points = np.array([[1.0, 1.0, 0.5], [1.0, 1.0, 1.5]])
    target, above = camera.project(points)
    assert target == pytest.approx([320.0, 240.0]) and camera.fx == pytest.approx(320.0)
    assert above[1] < target[1] and above[0] == pytest.approx(target[0])
    assert camera.centre() == pytest.approx([3.0, -2.0, 5.0])
    assert np.linalg.det(camera.cam_from_world[:3, :3]) == pytest.approx(1.0)
    down = splatpipe.look_at((0.0, 0.0, 9.0), (0.0, 0.0, 0.0))
    north = down.project(np.array([[0.0, 1.0, 0.0]]))[0]
    assert north[1] < down.cy and north[0] == pytest.approx(down.cx)


@pytest.mark.parametrize(
    "change", [{"width": 9000}, {"height": 0}, {"fx": float("nan")}, {"cam_from_world": np.full((4, 4), np.inf)}]
)
def test_cameras_that_cannot_be_rendered_are_refused(demo_run: Path, change: Mapping[str, Any]) -> None:
    run = splatpipe.open_run(demo_run)
    with pytest.raises(splatpipe.SplatpipeError) as caught:
        run.render(replace(run.cameras[0], **change))
    assert caught.value.hint
    with pytest.raises(splatpipe.SplatpipeError, match="cannot look at"):
        splatpipe.look_at((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))


def test_an_interrupted_script_ends_soon_and_keeps_finished_work(tmp_path: Path) -> None:
    script = (
        "import splatpipe, sys\nsplatpipe.run_capture(sys.argv[1], 'out', on_event=lambda e: print(e.kind, flush=True))"
    )
    command = [sys.executable, "-c", script, str(capture_path())]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        next(line for line in process.stdout if line == "stage_finished\n")
        process.send_signal(2)
        assert process.wait(60) != 0
    last = (tmp_path / "out" / EVENTS_FILE).read_text().splitlines()[-1]
    assert json.loads(last)["kind"] == "run_finished" and json.loads(last)["data"]["exit_code"] == 130
    assert (tmp_path / "out" / "report.html").is_file()
