"""Splats of other trainers: two scales, a filter, colours in bytes, values that are no logits."""

from pathlib import Path

import numpy as np
import pytest
import torch

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.ply import property_names, read_splat
from splatpipe.pipeline.splat.containers.ply_dialects import convolved
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.sh import C0

COUNT = 120
NAMES = tuple(property_names(0))


def table(names: tuple[str, ...], **kinds: str) -> np.ndarray:
    random = np.random.default_rng(0)
    rows = np.zeros(COUNT, [(name, kinds.get(name, "<f4")) for name in names])
    for name in names:
        rows[name] = random.integers(0, 256, COUNT) if kinds.get(name) == "u1" else random.normal(size=COUNT)
    return rows


def write(path: Path, rows: np.ndarray) -> Path:
    assert rows.dtype.names is not None
    kinds = {"f": "float", "u": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {kinds[rows.dtype[name].kind]} {name}" for name in rows.dtype.names]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
    return path


def test_flat_gaussians_have_no_extent_along_their_third_axis(tmp_path: Path) -> None:
    rows = table(tuple(name for name in NAMES if name != "scale_2"))
    scene = read_scene(write(tmp_path / "flat.ply", rows))
    assert (scene.gaussians.log_scales[:, 2] < -15.0).all()
    np.testing.assert_array_equal(scene.gaussians.log_scales[:, 1].numpy(), rows["scale_1"])
    assert any("two scales" in note for note in scene.notes)


def test_colours_in_bytes_are_colours(tmp_path: Path) -> None:
    colours = ("red", "green", "blue")
    names = (*(name for name in NAMES if not name.startswith("f_dc")), *colours)
    rows = table(names, **dict.fromkeys(colours, "u1"))
    scene = read_scene(write(tmp_path / "bytes.ply", rows))
    shown = 0.5 + C0 * scene.gaussians.sh[:, 0].numpy()
    np.testing.assert_allclose(255.0 * shown, np.stack([rows[name] for name in colours], 1), atol=1e-3)
    assert any("as bytes" in note for note in scene.notes)


def test_a_coloured_cloud_is_no_splat(tmp_path: Path) -> None:
    colours = ("red", "green", "blue")
    rows = table(("x", "y", "z", *colours), **dict.fromkeys(colours, "u1"))
    with pytest.raises(SplatpipeError, match=r"a point cloud or a mesh: it has no opacity, scale_0"):
        read_splat(write(tmp_path / "cloud.ply", rows))


def test_a_filter_is_applied(tmp_path: Path) -> None:
    rows = table((*NAMES, "filter_3D"))
    rows["filter_3D"] = 0.5
    scene = read_scene(write(tmp_path / "filtered.ply", rows))
    scales = np.exp(np.stack([rows[f"scale_{axis}"] for axis in range(3)], 1).astype(float))
    wider = np.sqrt(scales**2 + 0.25)
    np.testing.assert_allclose(scene.gaussians.log_scales.exp().numpy(), wider, rtol=1e-5)
    opacity = 1.0 / (1.0 + np.exp(-rows["opacity"].astype(float))) * scales.prod(1) / wider.prod(1)
    np.testing.assert_allclose(scene.gaussians.opacity_logits.sigmoid().numpy(), opacity, rtol=1e-4)
    assert any("filter_3D" in note for note in scene.notes)


def test_convolving_with_a_point_changes_nothing() -> None:
    log_scales, logits = torch.tensor([[-3.0, 0.0, 2.0], [-20.0, -1.0, 1.0]]), torch.tensor([-4.0, 20.0])
    same = convolved(log_scales, logits, torch.zeros(2))
    torch.testing.assert_close(same, (log_scales, logits), atol=1e-4, rtol=0.0)


def test_a_filter_that_is_no_number_is_refused(tmp_path: Path) -> None:
    rows = table((*NAMES, "filter_3D"))
    rows["filter_3D"][5] = np.nan
    with pytest.raises(SplatpipeError, match="not numbers in 1 of 120 Gaussians"):
        read_scene(write(tmp_path / "broken.ply", rows))


def test_opacities_and_scales_that_are_stored_as_they_are(tmp_path: Path) -> None:
    rows = table(NAMES)
    stored = rows.copy()
    stored["opacity"] = 1.0 / (1.0 + np.exp(-rows["opacity"]))
    for axis in range(3):
        stored[f"scale_{axis}"] = np.exp(rows[f"scale_{axis}"])
    scene, usual = (
        read_scene(write(tmp_path / name, each)) for name, each in (("stored.ply", stored), ("a.ply", rows))
    )
    torch.testing.assert_close(scene.gaussians.log_scales, usual.gaussians.log_scales, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(scene.gaussians.opacity_logits, usual.gaussians.opacity_logits, atol=1e-4, rtol=1e-4)
    assert any("not as logits" in note for note in scene.notes) and usual.notes == ()
    few = read_scene(write(tmp_path / "few.ply", stored[:10]))
    assert few.notes == () and float(few.gaussians.log_scales.min()) > 0.0


@pytest.mark.parametrize("name", ["scene.splat", "scene.KSPLAT", "chkpnt30000.pth"])
def test_other_formats_are_named_with_a_way_out(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(range(256)))
    with pytest.raises(SplatpipeError, match="files are not read") as caught:
        read_scene(path)
    assert "Save it as PLY" in caught.value.hint
