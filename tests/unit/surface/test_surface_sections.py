"""Sections through a house with known heights and walls, and their files read by other programs."""

import csv
from functools import cache
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from house_site import EAVES_M, ROOF, WALLS, cameras, depths_of, roof_height, true_height
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.depths.sources import DepthSource
from splatpipe.pipeline.surface.heights import surface_file
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile, open_surface
from splatpipe.pipeline.surface.measuring.section_files import unit_key, write_section
from splatpipe.pipeline.surface.measuring.sections import Section, cut_section
from splatpipe.pipeline.surface.measuring.traces import polygon_trace, section_trace
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

CELL_M = 0.1
BOX = np.array([[-11.0, -8.0, -1.0], [11.0, 8.0, 8.0]])
FRAME = Frame("enu", Similarity.identity(), Origin(47.83, 13.51, 512.0), "ellipsoidal", crs="EPSG:32633")


@cache
def grid() -> Grid:
    return make_grid(FRAME, BOX, CELL_M)


def house(folder: Path) -> SurfaceFile:
    """The true surface, with a hole."""
    tile = next(iter(grid().tiles(4096)))
    places = grid().centres_in_local(tile, np.full((grid().height, grid().width), 512.0))
    up = true_height(places[..., 0], places[..., 1])
    up = np.where((np.abs(places[..., 1] + 6.0) < 0.5) & (np.abs(places[..., 0]) < 2.0), np.nan, up + 512.0)
    return written(folder / "dsm.tif", up)


def bare_ground(folder: Path) -> SurfaceFile:
    """The ground without the house."""
    return written(folder / "dtm.tif", np.full((grid().height, grid().width), 512.0))


def written(path: Path, up: np.ndarray) -> SurfaceFile:
    size = {"width": grid().width, "height": grid().height, "count": 1, "dtype": "float32", "nodata": -9999.0}
    crs = grid().crs.horizontal
    with rasterio.open(path, "w", driver="GTiff", transform=grid().transform, crs=crs, **size) as file:
        file.write(np.where(np.isfinite(up), up, -9999.0).astype(np.float32), 1)
    return open_surface(path)


def line_of(*local: float) -> tuple[float, float, float, float]:
    """Return the start and end of a line in the CRS."""
    ends = grid().crs.crs_from_local(np.array([[*local[:2], 0.0], [*local[2:], 0.0]]))
    return tuple(ends[:, :2].ravel().tolist())


ACROSS = (0.3, -7.5, 0.3, 7.5)


def across(folder: Path, sources: tuple[DepthSource, ...] = ()) -> Section:
    return cut_section(house(folder), line_of(*ACROSS), grid().crs, sources, threads=1)


def test_heights_are_those_of_the_surface(tmp_path: Path) -> None:
    found = across(tmp_path)
    north = ACROSS[1] + found.distance_m
    off = found.height - 512.0 - true_height(np.full(len(north), ACROSS[0]), north)
    step = np.min(np.abs(north[:, None] - [ROOF[2], ROOF[3]]), axis=1) < CELL_M
    ridge = np.abs(north) < CELL_M
    clear = np.isfinite(off) & ~step & ~ridge
    assert np.abs(off[clear]).max() < 2e-3
    assert found.length_m == pytest.approx(15.0, abs=1e-4)  # on the ground, where the grid has 14.994
    assert np.isnan(found.height[np.abs(north + 6.0) < 0.4]).all()
    assert found.sigma_m.shape == found.height.shape


def test_windows_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = across(tmp_path)
    monkeypatch.setattr(surface_file, "WINDOW", 17)
    parts = across(tmp_path)
    np.testing.assert_allclose(parts.height, whole.height, rtol=0.0, atol=1e-6)


def test_points_show_the_walls_below_the_eaves(tmp_path: Path) -> None:
    sources = tuple(DepthSource(camera, lambda camera=camera: depths_of(camera)) for camera in cameras())
    found = across(tmp_path, sources)
    north, up = ACROSS[1] + found.points[:, 0], found.points[:, 1] - 512.0
    walls = (up > 0.3) & (up < EAVES_M - 0.3)
    assert walls.sum() > 20
    assert np.abs(np.abs(north[walls]) - WALLS[3]).max() < CELL_M
    roof = np.abs(north) < WALLS[3] - 0.2
    assert np.abs(up[roof] - roof_height(north[roof])).max() < CELL_M
    assert np.array_equal(across(tmp_path, sources).points, found.points)
    threaded = cut_section(house(tmp_path), line_of(*ACROSS), grid().crs, sources, threads=3)
    assert np.array_equal(threaded.points, found.points)


def test_a_trace_lies_on_the_surface_and_keeps_peaks_and_holes(tmp_path: Path) -> None:
    section = across(tmp_path)
    trace = section_trace(section, grid().crs, 10_000)
    assert trace["height"].count(None) == np.isnan(section.height).sum() > 0
    x, y, z = (np.array(trace[name], float) for name in "xyz")
    assert np.array_equal(np.isnan(z), np.isnan(section.height))
    distance, height = np.array(trace["distance"], float), np.array(trace["height"], float)
    known = np.isfinite(z)
    assert np.abs(x - ACROSS[0])[known].max() < 5e-3
    assert np.abs(y - ACROSS[1] - distance)[known].max() < 5e-3
    assert np.abs(z + 512.0 - height)[known].max() < 2e-3
    few = section_trace(section, grid().crs, 80)
    assert len(few["distance"]) <= 80
    assert {len(few[name]) for name in ("height", "sigma", "x", "y", "z")} == {len(few["distance"])}
    assert few["distance"][0] == 0.0
    assert few["distance"][-1] == pytest.approx(section.length_m, abs=1e-3)
    assert max(filter(None, few["height"])) == max(filter(None, trace["height"]))
    assert None in few["height"]


