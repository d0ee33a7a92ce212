"""evaluate: its figures can be reproduced from the PNGs that it writes, with third-party code."""

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import kornia
import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.render import view_measures
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.sky.panorama import write_panorama
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.stages import evaluate

MASKED = "flight 1/photo_4.png"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """The true model, a little out of place, and the dataset."""
    folder = tmp_path_factory.mktemp("evaluate")
    dataset = tiny_scene.write_dataset(folder / "dataset", masked=MASKED)
    model = tiny_scene.true_model()
    model.means = model.means + 0.01
    write_splat(folder / "model.ply", model)
    plan = make_plan(TrainConfig(), load_views(dataset), tiny_scene.split_of(load_views(dataset), 4), len(model))
    (folder / "rendering.json").write_text(plan.rendering().to_json())
    write_panorama(folder / "sky.npz", None)
    parts = {"model": folder / "model.ply", "rendering": folder / "rendering.json", "sky": folder / "sky.npz"}
    parts = {f"train.{name}": path for name, path in parts.items()} | {"undistort.dataset": dataset}
    parts["clean.model"] = parts.pop("train.model")
    parts |= tiny_scene.split_part(dataset, 4)
    return Inputs(parts, folder)


def held_out(inputs: Inputs, every: int, names: str = "") -> Inputs:
    """Return the inputs with other photos held out."""
    part = tiny_scene.split_part(inputs["undistort.dataset"], every, names)
    return replace(inputs, parts={**inputs.parts, **part})


