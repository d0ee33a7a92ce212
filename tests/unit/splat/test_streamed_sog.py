"""Streamed SOG: each leaf's runs in the files match the levels, in PlayCanvas' frame and numbering."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.splat.formats import sog
from splatpipe.pipeline.splat.levels.levels import LevelNode, build_levels
from splatpipe.pipeline.splat.levels.streamed_sog import LOD_META, write_streamed_sog
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin, facts_of_record

FACTS = SceneFacts("z up", metres=True, place=SplatOrigin(47.8, 13.5, 515.0, crs="EPSG:32633"))


@pytest.fixture(scope="module")
def wall() -> Scene:
    """Two walls of different size, so that their branches differ in height."""
    generator = torch.Generator().manual_seed(6)
    made = Gaussians.empty(900, 1)
    made.means = 10.0 * torch.rand(900, 3, generator=generator) * torch.tensor([1.0, 0.1, 1.0])
    made.means[800:] += torch.tensor([300.0, 0.0, 0.0])
    made.log_scales = torch.log(torch.tensor([0.2, 0.02, 0.2])) + 0.2 * torch.randn(900, 3, generator=generator)
    made.quats[:] = torch.nn.functional.normalize(torch.randn(900, 4, generator=generator), dim=1)
    made.sh = 0.3 * torch.randn(made.sh.shape, generator=generator)
    return Scene(made, FACTS)


@pytest.fixture(scope="module")
def root(wall: Scene) -> LevelNode:
    return build_levels(wall.gaussians, most_per_node=60)


@pytest.fixture(scope="module")
def written(wall: Scene, root: LevelNode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("streamed")
    write_streamed_sog(folder, wall, root)
    return folder


def leaves_of(tree: dict[str, Any]) -> list[dict[str, Any]]:
    return [leaf for child in tree["children"] for leaf in leaves_of(child)] if "children" in tree else [tree]


def read_meta(folder: Path) -> dict[str, Any]:
    meta: dict[str, Any] = json.loads((folder / LOD_META).read_text(encoding="ascii"))
    return meta


def test_every_level_covers_the_scene_and_the_finest_is_the_model(written: Path, wall: Scene, root: LevelNode) -> None:
    meta = read_meta(written)
    leaves = leaves_of(meta["tree"])
    assert len(leaves) == sum(not node.children for node in root.nodes())
    assert meta["version"] == 1 and meta["lodLevels"] >= 3
    assert meta["counts"][0] == len(wall.gaussians)
    assert meta["counts"][-1] == len(root.gaussians)
    assert meta["count"] == sum(meta["counts"]) == sum(len(node.gaussians) for node in root.nodes())
    for leaf in leaves:
        assert "0" in leaf["lods"] and all(lod["count"] > 0 for lod in leaf["lods"].values())


def test_runs_fill_their_files_one_after_another(written: Path) -> None:
    meta = read_meta(written)
    runs: dict[int, list[tuple[int, int]]] = {}
    for leaf in leaves_of(meta["tree"]):
        for level, lod in leaf["lods"].items():
            assert meta["filenames"][lod["file"]].startswith(f"{level}_")
            runs.setdefault(lod["file"], []).append((lod["offset"], lod["count"]))
    assert sorted(runs) == list(range(len(meta["filenames"])))
    for file, parts in runs.items():
        end = 0
        for offset, count in sorted(parts):
            assert offset == end
            end += count
        assert len(sog.read(written / meta["filenames"][file]).gaussians) == end


def test_contents_of_a_leaf_are_the_models_in_its_box(written: Path, wall: Scene) -> None:
    meta = read_meta(written)
    files = [sog.read(written / name).gaussians.means.numpy() for name in meta["filenames"]]
    found = []
    for leaf in leaves_of(meta["tree"]):
        low, high = np.array(leaf["bound"]["min"]) - 1e-2, np.array(leaf["bound"]["max"]) + 1e-2
        for level, lod in leaf["lods"].items():
            means = files[lod["file"]][lod["offset"] : lod["offset"] + lod["count"]]
            assert (means >= low).all() and (means <= high).all()
            if level == "0":
                found.append(means)
    turned = wall.turned("y down").gaussians.means.numpy().astype(np.float64)
    held = np.concatenate(found).astype(np.float64)
    nearest = np.linalg.norm(turned[:, None] - held[None], axis=2)
    assert nearest.min(0).max() < 0.02 and nearest.min(1).max() < 0.02  # a SOG's quantum at 300 m


def test_the_record_has_the_georeference(written: Path) -> None:
    assert facts_of_record(json.dumps(read_meta(written)["splatpipe"]), SceneFacts()) == FACTS


def test_the_same_levels_give_the_same_bytes(written: Path, wall: Scene, root: LevelNode, tmp_path: Path) -> None:
    write_streamed_sog(tmp_path, wall, root)
    names = sorted(str(path.relative_to(written)) for path in written.rglob("*") if path.is_file())
    assert names == sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert all((written / name).read_bytes() == (tmp_path / name).read_bytes() for name in names)


def test_levels_of_an_earlier_export_are_removed_and_other_files_kept(
    wall: Scene, root: LevelNode, tmp_path: Path
) -> None:
    write_streamed_sog(tmp_path, wall, root)
    (tmp_path / "3_1").mkdir()
    (tmp_path / "3_1/own.txt").write_text("mine")
    before = {path.name for path in tmp_path.iterdir()}
    few = Scene(wall.gaussians.first(20), FACTS)
    write_streamed_sog(tmp_path, few, build_levels(few.gaussians))
    assert len(before) > 3
    assert {path.name for path in tmp_path.iterdir()} == {"3_1", "0_0", LOD_META}


def test_a_model_of_one_node_has_one_level(wall: Scene, tmp_path: Path) -> None:
    few = Scene(wall.gaussians.first(20), FACTS)
    write_streamed_sog(tmp_path, few, build_levels(few.gaussians))
    meta = read_meta(tmp_path)
    assert (meta["lodLevels"], meta["counts"], meta["filenames"]) == (1, [20], ["0_0/meta.json"])
    assert meta["tree"]["lods"] == {"0": {"file": 0, "offset": 0, "count": 20}}


def test_a_level_that_is_a_link_is_not_written_through(wall: Scene, root: LevelNode, tmp_path: Path) -> None:
    (tmp_path / "secret").mkdir()
    (tmp_path / "web").mkdir()
    (tmp_path / "web/0_0").symlink_to(tmp_path / "secret")
    with pytest.raises(UsageError, match="0_0 is a link"):
        write_streamed_sog(tmp_path / "web", wall, root)
    assert list((tmp_path / "secret").iterdir()) == []