def test_a_polygon_is_draped_over_the_surface(tmp_path: Path) -> None:
    ring = np.array([[-9.0, -7.0], [9.0, -7.0], [9.0, 7.0], [-9.0, -3.0]])  # over the house, and beside the hole
    surface = house(tmp_path)
    (trace,) = polygon_trace(surface, (ring,), grid().crs, 200)
    x, y, z = (np.array(trace[name]) for name in "xyz")
    assert len(x) <= 200
    assert (x[0], y[0], z[0]) == (x[-1], y[-1], z[-1])
    for corner in ring:
        assert np.hypot(x - corner[0], y - corner[1]).min() < 2e-3
    off = np.abs(z - true_height(x, y))
    assert np.median(off) < 2e-3  # a step's own cells apart
    assert z.max() > 3.0
    (through,) = polygon_trace(surface, (np.array([[-1.0, -6.0], [1.0, -6.0], [0.0, -9.0]]),), grid().crs, 50)
    assert np.abs(np.array(through["z"])).max() < 2e-3  # straight on over the hole
    (nowhere,) = polygon_trace(surface, (ring + 500.0,), grid().crs, 8)
    assert len(nowhere["z"]) == 8


def test_files_are_read_by_other_programs(tmp_path: Path) -> None:
    sources = tuple(DepthSource(camera, lambda camera=camera: depths_of(camera)) for camera in cameras()[::4])
    section = across(tmp_path, sources)
    facts = write_section(tmp_path, "section-1", section, grid().crs)
    with (tmp_path / facts["csv"]).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["distance_m", "easting_m", "northing_m", "height_m", "height_sigma_m"]
    assert len(rows) == len(section.height)
    assert rows[0]["height_sigma_m"] == ""
    middle = rows[len(rows) // 2]
    assert float(middle["height_m"]) == pytest.approx(517.0, abs=0.05)
    assert float(middle["easting_m"]) == pytest.approx(section.place[len(rows) // 2, 0], abs=1e-4)
    names = pyogrio.raw.read(tmp_path / facts["dxf"], columns=["Layer"], force_2d=True)[3][0].tolist()
    assert names.count("SURFACE") == 2  # the hole breaks it
    assert {"GRID", "TEXT", "POINTS"} <= set(names)
    box = pyogrio.read_bounds(tmp_path / facts["dxf"])[1]
    surface = box[:, [name == "SURFACE" for name in names]]
    assert surface[0].min() == pytest.approx(0.0, abs=1e-3)
    assert surface[2].max() == pytest.approx(15.0, abs=1e-3)
    assert surface[3].max() == pytest.approx(517.0, abs=0.05)
    with Image.open(tmp_path / facts["picture"]) as picture:
        assert picture.width > 400
        assert len(np.unique(np.asarray(picture.convert("L")))) > 10
    before = (tmp_path / facts["picture"]).read_bytes(), (tmp_path / facts["dxf"]).read_bytes()
    write_section(tmp_path, "section-1", section, grid().crs)
    assert before == ((tmp_path / facts["picture"]).read_bytes(), (tmp_path / facts["dxf"]).read_bytes())


def test_the_ground_is_a_second_line(tmp_path: Path) -> None:
    section = cut_section(house(tmp_path), line_of(*ACROSS), grid().crs, (), 1, bare_ground(tmp_path))
    assert section.ground is not None
    assert np.allclose(section.ground, 512.0)
    facts = write_section(tmp_path, "section-1", section, grid().crs)
    with (tmp_path / facts["csv"]).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[-2:] == ["ground_m", "over_ground_m"]
    assert float(rows[len(rows) // 2]["over_ground_m"]) == pytest.approx(5.0, abs=0.05)
    assert float(rows[5]["over_ground_m"]) == pytest.approx(0.0, abs=2e-3)
    names = pyogrio.raw.read(tmp_path / facts["dxf"], columns=["Layer"], force_2d=True)[3][0].tolist()
    assert names.count("GROUND") == 1
    assert names.count("SURFACE") == 2
    trace = section_trace(section, grid().crs, 80)
    assert trace["ground"] == [512.0] * len(trace["distance"])


@pytest.mark.parametrize("local", [(1.0, 1.0, 1.0, 1.0), (200.0, 0.0, 300.0, 0.0), (0.0, 0.0, 9e6, 0.0)])
def test_a_line_without_data_is_refused(tmp_path: Path, local: tuple[float, ...]) -> None:
    start = line_of(0.0, 0.0, 1.0, 1.0)
    line = (start[0] + local[0], start[1] + local[1], start[0] + local[2], start[1] + local[3])
    with pytest.raises(SplatpipeError, match="The section"):
        cut_section(house(tmp_path), line, grid().crs, (), threads=1)
    with pytest.raises(SplatpipeError, match="no length"):
        cut_section(house(tmp_path), (float("nan"), 0.0, 1.0, 1.0), grid().crs, (), threads=1)


def test_units_are_in_names() -> None:
    assert [unit_key(unit) for unit in (1.0, 0.3048, 1200.0 / 3937.0)] == ["m", "ft", "us_ft"]