@pytest.fixture(scope="module")
def left(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("left")
    evaluate.run(EvaluateConfig(), inputs, out, tiny_scene.Recorder())
    return out


def read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None and picture.dtype == np.uint8
    return picture


def test_every_nth_view_is_measured_and_the_means_are_theirs(left: Path) -> None:
    result = json.loads((left / "metrics.json").read_text())
    assert [view["name"] for view in result["per_view"]] == [f"flight 1/photo_{n}.png" for n in (0, 4, 8)]
    assert result["test_views"] == 3
    for name in ("psnr", "psnr_cc", "ssim", "ms_ssim", "gmsd", "sharpness"):
        values = [view[name] for view in result["per_view"]]
        assert result["mean"][name] == pytest.approx(sum(values) / 3, abs=2e-6)


def test_only_as_many_views_as_asked_are_judged_and_their_figures_are_the_same(
    inputs: Inputs, left: Path, tmp_path: Path
) -> None:
    summary = evaluate.run(EvaluateConfig(most_views=2), inputs, tmp_path, tiny_scene.Recorder())
    few, every = (json.loads((folder / "metrics.json").read_text()) for folder in (tmp_path, left))
    assert (few["test_views"], few["held_out_views"]) == (2, 3) == (summary["test_views"], summary["held_out_views"])
    assert every["held_out_views"] == 3
    assert few["per_view"] == [every["per_view"][0], every["per_view"][2]]  # the second is not judged
    assert few["floaters"]["veil"]["photos"] == 2 and len(list((tmp_path / "views").glob("*.render.png"))) == 2


def test_judged_views_are_spread_evenly() -> None:
    names = [f"{number:02}.jpg" for number in range(37)]
    chosen = [int(name[:2]) for name in view_measures.judged_views(names, 8)]
    assert chosen[0] == 2 and chosen[-1] == 34 and set(np.diff(chosen)) == {4, 5}
    assert view_measures.judged_views(names, 0) == view_measures.judged_views(names, 37) == names
    assert view_measures.judged_views(names, 1) == names[18:19] and view_measures.judged_views([], 8) == []
    assert [len(set(view_measures.judged_views(names[:n], 8))) for n in range(8, 37)] == [8] * 29


def test_floaters_are_measured_with_or_without_held_out_views(left: Path, inputs: Inputs, tmp_path: Path) -> None:
    figures = json.loads((left / "metrics.json").read_text())["floaters"]
    assert figures["depth_disagreement"]["pixels"] > 0 and 0.0 <= figures["depth_disagreement"]["median"] < 0.1
    evaluate.run(EvaluateConfig(), held_out(inputs, 0), tmp_path, tiny_scene.Recorder())
    without = json.loads((tmp_path / "metrics.json").read_text())["floaters"]
    veils = [each.pop("veil") for each in (figures, without)]
    assert [(veil["held_out"], veil["photos"]) for veil in veils] == [(True, 3), (False, 9)]
    assert figures == without


def test_figures_can_be_recomputed_from_the_pngs(left: Path) -> None:
    for view in json.loads((left / "metrics.json").read_text())["per_view"]:
        photo, render = (read(left / "views" / f"{view['file']}.{kind}.png") for kind in ("photo", "render"))
        valid = np.ones(photo.shape[:2], bool)
        if view["name"] == MASKED:
            valid = read(left / "views" / f"{view['file']}.mask.png") > 0
            assert valid.mean() == pytest.approx(0.5) == pytest.approx(view["counted"])
        else:
            assert not (left / "views" / f"{view['file']}.mask.png").exists()
        error = (photo.astype(float) - render.astype(float))[valid] / 255.0
        assert view["psnr"] == pytest.approx(-10.0 * math.log10((error**2).mean()), abs=1e-4)
        render = np.where(valid[..., None], render, photo)
        pair = [torch.from_numpy(picture / 255.0).permute(2, 0, 1)[None] for picture in (render, photo)]
        similarity = kornia.metrics.ssim(*pair, window_size=11)[0].mean(dim=0).numpy()
        assert view["ssim"] == pytest.approx(similarity[valid].mean(), abs=1e-4)


def test_photos_are_kept_as_they_are(left: Path, inputs: Inputs) -> None:
    original = read(inputs["undistort.dataset"] / "images/flight 1/photo_0.png")
    np.testing.assert_array_equal(read(left / "views/flight 1_photo_0.photo.png"), original)


def test_photos_are_evaluated_at_their_own_size_whatever_was_trained(
    inputs: Inputs, left: Path, tmp_path: Path
) -> None:
    rendering = json.loads(inputs["train.rendering"].read_text()) | {"megapixels": 0.001}
    (tmp_path / "rendering.json").write_text(json.dumps(rendering))
    smaller = replace(inputs, parts={**inputs.parts, "train.rendering": tmp_path / "rendering.json"})
    summary = evaluate.run(EvaluateConfig(), smaller, tmp_path, tiny_scene.Recorder())
    assert (tmp_path / "metrics.json").read_bytes() == (left / "metrics.json").read_bytes()
    size = tiny_scene.WIDTH * tiny_scene.HEIGHT / 1e6
    assert summary["judged_megapixels"] == json.loads((left / "metrics.json").read_text())["judged_megapixels"]
    assert summary["judged_megapixels"] == pytest.approx(size, abs=5e-4)


def test_larger_photos_are_evaluated_at_one_size(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate, "JUDGED_MEGAPIXELS", 0.002)
    assert evaluate.run(EvaluateConfig(), inputs, tmp_path, tiny_scene.Recorder())["judged_megapixels"] == 0.002
    for view in json.loads((tmp_path / "metrics.json").read_text())["per_view"]:
        assert (view["width"], view["height"]) == (51, 38)
        assert read(tmp_path / "views" / f"{view['file']}.photo.png").shape == (38, 51, 3)


def test_figures_are_the_same_for_any_number_of_threads(inputs: Inputs, left: Path, tmp_path: Path) -> None:
    several = replace(inputs, machine=replace(inputs.machine, threads=3))
    evaluate.run(EvaluateConfig(), several, tmp_path, tiny_scene.Recorder())
    assert (tmp_path / "metrics.json").read_bytes() == (left / "metrics.json").read_bytes()


def test_error_picture_has_a_fixed_scale_and_greys_what_is_masked() -> None:
    photo = np.full((2, 3, 3), 100, np.uint8)
    render = photo.copy()
    render[0, 1] += 40
    render[0, 2] += 64
    render[1, 2] += 155
    mask = np.ones((2, 3), bool)
    mask[1, 0] = False
    picture = view_measures.error_picture(render, photo, mask)
    brightness = picture.astype(int).sum(axis=2)
    assert brightness[0, 0] < brightness[0, 1] < brightness[0, 2]
    np.testing.assert_array_equal(picture[0, 2], picture[1, 2])  # both beyond the scale's end
    np.testing.assert_array_equal(picture[1, 0], [128, 128, 128])


def test_without_held_out_views_it_says_so_and_leaves_valid_figures(inputs: Inputs, tmp_path: Path) -> None:
    recorder = tiny_scene.Recorder()
    summary = evaluate.run(EvaluateConfig(), held_out(inputs, 0), tmp_path, recorder)
    assert "held out" in recorder.warnings[0]
    assert summary["test_views"] == 0 and summary["psnr"] is None
    result = json.loads((tmp_path / "metrics.json").read_text())
    assert result["per_view"] == [] and result["mean"]["ssim"] is None
    assert list((tmp_path / "views").iterdir()) == []


def test_named_views_are_evaluated(inputs: Inputs, tmp_path: Path) -> None:
    named = held_out(inputs, 8, "flight 1/photo_2.png, flight 1/photo_7.png")
    assert evaluate.run(EvaluateConfig(), named, tmp_path, tiny_scene.Recorder())["test_views"] == 2


def test_wholly_masked_view_has_no_figures_and_the_mean_leaves_it_out() -> None:
    photo = np.zeros((16, 16, 3), np.uint8)
    figures = view_measures.measure(photo, photo, np.zeros((16, 16), bool))
    assert set(figures.values()) == {None}
    other = dict.fromkeys(figures, 2.0)
    assert view_measures.mean_measures([figures, other])["psnr"] == 2.0


def test_file_names_are_safe_and_unique_whatever_the_photos_are_called() -> None:
    names = ["a/b.jpg", "a_b.jpg", "A_B.png", "../../etc/passwd", "..", "x" * 300 + ".jpg", "Фото 1.JPG"]
    names += ["c:d?.jpg", ".jpg"]
    stems = view_measures.flat_stems(names)
    assert len({stem.casefold() for stem in stems}) == len(names)
    for stem in stems:
        assert stem and not set(stem) & set('/\\:*?"<>|') and not stem.startswith(".") and len(stem) < 110
    assert stems[0] == "a_b" and stems[6] == "Фото 1"


def test_broken_plan_says_what_to_do(inputs: Inputs, tmp_path: Path) -> None:
    (tmp_path / "rendering.json").write_text("{}")
    broken = Inputs({**inputs.parts, "train.rendering": tmp_path / "rendering.json"}, tmp_path)
    with pytest.raises(StageError, match=r"rendering\.json") as raised:
        evaluate.run(EvaluateConfig(), broken, tmp_path, tiny_scene.Recorder())
    assert raised.value.hint
