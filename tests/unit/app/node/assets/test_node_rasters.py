"""Maps and clouds on their way to WebODM: only what opens is packed; the orthophoto as a picture."""

import sqlite3
from contextlib import closing
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from hills import hill_grid, placed, write_hill
from PIL import Image

from splatpipe.pipeline.app.node.assets import rasters
from splatpipe.pipeline.app.node.assets.clouds import UnusableCloud, check_cloud
from splatpipe.pipeline.app.node.assets.rasters import UnusableRaster, check_map_tiles, check_raster, write_picture
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.levels.map_tiles import write_ortho_tiles
from splatpipe.pipeline.surface.rasters.geotiff import COLOURS, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.survey.crs.frames import Frame


def write_ortho(path: Path, grid: Grid) -> None:
    """Write red in the west, green in the east, and nothing in the north."""
    with raster_file(path, grid, COLOURS) as file:
        for tile in grid.tiles():
            rows, columns = tile.slices
            values = np.zeros((4, tile.height, tile.width), np.uint8)
            east = np.arange(grid.width)[columns] >= grid.width // 2
            values[0], values[1] = np.where(east, 0, 200), np.where(east, 200, 0)
            values[3] = 255 * (np.arange(grid.height)[rows, None] >= grid.height // 4)
            file.write(tile, values)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("maps")
    write_hill(made / "dsm.tif", hill_grid())
    write_ortho(made / "ortho.tif", hill_grid())
    write_hill(made / "nowhere.tif", hill_grid(Frame("arbitrary", Similarity.identity(), metres=True)))
    return made


def test_maps_of_ours_are_packed(folder: Path) -> None:
    check_raster(folder / "dsm.tif", colours=False)
    check_raster(folder / "ortho.tif", colours=True)


def test_a_map_without_a_place_on_the_earth_is_not(folder: Path) -> None:
    with pytest.raises(UnusableRaster, match="no place on the earth"):
        check_raster(folder / "nowhere.tif", colours=False)


def test_heights_are_no_orthophoto(folder: Path) -> None:
    with pytest.raises(UnusableRaster, match="RGBA"):
        check_raster(folder / "dsm.tif", colours=True)


def test_a_broken_map_is_not_packed(folder: Path, tmp_path: Path) -> None:
    data = (folder / "dsm.tif").read_bytes()
    for name, content in {"cut": data[: len(data) // 2], "empty": b"", "text": b"<VRTDataset/>"}.items():
        path = tmp_path / f"{name}.tif"
        path.write_bytes(content)
        with pytest.raises(UnusableRaster, match="cannot be read"):
            check_raster(path, colours=False)


def test_the_picture_has_the_orthophotos_colours_and_transparency(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with rasterio.open(folder / "ortho.tif") as raster:
        whole = raster.read().transpose(1, 2, 0)
    assert write_picture(folder / "ortho.tif", tmp_path / "whole.png") == whole.shape[1::-1]
    assert (np.asarray(Image.open(tmp_path / "whole.png")) == whole).all()
    monkeypatch.setattr(rasters, "MAX_PICTURE_PIXELS", 20_000)
    monkeypatch.setattr(rasters, "STRIP_ROWS", 16)
    width, height = write_picture(folder / "ortho.tif", tmp_path / "small.png")
    small = np.asarray(Image.open(tmp_path / "small.png"))
    assert small.shape == (height, width, 4) and 15_000 < width * height <= 20_000
    assert small[height // 2, width // 4].tolist() == [200, 0, 0, 255] and small[0, 0, 3] == 0
    assert small[-1, -width // 4].tolist() == [0, 200, 0, 255]
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".tif"] == []


def test_a_compound_crs_is_on_the_earth(tmp_path: Path) -> None:
    write_hill(tmp_path / "dsm.tif", hill_grid(placed("EPSG:25832+7837")))
    check_raster(tmp_path / "dsm.tif", colours=False)


def test_map_tiles_are_opened(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "ortho.mbtiles"
    write_ortho_tiles(folder / "ortho.tif", path, placed(), lambda done, total: None)
    check_map_tiles(path)
    with closing(sqlite3.connect(path)) as tiles, tiles:
        tiles.execute("DELETE FROM tiles")
    with pytest.raises(UnusableRaster, match="no tiles"):
        check_map_tiles(path)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(UnusableRaster, match="cannot be read"):
        check_map_tiles(path)


def test_clouds_are_opened(tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [5e5, 5e6, 0.0]
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (np.arange(5000) * 0.01 + start for start in (5e5, 5e6, 100.0))
    cloud.write(path)
    facts = check_cloud(path)
    assert facts.count == 5000 and facts.box[:, 2] == pytest.approx([100.0, 149.99])
    whole = path.read_bytes()
    for data in (b"", whole[:100], whole[:500], whole[:375] + b"\xff" * 200, b"LASF" + b"\xff" * 1000):
        path.write_bytes(data)
        with pytest.raises(UnusableCloud):
            check_cloud(path)
