"""Maps for phones: MBTiles at their place, read back by GDAL."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from hills import IDENTITY, box, hill_grid, placed, write_hill
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.levels.map_tiles import halved, write_ortho_tiles, write_relief_tiles
from splatpipe.pipeline.surface.levels.web_mercator import MapTile, geodetic_from_pixels, pixel_m, pixels_from_geodetic
from splatpipe.pipeline.surface.rasters.geotiff import COLOURS, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

GSD_M = 0.07
SHIFT_PX = 0.15  # of the orthophoto: GDAL's own transformation and two interpolations lie between


def write_ortho(path: Path, grid: Grid) -> None:
    """Write soft spots of all sizes, and nothing in the north-east."""
    random = np.random.default_rng(5)
    whole = sum(cv2.resize(random.normal(size=(n, n, 3)), (grid.width, grid.height)) for n in (12, 50, 110))
    whole = np.clip(128.0 + 40.0 * whole, 0.0, 255.0).astype(np.uint8)
    alpha = np.full((grid.height, grid.width), 255, np.uint8)
    alpha[: grid.height // 3, grid.width // 2 :] = 0
    with raster_file(path, grid, COLOURS) as file:
        for tile in grid.tiles():
            rows, columns = tile.slices
            file.write(tile, np.dstack([whole, alpha])[rows, columns].transpose(2, 0, 1))


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, grid = tmp_path_factory.mktemp("maps"), hill_grid(gsd_m=GSD_M)
    write_ortho(folder / "ortho.tif", grid)
    write_hill(folder / "dsm.tif", grid)
    seen: list[tuple[int, int]] = []
    write_ortho_tiles(folder / "ortho.tif", folder / "ortho.mbtiles", placed(), lambda *done: seen.append(done))
    assert seen[-1][0] == seen[-1][1] == len(seen)
    write_relief_tiles(folder / "dsm.tif", folder / "dsm.mbtiles", placed(), lambda done, total: None)
    return folder


def back_in(path: Path, like: Path) -> np.ndarray:
    """Return the bands of a map as GDAL sees it on another raster's grid."""
    with rasterio.open(like) as grid, rasterio.open(path, driver="MBTiles") as found:
        shape = {"transform": grid.transform, "width": grid.width, "height": grid.height, "crs": grid.crs}
        with WarpedVRT(found, resampling=Resampling.bilinear, **shape) as warped:
            return np.asarray(warped.read())


