"""Blocks in the pipeline: their number, shards of the training, and the merge."""

import json
import os
from dataclasses import asdict, replace
from pathlib import Path

import block_line
import building_site
import numpy as np
import pytest
import skies
import tiny_scene
import torch
from block_scene import OPTIONS, QUICK, SHARDS, prepared

from splatpipe.pipeline.app.report.chapters import training
from splatpipe.pipeline.engine.errors import StageError, UsageError
from splatpipe.pipeline.engine.runs.lock import locked_shard
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.sky.panorama import read_panorama
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.blocks import assembly
from splatpipe.pipeline.train.blocks.assembly import joint_history
from splatpipe.pipeline.train.blocks.cells.division import PHOTOS_A_BLOCK, Division, SceneSize, divided, memory_limit
from splatpipe.pipeline.train.blocks.cells.needs import need_of_blocks
from splatpipe.pipeline.train.blocks.cells.site_plan import block_limits, capped_shares, load_site_plan
from splatpipe.pipeline.train.blocks.options import BlocksConfig
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.stages import blocks, train

SITE = SceneSize(cap=1_000_000, expected=3e6, window_pixels=1 << 19, sh_degree=3, photos=400)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the inputs of `blocks`: a dataset of 30 photos, its split, the initial Gaussians."""
    folder = tmp_path_factory.mktemp("scene")
    return prepared(building_site.write_dataset(folder / "dataset"), 8)


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An OUT that one process made from beginning to end."""
    out = tmp_path_factory.mktemp("undisturbed")
    assert block_line.make(scene, out, OPTIONS).ran == ["blocks", *SHARDS, "train"]
    return out


def inputs(scene: Path, config: TrainConfig, **more: Path) -> Inputs:
    parts = {name: scene / path for name, path in block_line.GIVEN.items()} | {
        name.replace("_", "."): path for name, path in more.items()
    }
    settings = {f"train.{name}": value for name, value in config.model_dump().items()}
    return Inputs(parts, scene, settings, Machine("cpu", 1))


def part(out: Path, name: str) -> Path:
    stage, _, file = name.partition("/")
    (found,) = out.glob(f"stages/{stage}-*/{file}")
    return found


@pytest.mark.parametrize("limit", [1_000_000_000, 1_500_000_000, 2_000_000_000])
def test_a_cap_that_does_not_fit_is_kept_and_the_scene_is_divided(limit: int) -> None:
    found = divided(SITE, limit)
    assert found.blocks > 1 and found.cap == SITE.cap and found.memory_bytes <= limit
    assert found.need.trained < found.cap
    fewer = need_of_blocks(found.blocks - 1, SITE.cap, found.window_pixels, SITE.sh_degree)
    assert fewer.memory_bytes > limit - (found.memory_bytes - found.need.memory_bytes)  # as few as there can be


@pytest.mark.parametrize("limit", [1_000_000_000, 1_500_000_000, 2_000_000_000])
def test_the_coarse_pass_has_the_cap_of_the_whole_or_what_the_limit_holds(limit: int) -> None:
    found = divided(SITE, limit)
    room = limit - (found.memory_bytes - found.need.memory_bytes)  # ``need`` does not include the libraries
    assert found.need.trained < found.coarse_cap < found.cap  # more than a block trains: it has no frozen surroundings
    taken = [need_of_blocks(1, found.coarse_cap + n, found.window_pixels, SITE.sh_degree).memory_bytes for n in (0, 2)]
    assert taken[0] <= room < taken[1]
    assert divided(SITE, 0, least=4).coarse_cap == divided(SITE, 8_000_000_000, least=4).coarse_cap == SITE.cap


def test_a_scene_that_fits_or_stays_far_below_the_cap_is_not_divided() -> None:
    assert divided(SITE, 0).is_whole and divided(SITE, 8_000_000_000).is_whole
    assert divided(replace(SITE, expected=90_000.0), 1_500_000_000).is_whole
    assert divided(SITE, 0, least=4).blocks == divided(SITE, 8_000_000_000, least=4).blocks == 4


def test_few_photos_have_few_blocks_and_a_cap_that_these_hold() -> None:
    few = divided(replace(SITE, photos=5 * PHOTOS_A_BLOCK), 1_000_000_000)
    assert few.blocks == 5 and 0 < few.cap < SITE.cap and few.memory_bytes <= 1_000_000_000
    assert divided(replace(SITE, photos=PHOTOS_A_BLOCK), 1_000_000_000).is_whole
    assert divided(SITE, 500_000_000).is_whole  # training itself reports that it is too little


