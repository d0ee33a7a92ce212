"""Volumes of solids with known volume, and their sensitivity to noise."""

import json
import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile, open_surface
from splatpipe.pipeline.surface.measuring.correlation import SHARED_CELLS
from splatpipe.pipeline.surface.measuring.volume_file import volume_facts, write_volumes
from splatpipe.pipeline.surface.measuring.volumes import measure_volume
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

CELL_M = 0.1
BOX = np.array([[-15.0, -12.0, -5.0], [15.0, 12.0, 10.0]])
LOCAL = Frame("arbitrary", Similarity.identity(), metres=True)
PLACED = Frame("enu", Similarity.identity(), Origin(47.83, 13.51, 512.0), "ellipsoidal", crs="EPSG:32633")
IN_FEET = Frame("enu", Similarity.identity(), Origin(47.83, 13.51, 512.0), "ellipsoidal", crs="EPSG:3857")
NOISE_M = 0.03


@cache
def grid_of(crs: str) -> Grid:
    return make_grid({"local": LOCAL, "utm": PLACED, "mercator": IN_FEET}[crs], BOX, CELL_M)


def plain_file(path: Path, grid: Grid, bands: np.ndarray, nodata: float) -> None:
    """Write a file as third-party programs do."""
    size = {"width": grid.width, "height": grid.height, "count": len(bands), "dtype": bands.dtype, "nodata": nodata}
    with rasterio.open(path, "w", driver="GTiff", transform=grid.transform, crs=grid.crs.horizontal, **size) as file:
        file.write(np.where(np.isfinite(bands), bands, nodata).astype(bands.dtype))


def surface_file(
    folder: Path, grid: Grid, local_height: np.ndarray, sigma_m: float | None = None, name: str = "dsm"
) -> SurfaceFile:
    """Heights over the local plane as files in the CRS."""
    tile = next(iter(grid.tiles(4096)))
    places = grid.centres_in_local(tile, np.zeros((grid.height, grid.width)))
    places[..., 2] = local_height
    heights = grid.cells_from_local(places.reshape(-1, 3))[:, 2].reshape(local_height.shape)
    plain_file(folder / f"{name}.tif", grid, heights[None].astype(np.float32), -9999.0)
    if sigma_m is None:
        return open_surface(folder / f"{name}.tif")
    sigmas_mm = np.full((2, grid.height, grid.width), round(sigma_m * 1000.0), np.uint16)
    plain_file(folder / f"{name}_confidence.tif", grid, sigmas_mm, 0.0)
    return open_surface(folder / f"{name}.tif", folder / f"{name}_confidence.tif")


