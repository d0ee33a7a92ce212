"""3D Tiles: parsed from the specifications of 3D Tiles, glTF and SPZ, the output lies where pyproj puts it."""

import gzip
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import torch
from glb_parts import parts
from some_splats import some_gaussians

from splatpipe.pipeline.delivery.ecef_tiles import write_tiles_on_globe
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.levels.levels import LevelNode, build_levels
from splatpipe.pipeline.splat.levels.tiles import write_tiles
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin, facts_of_record

PLACE = SplatOrigin(52.2, 21.0, 113.25, "ellipsoidal", "EPSG:32634")
FACTS = SceneFacts("z up", True, True, PLACE, ({"step": "crop"},))
BOTH = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
SITE_M = 3000.0
MAX_ERROR_M = 0.6e-3  # half a step of 1/2048 m along each axis, and float32 at 1.5 km


def two_levels(spread: float = 20.0) -> tuple[Scene, LevelNode]:
    """Two leaves below a root that approximates them."""
    fine = some_gaussians(40, spread=spread)
    halves = [fine.select(fine.means[:, 0] < 0.0), fine.select(fine.means[:, 0] >= 0.0)]
    leaves = tuple(LevelNode(box_of(half), 0.0, half, ()) for half in halves)
    root = LevelNode(box_of(fine), 2.5, fine.select(torch.arange(0, 40, 4)), leaves)
    return Scene(fine, FACTS), root


def box_of(gaussians: Gaussians) -> np.ndarray:
    means = gaussians.means.double().numpy()
    return np.stack([means.min(axis=0) - 1.0, means.max(axis=0) + 1.0])


def tileset(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "tileset.json").read_text())
    return found


