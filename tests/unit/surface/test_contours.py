"""Contours: at the right heights, continuous across windows, and in files that GDAL reads."""

import json
from pathlib import Path

import numpy as np
import pyogrio
import pyproj
import pytest
from hills import GERMANY, IDENTITY, box, from_middle, hill, hill_grid, placed, write_hill

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.heights import contours as tracing
from splatpipe.pipeline.surface.heights.contour_files import INDEX_LAYER, LAYER, write_dxf, write_geojson
from splatpipe.pipeline.surface.heights.contours import Contour, Contours, neat_interval, trace_contours
from splatpipe.pipeline.surface.rasters.geotiff import HEIGHTS, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.survey.crs.frames import Frame

LINE_STRING, HAS_Z = 2, 0x80000000  # codes in WKB


def traced(path: Path, grid: Grid, interval: float | None = 0.5) -> Contours:
    write_hill(path, grid)
    return trace_contours(path, interval)


def in_metres(grid: Grid, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    west, _, _, north = grid.bounds
    return from_middle(grid, (line[:, 0] - west) / grid.cell, (north - line[:, 1]) / grid.cell)


def read_lines(path: Path) -> tuple[dict[str, object], list[np.ndarray], dict[str, np.ndarray]]:
    """Return what pyogrio's GDAL reads: metadata, lines and attributes."""
    meta, _, shapes, columns = pyogrio.raw.read(path)
    return meta, [line_of(shape) for shape in shapes], dict(zip(meta["fields"], columns, strict=True))


def line_of(wkb: bytes) -> np.ndarray:
    """The points of a line string as WKB (OGC Simple Features), little endian."""
    kind, count = np.frombuffer(wkb, "<u4", 2, 1)
    kind = int(kind)
    deep = 3 if kind & HAS_Z or kind > 1000 else 2
    assert kind & 0xFF == LINE_STRING or kind == 1000 + LINE_STRING
    return np.frombuffer(wkb, "<f8", int(count) * deep, 9).reshape(-1, deep)


def test_lines_lie_at_their_heights_and_not_where_there_is_no_data(tmp_path: Path) -> None:
    grid = hill_grid()
    found = traced(tmp_path / "dsm.tif", grid)
    assert {line.height for line in found.lines} >= {103.5, 104.0, 105.0, 109.0}
    for contour in found.lines:
        x, y = in_metres(grid, contour.line)
        steepest = 1.2  # the hill's slope, times half a cell each for tolerance and for cells
        assert np.abs(hill(x, y) - contour.height).max() < steepest * grid.cell
        assert not ((np.abs(x - 8.0) < 1.9) & (np.abs(y) < 1.9)).any()
        assert contour.is_index == (round(contour.height / 0.5) % 5 == 0)
    around_the_top = [line for line in found.lines if line.height == 109.0]
    assert len(around_the_top) == 1 and around_the_top[0].closed


@pytest.mark.parametrize("window", [64, 100])
def test_windows_leave_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, window: int) -> None:
    grid = hill_grid()
    whole = traced(tmp_path / "dsm.tif", grid)
    monkeypatch.setattr(tracing, "WINDOW", window)
    pieced = trace_contours(tmp_path / "dsm.tif", 0.5)
    assert [(line.height, line.closed) for line in pieced.lines] == [(line.height, line.closed) for line in whole.lines]
    for one, other in zip(whole.lines, pieced.lines, strict=True):
        for side in (np.min, np.max):
            np.testing.assert_allclose(side(one.line, axis=0), side(other.line, axis=0), atol=grid.cell)
        assert length(one) == pytest.approx(length(other), rel=0.02)


def length(contour: Contour) -> float:
    around = [contour.line, contour.line[:1]] if contour.closed else [contour.line]
    return float(np.linalg.norm(np.diff(np.concatenate(around), axis=0), axis=1).sum())


def test_lines_are_simple_and_noise_is_left_out(tmp_path: Path) -> None:
    grid = hill_grid(gsd_m=0.05)
    found = traced(tmp_path / "dsm.tif", grid)
    cells = sum(length(line) for line in found.lines) / grid.cell
    assert sum(len(line.line) for line in found.lines) < 0.1 * cells
    path = tmp_path / "spike.tif"
    with raster_file(path, grid, HEIGHTS) as file:
        for tile in grid.tiles():
            heights = np.full((tile.height, tile.width), 100.3, np.float32)
            heights[40, 50] = 103.0
            file.write(tile, heights)
    assert trace_contours(path, 1.0).lines == ()


@pytest.mark.parametrize(
    "cell, relief, interval",
    [(0.03, 8.0, 0.2), (0.02, 4.0, 0.2), (0.1, 30.0, 1.0), (0.03, 400.0, 5.0), (0.0166, 1.0, 0.1), (1.0, 0.0, 10.0)],
)
def test_interval_is_round_and_fits_the_heights_accuracy(cell: float, relief: float, interval: float) -> None:
    assert neat_interval(cell, relief) == interval


def test_interval_of_a_surface_follows_its_cells(tmp_path: Path) -> None:
    assert traced(tmp_path / "dsm.tif", hill_grid(), None).interval == 1.0


