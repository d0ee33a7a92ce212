"""The surface model of a scene with known heights."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from house_site import EAVES_M, ExactDepths, cameras, depths_of, edge_distance, photo_camera, true_height

from splatpipe.pipeline.surface.depths.sources import DepthSource, HeightRange, LruCache, photos_seeing
from splatpipe.pipeline.surface.heights.heights import HeightInput, Heights, surface_heights, tile_heights
from splatpipe.pipeline.surface.heights.holes import fill_holes
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.surface.sheets.raster_plane import RasterPlane

CELL_M = 0.2  # two pixels of the cameras that look down
LATTICE = Lattice(-11.04, 8.07, CELL_M, 110, 80)
WHOLE = Tile(0, 0, 80, 110)
RELIEF = HeightRange(-1.0, 8.0)
PIXEL_M = 0.1  # on the ground, of a camera that looks down


@cache
def exact() -> tuple[ExactDepths, ...]:
    return tuple(depths_of(camera) for camera in cameras())


@cache
def noisy() -> tuple[ExactDepths, ...]:
    """Half a pixel's width of noise, a tenth missing, and patches at a wrong depth that no other photo confirms."""
    random, result = np.random.default_rng(5), []
    for found in exact():
        depth = found.depth * (1 + random.normal(0, 0.5 / 200.0, found.depth.shape).astype(np.float32))
        confidence = found.confidence.copy()
        for _ in range(12):
            row, column = random.integers(0, 170), random.integers(0, 230)
            depth[row : row + 8, column : column + 8] *= np.float32(random.uniform(0.7, 1.2))
            confidence[row : row + 8, column : column + 8] = 0
        depth[random.random(depth.shape) < 0.1] = 0.0
        result.append(replace(found, depth=depth, confidence=np.where(depth > 0, confidence, 0).astype(np.uint8)))
    return tuple(result)


def capture(maps: tuple[ExactDepths, ...], limit_bytes: int = 1 << 30, lattice: Lattice = LATTICE) -> HeightInput:
    return HeightInput(
        [DepthSource(found.camera, lambda found=found: found) for found in maps], lattice, RELIEF, LruCache(limit_bytes)
    )


@cache
def made_exact() -> Heights:
    return tile_heights(capture(exact()), WHOLE)


@cache
def made_noisy() -> Heights:
    return tile_heights(capture(noisy()), WHOLE)


def errors(made: Heights, lattice: Lattice = LATTICE) -> tuple[np.ndarray, np.ndarray]:
    """Return each cell's height error, and which cells are clear of steps."""
    east, north = np.moveaxis(lattice.centres(made.tile), -1, 0)
    return made.height - true_height(east, north), edge_distance(east, north) > 2 * lattice.cell_m


def test_exact_depths_give_exact_heights() -> None:
    made = made_exact()
    off, clear = errors(made)
    assert np.isfinite(off).all()
    assert np.median(np.abs(off[clear])) < 1e-4  # heights are counted in steps of 0.1 mm
    assert np.abs(off[clear]).max() < 0.1 * PIXEL_M  # at the ridge and on the round tree a plane is not the surface
    assert (made.photos >= 3).all()


def test_edges_neither_grow_nor_shrink() -> None:
    made = made_exact()
    off, clear = errors(made)
    assert (np.abs(off[~clear]) > 0.5 * EAVES_M).mean() < 0.03
    higher = made.height > 1.5
    east, north = np.moveaxis(LATTICE.centres(WHOLE), -1, 0)
    assert abs(int(higher.sum()) - int((true_height(east, north) > 1.5).sum())) < 0.02 * higher.sum()


def test_noise_holes_and_wrong_patches_are_tolerated() -> None:
    off, clear = errors(made_noisy())
    flat = off[clear]
    assert np.isfinite(flat).mean() > 0.995
    flat = flat[np.isfinite(flat)]
    assert abs(np.median(flat)) < 0.2 * PIXEL_M
    assert 1.4826 * np.median(np.abs(flat - np.median(flat))) < 0.5 * PIXEL_M
    assert np.percentile(np.abs(flat), 95) < 1.5 * PIXEL_M


def test_expected_deviations_are_no_smaller_than_the_errors() -> None:
    made = made_noisy()
    off, clear = errors(made)
    valid = clear & np.isfinite(off)
    assert np.mean(np.abs(off[valid]) < 2 * made.sigma[valid]) > 0.9


def test_tiles_threads_and_memory_change_no_bit() -> None:
    whole = made_noisy()
    tiles = list(LATTICE.tiles(57))[::-1]
    for part in surface_heights(capture(noisy(), limit_bytes=1), tiles, threads=3):
        cut = np.s_[
            part.tile.row : part.tile.row + part.tile.height, part.tile.column : part.tile.column + part.tile.width
        ]
        assert np.array_equal(part.height, whole.height[cut], equal_nan=True)
        assert np.array_equal(part.sigma, whole.sigma[cut], equal_nan=True)
        assert np.array_equal(part.photos, whole.photos[cut])


def test_large_rasters_are_made_in_parts() -> None:
    whole, parts = made_noisy(), tile_heights(capture(noisy()), WHOLE, most=60_000)  # a third of the 180,000 cells
    assert np.array_equal(parts.height, whole.height, equal_nan=True)
    assert np.array_equal(parts.sigma, whole.sigma, equal_nan=True)
    assert np.array_equal(parts.photos, whole.photos)
    assert parts.tile == WHOLE


def test_cells_smaller_than_pixels_have_no_gaps_and_no_steps() -> None:
    lattice = Lattice(-3.02, 2.51, 0.04, 60, 60)  # on the roof, which slopes
    off, _ = errors(tile_heights(capture(exact(), lattice=lattice), Tile(0, 0, 60, 60)), lattice)
    assert np.isfinite(off).all()
    assert np.percentile(np.abs(off), 95) < 0.05 * PIXEL_M


