"""SPZ: the file, parsed strictly by its specification, contains what was written."""

import base64
import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.raster.rasterizer import render
from splatpipe.pipeline.splat.containers.spz_encoder import spz_bytes
from splatpipe.pipeline.splat.formats import spz
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin

QUARTER_TURN = math.sqrt(0.5)


def some_gaussians(count: int = 40, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    made = Gaussians.empty(count, degree)
    made.means = 20.0 * torch.randn(count, 3, generator=generator)
    made.log_scales = -3.0 + torch.randn(count, 3, generator=generator)
    made.quats = torch.randn(count, 4, generator=generator)
    made.opacity_logits = 2.0 * torch.randn(count, generator=generator)
    made.sh = 0.3 * torch.randn(made.sh.shape, generator=generator)
    return made


def read(data: bytes) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """Decode one number after another, as in the specification's README."""
    raw = gzip.decompress(data)
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", raw)
    assert magic == 0x5053474E
    terms = (degree + 1) ** 2 - 1
    sizes = {"means": 9, "alpha": 1, "colour": 3, "scale": 3, "quat": 3 if version == 2 else 4, "sh": 3 * terms}
    assert len(raw) == 16 + count * sum(sizes.values())
    arrays, at = {}, 16
    for name, size in sizes.items():
        block = raw[at : at + count * size]
        at += len(block)
        arrays[name] = [block[i * size : (i + 1) * size] for i in range(count)]
    found = {
        "means": np.array(
            [
                [int.from_bytes(m[i : i + 3], "little", signed=True) / 2**bits for i in (0, 3, 6)]
                for m in arrays["means"]
            ]
        ),
        "alpha": np.array([a[0] / 255.0 for a in arrays["alpha"]]),
        "dc": np.array([[(c / 255.0 - 0.5) / 0.15 for c in colour] for colour in arrays["colour"]]),
        "log_scales": np.array([[s / 16.0 - 10.0 for s in scale] for scale in arrays["scale"]]),
        "quats": np.array(
            [first_three(q) if version == 2 else smallest_three(struct.unpack("<I", q)[0]) for q in arrays["quat"]]
        ),
        "sh": np.array([[(s - 128.0) / 128.0 for s in sh] for sh in arrays["sh"]]).reshape(count, terms, 3),
    }
    return {"version": version, "degree": degree, "bits": bits, "flags": flags}, found


def smallest_three(word: int) -> list[float]:
    """(w, x, y, z): the index of the largest component of (x, y, z, w) in the upper bits, the others in order below."""
    largest, rest, square = word >> 30, [], 0.0
    for shift in (20, 10, 0):
        part = (word >> shift) & 1023
        value = (part & 511) / 511.0 * QUARTER_TURN
        rest.append(-value if part & 512 else value)
        square += value * value
    rest.insert(largest, math.sqrt(max(0.0, 1.0 - square)))
    return [rest[3], *rest[:3]]


def first_three(code: bytes) -> list[float]:
    """(w, x, y, z): each of x, y, z in a byte, w not negative."""
    x, y, z = (part / 127.5 - 1.0 for part in code)
    return [math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z)), x, y, z]


def matched(made: Gaussians, means: np.ndarray) -> Gaussians:
    """Gaussians in the file's order, which is its own, by their means."""
    order = torch.cdist(torch.from_numpy(means), made.means.double()).argmin(dim=1)
    assert sorted(order.tolist()) == list(range(len(made)))
    return made.select(order)


def apart_deg(quats: np.ndarray, others: torch.Tensor) -> np.ndarray:
    unit = others / torch.linalg.vector_norm(others, dim=1, keepdim=True)
    return np.degrees(2.0 * np.arccos(np.minimum(np.abs((quats * unit.numpy()).sum(axis=1)), 1.0)))


