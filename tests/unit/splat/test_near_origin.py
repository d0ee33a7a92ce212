"""Far coordinates: an origin is taken off in float64, recorded, carried through every format, and added again."""

from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from some_splats import some_gaussians

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.ply import property_names
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS
from splatpipe.pipeline.splat.formats.files import read_scene, write_scene
from splatpipe.pipeline.splat.formats.near_origin import scene_near_origin
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin, facts_of_record

UTM = (388714.5, 5299720.25, 515.0)
PLACE = SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634")


def far_splat(
    count: int = 400, far: tuple[float, float, float] = UTM, spread: float = 3.0
) -> tuple[Gaussians, np.ndarray]:
    """Gaussians near zero, and their true positions, far away."""
    gaussians = some_gaussians(count, degree=1, spread=spread)
    return gaussians, gaussians.means.double().numpy() + far


def write_ply(
    path: Path, gaussians: Gaussians, means: np.ndarray, kind: str = "<f8", comments: tuple[str, ...] = ()
) -> None:
    """Write a PLY as other programs do, all properties of one kind."""
    degree = gaussians.sh_degree
    rows = np.zeros(len(gaussians), [(name, kind) for name in property_names(degree)])
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    for prefix, columns in (
        ("f_dc", gaussians.sh[:, 0]),
        ("f_rest", rest),
        ("scale", gaussians.log_scales),
        ("rot", gaussians.quats),
    ):
        for i, column in enumerate(columns.T):
            rows[f"{prefix}_{i}"] = column
    rows["opacity"] = gaussians.opacity_logits
    for name, column in zip("xyz", means.T, strict=True):
        rows[name] = column
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], byte_order=kind[0], comments=list(comments)).write(path)


def positions(path: Path) -> np.ndarray:
    """The positions as plyfile reads them."""
    vertex = plyfile.PlyData.read(path, mmap=False)["vertex"]
    return np.stack([np.asarray(vertex[name], np.float64) for name in "xyz"], axis=1)


def furthest(found: np.ndarray, truth: np.ndarray) -> float:
    """The largest distance of any to the nearest true one."""
    return float(torch.cdist(torch.from_numpy(found - UTM), torch.from_numpy(truth - UTM)).amin(1).max())


@pytest.mark.parametrize("kind", ["<f8", ">f8"])
def test_an_origin_is_taken_off_before_positions_become_float32(tmp_path: Path, kind: str):
    gaussians, truth = far_splat()
    write_ply(tmp_path / "utm.ply", gaussians, truth, kind)
    scene = read_scene(tmp_path / "utm.ply")
    assert scene.facts.axes == "z up"  # such coordinates are a survey's
    assert scene.gaussians.means.dtype == torch.float32
    assert float(scene.gaussians.means.abs().max()) < 20.0
    assert all(number == round(number) for number in scene.facts.offset)  # short in messages
    np.testing.assert_allclose(scene.gaussians.means.double() + torch.tensor(scene.facts.offset), truth, atol=1e-6)
    assert scene.notes == ()


@pytest.mark.parametrize(
    "kind", [each for each in SPLAT_FORMATS if each.name != "compressed-ply"], ids=lambda k: k.name
)
def test_every_format_carries_the_origin_and_a_ply_has_it_added_again(tmp_path: Path, kind):
    gaussians, truth = far_splat()
    write_ply(tmp_path / "utm.ply", gaussians, truth)
    cost = write_scene(tmp_path / kind.file, read_scene(tmp_path / "utm.ply"), kind)
    between = read_scene(tmp_path / kind.file)
    assert any(between.facts.offset)
    write_scene(tmp_path / "back.ply", between)
    assert furthest(positions(tmp_path / "back.ply"), truth) <= max(cost.step, 1e-6)
    again = read_scene(tmp_path / "back.ply")
    assert again.facts.offset == between.facts.turned("z up").offset


def test_a_compressed_ply_is_read_between_its_float32_ranges(tmp_path: Path):
    """Chunks of far ranges hold finer positions than float32."""
    gaussians, truth = far_splat(256)
    scene = Scene(gaussians, SceneFacts("z up", offset=UTM))
    write_scene(tmp_path / "a.compressed.ply", scene)
    read = read_scene(tmp_path / "a.compressed.ply").turned("z up")
    assert read.facts.offset == UTM
    assert furthest(read.gaussians.means.double().numpy() + UTM, truth) < 0.05


