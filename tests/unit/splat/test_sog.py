"""SOG: read back strictly by the specification, by our reader, and under attack."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from PIL import Image
from tiny_scene import cameras, true_model

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.splat.formats.sog import encode_sog, read, write
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin

Table = dict[str, npt.NDArray[np.float64]]


def some_gaussians(count: int, sh_degree: int = 3, seed: int = 1) -> Gaussians:
    """Return Gaussians of all sizes and colours, in a box of 20 units."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians.empty(count, sh_degree)
    for name, scale in (("means", 10.0), ("log_scales", 1.0), ("quats", 1.0), ("opacity_logits", 2.0), ("sh", 0.2)):
        tensor = getattr(gaussians, name)
        tensor += scale * torch.randn(tensor.shape, generator=generator)
    gaussians.log_scales -= 3.0
    return gaussians


def decode(files: dict[str, bytes]) -> Table:
    """Decode pixel by pixel like the specification's own code (quaternion components in the order w, x, y, z)."""
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
def test_decoded_literally_by_the_specification_it_is_what_was_encoded(sh_degree: int) -> None:
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


def test_identical_values_are_exact_in_the_palette() -> None:
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


def test_a_file_states_its_frame_and_is_y_down(tmp_path: Path) -> None:
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


def test_our_reader_agrees_with_the_specification(tmp_path: Path) -> None:
    write(tmp_path / "a.sog", Scene(some_gaussians(400), SceneFacts("y down")))
    table = decode(rows_of_file(tmp_path / "a.sog"))
    found = read(tmp_path / "a.sog").gaussians
    assert np.allclose(found.means.numpy(), table["means"], rtol=1e-6, atol=1e-6)
    assert np.allclose(found.quats.numpy(), table["quats"], atol=1e-6)
    assert np.array_equal(found.log_scales.numpy(), table["log_scales"].astype(np.float32))
    assert np.array_equal(found.sh[:, 0].numpy(), table["dc"].astype(np.float32))
    assert np.array_equal(found.sh[:, 1:].numpy(), table["rest"].astype(np.float32))
    assert np.allclose(torch.sigmoid(found.opacity_logits).numpy(), table["opacities"], atol=2e-6)


def test_a_scene_reads_back_with_its_georeference_and_looks_the_same(tmp_path: Path) -> None:
    place = SplatOrigin(47.8, 13.5, 515.0, "EPSG:3855", "EPSG:32633")
    scene = Scene(true_model(), SceneFacts("z up", metres=True, place=place, edits=({"what": "crop"},)))
    write(tmp_path / "a.sog", scene)
    found = read(tmp_path / "a.sog")
    assert found.facts == SceneFacts("y down", metres=True, place=place, edits=({"what": "crop"},))
    options = RenderOptions(sh_degree=3)
    for camera in cameras()[::3]:
        before, after = (
            render(each, camera, options).colour for each in (scene.gaussians, found.turned("z up").gaussians)
        )
        assert -10.0 * torch.log10(((before - after) ** 2).mean()) > 40.0


def test_a_folder_is_read_as_the_bundle_is(tmp_path: Path) -> None:
    write(tmp_path / "a.sog", Scene(some_gaussians(60)))
    for name, data in rows_of_file(tmp_path / "a.sog").items():
        (tmp_path / name).write_bytes(data)
    bundled = read(tmp_path / "a.sog")
    for path in (tmp_path, tmp_path / "meta.json"):
        found = read(path)
        assert found.facts == bundled.facts
        assert all(
            torch.equal(tensor, bundled.gaussians.tensors()[name]) for name, tensor in found.gaussians.tensors().items()
        )


def test_a_third_party_file_is_y_down_without_georeference(tmp_path: Path) -> None:
    images = encode_sog(some_gaussians(60, 1), antialias=True)
    bundle(tmp_path / "a.sog", images.files())
    assert read(tmp_path / "a.sog").facts == SceneFacts("y down", antialias=True)


def test_pictures_as_png_and_a_codebook_that_begins_with_null_are_read(tmp_path: Path) -> None:
    """Both occur in third-party files: the specification allows the first, old programs wrote the second."""
    images = encode_sog(some_gaussians(60, 1))
    files = {"meta.json": b""}
    for name, data in images.images.items():
        out = io.BytesIO()
        Image.open(io.BytesIO(data)).save(out, "PNG")
        files[name] = out.getvalue()
    book = images.meta["scales"]["codebook"]
    first, book[0] = book[0], None
    files["meta.json"] = json.dumps(images.meta).encode()
    bundle(tmp_path / "a.sog", files)
    found, before = read(tmp_path / "a.sog").gaussians, decode(encode_sog(some_gaussians(60, 1)).files())
    assert np.array_equal(found.sh[:, 0].numpy(), before["dc"].astype(np.float32))
    others = before["log_scales"] != first
    assert np.array_equal(found.log_scales.numpy()[others], before["log_scales"].astype(np.float32)[others])
    assert np.allclose(found.log_scales.numpy()[~others], book[1] + (book[1] - book[-1]) / 255)


