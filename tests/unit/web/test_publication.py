"""Surface products for the web: written once each, and what the viewer shows of them."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import tiny_scene
from hills import hill_grid, placed, write_hill
from made_mesh import made_site, site_height
from pydantic import ValidationError

from splatpipe.pipeline.surface.levels.thinned_cloud import thinned_cloud
from splatpipe.pipeline.surface.rasters.geotiff import COLOURS, raster_file
from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk, CloudFrame, write_cloud
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.web import viewer_surfaces
from splatpipe.pipeline.web.options import SURFACE_FORMATS, PublishConfig, parse_any_formats
from splatpipe.pipeline.web.publication import RunProducts, write_publication, write_viewer_surfaces

SITE_M = 20.0
POINTS = 3000


@pytest.fixture(scope="module")
def products(tmp_path_factory: pytest.TempPathFactory) -> RunProducts:
    folder, grid = tmp_path_factory.mktemp("products"), hill_grid(gsd_m=0.5)
    write_hill(folder / "dsm.tif", grid)
    with raster_file(folder / "ortho.tif", grid, COLOURS) as file:
        for tile in grid.tiles():
            file.write(tile, np.full((4, tile.height, tile.width), 200, np.uint8))
    random = np.random.default_rng(0)
    plan = random.uniform(-SITE_M / 2.0, SITE_M / 2.0, (POINTS, 2))
    positions = np.column_stack([plan, site_height(plan, SITE_M)])
    colours = random.integers(0, 256, (POINTS, 3), np.uint8)
    chunk = CloudChunk(positions, colours, np.zeros((POINTS, 3), np.float32), np.ones(POINTS, np.uint8))
    write_cloud(folder / "cloud.laz", [chunk], CloudFrame.of_grid(grid))
    mesh = made_site(folder / "made", 50, 256, SITE_M)
    return RunProducts(placed(), folder / "cloud.laz", folder / "ortho.tif", folder / "dsm.tif", mesh)


def test_every_format_is_written_and_a_second_call_writes_nothing(products: RunProducts, tmp_path: Path) -> None:
    report = tiny_scene.Recorder()
    made = write_publication(SURFACE_FORMATS, products, tmp_path / "export", tmp_path / "work", report)
    names = sorted(path.name for path in (tmp_path / "export").iterdir())
    assert names == ["cloud.copc.laz", "dsm.mbtiles", "mesh-tiles", "ortho.mbtiles"] and list(made) == [
        *SURFACE_FORMATS
    ]
    assert not (tmp_path / "work").exists() and all(each["bytes"] > 1000 for each in made.values())
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "export").rglob("*")}
    again = write_publication(SURFACE_FORMATS, products, tmp_path / "export", tmp_path / "work", report)
    assert again == made and before == {path: path.stat().st_mtime_ns for path in (tmp_path / "export").rglob("*")}


def test_half_a_tileset_of_a_killed_run_is_removed(products: RunProducts, tmp_path: Path) -> None:
    left = tmp_path / "export/.mesh-tiles.1.abc.new/tiles"
    left.mkdir(parents=True)
    (left / "0-0-0.glb").write_text("half")
    write_publication(("mesh-tiles",), products, tmp_path / "export", tmp_path / "work", tiny_scene.Recorder())
    assert [path.name for path in (tmp_path / "export").iterdir()] == ["mesh-tiles"]


def test_what_the_run_does_not_have_is_left_out_and_told(products: RunProducts, tmp_path: Path) -> None:
    nothing = RunProducts(placed(), *[tmp_path / name for name in ("a.laz", "b.tif", "c.tif")], None)
    report = tiny_scene.Recorder()
    assert write_publication(SURFACE_FORMATS, nothing, tmp_path / "export", tmp_path / "work", report) == {}
    assert [re.match(r"[\w-]+", text).group() for text in report.warnings] == [*SURFACE_FORMATS]
    assert write_viewer_surfaces(nothing, tmp_path / "surfaces.json", tmp_path / "work", report) == []
    assert not (tmp_path / "surfaces.json").exists()
    only_dsm = replace(products, ortho=tmp_path / "none.tif")
    write_publication(("mbtiles",), only_dsm, tmp_path / "maps", tmp_path / "work", report)
    assert [path.name for path in (tmp_path / "maps").iterdir()] == ["dsm.mbtiles"]


def test_a_run_without_a_place_has_points_but_no_maps(products: RunProducts, tmp_path: Path) -> None:
    local = replace(products, frame=Frame("arbitrary", placed().world_from_model, metres=True))
    report = tiny_scene.Recorder()
    made = write_publication(SURFACE_FORMATS, local, tmp_path / "export", tmp_path / "work", report)
    assert list(made) == ["copc"] and len(report.warnings) == 2


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_the_viewer_gets_points_and_mesh_in_the_runs_frame(
    products: RunProducts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_surfaces, "MOST_TRIANGLES", 1500)
    monkeypatch.setattr(viewer_surfaces, "MOST_POINTS", 1000)
    path = tmp_path / "surfaces.json"
    shown = write_viewer_surfaces(products, path, tmp_path / "work", tiny_scene.Recorder())
    assert shown == ["mesh", "points"] and not (tmp_path / "work").exists()
    found, stamp = json.loads(path.read_text()), path.stat().st_mtime_ns
    assert write_viewer_surfaces(products, path, tmp_path / "work", tiny_scene.Recorder()) == shown
    assert path.stat().st_mtime_ns == stamp  # a killed run goes on behind it
    for data, least, most in ((found["points"], 400, 1000), (found["mesh"], 500, 2000)):
        places = numbers(data["xyz"], "<u2").reshape(-1, 3) * data["step"] + np.array(data["low"])
        assert least < len(places) <= most
        off = np.abs(places[:, 2] - site_height(places[:, :2], SITE_M))
        assert np.quantile(off, 0.9) < 0.01 and np.abs(places[:, :2]).max() < SITE_M / 2.0 + 0.01
    assert len(numbers(found["points"]["rgb"], "u1")) == len(numbers(found["points"]["xyz"], "<u2"))
    corners = len(numbers(found["mesh"]["xyz"], "<u2")) // 3
    indices = numbers(found["mesh"]["indices"], "<u4")
    assert 3 * 1400 < len(indices) <= 3 * 1500 and indices.max() == corners - 1
    assert len(numbers(found["mesh"]["uv"], "<u2")) == 2 * corners
    assert found["mesh"]["texture"].startswith("data:image/jpeg;base64,/9j/")


def test_thinning_is_even_and_keeps_colours(products: RunProducts) -> None:
    cloud, every = thinned_cloud(products.cloud, 500), laspy.read(products.cloud)
    assert 150 < len(cloud.coordinates) <= 500
    known = {tuple(place): tuple(colour) for place, colour in zip(every.xyz.tolist(), colours_of(every), strict=True)}
    assert all(
        known[tuple(p)] == tuple(c) for p, c in zip(cloud.coordinates.tolist(), cloud.colours.tolist(), strict=True)
    )
    low = every.header.mins[:2]
    cells = np.unique(np.floor((cloud.coordinates[:, :2] - low) / (SITE_M / 10.0)), axis=0)
    assert len(cells) >= 100  # of 100, none is empty


def colours_of(cloud: laspy.LasData) -> list[list[int]]:
    return (np.stack([cloud.red, cloud.green, cloud.blue], axis=1) // 257).tolist()


def test_formats_are_checked_before_anything_starts() -> None:
    assert PublishConfig(formats=" copc,mesh-tiles ").formats == "mesh-tiles,copc"
    with pytest.raises(ValidationError, match="there is no format"):
        PublishConfig(formats="spz")
    assert parse_any_formats("copc,spz") == ("spz", "copc")