def tiles(tile: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield tile
    for child in tile.get("children", []):
        yield from tiles(child)


def corners(tile: dict[str, Any]) -> np.ndarray:
    centre, axes = np.array(tile["boundingVolume"]["box"][:3]), np.array(tile["boundingVolume"]["box"][3:])
    half = axes.reshape(3, 3).sum(axis=0)
    assert np.count_nonzero(axes.reshape(3, 3) - np.diag(half)) == 0
    return np.stack([centre - half, centre + half])


def local_means(path: Path) -> np.ndarray:
    """Return positions of a tile's SPZ file, placed by the glTF's node, rotated from y up to z up as in 3D Tiles."""
    document, binary = parts(path.read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]
    spz = primitive["extensions"][BOTH[0]]["extensions"][BOTH[1]]
    raw = gzip.decompress(binary[: document["bufferViews"][spz["bufferView"]]["byteLength"]])
    magic, version, count, degree, bits = struct.unpack_from("<IIIBB", raw)
    assert (magic, version) == (0x5053474E, 2)
    assert {accessor["count"] for accessor in document["accessors"]} == {count}
    harmonics = [name for name in primitive["attributes"] if "SH_DEGREE" in name]
    assert len(harmonics) == (degree + 1) ** 2 - 1
    triples = np.frombuffer(raw, np.uint8, 9 * count, 16).reshape(count, 3, 3).astype(np.int64)
    whole = triples[..., 0] | triples[..., 1] << 8 | triples[..., 2] << 16
    about = np.where(whole >= 1 << 23, whole - (1 << 24), whole) / 2.0**bits
    (node,) = (document["nodes"][index] for index in document["scenes"][document["scene"]]["nodes"])
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    np.testing.assert_array_equal(matrix[:3, :3], np.eye(3))
    x, y, z = (about + matrix[:3, 3]).T
    return np.stack([x, -z, y], axis=1)


def apart(found: np.ndarray, expected: np.ndarray | torch.Tensor) -> float:
    """Largest distance from a point of either set to the nearest of the other: files may hold them in any order."""
    between = np.linalg.norm(found[:, None] - np.asarray(expected, np.float64)[None], axis=2)
    return float(max(between.min(axis=0).max(), between.min(axis=1).max()))


def test_the_tree_has_the_levels_and_only_its_root_is_georeferenced(tmp_path: Path):
    scene, root = two_levels()
    matrix = np.arange(16.0).reshape(4, 4)
    write_tiles(tmp_path, scene, root, matrix)
    root_file = tileset(tmp_path)
    assert root_file["asset"]["version"] == "1.1"
    assert facts_of_record(root_file["asset"]["extras"]["splatpipe"], SceneFacts()) == FACTS
    assert root_file["extensionsUsed"] == ["3DTILES_content_gltf"]
    assert root_file["extensions"]["3DTILES_content_gltf"] == {"extensionsUsed": BOTH, "extensionsRequired": BOTH}
    assert root_file["root"]["transform"] == matrix.T.ravel().tolist()
    assert all("transform" not in tile for tile in tiles(root_file["root"]) if tile is not root_file["root"])
    assert all("extensions" not in tile and tile["refine"] == "REPLACE" for tile in tiles(root_file["root"]))
    assert [tile["geometricError"] for tile in tiles(root_file["root"])] == [2.5, 0.0, 0.0]
    assert root_file["geometricError"] >= 2.5
    for node, tile in zip(root.nodes(), tiles(root_file["root"]), strict=True):
        document, _ = parts((tmp_path / tile["content"]["uri"]).read_bytes())
        assert document["extensionsRequired"] == BOTH and document["extensionsUsed"] == BOTH
        box = corners(tile)
        assert (box[0] <= node.box[0]).all() and (box[1] >= node.box[1]).all()
        np.testing.assert_allclose(box, node.box, atol=0.002)
        assert apart(local_means(tmp_path / tile["content"]["uri"]), node.gaussians.means) < MAX_ERROR_M


def test_our_own_reader_finds_each_nodes_gaussians_within_the_files_steps(tmp_path: Path):
    scene, root = two_levels()
    for node in root.nodes():
        node.gaussians.sh.mul_(0.5)  # SPZ holds harmonics within ±1
    write_tiles(tmp_path, scene, root, np.eye(4))
    for node, tile in zip(root.nodes(), tiles(tileset(tmp_path)["root"]), strict=True):
        read = read_scene(tmp_path / tile["content"]["uri"])
        assert read.facts.axes == "y up"
        made = Scene(node.gaussians, FACTS).turned("y up").gaussians
        between = torch.cdist(read.gaussians.means.double(), made.means.double())
        order = between.argmin(dim=0)  # a file's order is its own
        assert sorted(order.tolist()) == list(range(len(made)))
        found = read.gaussians.select(order)
        assert float(between.min(dim=0).values.max()) < MAX_ERROR_M
        assert float((found.log_scales - made.log_scales).abs().max()) < 0.5 / 16 + 1e-5
        assert float((found.opacity_logits.sigmoid() - made.opacity_logits.sigmoid()).abs().max()) < 0.5 / 255 + 1e-5
        assert float((found.sh[:, 0] - made.sh[:, 0]).abs().max()) < 0.5 / 255 / 0.15 + 1e-5
        signed = torch.nn.functional.normalize(made.quats, dim=1) * torch.where(made.quats[:, :1] < 0.0, -1.0, 1.0)
        within = 0.5 / 127.5 * (1.0 + 3.0**0.5)  # and where three bytes are longer than 1, they are made shorter
        assert float((found.quats[:, 1:] - signed[:, 1:]).abs().max()) < within + 1e-5
        whole = (found.sh[:, 1:] * 128.0).round().to(torch.int64).flatten(1).numpy()
        step = np.gcd.reduce(whole, axis=1) / 128.0  # a Gaussian's harmonics are multiples of one step
        off = (found.sh[:, 1:] - made.sh[:, 1:]).abs().flatten(1).amax(dim=1).numpy()
        assert (off <= step / 2.0 + 1e-5)[step > 0.0].all() and (off < 0.25 + 1e-5).all()


def test_tiles_of_an_earlier_tileset_are_removed_and_other_files_kept(tmp_path: Path):
    scene, root = two_levels()
    write_tiles(tmp_path, scene, root, np.eye(4))
    (tmp_path / "tiles/own.glb").write_bytes(b"mine")
    (tmp_path / "notes.txt").write_text("mine")
    write_tiles(tmp_path, scene, LevelNode(root.box, 0.0, scene.gaussians, ()), np.eye(4))
    files = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file())
    assert files == ["notes.txt", "tiles/0.glb", "tiles/own.glb", "tileset.json"]


