"""Compressed PLY: the file, decoded value by value, contains what was written; and files of all kinds."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from some_splats import some_gaussians

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.raster.rasterizer import render
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.formats import compressed_ply
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin

FACTS = SceneFacts("y down", True, True, SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634"))
SH_C0 = 0.28209479177387814


def bits(word: int, shift: int, count: int) -> float:
    return (word >> shift & (1 << count) - 1) / ((1 << count) - 1)


def by_the_letter(path: Path) -> dict[str, np.ndarray]:
    """Decode like PlayCanvas' reader: vertex by vertex, each with the ranges of its chunk."""
    elements = {element.name: element.data for element in plyfile.PlyData.read(path, mmap=False)}
    found: dict[str, list[list[float]]] = {name: [] for name in ("means", "log_scales", "colours", "alphas", "quats")}
    for i, vertex in enumerate(elements["vertex"]):
        chunk = elements["chunk"][i // 256]

        def between(shifts: list[tuple[int, int]], word: int, names: list[str], chunk=chunk) -> list[float]:
            parts = [bits(int(word), *shift) for shift in shifts]
            least, most = ([float(chunk[f"{end}_{name}"]) for name in names] for end in ("min", "max"))
            return [a * (1.0 - t) + b * t for a, b, t in zip(least, most, parts, strict=True)]

        vector = [(21, 11), (11, 10), (0, 11)]
        found["means"].append(between(vector, vertex["packed_position"], ["x", "y", "z"]))
        found["log_scales"].append(between(vector, vertex["packed_scale"], ["scale_x", "scale_y", "scale_z"]))
        found["colours"].append(between([(24, 8), (16, 8), (8, 8)], vertex["packed_color"], ["r", "g", "b"]))
        found["alphas"].append([bits(int(vertex["packed_color"]), 0, 8)])
        word = int(vertex["packed_rotation"])
        rest = [(bits(word, shift, 10) - 0.5) * math.sqrt(2.0) for shift in (20, 10, 0)]
        rest.insert(word >> 30, math.sqrt(max(0.0, 1.0 - sum(v * v for v in rest))))
        found["quats"].append(rest)
    arrays = {name: np.array(rows) for name, rows in found.items()}
    if "sh" in elements:
        rows = [
            [-4.0 if b == 0 else 4.0 if b == 255 else (b + 0.5) / 32.0 - 4.0 for b in row] for row in elements["sh"]
        ]
        arrays["sh"] = np.array(rows).reshape(len(rows), 3, -1).transpose(0, 2, 1)
    return arrays


def matched(scene: Scene, means: np.ndarray) -> Gaussians:
    """The scene's Gaussians in the order of those read, by their means."""
    apart = torch.cdist(torch.from_numpy(means).double(), scene.gaussians.means.double())
    order = apart.argmin(dim=1)
    assert len(set(order.tolist())) == len(scene.gaussians)
    return scene.gaussians.select(order)


def test_every_parameter_reads_back_within_half_a_step_of_its_code(tmp_path: Path) -> None:
    scene = Scene(some_gaussians(600), FACTS)
    compressed_ply.write(tmp_path / "a.ply", scene)
    found = by_the_letter(tmp_path / "a.ply")
    made = matched(scene, found["means"])
    for first in (0, 256, 512):
        some = slice(first, first + 256)
        for name, values in (("means", made.means), ("log_scales", made.log_scales)):
            step = (values[some].amax(dim=0) - values[some].amin(dim=0)).numpy() / [2047.0, 1023.0, 2047.0]
            assert (np.abs(found[name][some] - values[some].numpy()) <= 0.5 * step + 1e-5).all()
        colours = made.sh[some, 0].numpy() * SH_C0 + 0.5
        step = (colours.max(axis=0) - colours.min(axis=0)) / 255.0
        assert (np.abs(found["colours"][some] - colours) <= 0.5 * step + 1e-5).all()
    np.testing.assert_allclose(found["alphas"][:, 0], torch.sigmoid(made.opacity_logits), atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found["sh"], made.sh[:, 1:], atol=1.0 / 64 + 1e-6)
    quats = made.quats / torch.linalg.vector_norm(made.quats, dim=1, keepdim=True)
    cosine = np.abs((found["quats"] * quats.numpy()).sum(axis=1))
    assert np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0))).max() < 0.2  # each within half of √2 / 1023