@pytest.mark.parametrize("interval", [0.0, -1.0, float("nan"), 1e-9])
def test_invalid_interval_is_refused(tmp_path: Path, interval: float) -> None:
    with pytest.raises(SplatpipeError, match="cannot be drawn"):
        traced(tmp_path / "dsm.tif", hill_grid(gsd_m=0.5), interval)


def test_too_many_points_are_refused_before_they_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracing, "MAX_VERTICES", 50)
    with pytest.raises(SplatpipeError, match="more than 50 points"):
        traced(tmp_path / "dsm.tif", hill_grid(), 0.1)


@pytest.mark.parametrize("size", [(0.0, 0.0), (0.0, 10.0), (5.0, 5.0)])
def test_surface_without_data_has_files_without_lines(tmp_path: Path, size: tuple[float, float]) -> None:
    grid = make_grid(placed(), box(*size), 0.5)
    with raster_file(tmp_path / "dsm.tif", grid, HEIGHTS):
        pass
    found = trace_contours(tmp_path / "dsm.tif")
    assert found.lines == ()
    write_geojson(tmp_path / "contours.geojson", found, grid)
    write_dxf(tmp_path / "contours.dxf", found, grid.crs)
    assert json.loads((tmp_path / "contours.geojson").read_text())["features"] == []
    assert read_lines(tmp_path / "contours.dxf")[1] == []


def test_geojson_is_in_longitude_and_latitude_of_proj(tmp_path: Path) -> None:
    grid = hill_grid()
    found = traced(tmp_path / "dsm.tif", grid)
    path = tmp_path / "contours.geojson"
    write_geojson(path, found, grid)
    meta, lines, columns = read_lines(path)
    assert meta["crs"] == "EPSG:4326"
    assert columns["height"].tolist() == [line.height for line in found.lines]
    assert columns["index"].tolist() == [line.is_index for line in found.lines]
    proj = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    for contour, line in zip(found.lines, lines, strict=True):
        wanted = np.stack(proj.transform(*contour.line.T), axis=1)
        assert np.abs(line[: len(wanted)] - wanted).max() * 111_000.0 < 1e-3
        assert (line[0] == line[-1]).all() == contour.closed
    text = json.loads(path.read_text())
    assert "crs" not in text and text["heights"] == "EPSG:7837 (DHHN2016 height), metre"


def test_dxf_has_layers_elevations_and_coordinates_of_the_crs(tmp_path: Path) -> None:
    grid = hill_grid()
    found = traced(tmp_path / "dsm.tif", grid)
    path = tmp_path / "contours.dxf"
    write_dxf(path, found, grid.crs)
    _, lines, columns = read_lines(path)
    assert columns["Layer"].tolist() == [INDEX_LAYER if line.is_index else LAYER for line in found.lines]
    for contour, line in zip(found.lines, lines, strict=True):
        np.testing.assert_allclose(line[: len(contour.line), :2], contour.line, rtol=0.0, atol=1e-4)
        assert (line[:, 2] == contour.height).all()
    header = path.read_text(encoding="cp1252").split("ENDSEC")[0].split()
    assert header[header.index("$ACADVER") + 2] == "AC1015"
    assert header[header.index("$INSUNITS") + 2] == "6" and header[header.index("$MEASUREMENT") + 2] == "1"
    low = found.lines[0].line.min(axis=0)
    assert float(header[header.index("$EXTMIN") + 2]) <= low[0]


def test_dxf_in_feet_says_so(tmp_path: Path) -> None:
    frame = placed("+proj=tmerc +lat_0=52 +lon_0=10 +k=1 +datum=WGS84 +units=us-ft", "unknown", GERMANY)
    grid = hill_grid(frame)
    found = traced(tmp_path / "dsm.tif", grid, 2.0)
    write_dxf(tmp_path / "contours.dxf", found, grid.crs)
    header = (tmp_path / "contours.dxf").read_text(encoding="cp1252").split("ENDSEC")[0].split()
    assert header[header.index("$INSUNITS") + 2] == "21"


def test_frame_without_georeference_has_a_dxf_and_no_longitudes(tmp_path: Path) -> None:
    grid = make_grid(Frame("arbitrary", IDENTITY, metres=True), box(20.0, 15.0), 0.1)
    found = traced(tmp_path / "dsm.tif", grid)
    write_dxf(tmp_path / "contours.dxf", found, grid.crs)
    assert len(read_lines(tmp_path / "contours.dxf")[1]) == len(found.lines) > 0
    with pytest.raises(SplatpipeError, match="not georeferenced"):
        write_geojson(tmp_path / "contours.geojson", found, grid)
    assert not (tmp_path / "contours.geojson").exists()


def test_same_contours_give_the_same_bytes(tmp_path: Path) -> None:
    grid = hill_grid()
    found = traced(tmp_path / "dsm.tif", grid)
    files = []
    for name in ("one", "two"):
        write_dxf(tmp_path / f"{name}.dxf", found, grid.crs)
        write_geojson(tmp_path / f"{name}.geojson", trace_contours(tmp_path / "dsm.tif", 0.5), grid)
        files.append([(tmp_path / f"{name}{end}").read_bytes() for end in (".dxf", ".geojson")])
    assert files[0] == files[1]
