"""The terrain model of a made slope with houses, trees, a retaining wall and a bank, and its parts by themselves."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from slope_products import Silent, write_slope
from slope_scene import GROUND, HOUSE, TREE, SlopeScene, slope_scene

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.surface.ground import blocks
from splatpipe.pipeline.surface.ground.dtm import DtmTask, make_dtm
from splatpipe.pipeline.surface.ground.ground_filter import GroundScale, find_ground
from splatpipe.pipeline.surface.ground.membrane import LEVELS, REACH, SHRUNK, fill_membrane, fill_window, shrink
from splatpipe.pipeline.surface.ground.roofs import RoofScale, find_roofs
from splatpipe.pipeline.surface.heights.surface_file import open_surface
from splatpipe.pipeline.surface.rasters.grid import Grid

GSD_M = 0.056
FILES = ("dtm.tif", "dtm_confidence.tif", "chm.tif", "cover.tif")
SCALE = GroundScale(0.25, 0.028)


@cache
def scene() -> SlopeScene:
    return slope_scene(GSD_M)


def made(folder: Path, threads: int = 1) -> Grid:
    """Make the slope's terrain model in a folder."""
    folder.mkdir(exist_ok=True)
    grid = write_slope(scene(), folder)
    surface = open_surface(folder / "dsm.tif", folder / "dsm_confidence.tif")
    make_dtm(DtmTask(surface, grid, GSD_M, threads), folder / "parts", folder, folder / "cover.tif", Silent())
    return grid


def read(path: Path, band: int = 1) -> np.ndarray:
    with rasterio.open(path) as raster:
        return raster.read(band, masked=True).astype(np.float64).filled(np.nan)


def level(side: int = 80) -> np.ndarray:
    """Level ground with noise of some millimetres."""
    return np.random.default_rng(0).normal(0.0, 0.004, (side, side))


def test_parts_and_threads_change_no_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(tmp_path / "whole")
    monkeypatch.setattr(blocks, "SIDE", 400)
    made(tmp_path / "parts", threads=2)
    assert len(list((tmp_path / "parts/parts").iterdir())) == 12
    for name in FILES:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


def test_a_killed_run_goes_on_from_its_last_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "SIDE", 400)
    made(tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in FILES}
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").iterdir()}
    lost = [path for path in kept if path.name in ("ground-000001.npz", "terrain-000001.npz", "terrain-000002.npz")]
    for path in lost:
        path.unlink()
    made(tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in FILES} == before
    changed = [path for path, when in kept.items() if path.stat().st_mtime_ns != when]
    assert sorted(changed) == sorted(lost)


def test_ground_is_the_surface_and_what_is_hidden_is_near_the_truth(tmp_path: Path) -> None:
    made(tmp_path)
    terrain, cover = read(tmp_path / "dtm.tif"), read(tmp_path / "cover.tif")
    seen = cover == 2
    assert np.abs(terrain - read(tmp_path / "dsm.tif"))[seen].max() == 0.0
    hidden = scene().kind != GROUND
    assert np.quantile(np.abs(terrain - scene().terrain)[hidden] / GSD_M, 0.9) < 3.0


def test_roofs_are_buildings_and_crowns_are_not(tmp_path: Path) -> None:
    made(tmp_path)
    cover = read(tmp_path / "cover.tif")
    assert (cover[scene().kind == HOUSE] == 6).mean() > 0.9
    assert (cover[scene().kind == TREE] == 6).mean() < 0.03


def test_heights_over_ground_are_those_of_the_objects(tmp_path: Path) -> None:
    made(tmp_path)
    over = read(tmp_path / "chm.tif")
    assert np.nanmin(over) == 0.0
    with rasterio.open(tmp_path / "chm.tif") as raster:
        assert raster.units == ("metre",) and "VERTICAL_DATUM" not in raster.tags()
    true = scene().surface - scene().terrain
    house = (scene().kind == HOUSE) & np.isfinite(true)
    assert np.quantile(np.abs(over - true)[house], 0.95) < 3.0 * GSD_M


