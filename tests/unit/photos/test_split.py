"""The stage that selects held-out photos: its artifact, what it rejects, and which stages depend on it."""

from pathlib import Path

import pytest
import tiny_scene

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.options import SplitConfig
from splatpipe.pipeline.photos.pixels.dataset import load_split
from splatpipe.stages import split
from splatpipe.stages.line import LINE

NAMES = tuple(f"flight 1/photo_{number}.png" for number in range(tiny_scene.CAMERAS))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    folder = tmp_path_factory.mktemp("split")
    return Inputs({"undistort.dataset": tiny_scene.write_dataset(folder / "dataset")}, folder)


@pytest.mark.parametrize(
    ("config", "held_out"),
    [
        (SplitConfig(), (0, 8)),
        (SplitConfig(every=4), (0, 4, 8)),
        (SplitConfig(every=0), ()),
        (SplitConfig(every=4, views="photo_3, photo_1"), (1, 3)),
    ],
)
def test_its_part_names_both_kinds_in_order(
    inputs: Inputs, tmp_path: Path, config: SplitConfig, held_out: tuple[int, ...]
) -> None:
    summary = split.run(config, inputs, tmp_path, tiny_scene.Recorder())
    found = load_split(tmp_path / "split.json")
    assert found.held_out == tuple(NAMES[number] for number in held_out)
    assert found.train == tuple(name for name in NAMES if name not in found.held_out)
    assert summary == {"trained_on": len(NAMES) - len(held_out), "held_out": len(held_out)}


@pytest.mark.parametrize("config", [SplitConfig(every=1), SplitConfig(views="photo_99")])
def test_a_split_that_leaves_nothing_or_names_unknown_photos_is_refused(
    inputs: Inputs, tmp_path: Path, config: SplitConfig
) -> None:
    with pytest.raises(SplatpipeError) as raised:
        split.run(config, inputs, tmp_path, tiny_scene.Recorder())
    assert raised.value.hint and not (tmp_path / "split.json").exists()


def test_no_stage_borrows_the_splits_options() -> None:
    """All stages that need it read its part, and run after it."""
    order = [stage.name for stage in LINE]
    readers = [stage.name for stage in LINE if "split.views" in stage.reads]
    assert readers == ["initialize", "blocks", "train", "clean", "evaluate", "splat_depths"]
    assert order.index("split") < order.index("initialize")
    assert not [name for stage in LINE for name in stage.borrows if name.startswith(("split.", "evaluate."))]