def test_the_reader_agrees_with_a_literal_decoder(tmp_path: Path) -> None:
    for degree in (0, 1, 2, 3):
        compressed_ply.write(tmp_path / "a.ply", Scene(some_gaussians(300, degree), FACTS))
        found, read = by_the_letter(tmp_path / "a.ply"), compressed_ply.read(tmp_path / "a.ply")
        assert read.facts == FACTS
        made = read.gaussians
        assert made.sh_degree == degree
        np.testing.assert_allclose(made.means, found["means"], atol=1e-5)
        np.testing.assert_allclose(made.log_scales, found["log_scales"], atol=1e-6)
        np.testing.assert_allclose(made.sh[:, 0] * SH_C0 + 0.5, found["colours"], atol=1e-6)
        np.testing.assert_allclose(torch.sigmoid(made.opacity_logits), found["alphas"][:, 0], atol=1.1 * 0.25 / 255)
        np.testing.assert_allclose(made.quats, found["quats"], atol=1e-6)
        if degree:
            np.testing.assert_allclose(made.sh[:, 1:], found["sh"], atol=1e-6)


def test_it_is_written_y_down_whatever_the_up_axis_and_reproducibly(tmp_path: Path) -> None:
    scene = Scene(some_gaussians(1000), replace(FACTS, axes="z up"))
    compressed_ply.write(tmp_path / "a.ply", scene)
    read = compressed_ply.read(tmp_path / "a.ply")
    assert read.facts == FACTS
    made = matched(scene.turned("y down"), read.gaussians.means.numpy())
    torch.testing.assert_close(made.sh[:, 1:], read.gaussians.sh[:, 1:], atol=1.0 / 64 + 1e-6, rtol=0.0)
    compressed_ply.write(tmp_path / "b.ply", scene)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_it_looks_the_same(tmp_path: Path) -> None:
    made = some_gaussians(2000, spread=1.0)
    made.means[:, 1] += 6.0
    scene = Scene(made, SceneFacts("z up"))
    compressed_ply.write(tmp_path / "a.ply", scene)
    read = compressed_ply.read(tmp_path / "a.ply").turned("z up")
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    camera = Camera("view", 160, 120, 150.0, 150.0, 80.0, 60.0, cam_from_world)
    pictures = [render(each.gaussians, camera, RenderOptions(3, depth=False)).colour for each in (scene, read)]
    assert float(pictures[0].std()) > 0.1
    assert -10.0 * math.log10(float(((pictures[0] - pictures[1]) ** 2).mean())) > 42.0


def test_an_outlier_affects_only_its_own_chunk(tmp_path: Path) -> None:
    scene = Scene(some_gaussians(5000), FACTS)
    scene.gaussians.means[7] = torch.tensor([1e6, 0.0, 0.0])
    compressed_ply.write(tmp_path / "a.ply", scene)
    read = compressed_ply.read(tmp_path / "a.ply").gaussians.means
    nearest = torch.cdist(scene.gaussians.means.double(), read.double()).amin(dim=1)
    assert int((nearest > 0.1).sum()) < 256


def test_zero_and_identical_gaussians_are_written(tmp_path: Path) -> None:
    for made in (Gaussians.empty(0, 3), Gaussians.empty(1, 0), Gaussians.empty(257, 1)):
        compressed_ply.write(tmp_path / "a.ply", Scene(made, FACTS))
        read = compressed_ply.read(tmp_path / "a.ply").gaussians
        assert len(read) == len(made)
        assert torch.equal(read.means, made.means)
    made.means[3, 1] = float("nan")
    with pytest.raises(ValueError, match="finite"):
        compressed_ply.write(tmp_path / "b.ply", Scene(made, FACTS))
    assert not (tmp_path / "b.ply").exists()


def written_by_others(path: Path, colours: bool, byte_order: str = "<", swap: bool = False) -> None:
    """Write with plyfile: without colours like older writers, in the other byte order, with elements swapped."""
    ranges = [f"{end}_{name}" for name in ("x", "scale_x", "r") for end in ("min", "max")][: 6 if colours else 4]
    names = [r[:-1] + c for r in ranges for c in (("x", "y", "z") if r[-1] == "x" else ("r", "g", "b"))]
    chunk = np.zeros(1, [(name, "f4") for name in names])
    for name in names:
        chunk[name] = {"min": -1.0, "max": 3.0}[name[:3]] if name[4] != "s" else -2.0
    vertex = np.zeros(2, [(f"packed_{name}", "u4") for name in ("position", "rotation", "scale", "color")])
    vertex["packed_position"] = [0, 0xFFFFFFFF]
    vertex["packed_color"] = [0x000000FF, 0xFFFFFF80]
    vertex["packed_rotation"] = (512 << 20) | (512 << 10) | 512
    other = np.zeros(3, [("value", "f8")])
    elements = [(chunk, "chunk"), (vertex, "vertex"), (other, "other")]
    described = [plyfile.PlyElement.describe(*each) for each in (reversed(elements) if swap else elements)]
    plyfile.PlyData(described, byte_order=byte_order).write(path)


