"""Splat files of any format: recognised by content, written by name, including folders."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from some_splats import some_gaussians

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, UsageError
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.formats import model_folder, plain_ply
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS, format_named
from splatpipe.pipeline.splat.formats.files import (
    format_of_content,
    format_of_name,
    in_unit_quats,
    read_scene,
    write_scene,
)
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin

FACTS = SceneFacts("z up", False, True, SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634"))


READ = [kind for kind in SPLAT_FORMATS if any(each.reads and each.module == kind.module for each in SPLAT_FORMATS)]


@pytest.mark.parametrize("kind", READ, ids=lambda kind: kind.name)
def test_every_format_is_written_by_name_read_by_content_and_keeps_its_georeference(tmp_path: Path, kind):
    scene = in_unit_quats(Scene(some_gaussians(300), FACTS))
    path = tmp_path / kind.file
    assert format_of_name(path) == kind
    write_scene(path, scene)
    read = read_scene(path)
    assert read.facts.place == FACTS.place
    assert read.facts.metres
    assert len(read.gaussians) == 300
    span = float(scene.gaussians.means.amax() - scene.gaussians.means.amin())
    means = read.turned("z up").gaussians.means
    apart = torch.cdist(scene.gaussians.means.double(), means.double()).amin(dim=1)
    assert float(apart.max()) < 1e-3 * span


def test_a_ply_and_a_model_folder_keep_every_bit(tmp_path: Path):
    scene = Scene(some_gaussians(70), FACTS)
    for name in ("splat.ply", "model"):
        write_scene(tmp_path / name, scene)
        read = read_scene(tmp_path / name)
        for key, tensor in scene.gaussians.tensors().items():
            assert torch.equal(getattr(read.gaussians, key), tensor)


def test_the_copy_for_viewers_is_y_down(tmp_path: Path):
    scene = Scene(some_gaussians(5), FACTS)
    write_scene(tmp_path / "splat.viewer.ply", scene)
    read = read_scene(tmp_path / "splat.viewer.ply")
    assert read.facts.axes == "y down"
    torch.testing.assert_close(read.gaussians.means[:, 1], -scene.gaussians.means[:, 2])


def test_a_splat_without_georeference_becomes_a_ply_in_viewers_axes(tmp_path: Path):
    write_scene(tmp_path / "a.ply", Scene(some_gaussians(5), SceneFacts("y up")))
    assert read_scene(tmp_path / "a.ply").facts.axes == "y down"


def test_the_newest_iteration_of_a_model_folder_is_read(tmp_path: Path):
    for number, count in ((7000, 3), (30000, 4), (200, 5)):
        folder = tmp_path / f"point_cloud/iteration_{number}"
        folder.mkdir(parents=True)
        write_splat(folder / "point_cloud.ply", some_gaussians(count))
    (tmp_path / "point_cloud/iteration_99999").mkdir()
    assert len(model_folder.read(tmp_path).gaussians) == 4


@pytest.mark.parametrize("name", ["nothing.ply", "folder", "text.ply", "empty.sog", "other.bin"])
def test_a_file_that_is_no_splat_is_reported(tmp_path: Path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.ply").write_text("ply of sorts")
    (tmp_path / "empty.sog").write_bytes(b"")
    (tmp_path / "other.bin").write_bytes(b"\x00" * 99)
    with pytest.raises(SplatpipeError):
        read_scene(tmp_path / name)


def test_unknown_suffixes_and_names_are_refused(tmp_path: Path):
    with pytest.raises(UsageError, match="extension"):
        format_of_name(Path("a.xyz"))
    with pytest.raises(UsageError, match="no format"):
        format_named("obj")
    assert format_of_name(Path("a.ply")).name == "ply"
    assert format_of_name(Path("A.VIEWER.PLY")).name == "viewer-ply"
    assert format_of_name(Path("folder")).name == "model"
    assert format_of_name(Path("a.xyz"), "ply").name == "ply"
    assert format_of_content(_written(tmp_path)).name == "ply"


def test_an_unwritable_path_is_reported(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(MachineError, match="Cannot write"):
        write_scene(tmp_path / "file" / "a.ply", Scene(some_gaussians(2)))


def test_a_file_is_complete_or_unchanged(tmp_path: Path):
    path = _written(tmp_path)
    before = path.read_bytes()
    broken = Scene(some_gaussians(4))
    broken.gaussians.means[2] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        write_scene(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_nonempty_folder_is_left_alone(tmp_path: Path):
    write_scene(tmp_path / "model", Scene(some_gaussians(4)))
    with pytest.raises(UsageError, match="is an existing folder"):
        write_scene(tmp_path / "model", Scene(some_gaussians(5)))
    with pytest.raises(UsageError, match="is an existing folder"):
        write_scene(tmp_path / "model", Scene(some_gaussians(5)), format_named("ply"))
    assert len(read_scene(tmp_path / "model").gaussians) == 4


def test_quaternions_are_normalized_and_zero_becomes_the_identity():
    made = some_gaussians(3)
    made.quats[1] = 0.0
    unit = in_unit_quats(Scene(made)).gaussians.quats
    torch.testing.assert_close(unit.norm(dim=1), torch.ones(3))
    assert unit[1].tolist() == [1.0, 0.0, 0.0, 0.0]
    torch.testing.assert_close(unit[0] * made.quats[0].norm(), made.quats[0])


def _written(folder: Path) -> Path:
    plain_ply.write(folder / "a.ply", Scene(some_gaussians(2), replace(FACTS, place=None)))
    return folder / "a.ply"