def plan_of(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    places = grid.centres_in_local(next(iter(grid.tiles(4096))), np.full((grid.height, grid.width), 0.0))
    return places[..., 0], places[..., 1]


def square(half_m: float) -> PlanArea:
    ring = np.array([[-half_m, -half_m], [half_m, -half_m], [half_m, half_m], [-half_m, half_m]])
    return PlanArea.seen_from_above([(ring,)])


def cone(east: np.ndarray, north: np.ndarray, radius_m: float = 6.0, height_m: float = 4.0) -> np.ndarray:
    return height_m * np.maximum(1.0 - np.hypot(east, north) / radius_m, 0.0)


CONE_M3 = math.pi * 6.0**2 * 4.0 / 3.0


@pytest.mark.parametrize("crs", ["local", "utm", "mercator"])
def test_a_cone_on_a_slope_has_its_volume_on_the_ground(tmp_path: Path, crs: str) -> None:
    grid = grid_of(crs)
    east, north = plan_of(grid)
    surface = surface_file(tmp_path, grid, 0.05 * east - 0.02 * north + cone(east, north))
    found = measure_volume(surface, square(8.0), grid.crs, "rim")
    assert found.cut.m3 == pytest.approx(CONE_M3, rel=2e-3)
    assert found.fill.m3 < 0.2  # the rounding to whole steps of height, over 256 m²
    assert found.area_m2 == pytest.approx(256.0, rel=1e-4)
    assert found.known_m2 == pytest.approx(256.0, rel=2e-3)
    assert found.base.facts()["rim_misfit_m"] < 1e-3


def test_a_pit_is_filled_and_a_prism_cut(tmp_path: Path) -> None:
    grid = grid_of("local")
    east, north = plan_of(grid)
    pit = (np.abs(east + 4.0) < 2.0) & (np.abs(north) < 2.0)
    prism = (np.abs(east - 4.0) < 2.0) & (np.abs(north) < 3.0)
    surface = surface_file(tmp_path, grid, np.where(pit, -1.0, np.where(prism, 2.0, 0.0)))
    for base in ("rim", "lowest", 0.0):
        found = measure_volume(surface, square(8.0), grid.crs, base)
        assert found.cut.m3 == pytest.approx(48.0, rel=5e-3)
        assert found.fill.m3 == pytest.approx(16.0, rel=5e-3)
        assert found.net.m3 == pytest.approx(32.0, rel=5e-3)
    above = measure_volume(surface, square(8.0), grid.crs, -1.0)
    assert above.cut.m3 == pytest.approx(32.0 + 256.0, rel=5e-3)


def test_an_outline_divides_cells(tmp_path: Path) -> None:
    grid = grid_of("local")
    surface = surface_file(tmp_path, grid, np.ones((grid.height, grid.width)))
    triangle = PlanArea.seen_from_above([(np.array([[0.03, 0.02], [4.01, 0.57], [1.53, 3.96]]),)])
    found = measure_volume(surface, triangle, grid.crs, 0.0)
    assert found.cut.m3 == pytest.approx(triangle.size(), rel=3e-3)
    hole = PlanArea.seen_from_above([(square(5.0).polygons[0][0], square(2.0).polygons[0][0])])
    assert measure_volume(surface, hole, grid.crs, 0.0).cut.m3 == pytest.approx(84.0, rel=2e-3)


def noise_of(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Return noise with the spatial correlation that the module assumes."""
    field = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(shape), (0, 0), SHARED_CELLS)
    # Deviation NOISE_M after the blur of white noise.
    return np.asarray(field * (NOISE_M * 2.0 * math.sqrt(math.pi) * SHARED_CELLS))


TRIALS = 24


def test_the_uncertainty_is_that_of_many_trials(tmp_path: Path) -> None:
    grid = make_grid(LOCAL, np.array([[-5.0, -5.0, -1.0], [5.0, 5.0, 5.0]]), CELL_M)
    east, north = plan_of(grid)
    true = cone(east, north, 3.5, 2.0)
    trials = []
    for seed in range(TRIALS):
        surface = surface_file(tmp_path, grid, true + noise_of(seed, true.shape), NOISE_M)
        trials.append([measure_volume(surface, square(4.0), grid.crs, base).net for base in ("rim", 0.0)])
    for nets in zip(*trials, strict=True):
        found = np.array([net.m3 for net in nets])
        stated = float(np.median([net.sigma_m3 for net in nets]))
        assert 0.6 < found.std() / stated < 1.5  # so few determine it within 40 % in 99 % of cases
        assert abs(found.mean() - math.pi * 3.5**2 * 2.0 / 3.0) < 4.0 * stated / math.sqrt(TRIALS) + 0.05


def test_a_stated_height_has_the_datums_uncertainty(tmp_path: Path) -> None:
    grid = grid_of("local")
    surface = surface_file(tmp_path, grid, np.ones((grid.height, grid.width)), 0.001)
    loose = measure_volume(surface, square(5.0), grid.crs, 0.0, datum_sigma_m=0.05)
    assert loose.net.sigma_m3 == pytest.approx(100.0 * 0.05, rel=0.02)
    assert measure_volume(surface, square(5.0), grid.crs, "rim", datum_sigma_m=0.05).net.sigma_m3 < 0.1


@pytest.mark.parametrize("crs", ["utm", "mercator"])
def test_what_stands_on_the_ground_is_measured_over_it(tmp_path: Path, crs: str) -> None:
    grid = grid_of(crs)
    east, north = plan_of(grid)
    ground = 0.3 * east + 0.4 * np.sin(north)  # no plane
    heap = cone(east, north)
    surface = surface_file(tmp_path, grid, ground + heap, 0.01)
    terrain = surface_file(tmp_path, grid, ground, 0.05, "dtm")
    found = measure_volume(surface, square(8.0), grid.crs, terrain, datum_sigma_m=1.0)
    assert found.cut.m3 == pytest.approx(CONE_M3, rel=2e-3)
    assert found.fill.m3 == 0.0
    assert found.cut.sigma_m3 == pytest.approx(math.pi * 6.0**2 * 0.05, rel=0.02)  # all filled ground errs alike
    assert found.base.facts() == {"kind": "ground"}
    bare = measure_volume(surface, PlanArea.seen_from_above([(square(1.0).polygons[0][0] + 7.0,)]), grid.crs, terrain)
    assert (bare.net.m3, bare.net.sigma_m3) == (0.0, 0.0)  # the surface is the ground there
    itself = measure_volume(terrain, square(8.0), grid.crs, "rim")
    assert itself.net.m3 == pytest.approx(0.0, abs=3.0)


def test_ground_that_nobody_knows_has_no_volume(tmp_path: Path) -> None:
    grid = grid_of("local")
    east, _ = plan_of(grid)
    surface = surface_file(tmp_path, grid, np.ones((grid.height, grid.width)))
    terrain = surface_file(tmp_path, grid, np.where(east > 0.0, 0.0, np.nan), name="dtm")
    found = measure_volume(surface, square(4.0), grid.crs, terrain)
    assert found.cut.m3 == pytest.approx(32.0, rel=5e-3)
    assert found.area_m2 - found.known_m2 == pytest.approx(32.0, rel=5e-3)


def test_cells_without_height_are_reported_and_not_filled(tmp_path: Path) -> None:
    grid = grid_of("local")
    east, north = plan_of(grid)
    surface = surface_file(tmp_path, grid, np.where((np.abs(east) < 2.0) & (np.abs(north) < 2.0), np.nan, 1.0))
    found = measure_volume(surface, square(4.0), grid.crs, 0.0)
    assert found.cut.m3 == pytest.approx(48.0, rel=5e-3)
    assert found.area_m2 - found.known_m2 == pytest.approx(16.0, rel=2e-2)


def test_an_unknown_base_is_refused(tmp_path: Path) -> None:
    grid = grid_of("local")
    east, _ = plan_of(grid)
    surface = surface_file(tmp_path, grid, np.where(np.abs(east) < 2.0, 1.0, np.nan))
    with pytest.raises(SplatpipeError, match="outline has heights"):
        measure_volume(surface, square(4.0), grid.crs, "rim")
    away = PlanArea.seen_from_above([(square(4.0).polygons[0][0] + 100.0,)])
    for base in ("rim", 0.0):
        with pytest.raises(SplatpipeError, match=r"The polygon lies \d+ m north-east of the surface model"):
            measure_volume(surface, away, grid.crs, base)
    abroad = PlanArea.seen_from_above([(square(4.0).polygons[0][0] + np.array([-9e5, 0.0]),)])
    with pytest.raises(SplatpipeError, match=r"lies 900\.0 km west of the surface model") as caught:
        measure_volume(surface, abroad, grid.crs, "rim")
    assert "CRS" in caught.value.hint
    for base in ("rim", 0.0):
        with pytest.raises(SplatpipeError, match="far too long"):
            measure_volume(surface, square(1e7), grid.crs, base)


def test_the_file_lists_each_polygon_with_units(tmp_path: Path) -> None:
    grid = grid_of("utm")
    east, north = plan_of(grid)
    surface = surface_file(tmp_path, grid, cone(east, north), 0.01)
    both = PlanArea.seen_from_above([*square(8.0).polygons, (square(1.0).polygons[0][0] + 9.5,)])
    measured = [
        measure_volume(surface, PlanArea.seen_from_above([polygon]), grid.crs, "lowest") for polygon in both.polygons
    ]
    rows = [volume_facts(number, "Heap", volume) for number, volume in enumerate(measured, 1)]
    write_volumes(tmp_path / "volumes.json", rows, grid.crs)
    read = json.loads((tmp_path / "volumes.json").read_text())
    assert read["volumes"] == rows
    assert [row["polygon"] for row in rows] == [1, 2]
    assert rows[0]["cut_m3"] == pytest.approx(CONE_M3, rel=5e-3)
    assert rows[0]["base"]["height_m"] == pytest.approx(512.0, abs=2e-3)
    assert rows[1]["net_m3"] == pytest.approx(0.0, abs=0.01)
    assert 0.0 < rows[0]["net_sigma_m3"] < 5.0
    assert rows[0]["share_without_height"] < 2e-3


def test_a_file_on_another_grid_is_refused(tmp_path: Path) -> None:
    grid, other = grid_of("local"), make_grid(LOCAL, BOX / 2.0, CELL_M)
    surface_file(tmp_path, grid, np.zeros((grid.height, grid.width)), 0.01)
    surface_file(tmp_path, other, np.zeros((other.height, other.width)), 0.01, "other")
    with pytest.raises(SplatpipeError, match="not on the grid"):
        open_surface(tmp_path / "dsm.tif", tmp_path / "other_confidence.tif")
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(SplatpipeError, match="cannot be read"):
        open_surface(tmp_path / "text.tif")
