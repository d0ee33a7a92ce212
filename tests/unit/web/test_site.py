"""The viewer as a folder for web hosts, in a real browser: complete but coarse at first, in full detail in the end."""

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch
from web_sites import COUNT, MAX_PER_NODE, UP_FROM_DOWN, nodes_of

from splatpipe.pipeline.splat.levels.levels import LevelNode, build_levels
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts
from splatpipe.pipeline.survey.crs.frames import Frame, Similarity
from splatpipe.pipeline.web.site import write_site
from splatpipe.pipeline.web.viewer import ViewerScene
from splatpipe.pipeline.web.viewer_scene import ViewerRendering, viewer_scene, write_viewer


@pytest.fixture(scope="module")
def model() -> Gaussians:
    """Return the model in the world frame."""
    many = tiny_scene.true_model(COUNT)
    many.log_scales -= 0.9
    return many.transformed(1.0, torch.from_numpy(UP_FROM_DOWN), torch.zeros(3, dtype=torch.float64))


@pytest.fixture(scope="module")
def root(model: Gaussians) -> LevelNode:
    return build_levels(model, MAX_PER_NODE)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ViewerScene:
    dataset = tiny_scene.write_dataset(tmp_path_factory.mktemp("tiny") / "dataset")
    frame = Frame("arbitrary", Similarity(1.0, UP_FROM_DOWN, np.zeros(3)))
    rendering = ViewerRendering(antialias=False, background=(0.0, 0.0, 0.0), near=0.01)
    return viewer_scene(dataset, frame, rendering, (), COUNT, "Tiny </title> site")


@pytest.fixture(scope="module")
def site(scene: ViewerScene, model: Gaussians, root: LevelNode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, and the page next to it."""
    folder = tmp_path_factory.mktemp("site")
    write_site(folder / "web", scene, Scene(model, SceneFacts("z up")), root)
    write_viewer(folder, scene, model, largest_bytes=1e9)
    return folder


def test_the_same_site_has_the_same_bytes(
    site: Path, scene: ViewerScene, model: Gaussians, root: LevelNode, tmp_path: Path
) -> None:
    write_site(tmp_path / "again", scene, Scene(model, SceneFacts("z up")), root)
    for file in (tmp_path / "again").rglob("*"):
        if file.is_file():
            assert file.read_bytes() == (site / "web" / file.relative_to(tmp_path / "again")).read_bytes()


def test_a_nodes_positions_keep_millimetres_in_a_site_of_three_kilometres(
    scene: ViewerScene, model: Gaussians, tmp_path: Path
) -> None:
    wide = model.clone()
    wide.means = torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([3000.0, 3000.0, 50.0])
    root = build_levels(wide, MAX_PER_NODE)
    write_site(tmp_path / "web", scene, Scene(wide, SceneFacts("z up")), root)
    found = []
    for node in nodes_of(tmp_path):
        if not node["children"]:
            data = gzip.decompress((tmp_path / "web" / node["file"]).read_bytes())
            count, _, bits = struct.unpack_from("<IBB", data, 8)
            steps = np.frombuffer(data, np.uint8, 9 * count, 16).reshape(-1, 3).astype(np.int32)
            places = ((steps[:, 0] | steps[:, 1] << 8 | steps[:, 2] << 16) << 8 >> 8).reshape(-1, 3) / 2.0**bits
            found.append(np.stack([places[:, 0], -places[:, 2], places[:, 1]], axis=1) + node["origin"])
    places, truth = np.concatenate(found), wide.means.numpy().astype(float)
    order = [np.lexsort(np.round(each, 1).T) for each in (places, truth)]
    assert np.abs(places[order[0]] - truth[order[1]]).max() < 0.001


def test_a_splat_that_is_not_z_up_is_refused(
    scene: ViewerScene, model: Gaussians, root: LevelNode, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="z up"):
        write_site(tmp_path / "web", scene, Scene(model, SceneFacts("y down")), root)
