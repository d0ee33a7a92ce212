"""GeoTIFFs: Cloud Optimized, with the values and georeference written, read by rasterio, Pillow and pyproj."""

import os
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from hills import IDENTITY, box, from_middle, hill, hill_grid, placed, write_hill
from PIL import Image
from rasterio.enums import ColorInterp, MaskFlags
from rio_cogeo.cogeo import cog_info, cog_validate

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.heights.surface_file import open_surface
from splatpipe.pipeline.surface.rasters.geotiff import (
    COLOURS,
    COLOURS_AS_JPEG,
    CONFIDENCE,
    HEIGHTS,
    NODATA_HEIGHT,
    RasterForm,
    raster_file,
)
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.survey.crs.frames import Frame

STEP_M = 0.5 / 1024.0  # half of a height's step
RINGING = 10  # largest error by JPEG beside the black outside, of a value of 90
FORMS = {"heights": HEIGHTS, "confidence": CONFIDENCE, "colours": COLOURS, "jpeg": COLOURS_AS_JPEG}
EXTRA_SAMPLES, UNASSOCIATED_ALPHA = 338, 2  # TIFF 6.0's tag and value


def write_colours(path: Path, grid: Grid, form: RasterForm) -> np.ndarray:
    """Gradients, without data where column + row is below a number; what was written."""
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width]
    seen = columns + rows >= 150
    bands = [columns % 256, rows % 256, (columns + rows) // 4 % 256, np.full(seen.shape, 255)]
    values = (np.stack(bands) * seen).astype(np.uint8)
    with raster_file(path, grid, form) as file:
        for t in grid.tiles(200):
            file.write(t, values[:, t.row : t.row + t.height, t.column : t.column + t.width])
    return values


def test_heights_are_read_back_where_they_were_written(tmp_path: Path) -> None:
    grid = hill_grid(gsd_m=0.05)
    path = tmp_path / "dsm.tif"
    write_hill(path, grid)
    assert cog_validate(path, strict=True) == (True, [], [])
    with rasterio.open(path) as raster:
        heights = raster.read(1, masked=True)
        assert raster.transform == grid.transform and raster.tags()["AREA_OR_POINT"] == "Area"
        assert raster.nodata == NODATA_HEIGHT and raster.dtypes == ("float32",)
        assert raster.units == ("metre",) and raster.descriptions == ("height",)
        assert raster.tags()["VERTICAL_DATUM"] == "EPSG:7837 (DHHN2016 height), metre"
        assert raster.overviews(1) == [2]
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    x, y = from_middle(grid, columns, rows)
    inside = (np.abs(x - 8.0) < 2.0) & (np.abs(y) < 2.0)
    assert (heights.mask == inside).all()
    assert float(np.abs(heights - hill(x, y)).max()) < STEP_M + 1e-5  # and float32's own at 100 m
    assert list(tmp_path.iterdir()) == [path]


def test_overviews_average_valid_cells_only(tmp_path: Path) -> None:
    path = tmp_path / "dsm.tif"
    write_hill(path, hill_grid(gsd_m=0.05))
    with rasterio.open(path, overview_level=0) as raster:
        heights = raster.read(1, masked=True)
    assert heights.mask.any() and float(heights.min()) > 102.0 and float(heights.max()) < 112.0


@pytest.mark.parametrize(
    "crs, vertical, codes",
    [
        ("EPSG:25832+7837", "EPSG:7837", ("25832", "7837")),
        ("EPSG:5555", "EPSG:5783", ("25832", "5783")),
        ("EPSG:25832", "ellipsoidal", ("25832",)),
        ("", "unknown", ("32632",)),
    ],
)
def test_crs_of_heights_has_its_vertical_datum_where_it_is_known(
    tmp_path: Path, crs: str, vertical: str, codes: tuple[str, ...]
) -> None:
    grid = hill_grid(placed(crs, vertical), 0.5)
    path = tmp_path / "dsm.tif"
    write_hill(path, grid, hole=False)
    with rasterio.open(path) as raster:
        read = pyproj.CRS.from_wkt(raster.crs.to_wkt(version="WKT2_2019"))
        tag = raster.tags()["VERTICAL_DATUM"]
    parts = read.sub_crs_list if read.is_compound else [read]
    assert tuple(part.to_authority()[1] for part in parts) == codes
    assert tag == grid.crs.described_heights()
    assert list(tmp_path.iterdir()) == [path]  # no .aux.xml beside it


def test_parameters_of_a_datum_are_kept(tmp_path: Path) -> None:
    shift = "598.1,73.7,418.2,0.202,0.045,-2.455,6.7"
    crs = f"+proj=tmerc +lat_0=50 +lon_0=10 +k=1 +ellps=bessel +towgs84={shift} +units=m"
    path = tmp_path / "dsm.tif"
    write_hill(path, hill_grid(placed(crs, "EPSG:7837"), 0.5))
    with rasterio.open(path) as raster:
        assert "TOWGS84[598.1,73.7,418.2" in raster.crs.to_wkt()
        assert raster.tags()["VERTICAL_DATUM"] == "EPSG:7837 (DHHN2016 height), metre"


def test_crs_in_feet_has_heights_in_feet(tmp_path: Path) -> None:
    origin = type(placed().origin)(40.7, -73.9, 30.0)
    frame = Frame("enu", IDENTITY, origin, "EPSG:5703", crs="EPSG:2263", approximate_crs=True)
    path = tmp_path / "dsm.tif"
    write_hill(path, make_grid(frame, box(20.0, 15.0), 0.5), hole=False)
    with rasterio.open(path) as raster:
        assert raster.units == ("US survey foot",) and raster.crs.linear_units == "US survey foot"
        assert "NAVD88 height (ftUS)" in raster.crs.to_wkt() and raster.res == (1.64, 1.64)


def test_frame_without_georeference_has_a_local_crs(tmp_path: Path) -> None:
    grid = make_grid(Frame("arbitrary", IDENTITY, metres=True), box(3.0, 2.0), 0.01)
    path = tmp_path / "dsm.tif"
    write_hill(path, grid, hole=False)
    with rasterio.open(path) as raster:
        assert raster.crs.to_wkt().startswith("LOCAL_CS") and raster.crs.to_epsg() is None
        assert raster.bounds == pytest.approx((-3.0, -2.0, 3.0, 2.0))
        assert raster.tags()["VERTICAL_DATUM"] == "above the local zero, metre"
    assert cog_validate(path, strict=True)[0]


def test_lossless_colours_are_the_same_with_an_alpha_band(tmp_path: Path) -> None:
    path = tmp_path / "ortho.tif"
    wanted = write_colours(path, hill_grid(gsd_m=0.05), COLOURS)
    assert cog_validate(path, strict=True) == (True, [], [])
    with rasterio.open(path) as raster:
        np.testing.assert_array_equal(raster.read(), wanted)
        assert raster.colorinterp[3] == ColorInterp.alpha and raster.nodata is None
        assert not pyproj.CRS.from_wkt(raster.crs.to_wkt()).is_compound
        np.testing.assert_array_equal(raster.dataset_mask(), wanted[3])
    with Image.open(path) as picture:  # libtiff without GDAL
        assert picture.mode == "RGBA" and picture.tag_v2[EXTRA_SAMPLES] == (UNASSOCIATED_ALPHA,)
        np.testing.assert_array_equal(np.asarray(picture), wanted.transpose(1, 2, 0))


def test_colours_as_jpeg_are_near_with_a_mask_that_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "ortho.tif"
    wanted = write_colours(path, hill_grid(gsd_m=0.05), COLOURS_AS_JPEG)
    assert cog_validate(path, strict=True) == (True, [], [])
    with rasterio.open(path) as raster:
        assert raster.count == 3 and raster.nodata is None and raster.compression.name == "jpeg"
        assert raster.mask_flag_enums[0] == [MaskFlags.per_dataset]
        np.testing.assert_array_equal(raster.dataset_mask(), wanted[3])
        off = np.abs(raster.read().astype(int) - wanted[:3])[:, wanted[3] > 0]
    assert float(off.mean()) < 3.0  # 8 where a gradient starts again from zero


@pytest.mark.parametrize("form, off_most", [(COLOURS, 0), (COLOURS_AS_JPEG, RINGING)], ids=["lossless", "jpeg"])
def test_overviews_of_colours_have_no_dark_fringe(tmp_path: Path, form: RasterForm, off_most: int) -> None:
    path = tmp_path / "ortho.tif"
    with raster_file(path, hill_grid(gsd_m=0.05), form) as file:
        for tile in hill_grid(gsd_m=0.05).tiles():
            values = np.full((4, tile.height, tile.width), 90, np.uint8)
            values[3] = 255
            values[3, 101:, :77] = 0  # odd: cells of the overview are half outside
            file.write(tile, values)
    with rasterio.open(path, overview_level=0) as raster:
        seen = raster.dataset_mask() > 0
        off = np.abs(raster.read([1, 2, 3]).astype(int) - 90)[:, seen]
    assert not seen.all() and off.max() <= off_most


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("size", [(0.0, 0.0), (20.0, 15.0)])
def test_raster_that_nothing_was_written_to_has_no_data_anywhere(
    tmp_path: Path, name: str, size: tuple[float, float]
) -> None:
    path = tmp_path / "empty.tif"
    with raster_file(path, make_grid(placed(), box(*size), 0.05), FORMS[name]):
        pass
    assert cog_validate(path, strict=True) == (True, [], [])
    with rasterio.open(path) as raster:
        assert not raster.dataset_mask().any()


@pytest.mark.parametrize("name", FORMS)
def test_same_values_give_the_same_bytes(tmp_path: Path, name: str) -> None:
    grid = hill_grid()
    files = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / f"{folder}.tif"
        values = np.random.default_rng(1).integers(1, 255, (len(FORMS[name].bands), grid.height, grid.width))
        tiles = list(grid.tiles(128))
        with raster_file(path, grid, FORMS[name]) as file:
            for t in tiles if folder == "one" else tiles[::-1]:
                some = values[:, t.row : t.row + t.height, t.column : t.column + t.width]
                file.write(t, some.astype(FORMS[name].dtype))
        files.append(path.read_bytes())
    assert cog_info(path).COG
    assert files[0] == files[1]


def test_mismatched_arrays_are_refused_and_the_old_file_is_kept(tmp_path: Path) -> None:
    grid = hill_grid()
    path = tmp_path / "dsm.tif"
    path.write_text("old")
    tile = next(grid.tiles())
    with pytest.raises(ValueError, match="float64"), raster_file(path, grid, HEIGHTS) as file:
        file.write(tile, np.zeros((tile.height, tile.width)))
    with pytest.raises(ValueError, match="is not"), raster_file(path, grid, HEIGHTS) as file:
        file.write(tile, np.zeros((3, tile.height, tile.width), np.float32))
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_gdal_leaves_pyproj_and_the_environment_alone(tmp_path: Path) -> None:
    def state() -> tuple[object, ...]:
        there = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326").transform(566277.0, 5783746.0)
        return there, pyproj.datadir.get_data_dir(), pyproj.network.is_network_enabled(), dict(os.environ)

    before = state()
    path = tmp_path / "dsm.tif"
    write_hill(path, hill_grid())
    assert state() == before
    with pytest.raises(rasterio.errors.EnvError):
        rasterio.env.getenv()  # none of our settings remains after writing


def test_a_virtual_raster_under_the_name_of_a_geotiff_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("SECRET KEY BYTES")
    (tmp_path / "dsm.tif").write_text(
        '<VRTDataset rasterXSize="4" rasterYSize="4"><GeoTransform>0,1,0,4,0,-1</GeoTransform>'
        '<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand"><SourceFilename relativetoVRT="0">'
        f"{tmp_path}/secret.txt</SourceFilename><PixelOffset>1</PixelOffset><LineOffset>4</LineOffset>"
        "</VRTRasterBand></VRTDataset>"
    )
    with rasterio.open(tmp_path / "dsm.tif") as raster:
        assert raster.read(1).tobytes() == b"SECRET KEY BYTES"  # GDAL alone does
    with pytest.raises(SplatpipeError, match=r"dsm.tif cannot be read"):
        open_surface(tmp_path / "dsm.tif")