@pytest.mark.parametrize(("byte_order", "swap"), [("<", False), (">", False), ("<", True)])
def test_older_files_have_colours_from_0_to_1_and_foreign_ones_are_y_down_without_georeference(
    tmp_path, byte_order, swap
):
    for colours, expected in ((True, [[-1.0] * 3, [3.0] * 3]), (False, [[0.0] * 3, [1.0] * 3])):
        written_by_others(tmp_path / "a.ply", colours, byte_order, swap)
        read = compressed_ply.read(tmp_path / "a.ply")
        assert read.facts == SceneFacts("y down")
        torch.testing.assert_close(read.gaussians.means, torch.tensor([[-1.0] * 3, [3.0] * 3]))
        torch.testing.assert_close(read.gaussians.log_scales, torch.full((2, 3), -2.0))
        torch.testing.assert_close(read.gaussians.sh[:, 0] * SH_C0 + 0.5, torch.tensor(expected))


HEADER_LIES = [
    (b"element vertex 300", b"element vertex 999999999999"),
    (b"element vertex 300", b"element vertex 301"),
    (b"element vertex 300", b"element vertex 200"),
    (b"element chunk 2", b"element chunk 999999999"),
    (b"element chunk 2", b"element chunk 1"),
    (b"element sh 300", b"element sh 299"),
    (b"element sh", b"element hs"),
    (b"element chunk", b"element junk1"),
    (b"property uchar f_rest_44", b"property uchar f_rest_45"),
    (b"property uchar f_rest_44\n", b""),
    (b"property uchar f_rest_0\n", b"property ushort f_rest_0\n"),
    (b"property uint packed_color", b"property float packed_color"),
    (b"property float max_x", b"property float max_q"),
    (b"property uint packed_scale", b"property list uchar uint packed_scale"),
    (b"property float min_x", b"property list uchar float min_x"),
]


@pytest.mark.parametrize(("true", "lie"), HEADER_LIES, ids=lambda part: part.decode()[:40])
def test_a_false_header_is_an_error(tmp_path: Path, true: bytes, lie: bytes) -> None:
    compressed_ply.write(tmp_path / "a.ply", Scene(some_gaussians(300), FACTS))
    data = (tmp_path / "a.ply").read_bytes()
    assert true in data
    (tmp_path / "a.ply").write_bytes(data.replace(true, lie, 1))
    if lie == b"element hs":  # an unknown element is ignored
        assert compressed_ply.read(tmp_path / "a.ply").gaussians.sh_degree == 0
        return
    with pytest.raises(SplatpipeError):
        compressed_ply.read(tmp_path / "a.ply")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3e38, 1e20, 0.0])
def test_invalid_ranges_are_an_error(tmp_path: Path, value: float) -> None:
    compressed_ply.write(tmp_path / "a.ply", Scene(some_gaussians(300), FACTS))
    data = bytearray((tmp_path / "a.ply").read_bytes())
    number = struct.pack("<f", value) if value else b"\x01\x00\x80\x7f"  # a signalling NaN: casting it warns
    for field in range(12):  # the first chunk's bounds of positions and scales
        at = data.index(b"end_header\n") + len(b"end_header\n") + 4 * field
        broken = data[:at] + number + data[at + 4 :]
        (tmp_path / "b.ply").write_bytes(broken)
        with pytest.raises(SplatpipeError):
            compressed_ply.read(tmp_path / "b.ply")


def test_the_plain_ply_reader_names_the_command_to_use_and_a_plain_file_is_not_compressed(tmp_path: Path) -> None:
    compressed_ply.write(tmp_path / "a.ply", Scene(some_gaussians(3), FACTS))
    with pytest.raises(SplatpipeError) as raised:
        read_splat(tmp_path / "a.ply")
    assert "splatpipe convert" in raised.value.hint
    (tmp_path / "b.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nend_header\n")
    with pytest.raises(SplatpipeError, match="no chunks"):
        compressed_ply.read(tmp_path / "b.ply")
    with pytest.raises(SplatpipeError, match="Cannot read"):
        compressed_ply.read(tmp_path / "none.ply")


@given(data=st.data())
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_files_end_in_our_error_or_in_numbers(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.ply"
    compressed_ply.write(path, Scene(some_gaussians(20, 1), FACTS))
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[: data.draw(st.integers(0, len(raw)))] if data.draw(st.booleans()) else raw)
    try:
        read = compressed_ply.read(path)
    except SplatpipeError:
        return
    assert bool(read.gaussians.finite().all())
