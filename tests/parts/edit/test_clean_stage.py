"""`clean`: what it removes from the splat of a small dataset with known truth, and what it keeps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tiny_scene
import torch

from splatpipe.pipeline.app.report.chapters.training import removed_in_words
from splatpipe.pipeline.edit.options import CleanConfig
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.splat.containers.ply import read_splat, read_splat_header, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.sky.panorama import write_panorama
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.stages import clean
from splatpipe.stages.line import CLEAN, LINE

COMMENTS = ("made by a test",)
FLOATERS = 5


def floaters() -> Gaussians:
    """Between the cameras and the blobs, high above and far below each other."""
    found = Gaussians.empty(FLOATERS, 3)
    places = [
        (-0.9, -1.3, -1.8),
        (0.9, -1.3, -1.8),
        (0.0, 1.4, -1.8),
        (-1.1, 1.2, -1.6),
        (0, -1.6, -1.5),
    ]
    found.means[:] = torch.tensor(places)
    found.log_scales[:] = -2.8
    found.opacity_logits[:] = 3.0
    found.sh[:, 0] = rgb_to_dc(torch.tensor([1.0, 0.0, 1.0]))
    return found


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene.write_dataset(tmp_path_factory.mktemp("clean") / "dataset")


def inputs_of(folder: Path, dataset: Path, model: Gaussians, threads: int = 1) -> Inputs:
    write_splat(folder / "trained.ply", model, COMMENTS)
    views = load_views(dataset)
    plan = make_plan(TrainConfig(antialias=False), views, tiny_scene.split_of(views, 4), len(model))
    (folder / "rendering.json").write_text(plan.rendering().to_json())
    write_panorama(folder / "sky.npz", None)
    parts = {"train.model": folder / "trained.ply", "train.rendering": folder / "rendering.json"}
    parts |= {"train.sky": folder / "sky.npz", "undistort.dataset": dataset} | tiny_scene.split_part(dataset, 4)
    return Inputs(parts, folder, machine=Machine("cpu", threads))


def test_floaters_are_removed_and_the_rest_keeps_its_bits(dataset: Path, tmp_path: Path) -> None:
    """One and two threads give the same, and the held-out photos are not used."""
    truth = tiny_scene.true_model()
    both, recorder = Gaussians.concat([truth, floaters()]), tiny_scene.Recorder()
    left = []
    for threads in (1, 2):
        out = tmp_path / str(threads)
        out.mkdir()
        summary = clean.run(CleanConfig(), inputs_of(tmp_path, dataset, both, threads), out, recorder)
        left.append((out / "model.ply").read_bytes())
    assert left[0] == left[1]
    cleaned = read_splat(tmp_path / "1/model.ply")
    assert read_splat_header(tmp_path / "1/model.ply").comments == COMMENTS
    kept = [bool((both.means[row] == cleaned.means).all(1).any()) for row in range(len(both))]
    assert not any(kept[-FLOATERS:]) and sum(kept[:-FLOATERS]) >= 0.97 * len(truth)
    assert summary["removed"] == len(both) - len(cleaned) and summary["gaussians"] == len(cleaned)
    data = json.loads((tmp_path / "1/cleaned.json").read_text())
    assert data["gaussians"] == len(both) and sum(data["removed"].values()) == summary["removed"]
    assert recorder.notes[0].startswith(f"Removed {summary['removed']} of {len(both)} Gaussians: ")
    assert recorder.steps[-1][0] == recorder.steps[-1][1] and not recorder.warnings


@pytest.mark.parametrize("enabled", [False, True])
def test_where_nothing_is_removed_the_bytes_are_those_of_training(enabled: bool, dataset: Path, tmp_path: Path) -> None:
    seen = tiny_scene.true_model(9)  # too few for anything to be isolated or hidden
    inputs = inputs_of(tmp_path, dataset, seen)
    out = tmp_path / "out"
    out.mkdir()
    recorder = tiny_scene.Recorder()
    summary = clean.run(CleanConfig(enabled=enabled), inputs, out, recorder)
    assert summary["removed"] == 0 and not recorder.notes
    assert (out / "model.ply").read_bytes() == inputs["train.model"].read_bytes()


def test_disabled_it_still_reads_the_trained_model() -> None:
    """`test_ablation.py` runs a pipeline of its own in this way."""
    assert not CleanConfig(enabled=False).is_off


def test_a_damaged_model_is_reported(dataset: Path, tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path, dataset, tiny_scene.true_model())
    inputs["train.model"].write_bytes(inputs["train.model"].read_bytes()[:5000])
    with pytest.raises(SplatpipeError, match="cut off"):
        clean.run(CleanConfig(), inputs, tmp_path, tiny_scene.Recorder())


def test_everything_derived_from_the_splat_uses_the_cleaned_one() -> None:
    after = [stage for stage in LINE[LINE.index(CLEAN) + 1 :] if any(part.endswith(".model") for part in stage.reads)]
    assert not [stage.name for stage in after if "train.model" in stage.reads]
    readers = {stage.name for stage in after if "clean.model" in stage.reads}
    assert {"evaluate", "export", "flythrough", "splat_depths"} <= readers


def test_the_report_states_what_was_removed() -> None:
    assert removed_in_words({"reasons": {"floating": 12, "transparent": 2000, "oversized": 0}}) == (
        "2,012 removed: 12 floating, 2,000 transparent"
    )
    assert removed_in_words({"reasons": {"floating": 0}}) == "none removed"
    assert removed_in_words({"removed": 0}) == ""
