"""Where the live page's images are rendered: as configured, and never at the expense of training on the GPU."""

import json
from pathlib import Path

import pytest
import tiny_scene
import torch

from splatpipe.pipeline.app.view import checkpoint_render
from splatpipe.pipeline.app.view.checkpoint_render import (
    LEFT_SHARE,
    RENDER_BYTES,
    LoadedModel,
    ModelSource,
    device_of,
    newest,
    pictures,
)
from splatpipe.pipeline.app.view.live import Live
from splatpipe.pipeline.engine.runs.run_folder import Contents, RunFolder
from splatpipe.pipeline.engine.runs.store import Artifact
from splatpipe.pipeline.photos.pixels.dataset import View, load_views
from splatpipe.pipeline.raster.device import Device, cpu
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.render.rendering import Model, placed
from splatpipe.stages.line import LINE

CARD = Device("cuda", torch.device("cpu"))  # stands in for a card: the CPU renders on it
WHOLE = 8 << 30


@pytest.fixture
def view(tmp_path: Path) -> View:
    tiny_scene.write_dataset(tmp_path / "dataset")
    return load_views(tmp_path / "dataset")[0]


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A machine with a card, all of it free; the devices that models are placed on."""
    places: list[str] = []

    def watched(model: Model, device: Device) -> Model:
        places.append(device.name)
        return placed(model, device)

    monkeypatch.setattr(checkpoint_render, "choose_device", lambda wanted: CARD)
    monkeypatch.setattr(checkpoint_render, "placed", watched)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (WHOLE, WHOLE))
    return places


def loaded_model() -> LoadedModel:
    return LoadedModel(tiny_scene.true_model(), None, RenderOptions(3, depth=False), None, 0)


def test_images_are_rendered_on_the_runs_device_if_it_has_free_memory(
    view: View, card: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = pictures(loaded_model(), view, 1, "cpu")
    assert card == ["cpu"]
    least = int(LEFT_SHARE * WHOLE) + RENDER_BYTES * tiny_scene.GAUSSIANS
    for asked, free, place in (("auto", least, "cuda"), ("cuda", WHOLE, "cuda"), ("auto", least - 1, "cpu")):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device, free=free: (free, WHOLE))
        card.clear()
        assert pictures(loaded_model(), view, 1, asked) == expected
        assert card == [place]
    monkeypatch.setattr(checkpoint_render, "choose_device", lambda wanted: cpu())
    assert pictures(loaded_model(), view, 1, "auto") == expected
    assert card == ["cpu", "cpu"]


def test_if_the_card_turns_out_full_the_cpu_renders(
    view: View, card: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = pictures(loaded_model(), view, 1, "cpu")
    watched = checkpoint_render.placed

    def full(model: Model, device: Device) -> Model:
        there = watched(model, device)
        if device.name == "cuda":
            raise torch.OutOfMemoryError("out of memory")
        return there

    monkeypatch.setattr(checkpoint_render, "placed", full)
    assert pictures(loaded_model(), view, 1, "auto") == expected
    assert card == ["cpu", "cuda", "cpu"]


def test_if_the_card_fails_the_cpu_renders(view: View, card: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    expected = pictures(loaded_model(), view, 1, "cpu")
    watched, said = checkpoint_render.placed, ["CUDA error: unspecified launch failure\nCUDA kernel errors might be"]

    def fails(*given: object) -> None:
        raise RuntimeError(said[0])

    def failing(model: Model, device: Device) -> Model:
        there = watched(model, device)
        return there if device.name == "cpu" else fails()

    monkeypatch.setattr(checkpoint_render, "placed", failing)
    monkeypatch.setattr(torch.cuda, "empty_cache", fails)
    assert pictures(loaded_model(), view, 1, "auto") == expected
    assert card == ["cpu", "cuda", "cpu"]
    said[0] = "The size of tensor a (3) must match"  # a mistake of ours is not hidden
    with pytest.raises(RuntimeError, match="size of tensor"):
        pictures(loaded_model(), view, 1, "auto")


def test_the_device_is_that_of_the_training_then_that_of_the_run() -> None:
    assert device_of(Contents(), "cpu") == "cpu"
    done = Artifact(Path("train"), {"machine": {"device": "cpu", "threads": 1}})
    assert device_of(Contents({"train": done}), "auto") == "cpu"
    assert device_of(Contents({"train": Artifact(Path("train"), {})}), "cuda") == "cuda"


def test_the_page_renders_on_the_device_of_the_current_run(
    view: View, card: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = ModelSource(tmp_path, "checkpoint", "stamp", None)
    monkeypatch.setattr(checkpoint_render, "newest", lambda opened: source)
    monkeypatch.setattr(checkpoint_render, "load", lambda source, opened: loaded_model())
    monkeypatch.setattr(Live, "_refresh", lambda live: (live._log.read(), (Contents(), (view,)))[1])
    for asked, machine in (("cpu", {"device": "cpu"}), ("cuda", {"device": "auto"}), ("cuda", 3)):
        event = {"kind": "run_started", "stage": "", "data": {"stages": ["train"], "machine": machine}, "time_s": 1.0}
        (tmp_path / "events.jsonl").write_text(json.dumps(event) + "\n")
        live = Live(RunFolder(tmp_path, LINE))
        card.clear()
        try:
            assert live.picture(0, "render")
        finally:
            live.close()
        assert card == [asked]


def written(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def left(stage: str, name: str, path: Path, digest: str) -> dict[str, Artifact]:
    manifest = {"stage": stage, "parts": {name: {"path": path.name, "digest": digest}}}
    return {stage: Artifact(path.parent, manifest)}


def test_for_a_scene_in_blocks_the_coarse_model_and_then_a_blocks_is_shown(tmp_path: Path) -> None:
    begun = left("initialize", "splat", written(tmp_path / "init.ply"), "1" * 64)
    blocks = tmp_path / "blocks"
    checkpoint, model = (written(blocks / "coarse" / name) for name in ("checkpoint.npz", "model.ply"))
    opened = Contents(begun, {"blocks": blocks})
    found = newest(opened)
    assert found is not None and (found.kind, found.path, found.block) == ("checkpoint", checkpoint, 0)
    checkpoint.unlink()
    assert (found := newest(opened)) is not None and found.kind == "initial"  # nothing says that the model is complete
    written(blocks / "coarse.json")  # dividing the site, which comes next, takes a while
    assert (found := newest(opened)) is not None
    assert (found.kind, found.path, found.rendering) == ("coarse", model, blocks / "coarse" / "rendering.json")
    coarse = left("blocks", "coarse", blocks / "coarse", "2" * 64)
    block = written(tmp_path / "train.12" / "checkpoint.npz")
    assert (found := newest(Contents(begun | coarse, {"train.12": block.parent}))) is not None
    assert (found.kind, found.path, found.block) == ("checkpoint", block, 12)
    assert (found := newest(Contents(begun | coarse))) is not None
    assert (found.kind, found.stamp) == ("coarse", "2" * 16)
