"""GLB: our files, parsed strictly by the glTF specification; third-party files in all forms; hostile files."""

import io
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_scene
import torch
from glb_parts import packed, parts
from some_splats import some_gaussians

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.containers.glb_container import write_head
from splatpipe.pipeline.splat.formats import glb
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin

FACTS = SceneFacts("z up", True, True, SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634"), ({"step": "crop"},))
SPLATTING = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
MAX_FILE_BYTES = 2**32 - 1


def attributes(data: bytes) -> dict[str, np.ndarray]:
    document, binary = parts(data)
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    found = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        shape = (accessor["count"], SIZES[accessor["type"]])
        number = np.dtype(NUMBERS[accessor["componentType"]])
        assert view["byteLength"] == number.itemsize * shape[0] * shape[1] and view["byteOffset"] % 4 == 0
        rows = np.frombuffer(binary, number, shape[0] * shape[1], view["byteOffset"])
        found[name] = rows.reshape(shape)
    return found


@pytest.fixture
def written(tmp_path: Path) -> bytes:
    glb.write(tmp_path / "splat.glb", Scene(some_gaussians(60), FACTS))
    return (tmp_path / "splat.glb").read_bytes()


def test_one_gaussian_is_stored_as_specified(tmp_path: Path):
    one = some_gaussians(1)
    one.means = torch.tensor([[1.0, 2.0, 3.0]])  # east, north, up
    one.quats = torch.tensor([[2.0, 0.0, 0.0, 0.0]])  # upright, not of unit length
    one.log_scales, one.opacity_logits = torch.log(torch.tensor([[0.5, 0.25, 2.0]])), torch.zeros(1)
    one.sh[0, :4] = torch.tensor([[0.0, 1.0, -3.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.3, 0.0, 0.0]])
    glb.write(tmp_path / "one.glb", Scene(one, FACTS))
    document, _ = parts((tmp_path / "one.glb").read_bytes())
    found = attributes((tmp_path / "one.glb").read_bytes())
    assert document["extensionsUsed"] == [SPLATTING] and "extensionsRequired" not in document
    kernel = document["meshes"][0]["primitives"][0]["extensions"][SPLATTING]
    assert (kernel["kernel"], kernel["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    names = [f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
    assert [name for name in found if "SH_DEGREE" in name] == names
    np.testing.assert_allclose(found["POSITION"], [[1.0, 3.0, -2.0]])  # up is y, north is −z
    np.testing.assert_allclose(found[f"{SPLATTING}:SCALE"], [[0.5, 0.25, 2.0]], rtol=1e-6)
    np.testing.assert_allclose(found[f"{SPLATTING}:OPACITY"], [[0.5]])
    # x, y, z, w of a quarter turn about x, backwards: what was up (z) is y
    np.testing.assert_allclose(found[f"{SPLATTING}:ROTATION"], [[-(0.5**0.5), 0.0, 0.0, 0.5**0.5]], atol=1e-7)
    np.testing.assert_allclose(found[names[0]], [[0.0, 1.0, -3.0]])
    # the basis of degree 1 is −y, z, −x: of east, north, up it was (−n, u, −e), and is (−u, −n, −e)
    red = [found[name][0, 0] for name in names[1:4]]
    np.testing.assert_allclose(red, [-0.2, 0.1, 0.3], atol=1e-6)
    np.testing.assert_array_equal(found["COLOR_0"], [[128, 199, 0, 128]])


def test_positions_state_their_exact_bounds(written: bytes):
    document, _ = parts(written)
    positions = attributes(written)["POSITION"]
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert accessor["min"] == positions.min(axis=0).tolist() and accessor["max"] == positions.max(axis=0).tolist()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_round_trip_keeps_every_value_and_the_metadata(tmp_path: Path, degree: int):
    scene = Scene(some_gaussians(70, degree), FACTS)
    glb.write(tmp_path / "a.glb", scene)
    read = glb.read(tmp_path / "a.glb")
    assert read.facts == replace(FACTS, axes="y up")
    expected = scene.turned("y up").gaussians
    expected.quats /= torch.linalg.vector_norm(expected.quats, dim=1, keepdim=True)
    assert torch.equal(read.gaussians.means, expected.means) and torch.equal(read.gaussians.sh, expected.sh)
    torch.testing.assert_close(read.gaussians.log_scales, expected.log_scales, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(read.gaussians.quats, expected.quats, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(read.gaussians.opacity_logits, expected.opacity_logits, rtol=0.0, atol=1e-4)
    glb.write(tmp_path / "b.glb", scene)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_a_round_trip_looks_the_same(tmp_path: Path):
    model = tiny_scene.true_model()
    glb.write(tmp_path / "a.glb", Scene(model, SceneFacts("z up")))
    back = glb.read(tmp_path / "a.glb").turned("z up").gaussians
    options = RenderOptions(model.sh_degree)
    for camera in tiny_scene.cameras()[:3]:
        views = [rasterizer.render(each, camera, options).colour.double() for each in (model, back)]
        error = float(((views[0] - views[1]) ** 2).mean())
        assert 10.0 * np.log10(1.0 / max(error, 1e-12)) >= 70.0


def test_opacities_and_scales_at_their_ends_stay_finite(tmp_path: Path):
    model = some_gaussians(3)
    model.opacity_logits = torch.tensor([-300.0, 300.0, 0.0])
    model.log_scales[0] = -200.0
    glb.write(tmp_path / "a.glb", Scene(model, SceneFacts("y up")))
    read = glb.read(tmp_path / "a.glb").gaussians
    assert torch.sigmoid(read.opacity_logits).tolist() == pytest.approx([0.0, 1.0, 0.5], abs=1e-7)
    assert bool(read.finite().all())


def test_what_a_glb_cannot_hold_is_refused():
    with pytest.raises(SplatpipeError, match="32-bit number"):
        write_head(io.BytesIO(), {}, MAX_FILE_BYTES - 3)
    with pytest.raises(SplatpipeError, match="at least one Gaussian"):
        glb.write(Path("never"), Scene(Gaussians.empty(0, 0)))


def test_infinite_figures_are_not_written(tmp_path: Path):
    model = some_gaussians(3)
    model.log_scales[1] = 100.0  # finite, but its exponential is not
    with pytest.raises(SplatpipeError, match="larger than"):
        glb.write(tmp_path / "a.glb", Scene(model))
    model.means[0, 0] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        glb.write(tmp_path / "a.glb", Scene(model))


def foreign(change: Callable[[dict[str, Any]], None] = lambda document: None) -> bytes:
    """Two splats, interleaved, of bytes and shorts, without harmonics, without their own opacity, below two nodes."""
    number = np.dtype(
        [("position", "<f4", 3), ("rotation", "<i2", 4), ("scale", "<u2", 3), ("fill", "<u2"), ("rgba", "u1", 4)]
    )
    rows = np.zeros(2, number)
    rows["position"] = [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
    rows["rotation"] = [[0, 0, 0, 32767], [32767, 0, 0, 0]]
    rows["scale"] = [[65535, 0, 0], [65535 // 5, 65535, 65535]]
    rows["rgba"] = [[255, 0, 51, 255], [0, 255, 0, 51]]

    def accessor(name: str, component: int, kind: str) -> dict[str, Any]:
        offset = number.fields[name][1]
        whole = component != 5126
        return {
            "bufferView": 0,
            "byteOffset": offset,
            "componentType": component,
            "normalized": whole,
            "count": 2,
            "type": kind,
        }

    names = {"POSITION": 0, f"{SPLATTING}:ROTATION": 1, f"{SPLATTING}:SCALE": 2, "COLOR_0": 3}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [SPLATTING],
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1], "translation": [10.0, 0.0, 0.0]},
            {"mesh": 0, "rotation": [0.0, 0.0, 0.5**0.5, 0.5**0.5], "scale": [2.0, 2.0, 2.0]},
        ],
        "meshes": [{"primitives": [{"attributes": names, "mode": 0, "extensions": {SPLATTING: {}}}]}],
        "accessors": [
            accessor("position", 5126, "VEC3"),
            accessor("rotation", 5122, "VEC4"),
            accessor("scale", 5123, "VEC3"),
            accessor("rgba", 5121, "VEC4"),
        ],
        "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": number.itemsize}],
        "buffers": [{"byteLength": rows.nbytes}],
    }
    change(document)
    return packed(document, rows.tobytes())


def read(tmp_path: Path, data: bytes) -> Scene:
    (tmp_path / "file.glb").write_bytes(data)
    return glb.read(tmp_path / "file.glb")


def test_third_party_files_are_read_whatever_their_layout(tmp_path: Path):
    scene = read(tmp_path, foreign())
    assert scene.facts == SceneFacts("y up")
    found = scene.gaussians
    # a quarter turn about z, scaled by two, moved by 10 along x
    np.testing.assert_allclose(found.means.numpy(), [[10.0, 2.0, 0.0], [6.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(torch.exp(found.log_scales).numpy(), [[2.0, 0.0, 0.0], [0.4, 2.0, 2.0]], atol=1e-6)
    half = 0.5**0.5
    np.testing.assert_allclose(found.quats.numpy(), [[half, 0.0, 0.0, half], [0.0, half, half, 0.0]], atol=1e-6)
    assert torch.sigmoid(found.opacity_logits).tolist() == pytest.approx([1.0, 0.2], abs=1e-6)
    colours = 0.5 + 0.28209479177387814 * found.sh[:, 0]
    np.testing.assert_allclose(colours.numpy(), [[1.0, 0.0, 0.2], [0.0, 1.0, 0.0]], atol=1e-6)
    assert found.sh_degree == 0


def test_splats_that_are_drawn_twice_are_read_twice(tmp_path: Path):
    def twice(document: dict[str, Any]) -> None:
        document["nodes"].append({"mesh": 0})
        document["scenes"][0]["nodes"].append(2)

    found = read(tmp_path, foreign(twice)).gaussians
    assert found.means[2:].tolist() == [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]


def test_a_node_far_away_is_an_origin_and_not_rounded(tmp_path: Path):
    def far(document: dict[str, Any]) -> None:
        document["nodes"][0]["translation"] = [388714.001, 515.002, -5299720.003]

    (tmp_path / "a").write_bytes(foreign(far))
    scene = glb.read(tmp_path / "a")
    whole = scene.gaussians.means.double().numpy() + scene.facts.offset
    np.testing.assert_allclose(
        whole, [[388714.001, 517.002, -5299720.003], [388710.001, 515.002, -5299720.003]], atol=1e-6
    )


def test_harmonics_of_the_lower_degree_are_filled_up(tmp_path: Path):
    glb.write(tmp_path / "a", Scene(some_gaussians(4, 2)))
    _, binary = parts((tmp_path / "a").read_bytes())
    document, _ = parts((tmp_path / "a").read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    few = {name: index for name, index in primitive["attributes"].items() if "DEGREE_2" not in name}
    document["meshes"][0]["primitives"].append({**primitive, "attributes": few})
    found = read(tmp_path, packed(document, binary)).gaussians
    assert found.sh_degree == 2 and len(found) == 8
    assert torch.equal(found.sh[:4, :4], found.sh[4:, :4]) and not bool(found.sh[4:, 4:].any())


def at(*path: Any) -> Callable[[dict[str, Any], Any], None]:
    """Put a value into a document, or with ``...`` take it out."""

    def put(document: dict[str, Any], value: Any) -> None:
        for key in path[:-1]:
            document = document[key]
        if value is ...:
            del document[path[-1]]
        else:
            document[path[-1]] = value

    return put


PRIMITIVE = ("meshes", 0, "primitives", 0)
HOSTILE = [
    (at("buffers", 0, "uri"), "../../etc/passwd", "other files"),
    (at("buffers", 0, "uri"), "data:,", "other files"),
    (at("bufferViews", 0, "buffer"), 1, "buffers"),
    (at("bufferViews", 0, "byteLength"), 10**30, "outside"),
    (at("bufferViews", 0, "byteOffset"), -4, "outside"),
    (at("bufferViews", 0, "byteOffset"), 2**63, "outside"),
    (at("bufferViews", 0, "byteLength"), True, "outside"),
    (at("bufferViews", 0, "byteStride"), 4, "rows are not valid"),
    (at("bufferViews", 0, "byteStride"), 0, "stride"),
    (at("bufferViews", 0, "extensions"), {"EXT_meshopt_compression": {}}, "meshopt"),
    (at("bufferViews"), {}, "bufferViews"),
    (at("accessors", 0, "count"), 2**40, "outside"),
    (at("accessors", 0, "count"), 0, "rows are not valid"),
    (at("accessors", 0, "count"), 1.5, "rows are not valid"),
    (at("accessors", 0, "count"), 1, "different lengths"),
    (at("accessors", 0, "byteOffset"), 2**70, "outside"),
    (at("accessors", 0, "bufferView"), ..., "sparse or missing"),
    (at("accessors", 0, "sparse"), {}, "sparse or missing"),
    (at("accessors", 0, "componentType"), 9, "an accessor has the type"),
    (at("accessors", 0, "type"), "MAT4", "an accessor has the type"),
    (at("accessors", 0, "type"), [], "an accessor has the type"),
    (at("accessors", 0), 7, "not an object"),
    (at(*PRIMITIVE, "attributes", "POSITION"), 99, "accessors"),
    (at(*PRIMITIVE, "attributes", "POSITION"), ..., "a splat has no POSITION"),
    (at(*PRIMITIVE, "attributes"), [], "no attributes"),
    (at(*PRIMITIVE, "attributes", f"{SPLATTING}:SH_DEGREE_1_COEF_0"), 0, "not complete"),
    (at(*PRIMITIVE, "extensions", SPLATTING, "kernel"), "cube", "kernel cube"),
    (at(*PRIMITIVE, "extensions", SPLATTING, "colorSpace"), "lin_rec709_display", "colorSpace"),
    (at(*PRIMITIVE, "extensions"), {}, "no splat"),
    (at("meshes"), 3, "meshes"),
    (at("nodes", 1, "children"), [0], "not a tree"),
    (at("nodes", 0, "children"), [1, 1], "not a tree"),
    (at("nodes", 0, "children"), [10**9], "nodes"),
    (at("nodes", 0, "children"), 1, "not a list"),
    (at("nodes", 1, "scale"), [1.0, 2.0, 1.0], "stretches"),
    (at("nodes", 1, "scale"), [-1.0, 1.0, 1.0], "stretches"),
    (at("nodes", 1, "scale"), [0.0, 0.0, 0.0], "stretches"),
    (at("nodes", 1, "rotation"), [0.0, 0.0, 0.0, 0.0], "rotation"),
    (at("nodes", 1, "rotation"), ["a", 0, 0, 0], "not made of numbers"),
    (at("nodes", 1, "translation"), [float("nan"), 0.0, 0.0], "not made of numbers"),
    (at("nodes", 1, "translation"), [10**400, 0.0, 0.0], "not made of numbers"),
    (at("nodes", 1, "matrix"), [1.0] * 15, "not made of numbers"),
    (at("nodes", 1, "matrix"), [0.0] * 16, "stretches"),
    (at("extensionsRequired"), ["KHR_draco_mesh_compression"], "KHR_draco"),
    (at("extensionsRequired"), 5, "which cannot be read"),
    (at("extensionsRequired"), [[1]], "which cannot be read"),
    (at(*PRIMITIVE, "extensions", SPLATTING, "extensions"), {SPZ: {"bufferView": 9}}, "bufferViews"),
    (at(*PRIMITIVE, "extensions", SPLATTING, "extensions"), {SPZ: {"bufferView": 0}}, "SPZ"),
    (at("scenes"), [], "scenes"),
    (at("scene"), "0", "scenes"),
]


@pytest.mark.parametrize(("put", "value", "message"), HOSTILE)
def test_hostile_documents_are_refused(tmp_path: Path, put, value, message):
    with pytest.raises(SplatpipeError, match=message):
        read(tmp_path, foreign(lambda document: put(document, value)))


def test_irrelevant_fields_may_have_any_value(tmp_path: Path):
    def anything(document: dict[str, Any]) -> None:
        document["bufferViews"][0]["extensions"] = 5
        document["meshes"][0]["primitives"] += [7, {"extensions": []}]
        document["asset"] = None

    assert len(read(tmp_path, foreign(anything)).gaussians) == 2


def test_many_splats_of_the_same_few_bytes_are_refused(tmp_path: Path):
    def many(document: dict[str, Any]) -> None:
        document["meshes"][0]["primitives"] *= 1001

    def more_than_there_are(document: dict[str, Any]) -> None:
        document["meshes"][0]["primitives"] *= 3

    for change, message in ((many, "more than 1000"), (more_than_there_are, "more Gaussians than")):
        with pytest.raises(SplatpipeError, match=message):
            read(tmp_path, foreign(change))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cut off"),
        (b'{"asset": {"version": "2.0"}}', "not a GLB"),
        (struct.pack("<4sII", b"glTF", 1, 12), "version 1"),
        (struct.pack("<4sII", b"glTF", 2, 2**32 - 1), "cut off"),
        (struct.pack("<4sIII4s", b"glTF", 2, 20, 2**32 - 1, b"JSON"), "first chunk"),
        (struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0"), "first chunk"),
        (struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"[1] ", "not an object"),
        (struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"\xff\xfe{}", "JSON"),
        (struct.pack("<4sIII4s", b"glTF", 2, 100020, 100000, b"JSON") + b"[" * 100000, "JSON"),
        (struct.pack("<4sIII4s", b"glTF", 2, 5000020, 5000000, b"JSON") + b" " * 5000000, "bytes of JSON"),
        (struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"{}  ", "contains no splat"),
    ],
)
def test_hostile_containers_are_refused(tmp_path: Path, data: bytes, message: str):
    with pytest.raises(SplatpipeError, match=message):
        read(tmp_path, data)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("POSITION", np.nan, "not numbers"),
        ("POSITION", 1e30, "coordinates beyond"),
        (f"{SPLATTING}:SCALE", -1.0, "negative"),
        (f"{SPLATTING}:SCALE", 1e30, "scales as large"),
        (f"{SPLATTING}:SCALE", np.inf, "not numbers"),
        (f"{SPLATTING}:OPACITY", 1.5, "opacities"),
        (f"{SPLATTING}:OPACITY", np.nan, "not numbers"),
        (f"{SPLATTING}:ROTATION", np.nan, "not numbers"),
    ],
)
def test_values_that_are_not_valid_splats_are_refused(
    tmp_path: Path, written: bytes, name: str, value: float, message: str
):
    document, binary = parts(written)
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
    start = len(written) - len(binary) + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    data = bytearray(written)
    data[start + 4 : start + 8] = struct.pack("<f", value)
    with pytest.raises(SplatpipeError, match=message):
        read(tmp_path, bytes(data))


def test_a_record_cannot_say_that_a_glb_is_not_y_up(tmp_path: Path, written: bytes):
    document, binary = parts(written)
    document["asset"]["extras"]["splatpipe"] = FACTS.record()
    assert read(tmp_path, packed(document, binary)).facts == replace(FACTS, axes="y up")
    for extras in (None, [], {"splatpipe": 5}, {"splatpipe": "{"}):
        document["asset"]["extras"] = extras
        assert read(tmp_path, packed(document, binary)).facts == SceneFacts("y up")


def test_mutated_files_are_read_or_refused(tmp_path: Path, written: bytes):
    generator = np.random.default_rng(7)
    document_ends = struct.unpack_from("<I", written, 12)[0] + 28
    for original in (written, foreign()):
        for _ in range(150):
            data = bytearray(original)
            where = generator.integers(0, min(document_ends, len(data)), generator.integers(1, 6))
            for index in where:
                data[index] = generator.integers(0, 256)
            data = data[: generator.integers(1, len(data))] if generator.random() < 0.2 else data
            try:
                read(tmp_path, bytes(data))
            except SplatpipeError as error:
                assert str(tmp_path) in error.message