@pytest.mark.parametrize("name", ["splat.viewer.ply", "model"])
def test_copies_for_viewers_stay_float32_about_the_origin(tmp_path: Path, name: str):
    gaussians, truth = far_splat()
    write_ply(tmp_path / "utm.ply", gaussians, truth)
    write_scene(tmp_path / name, read_scene(tmp_path / "utm.ply"))
    ply = tmp_path / name / "point_cloud/iteration_30000/point_cloud.ply" if name == "model" else tmp_path / name
    assert b"property double" not in ply.read_bytes()
    assert b"comment offset: " in ply.read_bytes()
    assert float(np.abs(positions(ply)).max()) < 20.0


def test_what_lies_near_zero_keeps_its_bits(tmp_path: Path):
    gaussians, _ = far_splat()
    write_ply(tmp_path / "local.ply", gaussians, gaussians.means.numpy())
    scene = read_scene(tmp_path / "local.ply")
    assert scene.facts == SceneFacts("y down") and scene.notes == ()
    assert torch.equal(scene.gaussians.means, gaussians.means)


def test_positions_rounded_by_another_program_are_told(tmp_path: Path):
    gaussians, truth = far_splat()
    write_ply(tmp_path / "utm32.ply", gaussians, truth, "<f4")
    scene = read_scene(tmp_path / "utm32.ply")
    assert "rounded to 0.5 before" in " ".join(scene.notes)
    write_scene(tmp_path / "again.ply", scene)
    np.testing.assert_array_equal(positions(tmp_path / "again.ply"), positions(tmp_path / "utm32.ply"))


def test_two_sites_that_no_origin_serves_are_refused(tmp_path: Path):
    gaussians, truth = far_splat()
    truth[:200] -= UTM
    write_ply(tmp_path / "two.ply", gaussians, truth)
    with pytest.raises(SplatpipeError, match="would displace"):
        read_scene(tmp_path / "two.ply")


def test_degrees_are_told_and_not_written_where_they_would_collapse(tmp_path: Path):
    gaussians, truth = far_splat(far=(11.5755, 48.1374, 515.0))
    truth[:, :2] = np.array([11.5755, 48.1374]) + 1e-5 * gaussians.means[:, :2].numpy()
    write_ply(tmp_path / "degrees.ply", gaussians, truth)
    scene = read_scene(tmp_path / "degrees.ply")
    assert "degrees and metres" in " ".join(scene.notes)
    with pytest.raises(SplatpipeError, match="would destroy"):
        write_scene(tmp_path / "degrees.spz", scene)
    assert not (tmp_path / "degrees.spz").exists()
    write_scene(tmp_path / "back.ply", scene)
    np.testing.assert_allclose(positions(tmp_path / "back.ply")[:, :2], truth[:, :2], atol=1e-11)


def test_an_offset_that_another_program_states_is_named(tmp_path: Path):
    gaussians, _ = far_splat()
    comments = ("Global shift: -388714.5 -5299720.25 -515", "Generated by 3D tool 2.1")
    write_ply(tmp_path / "a.ply", gaussians, gaussians.means.numpy(), "<f4", comments)
    (note,) = read_scene(tmp_path / "a.ply").notes
    assert "Global shift: -388714.5" in note
    write_scene(tmp_path / "b.ply", Scene(gaussians, SceneFacts("z up", metres=True, place=PLACE)))
    assert read_scene(tmp_path / "b.ply").notes == ()  # our own comments


def test_far_from_a_recorded_place_is_refused_if_it_was_finer(tmp_path: Path):
    gaussians, truth = far_splat()
    comments = tuple(plain_ply.header_comments(SceneFacts("z up", metres=True, place=PLACE)))
    write_ply(tmp_path / "a.ply", gaussians, truth, comments=comments)
    with pytest.raises(SplatpipeError, match="its own record"):
        read_scene(tmp_path / "a.ply")


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(tmp_path: Path, count: int):
    gaussians, truth = far_splat(count)
    gaussians.means = torch.from_numpy(truth)
    scene = scene_near_origin(tmp_path, gaussians, SceneFacts("y up"))
    assert scene.facts.axes == "y up" and scene.notes == ()
    assert any(scene.facts.offset) == (count > 0)


def test_the_record_of_an_offset_is_turned_and_validated():
    facts = SceneFacts("z up", offset=(1.0, 2.0, 3.0))
    assert facts.turned("y down").offset == (1.0, -3.0, 2.0)
    assert facts.turned("y up").turned("z up") == facts
    assert facts_of_record(facts.record(), SceneFacts()) == facts
    assert "offset" not in SceneFacts().record()
    for false in ("[1,2]", "[1,2,1e400]", '"abc"', "[1,2,1e13]"):
        assert facts_of_record(facts.record().replace("[1.0,2.0,3.0]", false), SceneFacts("y up")) == SceneFacts("y up")
    placed = SceneFacts("z up", place=PLACE).record()[:-1] + ',"offset":[1,2,3]}'
    assert facts_of_record(placed, SceneFacts("y up")) == SceneFacts("y up")