def test_a_turned_sheet_gives_the_same_surface() -> None:
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]]
    turn[:3, 3] = [0.5, -0.2, -2.0]
    plane = RasterPlane(turn, Lattice(-6.0, 5.0, CELL_M, 60, 50), HeightRange(-3.0, 6.0))
    sources = [plane.transform_depths(DepthSource(found.camera, lambda found=found: found)) for found in exact()]
    made = tile_heights(HeightInput(sources, plane.lattice, plane.relief, LruCache(1 << 30)), Tile(0, 0, 50, 60))
    places = np.concatenate([plane.lattice.centres(made.tile), made.height[..., None]], axis=-1)
    east, north, up = np.moveaxis(plane.local_from_plane(places), -1, 0)
    clear = edge_distance(east, north) > 2 * CELL_M
    assert np.abs(up - true_height(east, north))[clear].max() < 0.2 * PIXEL_M  # on the round tree
    assert np.allclose(plane.plane_from_local(plane.local_from_plane(places)), places, equal_nan=True)


def test_places_that_only_two_photos_see_have_no_height() -> None:
    two = tuple(replace(found, confidence=np.minimum(found.confidence, 1).astype(np.uint8)) for found in exact()[:2])
    made = tile_heights(capture(two), WHOLE)
    assert np.isnan(made.height).all()
    assert not made.photos.any()


def test_without_views_there_are_no_heights() -> None:
    for maps in ((), tuple(replace(f, depth=np.zeros_like(f.depth)) for f in exact()[:3])):
        made = tile_heights(capture(maps), Tile(0, 0, 10, 12))
        assert made.height.shape == (10, 12)
        assert np.isnan(made.height).all()
        assert np.isnan(made.sigma).all()


def test_a_floating_patch_that_others_look_through_is_no_roof() -> None:
    maps = list(exact())
    for number in (4, 5):  # two photos agree on a plate two metres above the lawn, which all others look through
        camera = maps[number].camera
        depth = maps[number].depth.copy()
        row, column = np.mgrid[: camera.height, : camera.width]
        east = camera.centre()[0] + (column + 0.5 - camera.cx) / camera.fx * 18.0
        north = camera.centre()[1] - (row + 0.5 - camera.cy) / camera.fy * 18.0
        depth[(east > 5.0) & (east < 6.0) & (north > -2.0) & (north < 0.0)] = 18.0
        maps[number] = replace(maps[number], depth=depth, confidence=np.full_like(maps[number].confidence, 1))
    off, clear = errors(tile_heights(capture(tuple(maps)), WHOLE))
    assert np.abs(off[clear]).max() < 0.1 * PIXEL_M


def test_small_holes_are_filled_and_counted() -> None:
    maps = []
    for found in exact():
        points = found.camera.project(np.array([[5.5, -5.5, 0.0]]))[0]
        depth = found.depth.copy()
        row, column = np.mgrid[: depth.shape[0], : depth.shape[1]]
        depth[np.hypot(column + 0.5 - points[0], row + 0.5 - points[1]) < 4.0] = 0.0
        maps.append(replace(found, depth=depth))
    made = tile_heights(capture(tuple(maps)), WHOLE)
    off, _ = errors(made)
    assert np.isfinite(off).all()
    assert (made.photos == 1).any()
    assert np.abs(off[made.photos == 1]).max() < 0.1 * PIXEL_M
    assert made.sigma[made.photos == 1].min() >= CELL_M - 1e-6


def test_a_hole_at_a_wall_is_filled_with_ground_and_a_wide_one_is_left() -> None:
    height = np.zeros((9, 30))
    height[:, :5] = 3.0
    height[3:6, 5] = np.nan
    height[:, 12:24] = np.nan
    result, new = fill_holes(height, 0.1, 4)
    assert new[4, 5]
    assert result[4, 5] == 0.0
    assert np.isnan(result[:, 16:20]).all()


def test_photos_that_cannot_see_a_tile_are_not_loaded() -> None:
    far = photo_camera("far", (200.0, 0.0, 20.0), (200.0, 0.0, 0.0))
    away = photo_camera("away", (20.0, 0.0, 2.0), (40.0, 0.0, 2.0))
    assert photos_seeing([far, away], LATTICE, WHOLE, RELIEF) == []

    def never() -> ExactDepths:
        raise AssertionError("loaded")

    tile_heights(HeightInput([DepthSource(far, never)], LATTICE, RELIEF, LruCache(1)), WHOLE)


def test_depths_of_another_size_are_refused() -> None:
    odd = replace(exact()[0], depth=np.ones((3, 4), np.float32), confidence=np.ones((3, 4), np.uint8))
    with pytest.raises(ValueError, match="depths of"):
        tile_heights(capture((odd,)), WHOLE)


@pytest.mark.parametrize("arguments", [(0.0, 0.0, 0.0, 5, 5), (0.0, 0.0, float("nan"), 5, 5), (0.0, 0.0, 1.0, 0, 5)])
def test_a_lattice_without_cells_is_refused(arguments: tuple[float, float, float, int, int]) -> None:
    with pytest.raises(ValueError, match="lattice"):
        Lattice(*arguments)


def test_a_cache_keeps_within_its_limit() -> None:
    cache: LruCache[str] = LruCache(25)
    loads: list[str] = []

    def load(name: str) -> tuple[str, int]:
        loads.append(name)
        return name, 10

    for name in "abcab":
        assert cache.get(name, lambda name=name: load(name)) == name
    assert loads == ["a", "b", "c", "a", "b"]
    assert cache.get("b", lambda: load("b")) == "b"
    assert len(loads) == 5