def test_version_2_differs_only_in_its_rotations() -> None:
    made = some_gaussians()
    head, found = read(spz_bytes(made, antialias=False, version=2))
    head_3, found_3 = read(spz_bytes(made, antialias=False))
    assert head == {**head_3, "version": 2}
    for name in found.keys() - {"quats"}:
        np.testing.assert_array_equal(found[name], found_3[name])
    made = matched(made, found["means"])
    quats = made.quats / torch.linalg.vector_norm(made.quats, dim=1, keepdim=True)
    xyz = quats[:, 1:] * torch.where(quats[:, :1] < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(found["quats"][:, 1:], xyz, atol=0.5 / 127.5 + 1e-6)
    with pytest.raises(ValueError, match="version"):
        spz_bytes(made, antialias=False, version=1)


def test_every_parameter_reads_back_within_half_a_step_of_its_code() -> None:
    made = some_gaussians()
    head, found = read(spz_bytes(made, antialias=True, sh_step=None))
    assert head["version"] == 3
    assert head["degree"] == 3
    assert head["flags"] & 1
    made = matched(made, found["means"])
    np.testing.assert_allclose(found["means"], made.means, atol=0.5 / 2 ** head["bits"] + 1e-6)
    np.testing.assert_allclose(found["alpha"], torch.sigmoid(made.opacity_logits), atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found["dc"], made.sh[:, 0].clamp(-3.3, 3.3), atol=0.5 / 255 / 0.15 + 1e-6)
    np.testing.assert_allclose(found["log_scales"], made.log_scales, atol=0.5 / 16 + 1e-6)
    np.testing.assert_allclose(found["sh"], made.sh[:, 1:].clamp(-1.0, 127.0 / 128.0), atol=0.5 / 128 + 1e-6)
    assert apart_deg(found["quats"], made.quats).max() < 0.25  # three components, each within half of 1 / 722


def test_harmonics_are_finer_where_they_are_more_visible() -> None:
    made = some_gaussians(400)
    made.sh.clamp_(-0.45, 0.45)
    weight = torch.sigmoid(made.opacity_logits) * made.log_scales.sort(dim=1).values[:, 1:].mean(dim=1).exp()
    made = made.select(torch.argsort(weight))
    _, found = read(spz_bytes(made, antialias=False, sh_step=8.0))
    error = np.abs(found["sh"] - matched(made, found["means"]).sh[:, 1:].numpy()).max(axis=(1, 2)) * 128.0
    in_order = error[torch.cdist(made.means.double(), torch.from_numpy(found["means"])).argmin(dim=1).numpy()]
    assert in_order[:60].max() > 8.5  # steps of more than 16
    assert in_order[100:300].max() < 8.1  # about 8: 16 at most
    assert in_order[-40:].max() < 4.1  # 8 at most


def test_precision_of_positions_follows_the_gaussians_size() -> None:
    made = some_gaussians(400)
    for log_scale, bits in ((0.0, 12), (-6.0, 13), (-30.0, 16)):  # at most 16: 100 units fill 24 bits
        made.log_scales[:] = log_scale
        head, found = read(spz_bytes(made, antialias=False))
        assert head["bits"] == bits
        np.testing.assert_allclose(found["means"], matched(made, found["means"]).means, atol=0.5 / 2**bits + 1e-5)


def test_a_far_gaussian_is_moved_in_along_its_ray_and_shrunk_in_proportion() -> None:
    made = some_gaussians(1000)
    made.means[7] = torch.tensor([3e6, 4e6, 0.0])
    head, found = read(spz_bytes(made, antialias=False))
    assert 2.0 ** -head["bits"] < 1e-3  # the scene, 100 units wide, keeps its places
    far = int(np.linalg.norm(found["means"], axis=1).argmax())
    np.testing.assert_allclose(found["means"][far] / np.linalg.norm(found["means"][far]), [0.6, 0.8, 0.0], atol=1e-5)
    shrunk = np.linalg.norm(found["means"][far]) / 5e6
    expected = made.log_scales[7].numpy() + math.log(shrunk)
    np.testing.assert_allclose(found["log_scales"][far], np.maximum(expected, -10.0), atol=0.5 / 16 + 1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_store_only_their_terms(degree: int) -> None:
    head, found = read(spz_bytes(some_gaussians(5, degree), antialias=False))
    assert head["degree"] == degree
    assert found["sh"].shape == (5, (degree + 1) ** 2 - 1, 3)


def test_the_same_gaussians_give_the_same_bytes_and_zero_give_a_valid_file() -> None:
    assert spz_bytes(some_gaussians(), antialias=True) == spz_bytes(some_gaussians(), antialias=True)
    head, found = read(spz_bytes(some_gaussians(0), antialias=False))
    assert len(found["means"]) == 0
    assert head["flags"] == 0


def test_values_that_are_not_finite_are_refused() -> None:
    made = some_gaussians()
    made.means[3, 1] = float("nan")
    with pytest.raises(ValueError, match="finite"):
        spz_bytes(made, antialias=False)


FACTS = SceneFacts("y up", True, True, SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634"))


def version_4(data: bytes, degree: int = 3, extensions: bytes = b"", flags: int = 0) -> bytes:
    """Return the same arrays strictly in version 4: a plain header, a table of sizes, one zstd stream per array."""
    raw = gzip.decompress(data)
    _, _, count, _, bits, kept, _ = struct.unpack_from("<IIIBBBB", raw)
    streams, table, at = [], [], 16
    for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)):
        block = raw[at : at + width * count]
        at += len(block)
        if block:
            streams.append(zstandard.compress(block, 12))
            table.append(struct.pack("<QQ", len(streams[-1]), len(block)))
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, kept | flags, len(table), 32 + len(extensions))
    return b"".join([head, extensions, *table, *streams])