def shift_px(one: np.ndarray, other: np.ndarray) -> float:
    """Return how far two images are apart, in their southern half."""
    a, b = (np.float32(each[each.shape[0] // 2 :]) for each in (one, other))
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
    none, _ = cv2.phaseCorrelate(a, a, window)  # half a pixel for images of odd size
    found, likeness = cv2.phaseCorrelate(a, b, window)
    assert likeness > 0.5
    return float(np.hypot(*np.subtract(found, none)))


def test_the_orthophoto_lies_where_gdal_has_it(maps: Path) -> None:
    back = back_in(maps / "ortho.mbtiles", maps / "ortho.tif")
    with rasterio.open(maps / "ortho.tif") as raster:
        bands = raster.read()
    both = (bands[3] == 255) & (back[3] == 255)
    assert both.sum() > 0.97 * (bands[3] == 255).sum()
    assert (back[3][bands[3] == 0] > 0).mean() < 0.02  # a pixel at its edges
    assert shift_px(bands[1], back[1]) < SHIFT_PX
    error = np.float32(bands[:3])[:, both] - np.float32(back[:3])[:, both]
    assert np.sqrt((error**2).mean()) < 6.0


def test_the_surface_model_is_shaded_and_its_hole_is_empty(maps: Path) -> None:
    back = back_in(maps / "dsm.mbtiles", maps / "dsm.tif")
    with rasterio.open(maps / "dsm.tif") as raster:
        height, known = raster.read(1), raster.read_masks(1) > 0
    edge = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}
    inner, outer = (cv2.erode(each.astype(np.uint8), np.ones((7, 7)), **edge) > 0 for each in (known, ~known))
    assert (back[3][inner] == 255).all() and (back[3][outer] == 0).all()
    green = back[1].astype(float)
    assert green[inner & (height > 109.0)].mean() > green[inner & (height < 104.0)].mean() + 60.0  # viridis


def test_zooms_follow_the_pixel_and_each_has_the_whole(maps: Path) -> None:
    with sqlite3.connect(maps / "ortho.mbtiles") as database:
        facts = dict(database.execute("SELECT name, value FROM metadata"))
        counts = dict(database.execute("SELECT zoom_level, count(*) FROM tiles GROUP BY zoom_level"))
        tiles = [row[0] for row in database.execute("SELECT tile_data FROM tiles")]
    database.close()
    low, high = int(facts["minzoom"]), int(facts["maxzoom"])
    assert sorted(counts) == list(range(low, high + 1)) and high - low >= 2
    assert GSD_M / 1.7 < pixel_m(high, 52.2) < 1.19 * GSD_M
    west, south, east, north = (float(value) for value in facts["bounds"].split(","))
    assert west < 9.97 < east and south < 52.2 < north
    kinds = {data[:2] for data in tiles}
    assert kinds == {b"\xff\xd8", b"\x89P"}  # JPEG where opaque, PNG where not
    whole = cv2.imdecode(np.frombuffer(tiles[-1], np.uint8), cv2.IMREAD_UNCHANGED)
    assert whole.shape[:2] == (256, 256)


def test_the_same_raster_gives_the_same_bytes(maps: Path, tmp_path: Path) -> None:
    write_ortho_tiles(maps / "ortho.tif", tmp_path / "ortho.mbtiles", placed(), lambda done, total: None)
    assert (tmp_path / "ortho.mbtiles").read_bytes() == (maps / "ortho.mbtiles").read_bytes()


def test_feet_and_another_datum_are_no_obstacle(tmp_path: Path) -> None:
    frame = replace(placed("EPSG:2263", "ellipsoidal", Origin(40.7, -74.0, 10.0)), approximate_crs=True)
    grid = make_grid(frame, box(20.0, 15.0), GSD_M)
    write_ortho(tmp_path / "ortho.tif", grid)
    made = write_ortho_tiles(tmp_path / "ortho.tif", tmp_path / "ortho.mbtiles", frame, lambda done, total: None)
    assert GSD_M / 1.7 < pixel_m(made["max_zoom"], 40.7) < 1.19 * GSD_M
    back = back_in(tmp_path / "ortho.mbtiles", tmp_path / "ortho.tif")
    with rasterio.open(tmp_path / "ortho.tif") as raster:
        assert shift_px(raster.read(2), back[1]) < SHIFT_PX


def test_what_is_nowhere_or_no_raster_is_refused(maps: Path, tmp_path: Path) -> None:
    nowhere = Frame("arbitrary", IDENTITY, metres=True)
    with pytest.raises(SplatpipeError, match="georeferenced"):
        write_ortho_tiles(maps / "ortho.tif", tmp_path / "a.mbtiles", nowhere, lambda done, total: None)
    (tmp_path / "ortho.tif").write_text("<VRTDataset/>")
    with pytest.raises(SplatpipeError, match="cannot be read"):
        write_ortho_tiles(tmp_path / "ortho.tif", tmp_path / "a.mbtiles", placed(), lambda done, total: None)
    assert not (tmp_path / "a.mbtiles").exists()


def test_pixels_of_the_map_are_web_mercators() -> None:
    corners = geodetic_from_pixels(np.array([[0.0, 0.0], [128.0, 128.0], [256.0, 256.0]]), 0, 7.0)
    np.testing.assert_allclose(corners[:, 1], [-180.0, 0.0, 180.0])
    np.testing.assert_allclose(corners[:, 0], [85.0511287798, 0.0, -85.0511287798], atol=1e-9)
    places = np.array([[47.8, 13.5, 500.0], [-33.9, 151.2, 500.0]])
    np.testing.assert_allclose(geodetic_from_pixels(pixels_from_geodetic(places, 21), 21, 500.0), places, atol=1e-10)
    assert MapTile(3, 4, 5).children()[3] == MapTile(4, 9, 11)


def test_halving_weighs_colours_by_their_alpha() -> None:
    picture = np.zeros((2, 2, 4), np.uint8)
    picture[0, 0] = [200, 100, 50, 255]
    picture[1, 1] = [100, 200, 50, 255]
    np.testing.assert_array_equal(halved(picture), [[[150, 150, 50, 128]]])
