"""SOG: read back by the letter of the specification, by our reader, and under attack."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from PIL import Image

from splatpipe.pipeline.splat.formats.sog import encode_sog, write
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.scene import Scene, SceneFacts

Table = dict[str, npt.NDArray[np.float64]]


def some_gaussians(count: int, sh_degree: int = 3, seed: int = 1) -> Gaussians:
    """Of all sizes and colours, in a box of 20 units."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians.empty(count, sh_degree)
    for name, scale in (("means", 10.0), ("log_scales", 1.0), ("quats", 1.0), ("opacity_logits", 2.0), ("sh", 0.2)):
        tensor = getattr(gaussians, name)
        tensor += scale * torch.randn(tensor.shape, generator=generator)
    gaussians.log_scales -= 3.0
    return gaussians


def decode(files: dict[str, bytes]) -> Table:
    """Pixel by pixel as the specification's own code says (which counts a quaternion's components w, x, y, z)."""
    meta = json.loads(files["meta.json"])
    count = meta["count"]

    def pixels(part: str, which: int = 0) -> npt.NDArray[np.int64]:
        picture = Image.open(io.BytesIO(files[meta[part]["files"][which]])).convert("RGBA")
        return np.asarray(picture).reshape(-1, 4).astype(np.int64)

    low, high = pixels("means", 0), pixels("means", 1)
    means, quats = np.zeros((count, 3)), np.zeros((count, 4))
    sizes, colours, opacities = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    turned, scaled, painted = pixels("quats"), pixels("scales"), pixels("sh0")
    for i in range(count):
        for axis in range(3):
            least, most = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            n = least + (most - least) * ((high[i, axis] << 8) | low[i, axis]) / 65535
            means[i, axis] = np.sign(n) * (np.exp(abs(n)) - 1)
            sizes[i, axis] = meta["scales"]["codebook"][scaled[i, axis]]
            colours[i, axis] = meta["sh0"]["codebook"][painted[i, axis]]
        rest = [(code / 255 - 0.5) * 2 / np.sqrt(2) for code in turned[i, :3]]
        rest.insert(turned[i, 3] - 252, np.sqrt(max(0.0, 1 - sum(value * value for value in rest))))
        quats[i] = rest
        opacities[i] = painted[i, 3] / 255
    table = {"means": means, "log_scales": sizes, "quats": quats, "dc": colours, "opacities": opacities}
    if "shN" in meta:
        coefficients = (3, 8, 15)[meta["shN"]["bands"] - 1]
        labels = pixels("shN", 1)
        picture = np.asarray(Image.open(io.BytesIO(files[meta["shN"]["files"][0]])).convert("RGB"))
        rest_of_sh = np.zeros((count, coefficients, 3))
        for i in range(count):
            entry = labels[i, 0] + (labels[i, 1] << 8)
            assert entry < meta["shN"]["count"]
            for c in range(coefficients):
                pixel = picture[entry // 64, (entry % 64) * coefficients + c]
                rest_of_sh[i, c] = [meta["shN"]["codebook"][code] for code in pixel]
        table["rest"] = rest_of_sh
    return table


def rows_of_file(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_decoded_by_the_letter_of_the_specification_it_is_what_was_coded(sh_degree: int) -> None:
    gaussians = some_gaussians(700, sh_degree)
    table = decode(encode_sog(gaussians, in_order=True).files())
    logs = np.log1p(gaussians.means.abs().numpy())
    quantum = (logs.max(0) * 2) / 65535 * np.exp(logs)  # half a step of a range that is at most twice the largest
    assert (np.abs(table["means"] - gaussians.means.numpy()) <= quantum).all()
    assert np.abs(table["log_scales"] - gaussians.log_scales.numpy()).max() < 0.2
    assert np.abs(table["log_scales"] - gaussians.log_scales.numpy()).mean() < 0.01
    assert np.abs(table["dc"] - gaussians.sh[:, 0].numpy()).mean() < 0.002
    assert np.abs(table["opacities"] - torch.sigmoid(gaussians.opacity_logits).numpy()).max() <= 0.5 / 255 + 1e-6
    unit = torch.nn.functional.normalize(gaussians.quats).numpy()
    assert np.abs(np.abs((table["quats"] * unit).sum(1)) - 1.0).max() < 1e-4
    assert ("rest" in table) == (sh_degree > 0)


def test_what_is_alike_is_kept_to_the_bit_in_the_palette() -> None:
    gaussians = some_gaussians(600)
    gaussians.sh[:, 1:] = gaussians.sh[:4, 1:].repeat(150, 1, 1).round(decimals=1)
    table = decode(encode_sog(gaussians, in_order=True).files())
    assert np.array_equal(table["rest"].astype(np.float32), gaussians.sh[:, 1:].numpy())


def test_same_bytes_for_any_number_of_threads(tmp_path: Path) -> None:
    scene, before = Scene(some_gaussians(3000)), torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            write(tmp_path / f"{threads}.sog", scene)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert (tmp_path / "1.sog").read_bytes() == (tmp_path / "3.sog").read_bytes()


def test_a_file_tells_its_frame_and_lies_y_down(tmp_path: Path) -> None:
    scene = Scene(some_gaussians(50, 0), SceneFacts("z up", antialias=True, metres=True))
    write(tmp_path / "a.sog", scene)
    files = rows_of_file(tmp_path / "a.sog")
    meta: dict[str, Any] = json.loads(files["meta.json"])
    assert meta["antialias"] is True and meta["splatpipe"]["axes"] == "y down" and meta["splatpipe"]["metres"] is True
    ups = np.sort(decode(files)["means"][:, 1])
    assert np.allclose(ups, np.sort(-scene.gaussians.means[:, 2].numpy()), atol=0.01)


def test_values_that_are_not_finite_are_never_written() -> None:
    gaussians = some_gaussians(5)
    gaussians.means[2, 1] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        encode_sog(gaussians)