def test_a_requested_limit_takes_precedence_over_the_machines() -> None:
    assert memory_limit(3, 100) == 3 and 0 < memory_limit(0, 100) < 100 and memory_limit(0, 0) == 0


def test_shares_add_up_to_the_cap_and_no_block_has_more_than_fits() -> None:
    assert capped_shares(100, [1.0, 1.0, 2.0], [90, 90, 90]) == [25, 25, 50]
    assert capped_shares(100, [1.0, 1.0, 8.0], [90, 90, 40]) == [30, 30, 40]
    assert capped_shares(100, [1.0, 1.0], [10, 10]) == [10, 10]
    division = divided(SITE, 1_500_000_000)
    block_counts = [(1.0, 1000, 1400), (3.0, 2000, 2300), (1.0, 0, 0), *[(1.0, 1000, 1400)] * (division.blocks - 3)]
    limits = block_limits(division, SITE.sh_degree, block_counts)
    assert sum(each.share for each in limits) == SITE.cap
    for each in limits:
        assert 0 < each.share <= each.trained <= division.need.trained and each.frozen > 0


def test_without_blocks_there_is_no_coarse_pass_and_training_is_unchanged(scene: Path, tmp_path: Path) -> None:
    config = tiny_scene.plain(iterations=12, sh_degree=0)
    folders = [tmp_path / name for name in ("blocks", "whole", "line")]
    for folder in folders:
        folder.mkdir()
    summary = blocks.run(BlocksConfig(), inputs(scene, config), folders[0], tiny_scene.Recorder())
    assert summary == {"blocks": 1} and json.loads((folders[0] / "blocks.json").read_text()) == {"shards": 0}
    assert not list((folders[0] / "coarse").iterdir())
    more = {"blocks_plan": folders[0] / "blocks.json", "blocks_coarse": folders[0] / "coarse"}
    loop.run(config, inputs(scene, config), folders[1], tiny_scene.Recorder())
    train.run(config, inputs(scene, config, **more), folders[2], tiny_scene.Recorder())
    for name in ("model.ply", "history.json", "plan.json", "rendering.json", "exposures.json", "sky.npz"):
        assert (folders[1] / name).read_bytes() == (folders[2] / name).read_bytes()