def test_attributes_are_those_that_cesium_reads(tmp_path: Path):
    scene, root = two_levels()
    write_tiles(tmp_path, scene, root, np.eye(4))
    document, _ = parts((tmp_path / "tiles/0.glb").read_bytes())
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    accessors = {name: document["accessors"][index] for name, index in attributes.items()}
    assert not any("bufferView" in accessor for accessor in accessors.values())
    assert (accessors["COLOR_0"]["componentType"], accessors["COLOR_0"]["type"]) == (5121, "VEC4")
    assert not {f"{BOTH[0]}:OPACITY", f"{BOTH[0]}:SH_DEGREE_0_COEF_0"} & attributes.keys()
    x, y, z = root.gaussians.means.double().T
    middle = np.array(document["nodes"][0]["matrix"][12:15])
    low = np.array([x.min(), z.min(), (-y).min()]) - middle
    np.testing.assert_allclose(accessors["POSITION"]["min"], low, atol=1e-4)


def test_a_site_of_three_kilometres_keeps_its_millimetres(tmp_path: Path):
    gaussians = some_gaussians(3000, 0)
    gaussians.means = SITE_M * (torch.rand(3000, 3, generator=torch.Generator().manual_seed(3)) - 0.5)
    root = build_levels(gaussians, 200)
    write_tiles(tmp_path, Scene(gaussians, FACTS), root, np.eye(4))
    for node, tile in zip(root.nodes(), tiles(tileset(tmp_path)["root"]), strict=True):
        assert apart(local_means(tmp_path / tile["content"]["uri"]), node.gaussians.means) < MAX_ERROR_M


def test_points_lie_on_the_earth_where_pyproj_says(tmp_path: Path):
    scene, root = two_levels()
    placement = write_tiles_on_globe(tmp_path, scene, root)
    assert not placement.approximate
    root_file = tileset(tmp_path)
    matrix = np.array(root_file["root"]["transform"]).reshape(4, 4).T
    (leaf,) = (tile for tile in tiles(root_file["root"]) if tile.get("content", {}).get("uri") == "tiles/1.glb")
    local = local_means(tmp_path / leaf["content"]["uri"])
    ecef = local @ matrix[:3, :3].T + matrix[:3, 3]
    there = f"+lat_0={PLACE.latitude} +lon_0={PLACE.longitude} +h_0={PLACE.height_m}"
    topocentric = pyproj.Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 {there} +inv")
    expected = np.stack(topocentric.transform(*root.children[0].gaussians.means.double().numpy().T), axis=1)
    assert apart(ecef, expected) < 1e-3