@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.parametrize("version", [2, 3, 4])
def test_the_reader_agrees_with_a_literal_decoder(tmp_path: Path, monkeypatch, version: int, degree: int) -> None:
    monkeypatch.setattr(spz, "_ROWS", 128)
    data = spz_bytes(some_gaussians(300, degree), antialias=True, version=min(version, 3))
    _, found = read(data)
    (tmp_path / "a.spz").write_bytes(version_4(data, degree) if version == 4 else data)
    scene = spz.read(tmp_path / "a.spz")
    assert scene.facts == SceneFacts("y up", antialias=True)
    made = scene.gaussians
    assert made.sh_degree == degree
    np.testing.assert_allclose(made.means, found["means"], rtol=1e-6)
    np.testing.assert_allclose(torch.sigmoid(made.opacity_logits), found["alpha"], atol=1.1 * 0.25 / 255)
    np.testing.assert_allclose(made.sh[:, 0], found["dc"], atol=1e-6)
    np.testing.assert_allclose(made.sh[:, 1:], found["sh"], atol=1e-6)
    np.testing.assert_allclose(made.log_scales, found["log_scales"], atol=1e-6)
    assert apart_deg(found["quats"] / np.linalg.norm(found["quats"], axis=1, keepdims=True), made.quats).max() < 0.05


SPLAT_TRANSFORM = (  # 2.7.1, --spz-version 4, of four Gaussians of degree 1
    "TkdTUAQAAAAEAAAAAQwABiAAAAAAAAAAAAAAAAAAAAAtAAAAAAAAACQAAAAAAAAADQAAAAAAAAAEAAAAAAAAABUAAAAAAAAADAAAAAAAAAAVAAAA"
    "AAAAAAwAAAAAAAAAGQAAAAAAAAAQAAAAAAAAAC0AAAAAAAAAJAAAAAAAAAAotS/9ICQhAQAqFQB19/8H/v/iEwB2DgBRBQBFz//J8//iIAD77f+O"
    "HADdAQAotS/9IAQhAACOA8VuKLUv/SAMYQAAi4pvb5KBdXWQjoWKKLUv/SAMYQAAbWF3dGloV26pU4pcKLUv/SAQgQAAEKcw9d1KBahVREYHITUy"
    "aii1L/0gJCEBALBwcHhYUKB4mLCQuJCQUFCIeHCQYJigaIggoFCIcKiguFCowA=="
)