def bundle(path: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in files.items():
            archive.writestr(name, data)


def flat_picture(width: int, height: int, lossless: bool = True) -> bytes:
    """A small file, whatever size it declares."""
    out = io.BytesIO()
    Image.new("RGBA", (width, height), (1, 2, 3, 255)).save(out, "WEBP", lossless=lossless)
    return out.getvalue()


Meta = dict[str, Any]


def at(*keys: str | int, value: Any) -> Callable[[Meta], None]:
    """An attack that puts a value somewhere into the meta.json."""

    def attack(meta: Meta) -> None:
        for key in keys[:-1]:
            meta = meta[key]  # type: ignore[index]
        meta[keys[-1]] = value  # type: ignore[index]

    return attack


LIES: dict[str, Callable[[Meta], None]] = {
    "version 1": lambda meta: meta.pop("version"),
    "version 3": at("version", value=3),
    "version true": at("version", value=True),
    "a streamed one": lambda meta: (meta.pop("version"), meta.update(lodLevels=3)),
    "more Gaussians than pixels": at("count", value=3000),
    "no count": lambda meta: meta.pop("count"),
    "2 billion Gaussians": at("count", value=2_000_000_000),
    "10 million Gaussians": at("count", value=10_000_000),
    "fewer than none": at("count", value=-1),
    "a count that is true": at("count", value=True),
    "a count with a fraction": at("count", value=60.0),
    "a count of text": at("count", value="60"),
    "no means": lambda meta: meta.pop("means"),
    "means of text": at("means", value="means"),
    "two numbers": at("means", "mins", value=[0.0, 1.0]),
    "a range of text": at("means", "maxs", value=["a", "b", "c"]),
    "a range that is no number": at("means", "maxs", value=[float("nan")] * 3),
    "a range without end": at("means", "maxs", value=[float("inf")] * 3),
    "a range of 1e300": at("means", "maxs", value=[1e300] * 3),
    "a range of exp(200)": at("means", "maxs", value=[200.0] * 3),
    "a range of a huge whole number": at("means", "maxs", value=[10**400] * 3),
    "one picture of two": at("means", "files", value=["means_l.webp"]),
    "pictures of numbers": at("means", "files", value=[1, 2]),
    "a picture elsewhere": at("quats", "files", value=["../../etc/passwd"]),
    "a picture at the root": at("quats", "files", value=["/etc/passwd"]),
    "a picture on another drive": at("quats", "files", value=["C:\\quats.webp"]),
    "a picture with a NUL": at("quats", "files", value=["quats\0.webp"]),
    "a picture without a name": at("quats", "files", value=[""]),
    "the folder itself": at("quats", "files", value=["."]),
    "a picture that is not there": at("quats", "files", value=["b.webp"]),
    "the meta.json as a picture": at("quats", "files", value=["meta.json"]),
    "a quaternion of no mode": at("quats", "files", value=["sh0.webp"]),
    "scales as they are, not their logarithms": at("scales", "codebook", value=[300.0] * 256),
    "a codebook that is no number": at("scales", "codebook", value=[float("nan")] * 256),
    "an empty codebook": at("sh0", "codebook", value=[]),
    "a short codebook": at("sh0", "codebook", value=[0.0, 1.0]),
    "a huge codebook": at("sh0", "codebook", value=[0.0] * 100_000),
    "a codebook of lists": at("sh0", "codebook", value=[[0.0]] * 256),
    "no codebook": lambda meta: meta["sh0"].pop("codebook"),
    "9 bands": at("shN", "bands", value=9),
    "3 bands in a picture of 2": at("shN", "bands", value=3),
    "no entries": at("shN", "count", value=0),
    "fewer entries than named": at("shN", "count", value=1),
    "a million entries": at("shN", "count", value=1_000_000),
    "more entries than there are": at("shN", "count", value=60_000),
    "harmonics of nothing": at("shN", value=None),
}


@pytest.mark.parametrize("bundled", [True, False], ids=["bundled", "folder"])
@pytest.mark.parametrize("attack", LIES.values(), ids=LIES.keys())
def test_false_metadata_are_refused(attack: Callable[[Meta], None], bundled: bool, tmp_path: Path) -> None:
    images = encode_sog(some_gaussians(60, 2), in_order=True)
    attack(images.meta)
    files = {"meta.json": json.dumps(images.meta).encode(), **images.images}
    if bundled:
        bundle(tmp_path / "a.sog", files)
    else:
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
    with pytest.raises(SplatpipeError):
        read(tmp_path / "a.sog" if bundled else tmp_path)


def test_a_damaged_record_is_ignored(tmp_path: Path) -> None:
    for record in (17, "no JSON", {"format": 1}, [[]], {"format": 1, "axes": "z up", "edits": 3}):
        images = encode_sog(some_gaussians(8, 0))
        images.meta["splatpipe"] = record
        bundle(tmp_path / "a.sog", images.files())
        assert read(tmp_path / "a.sog").facts == SceneFacts("y down")


BROKEN_META = {
    "nothing": b"",
    "no JSON": b"{",
    "no object": b"[1]",
    "no text": b"\xff\xfe\x00{",
    "deep": b"[" * 200_000,
    "deep inside": b'{"version":2,"count":1,"splatpipe":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "large": b'{"version":2,"a":"' + b"a" * 3_000_000 + b'"}',
}


@pytest.mark.parametrize("meta", BROKEN_META.values(), ids=BROKEN_META.keys())
def test_a_broken_meta_json_is_refused(meta: bytes, tmp_path: Path) -> None:
    files = {**encode_sog(some_gaussians(8, 0)).files(), "meta.json": meta}
    bundle(tmp_path / "a.sog", files, zipfile.ZIP_DEFLATED)
    (tmp_path / "meta.json").write_bytes(meta)
    for path in (tmp_path / "a.sog", tmp_path / "meta.json"):
        with pytest.raises(SplatpipeError):
            read(path)


BROKEN_PICTURES = {
    "nothing": b"",
    "no picture": b"x" * 1000,
    "a header of 16,383 squared": b"RIFF\x20\0\0\0WEBPVP8L\x14\0\0\0\x2f" + b"\xff" * 4 + b"\0" * 40,
    "16 million squared": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + b"\xff" * 6 + b"\0" * 40,
    "a PNG of 4 billion squared": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\xff" * 8 + b"\x08\6\0\0\0" + b"\0" * 40,
    "4,000 squared": flat_picture(4000, 4000),
    "smaller": flat_picture(4, 4),
    "cut off": encode_sog(some_gaussians(60, 0)).images["means_l.webp"][:-20],
    "a lie of its size": struct.pack("<4sI4s4sIBI", b"RIFF", 60, b"WEBP", b"VP8L", 40, 0x2F, 7 | 7 << 14) + b"\0" * 36,
}


@pytest.mark.parametrize("picture", BROKEN_PICTURES.values(), ids=BROKEN_PICTURES.keys())
def test_a_broken_picture_is_refused(picture: bytes, tmp_path: Path) -> None:
    bundle(tmp_path / "a.sog", {**encode_sog(some_gaussians(60, 0)).files(), "means_l.webp": picture})
    with pytest.raises(SplatpipeError):
        read(tmp_path / "a.sog")


def test_broken_archives_are_refused(tmp_path: Path) -> None:
    files, path = encode_sog(some_gaussians(60, 0)).files(), tmp_path / "a.sog"
    bundle(path, files)
    whole = path.read_bytes()
    end = whole.rindex(b"PK\5\6")
    flipped = bytearray(whole)
    flipped[whole.index(b"RIFF") + 40] ^= 0xFF
    listed = whole[:end] + whole[end : end + 12] + struct.pack("<I", 0xFFFF_FFFF) + whole[end + 16 :]
    large = whole[:end] + b"PK\6\7" + b"\0" * 16 + whole[end:]
    for data in (whole[:-1], whole[: len(whole) // 2], b"PK", b"PK\5\6", bytes(flipped), listed, large, b"", b"{}"):
        path.write_bytes(data)
        with pytest.raises(SplatpipeError):
            read(path)
    with pytest.raises(SplatpipeError):
        read(tmp_path / "not there.sog")


def test_archives_that_unpack_to_too_much_are_refused(tmp_path: Path) -> None:
    files, path = encode_sog(some_gaussians(60, 0)).files(), tmp_path / "a.sog"
    bundle(path, {**files, "means_l.webp": files["means_l.webp"] + b"\0" * 50_000_000}, zipfile.ZIP_DEFLATED)
    with pytest.raises(SplatpipeError, match="too large"):
        read(path)
    bundle(path, {**files, **{f"{i}.webp": b"" for i in range(3000)}})
    with pytest.raises(SplatpipeError, match="far larger directory"):
        read(path)
    bundle(path, files, zipfile.ZIP_BZIP2)
    with pytest.raises(SplatpipeError, match="unsupported"):
        read(path)
    with zipfile.ZipFile(path, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        for name, data in [*files.items(), ("quats.webp", files["quats.webp"])]:
            archive.writestr(name, data)
    with pytest.raises(SplatpipeError, match="exactly one quats"):
        read(path)


@pytest.mark.parametrize("count", [0, 1, 2, 17])
def test_few_gaussians_are_written_and_read(count: int, tmp_path: Path) -> None:
    scene = Scene(some_gaussians(count), SceneFacts("y down"))
    write(tmp_path / "a.sog", scene)
    found = read(tmp_path / "a.sog").gaussians
    assert len(found) == count and found.sh_degree == 3
    assert np.allclose(np.sort(found.means.numpy(), 0), np.sort(scene.gaussians.means.numpy(), 0), atol=0.01)