def test_a_machine_with_other_memory_continues_with_the_existing_division(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny_scene.plain(iterations=12, sh_degree=0, max_gaussians=2_000_000)
    monkeypatch.setattr(blocks, "available_memory_bytes", lambda: 32 << 30)
    blocks.run(BlocksConfig(), inputs(scene, config), tmp_path, tiny_scene.Recorder())
    kept = (tmp_path / "division.json").read_bytes()
    monkeypatch.setattr(blocks, "available_memory_bytes", lambda: 1 << 30)
    assert blocks.run(BlocksConfig(), inputs(scene, config), tmp_path, tiny_scene.Recorder()) == {"blocks": 1}
    assert (tmp_path / "division.json").read_bytes() == kept
    division = divided(SITE, 1_500_000_000)
    assert Division.of_facts(json.loads(json.dumps(asdict(division)))) == division


def test_merged_blocks_have_the_outputs_of_a_training(undisturbed: Path) -> None:
    site = load_site_plan(part(undisturbed, "blocks/blocks.json"))
    model = read_splat(part(undisturbed, "train/model.ply"))
    assert len(site.blocks) == 3 and sum(each.share for each in site.blocks) == 6000 >= len(model)
    each = [len(read_splat(part(undisturbed, f"{name}/model.ply"))) for name in SHARDS]
    assert 0 < len(model) <= sum(each)
    for name in ("sky.npz", "exposures.json", "rendering.json"):
        before = part(undisturbed, f"blocks/coarse/{name}")
        assert part(undisturbed, f"train/{name}").read_bytes() == before.read_bytes()
    manifest = json.loads(part(undisturbed, "train/manifest.json").read_text())
    history = json.loads(part(undisturbed, "train/history.json").read_text())
    steps = [point["iteration"] for point in history["curve"]]
    assert steps == sorted(steps) and steps[-1] == manifest["summary"]["iterations"] >= 80
    assert manifest["summary"]["blocks"] == len(history["blocks"]) == 3
    assert manifest["summary"]["gaussians"] == len(model) and manifest["summary"]["plan"]["max_gaussians"] <= 6000
    assert manifest["summary"]["loss"] < history["curve"][0]["loss"]


def test_blocks_model_the_sky_and_exclude_moving_objects(tmp_path: Path) -> None:
    folder = prepared(skies.write_dataset(tmp_path / "dataset"), 3)
    config = tiny_scene.plain(iterations=40, max_gaussians=3000, sh_degree=0, sky="model", robust=0.05)
    block_line.make(folder, tmp_path, {"train": config.model_dump(), "blocks": {"least": 2}})
    summary = json.loads(part(tmp_path, "train/manifest.json").read_text())["summary"]
    assert summary["blocks"] == 2 and summary["sky_photos"] == 4
    each = [json.loads(part(tmp_path, f"train.{number}/manifest.json").read_text())["summary"] for number in (1, 2)]
    left_out = [block["robust_left_out"] for block in each]
    assert 0.0 < min(left_out) <= summary["robust_left_out"] <= max(left_out) < 0.1
    panorama = read_panorama(part(tmp_path, "train/sky.npz"))
    model = read_splat(part(tmp_path, "train/model.ply"))
    assert panorama is not None
    for view in load_views(folder / "dataset"):
        photo, sky = skies.trace(view.camera)
        sky_render = rasterizer.render(model, view.camera, rasterizer.RenderOptions(0))
        assert float(sky_render.alpha[torch.from_numpy(sky)].mean()) < 0.05  # no block has added Gaussians there
        behind = panorama.behind(view.camera, (0.0, 0.0, 0.0)).numpy()
        assert np.abs(behind - photo.pixels / 255.0)[sky].mean() < 0.03


class Kill(BaseException):
    """Stands in for a kill."""


def test_a_finished_coarse_pass_is_not_repeated(
    scene: Path, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(**QUICK)

    def killed(*_arguments: object) -> None:
        raise Kill

    with monkeypatch.context() as patch, pytest.raises(Kill):
        patch.setattr(blocks, "lay_out", killed)
        blocks.run(BlocksConfig(least=3), inputs(scene, config), tmp_path, tiny_scene.Recorder())
    monkeypatch.setattr(blocks, "train_coarse", killed)
    summary = blocks.run(BlocksConfig(least=3), inputs(scene, config), tmp_path, tiny_scene.Recorder())
    manifest = json.loads(part(undisturbed, "blocks/manifest.json").read_text())
    assert summary["of_blocks"] == manifest["summary"]["of_blocks"] and summary["coarse"]["gaussians"] > 0
    for path in ("blocks.json", "coarse/model.ply"):
        assert (tmp_path / path).read_bytes() == part(undisturbed, f"blocks/{path}").read_bytes()


def test_a_coarse_pass_is_reported_as_done_once_its_files_are_on_disk(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[Path] = []
    flush, write_durably = os.fsync, blocks.write_durably

    def noted(descriptor: int) -> None:
        flushed.append(Path(f"/proc/self/fd/{descriptor}").readlink())
        flush(descriptor)

    def coarse(_train: object, _inputs: object, _limits: object, out: Path, _report: object) -> dict[str, object]:
        (out / "model.ply").write_text("a model")
        flushed.clear()
        return {"iterations": 1}

    def checked_write(path: Path, content: str) -> None:
        if path.name == "coarse.json":
            assert {tmp_path / "coarse", tmp_path / "coarse" / "model.ply"} <= set(flushed)
        write_durably(path, content)

    def killed(*_arguments: object) -> None:
        raise Kill

    for name, stand_in in (("train_coarse", coarse), ("write_durably", checked_write), ("lay_out", killed)):
        monkeypatch.setattr(blocks, name, stand_in)
    monkeypatch.setattr(os, "fsync", noted)
    with pytest.raises(Kill):
        blocks.run(BlocksConfig(least=3), inputs(scene, TrainConfig(**QUICK)), tmp_path, tiny_scene.Recorder())
    assert json.loads((tmp_path / "coarse.json").read_text()) == {"iterations": 1}


def test_missing_blocks_are_named_before_anything_is_merged(scene: Path, undisturbed: Path, tmp_path: Path) -> None:
    plan, coarse = (part(undisturbed, f"blocks/{name}") for name in ("blocks.json", "coarse"))
    given = inputs(scene, TrainConfig(**QUICK), blocks_plan=plan, blocks_coarse=coarse)
    shards = [part(undisturbed, f"{name}/model.ply").parent for name in SHARDS]
    for there, named in (
        (shards[:2], "block 3 has no model"),
        ([shards[0], tmp_path, shards[2]], "block 2 has no model"),
    ):
        with pytest.raises(StageError, match=named) as raised:
            train.run(TrainConfig(**QUICK), replace(given, shards=tuple(there)), tmp_path, tiny_scene.Recorder())
        assert "--rerun-from train" in raised.value.hint
    with pytest.raises(StageError, match="None of the 3 blocks"):
        train.run(TrainConfig(**QUICK), given, tmp_path, tiny_scene.Recorder())


def test_too_few_photos_for_blocks_are_trained_within_the_machines_memory(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(SITE, photos=PHOTOS_A_BLOCK)
    assert divided(few, 1_500_000_000).is_near and not divided(few, 8_000_000_000).is_near
    assert not divided(SITE, 1_500_000_000).is_near
    near = divided(few, 1_500_000_000)
    monkeypatch.setattr(blocks, "_division", lambda *_: near)
    config = tiny_scene.plain(iterations=12, sh_degree=0)
    summary = blocks.run(BlocksConfig(), inputs(scene, config), tmp_path, tiny_scene.Recorder())
    assert summary == {"blocks": 1, "limit_bytes": near.limit_bytes}
    seen: list[TrainConfig] = []
    monkeypatch.setattr(loop, "run", lambda config, *_: seen.append(config) or {})
    more = {"blocks_plan": tmp_path / "blocks.json", "blocks_coarse": tmp_path / "coarse"}
    for asked in (0, 900_000_000):
        own = config.model_copy(update={"max_memory_bytes": asked})
        train.run(own, inputs(scene, own, **more), tmp_path, tiny_scene.Recorder())
    assert [each.max_memory_bytes for each in seen] == [near.limit_bytes, 900_000_000]


def test_two_processes_may_train_two_blocks_but_not_the_same_one(
    scene: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.engine.runs.lock.PATIENCE_S", 0.2)
    with locked_shard(undisturbed, "train.2"):
        with pytest.raises(UsageError, match=r"is running train\.2 in"):
            block_line.make(scene, undisturbed, OPTIONS, "train.2")
        with pytest.raises(UsageError, match=r"is running train\.2 in|is working in"):
            block_line.make(scene, undisturbed, OPTIONS)
        assert block_line.make(scene, undisturbed, OPTIONS, "train.1").ran == []  # it is there


def test_the_history_of_blocks_is_one_curve_after_the_coarse_pass() -> None:
    def history(*curve: tuple[int, float, int]) -> dict[str, object]:
        points = [
            {"iteration": step, "loss": loss, "gaussians": count, "sh_degree": 0, "width": 9}
            for step, loss, count in curve
        ]
        return {"curve": points, "resets": [], "skipped_gradients": 1}

    joint = joint_history(history((50, 0.5, 10)), [history((50, 0.4, 5), (100, 0.2, 9)), history((60, 0.3, 7))])
    assert [(point["iteration"], point["gaussians"]) for point in joint["curve"]] == [(50, 10), (160, 12), (210, 16)]
    assert joint["curve"][-1]["loss"] == pytest.approx((100 * 0.2 + 60 * 0.3) / 160)
    assert joint["skipped_gradients"] == 3 and len(joint["blocks"]) == 2


def test_the_reported_size_is_the_blocks_not_the_coarse_passs(tmp_path: Path) -> None:
    summaries = {"blocks": {"coarse": {"train_megapixels": 0.49}}, "train.1": {"train_megapixels": 1.9466}}
    summaries |= {"train.2": {"train_megapixels": 0.0}}  # one that had nothing to train
    given = replace(Inputs({}, tmp_path), summaries=summaries, shards=(tmp_path,) * 2)
    assert assembly._summary(given, {"curve": []}, 100)["train_megapixels"] == 1.9466


def test_the_reason_for_fewer_iterations_of_blocks_is_reported(tmp_path: Path) -> None:
    parts = [{"iterations": 90, "planned_iterations": 100, "flat_at": 80}, {"iterations": 70, "planned_iterations": 70}]
    parts.append({"iterations": 60, "planned_iterations": 80, "sizes_ended": [30], "flat_at": 50})
    summaries = {"blocks": {"coarse": {"iterations": 20, "planned_iterations": 30, "sizes_ended": [10]}}}
    summaries |= {f"train.{number}": part for number, part in enumerate(parts, 1)}
    given = replace(Inputs({}, tmp_path), summaries=summaries, shards=(tmp_path,) * 3)
    summary = assembly._summary(given, {"curve": []}, 100) | {"blocks": 3}
    assert (summary["iterations"], summary["planned_iterations"]) == (240, 280)
    assert summary["flat"] == {
        "coarse": {"sizes_ended": [10]},
        "1": {"flat_at": 80},
        "3": {"flat_at": 50, "sizes_ended": [30]},
    }
    assert training._why_earlier(summary) == ": the loss was flat in the coarse pass and in 2 of 3 blocks"
    assert "flat" not in assembly._summary(replace(given, summaries={}), {"curve": []}, 100)