def test_a_file_of_splat_transform_in_version_4_reads_as_its_original(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(base64.b64decode(SPLAT_TRANSFORM))
    found = spz.read(tmp_path / "a.spz").turned("y down").gaussians
    generator = torch.Generator().manual_seed(1)
    means = 2.0 * torch.randn(4, 3, generator=generator)
    log_scales = -3.0 + torch.randn(4, 3, generator=generator)
    order = torch.cdist(found.means, means).argmin(dim=1)
    torch.testing.assert_close(found.means, means[order], atol=1.3e-4, rtol=0.0)
    torch.testing.assert_close(found.log_scales, log_scales[order], atol=0.5 / 16 + 1e-5, rtol=0.0)
    assert found.sh_degree == 1


def test_version_1_has_half_floats(tmp_path: Path) -> None:
    raw = struct.pack("<IIIBBBB", 0x5053474E, 1, 1, 0, 12, 0, 0) + struct.pack("<3e", 1.5, -2.25, 300.0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(raw + bytes([255, 0, 128, 255, 160, 160, 160, 128, 128, 128])))
    assert spz.read(tmp_path / "a.spz").gaussians.means.tolist() == [[1.5, -2.25, 300.0]]


def test_the_record_is_invisible_to_other_readers(tmp_path: Path) -> None:
    scene = Scene(some_gaussians(300), FACTS)
    spz.write(tmp_path / "a.spz", scene)
    data = (tmp_path / "a.spz").read_bytes()
    assert spz.read(tmp_path / "a.spz").facts == FACTS
    assert gzip.decompress(data) == zlib.decompress(data, 31) == gzip.decompress(spz_bytes(scene.gaussians, True))
    named = data[:10] + struct.pack("<H", 5) + b"xy" + struct.pack("<H", 1) + b"z"  # another's field
    (tmp_path / "b.spz").write_bytes(named + data[12 + struct.unpack_from("<H", data, 10)[0] :])
    assert spz.read(tmp_path / "b.spz").facts == SceneFacts("y up", antialias=True)


def test_it_is_written_y_up_and_looks_the_same(tmp_path: Path) -> None:
    made = some_gaussians(2000)
    made.means /= 20.0
    made.means[:, 1] += 6.0
    made.sh *= 0.5
    scene = Scene(made, SceneFacts("z up"))
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    camera = Camera("view", 160, 120, 150.0, 150.0, 80.0, 60.0, cam_from_world)
    options = RenderOptions(3, depth=False)
    expected = render(made, camera, options).colour
    for write, least_db in ((spz.write, 36.0), (spz.write_version_2, 34.0)):
        write(tmp_path / "a.spz", scene)
        read_back = spz.read(tmp_path / "a.spz")
        assert read_back.facts.axes == "y up"
        colour = render(read_back.turned("z up").gaussians, camera, options).colour
        assert -10.0 * math.log10(float(((colour - expected) ** 2).mean())) > least_db


def attacked(tmp_path: Path, data: bytes, said: str) -> None:
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(SplatpipeError, match=said):
        spz.read(tmp_path / "a.spz")


def test_false_gzip_files_are_an_error(tmp_path: Path) -> None:
    raw = gzip.decompress(spz_bytes(some_gaussians(300), antialias=False))

    def lying(at: int, layout: str, value: int) -> bytes:
        return gzip.compress(raw[:at] + struct.pack(layout, value) + raw[at + struct.calcsize(layout) :], mtime=0)

    attacked(tmp_path, lying(0, "<I", 7), "not an SPZ")
    attacked(tmp_path, lying(4, "<I", 9), "version 9")
    attacked(tmp_path, lying(8, "<I", 0xFFFFFFFF), "promised")
    attacked(tmp_path, lying(8, "<I", 301), "end early")
    attacked(tmp_path, lying(12, "<B", 4), "degree 4")
    attacked(tmp_path, gzip.compress(raw + bytes(70_000), mtime=0), "more than")
    attacked(tmp_path, gzip.compress(raw + bytes(10), mtime=0)[:-4], "cut off")
    attacked(tmp_path, gzip.compress(raw, mtime=0)[:-6] + bytes(6), "damaged")
    attacked(tmp_path, b"", "not an SPZ")
    bomb = struct.pack("<IIIBBBB", 0x5053474E, 3, 60_000_000, 0, 12, 0, 0) + bytes(20_000_000)
    attacked(tmp_path, gzip.compress(bomb, mtime=0), "promised")


def test_false_zstd_files_are_an_error(tmp_path: Path) -> None:
    whole = version_4(spz_bytes(some_gaussians(300), antialias=False))

    def lying(at: int, layout: str, value: int) -> bytes:
        return whole[:at] + struct.pack(layout, value) + whole[at + struct.calcsize(layout) :]

    attacked(tmp_path, lying(4, "<I", 5), "version 5")
    attacked(tmp_path, lying(8, "<I", 0xFFFFFFFF), "promised")
    attacked(tmp_path, lying(8, "<I", 299), "streams do not hold")
    attacked(tmp_path, lying(15, "<B", 5), "is not valid")
    attacked(tmp_path, lying(16, "<I", 0xFFFFFFFF), "is not valid")
    attacked(tmp_path, lying(16, "<I", 0), "is not valid")
    attacked(tmp_path, lying(32, "<Q", 1 << 63), "do not end with")
    attacked(tmp_path, lying(40, "<Q", 1 << 63), "streams do not hold")
    attacked(tmp_path, lying(128, "<I", 0), "zstd")
    attacked(tmp_path, whole[:-1], "do not end with")
    attacked(tmp_path, whole[:20], "cut off")


def test_files_with_other_axes_are_refused_and_unknown_extensions_skipped(tmp_path: Path) -> None:
    data = spz_bytes(some_gaussians(300), antialias=False)
    orbit = struct.pack("<IIfff", 0xADBE0002, 12, 0.0, 1.0, 2.0)
    for value, fits in ((4, True), (0, True), (7, False)):
        extensions = orbit + struct.pack("<III", 0xADBE0003, 4, value)
        raw = bytearray(gzip.decompress(data))
        raw[14] |= 2
        for kind in (version_4(data, 3, extensions, 2), gzip.compress(raw + extensions, mtime=0)):
            if fits:
                (tmp_path / "a.spz").write_bytes(kind)
                assert len(spz.read(tmp_path / "a.spz").gaussians) == 300
            else:
                attacked(tmp_path, kind, "axes other")


@given(data=st.data())
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_files_end_in_our_error_or_in_numbers(tmp_path: Path, data: st.DataObject) -> None:
    made = spz_bytes(some_gaussians(20, 1), antialias=False)
    raw = bytearray(version_4(made, 1) if data.draw(st.booleans()) else gzip.decompress(made))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(raw[: data.draw(st.integers(0, len(raw)))] if data.draw(st.booleans()) else raw)
    (tmp_path / "a.spz").write_bytes(cut if raw[4:8] == b"\x04\0\0\0" else gzip.compress(cut))
    try:
        scene = spz.read(tmp_path / "a.spz")
    except SplatpipeError:
        return
    assert bool(scene.gaussians.finite().all())