def test_files_give_esri_programs_the_crs_and_its_transformation(tmp_path: Path):
    scene, root = two_levels()
    write_tiles_on_globe(tmp_path, scene, root)
    root_file = tileset(tmp_path)
    assert root_file["extensions"]["ESRI_crs"] == {"wkid": 32634, "vcsWkid": 115700}
    assert "ESRI_crs" in root_file["extensionsUsed"] and "extensionsRequired" not in root_file
    every = [tile["extensions"]["ESRI_crs"] for tile in tiles(root_file["root"])]
    assert ["transform" in each for each in every] == [True, False, False]
    assert [each["boundingVolume"] for each in every] == [tile["boundingVolume"] for tile in tiles(root_file["root"])]
    matrix = np.array(every[0]["transform"]).reshape(4, 4).T
    local = root.gaussians.means.double().numpy()
    there = f"+lat_0={PLACE.latitude} +lon_0={PLACE.longitude} +h_0={PLACE.height_m}"
    ecef = pyproj.Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 {there} +inv").transform(*local.T)
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef)
    easting, northing = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32634", always_xy=True).transform(*geodetic[:2])
    expected = np.stack([easting, northing, geodetic[2]], axis=1)
    assert np.abs(local @ matrix[:3, :3].T + matrix[:3, 3] - expected).max() < 0.002


@pytest.mark.parametrize(
    ("place", "said"),
    [
        (replace(PLACE, crs="EPSG:4326"), None),
        (replace(PLACE, vertical_datum="unknown"), {"wkid": 32634}),
        (replace(PLACE, crs=""), {"wkid": 32634, "vcsWkid": 115700}),
    ],
)
def test_only_known_facts_of_a_crs_are_written(tmp_path: Path, place: SplatOrigin, said: dict[str, int] | None):
    scene, root = two_levels()
    placement = write_tiles_on_globe(tmp_path, replace(scene, facts=replace(FACTS, place=place)), root)
    assert tileset(tmp_path)["extensions"].get("ESRI_crs") == said
    assert placement.approximate == (place.vertical_datum == "unknown")


def test_a_crs_without_a_code_is_written_as_its_definition(tmp_path: Path):
    scene, root = two_levels()
    own = "+proj=tmerc +lat_0=52 +lon_0=21 +k=1 +x_0=5000 +y_0=2000 +ellps=GRS80 +units=m"
    write_tiles_on_globe(tmp_path, replace(scene, facts=replace(FACTS, place=replace(PLACE, crs=own))), root)
    root_file = tileset(tmp_path)["extensions"]["ESRI_crs"]
    assert "wkid" not in root_file
    assert pyproj.CRS.from_wkt(root_file["wkt2"]).is_projected


def test_tiles_of_a_splat_without_georeference_are_refused(tmp_path: Path):
    scene, root = two_levels()
    nowhere = replace(scene, facts=replace(FACTS, place=None))
    with pytest.raises(SplatpipeError, match="need a georeferenced splat") as caught:
        write_tiles(tmp_path, nowhere, root, np.eye(4))
    assert "Georeference" in caught.value.hint
    with pytest.raises(SplatpipeError, match="need a georeferenced splat"):
        write_tiles_on_globe(tmp_path, nowhere, root)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("axes", ["y up", "y down"])
def test_tiles_are_the_same_whatever_the_axes_of_the_scene(tmp_path: Path, axes):
    scene, _ = two_levels()
    turned = scene.turned(axes)
    for name, each in (("a", scene), ("b", turned)):
        write_tiles(tmp_path / name, each, LevelNode(box_of(each.gaussians), 0.0, each.gaussians, ()), np.eye(4))
    assert apart(*(local_means(tmp_path / name / "tiles/0.glb") for name in "ab")) < 1e-3
    first, second = (tileset(tmp_path / name)["root"]["boundingVolume"]["box"] for name in "ab")
    np.testing.assert_allclose(first, second, atol=0.002)


def test_the_same_levels_give_the_same_bytes_and_empty_nodes_no_tile(tmp_path: Path):
    scene, root = two_levels()
    empty = LevelNode(root.box, 9.0, scene.gaussians.first(0), (root,))
    for name in ("a", "b"):
        write_tiles(tmp_path / name, scene, empty, np.eye(4))
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert [str(path) for path in files] == ["tiles/1.glb", "tiles/2.glb", "tiles/3.glb", "tileset.json"]
    assert all((tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes() for path in files)
    assert "content" not in tileset(tmp_path / "a")["root"]