def test_confidence_is_the_distance_to_ground_and_grows_with_it(tmp_path: Path) -> None:
    grid = made(tmp_path)
    away, deviation = (read(tmp_path / "dtm_confidence.tif", band) for band in (1, 2))
    seen = read(tmp_path / "cover.tif") == 2
    assert (away[seen] == 0.0).all() and (away[~seen & np.isfinite(away)] >= 100.0 * grid.cell_m / 2.0).all()
    row, column = (round(each / grid.cell_m) for each in (28.0, 27.0))  # the middle of the house on the plot
    assert 380.0 < away[row, column] < 430.0
    assert deviation[row, column] > 4.0 * np.nanmedian(deviation[seen])
    errors_mm = np.abs(read(tmp_path / "dtm.tif") - scene().terrain) * 1000.0
    assert (errors_mm <= 2.0 * deviation)[~seen & np.isfinite(errors_mm)].mean() > 0.9


def test_another_grid_is_refused(tmp_path: Path) -> None:
    grid = write_slope(scene(), tmp_path)
    other = Grid(**{**vars(grid), "width": grid.width + 1})
    task = DtmTask(open_surface(tmp_path / "dsm.tif"), other, GSD_M, 1)
    with pytest.raises(StageError, match="another grid"):
        make_dtm(task, tmp_path / "parts", tmp_path, tmp_path / "cover.tif", Silent())


def test_a_surface_without_heights_has_no_ground() -> None:
    assert not find_ground(np.full((30, 40), np.nan), SCALE).any()
    assert np.isnan(fill_membrane(np.full((30, 40), np.nan))).all()


def test_level_ground_and_a_steep_plane_are_ground_to_their_borders() -> None:
    assert find_ground(level(), SCALE).all()
    rise = 0.6 * SCALE.cell_m * np.arange(80.0)
    assert find_ground(level() + rise[:, None], SCALE).all()


def test_a_hill_is_ground_and_a_wide_flat_roof_is_not() -> None:
    y, x = (np.mgrid[:160, :160] - 80.0) * SCALE.cell_m
    hill = 3.0 * np.exp(-(x**2 + y**2) / 50.0)
    assert find_ground(level(160) + hill, SCALE).all()
    hall = (np.abs(x) < 12.0) & (np.abs(y) < 8.0)
    found = find_ground(level(160) + 5.0 * hall, SCALE)
    assert not found[hall].any() and found[~hall].mean() > 0.98


def test_a_kerb_is_no_object_and_a_low_box_is() -> None:
    high, box = level(), level()
    high[:, 40:] += 0.12
    assert find_ground(high, SCALE).all()
    box[30:38, 30:38] += 0.45
    found = find_ground(box, SCALE)
    assert not found[31:37, 31:37].any() and found.sum() >= 80 * 80 - 110


def test_pits_of_noise_do_not_pull_the_ground_down() -> None:
    pitted = level()
    pitted[np.random.default_rng(1).random(pitted.shape) < 0.02] -= 2.0
    found = find_ground(pitted, SCALE)
    assert (found[pitted > -1.0]).mean() > 0.99 and not found[pitted < -1.0].any()


def test_a_membrane_continues_a_plane() -> None:
    plane = 3.0 + 0.4 * np.arange(90.0)[:, None] - 0.2 * np.arange(70.0)
    holed = plane.copy()
    holed[20:60, 15:50] = np.nan
    assert np.abs(fill_membrane(holed) - plane).max() < 0.03


def test_windows_are_filled_as_the_whole_is() -> None:
    rng = np.random.default_rng(2)
    side = 2 * REACH + 10 * SHRUNK
    heights = rng.normal(0.0, 1.0, (side, side))
    heights[rng.random(heights.shape) < 0.1] = np.nan
    heights[REACH - 40 : REACH + 90, REACH - 60 : REACH + 60] = np.nan
    coarse = fill_membrane(shrink(heights))
    whole = fill_window(heights, coarse)
    top = 6 * SHRUNK
    part = fill_window(heights[top:], coarse[top // SHRUNK :])
    assert (part[REACH:] == whole[top + REACH :]).all() and 1 << LEVELS == SHRUNK


def test_rough_and_small_tops_are_no_roofs() -> None:
    scale = RoofScale(0.25, 0.028)
    roof = np.zeros((60, 60))
    roof[15:45, 15:45] = 4.0 + 0.1 * np.arange(30.0)
    assert find_roofs(roof, roof, scale)[16:44, 16:44].all() and find_roofs(roof, roof, scale).sum() == 900
    rough = np.where(roof > 0.0, roof + np.random.default_rng(3).normal(0.0, 0.3, roof.shape), 0.0)
    assert not find_roofs(rough, rough, scale).any()
    low = np.where(roof > 0.0, 1.5, 0.0)
    assert not find_roofs(low, low, scale).any()
