"""The orthophoto of a scene whose colours are known: walls are red and nothing else is."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from house_site import cameras, depths_of, edge_distance, photo_of, true_height, true_orthophoto

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.exposures import exposure_levels
from splatpipe.pipeline.surface.depths.photo_gains import GAMMA, OFFSET, PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import (
    PLAIN_TONE,
    DistortionGrid,
    PhotoSource,
    sample_colours,
    tone_curve,
)
from splatpipe.pipeline.surface.depths.point_visibility import contiguous, project_points
from splatpipe.pipeline.surface.depths.sources import DepthSource, HeightRange, LruCache
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.ortho import mosaic
from splatpipe.pipeline.surface.ortho.orthophoto import (
    EXTENDED_CELLS,
    OrthoInput,
    Orthophoto,
    orthophotos,
    tile_orthophoto,
)
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

HEIGHTS = Lattice(-11.04, 8.07, 0.1, 220, 160)
FINE = Lattice(-11.04, 8.07, 0.1, 220, 160)
WHOLE = Tile(0, 0, 160, 220)
RELIEF = HeightRange(-1.0, 8.0)
EXPOSURES = 2.0 ** np.random.default_rng(2).uniform(-0.3, 0.3, len(cameras()))


@cache
def plain_album() -> OrthoInput:
    """All photos, each exposed differently."""
    sources = []
    for camera, exposure in zip(cameras(), EXPOSURES, strict=True):
        found = depths_of(camera)
        photo = np.asarray(cv2.LUT(photo_of(camera), tone_curve(np.full(3, exposure)).reshape(1, 256, 3)))
        depths = DepthSource(camera, lambda found=found: found)
        sources.append(PhotoSource(camera, lambda photo=photo: photo, depths))
    east, north = np.moveaxis(HEIGHTS.centres(WHOLE), -1, 0)
    surface = HeightField(HEIGHTS, true_height(east, north).astype(np.float32))
    return OrthoInput(
        sources, surface, FINE, RELIEF, PhotoGains.plain(len(sources)), LruCache(1 << 28), LruCache(1 << 28)
    )


def levels(album: OrthoInput) -> PhotoGains:
    """Exposures equalised at places on the surface."""
    centres, up = HEIGHTS.centres(WHOLE)[1::3, 1::3], album.surface.height[1::3, 1::3]
    places = np.concatenate([centres, up[..., None].astype(np.float64)], axis=-1).reshape(-1, 3)
    return exposure_levels(album.sources, places[np.isfinite(places[:, 2])], 2 * HEIGHTS.cell_m, threads=1)


@cache
def album() -> OrthoInput:
    """Return the input with exposures equalised."""
    return replace(plain_album(), levels=levels(plain_album()))


@cache
def made() -> Orthophoto:
    return tile_orthophoto(album(), WHOLE)


def truth(lattice: Lattice, tile: Tile) -> np.ndarray:
    centres = lattice.centres(tile)
    off = ((np.arange(4) + 0.5) / 4 - 0.5) * lattice.cell_m
    return np.mean([true_orthophoto(centres[..., 0] + e, centres[..., 1] + n) for e in off for n in off], axis=0)


def psnr(colour: np.ndarray, true: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean(np.square(colour - true))))


def test_it_is_the_view_straight_down() -> None:
    assert made().known.all()
    assert psnr(made().colour, truth(FINE, WHOLE)) > 30.0


def test_walls_do_not_lean() -> None:
    red = (made().colour[..., 0] > 150) & (made().colour[..., 1] < 90)
    assert red.mean() < 1e-3


def test_nothing_is_duplicated_beside_the_eaves() -> None:
    east, north = np.moveaxis(FINE.centres(WHOLE), -1, 0)
    near = (edge_distance(east, north) < 1.0) & (edge_distance(east, north) > 0.15) & (true_height(east, north) == 0.0)
    off = np.abs(made().colour.astype(float) - truth(FINE, WHOLE)).max(axis=-1)
    assert (off[near] > 40.0).mean() < 0.002  # lawn and roof differ by 100 in blue


def test_stripes_keep_their_contrast() -> None:
    east, north = np.moveaxis(FINE.centres(WHOLE), -1, 0)
    lawn = (edge_distance(east, north) > 0.5) & (true_height(east, north) == 0.0)
    assert made().colour[..., 1][lawn].std() > 0.9 * truth(FINE, WHOLE)[..., 1][lawn].std()


def test_exposures_are_equalised() -> None:
    left = np.log2(album().levels.gain[:, 1] * EXPOSURES)
    assert np.ptp(left) < 0.06
    assert np.ptp(np.log2(EXPOSURES)) > 0.4


def test_dark_corners_are_equalised() -> None:
    """Photos through a lens that loses half of the light in the corners."""
    plain = plain_album()
    sources = []
    for source in plain.sources:
        rows, columns = np.mgrid[: source.camera.height, : source.camera.width] + 0.5
        x, y = 2.0 * columns / source.camera.width - 1.0, 2.0 * rows / source.camera.height - 1.0
        shade = np.exp(-0.35 * (x * x + y * y))[..., None]
        dark = np.clip(np.round((source.load() + OFFSET) * shade ** (1.0 / GAMMA) - OFFSET), 0, 255).astype(np.uint8)
        sources.append(replace(source, load=lambda dark=dark: dark))
    shaded = replace(plain, sources=sources)
    found = levels(shaded)
    middle = found.shading.mean(axis=(0, 2))
    assert np.abs(middle[[2, 4]] - 0.35).max() < 0.1  # the terms of x² and y²
    assert np.abs(middle[[0, 1, 3]]).max() < 0.1
    east, north = np.moveaxis(HEIGHTS.centres(WHOLE), -1, 0)
    points = contiguous((east, north, true_height(east, north)))
    seen = project_points(plain.sources[0].camera, *points).inside & np.isfinite(points[2])
    log_colours = [
        np.log(levels_used.sample(0, (source, source.load()), points, seen, HEIGHTS.cell_m)[seen] + OFFSET)
        for levels_used, source in ((levels(plain), plain.sources[0]), (found, sources[0]), (plain.levels, sources[0]))
    ]
    levelled, dark = (np.subtract(*np.quantile(each - log_colours[0], [0.95, 0.05])) for each in log_colours[1:])
    assert levelled < 0.05
    assert dark > 0.15


def test_tiles_and_threads_change_no_bit() -> None:
    for part in orthophotos(album(), list(FINE.tiles(90))[::-1], threads=3):
        tile = part.tile
        cut = np.s_[tile.row : tile.row + tile.height, tile.column : tile.column + tile.width]
        for name in ("colour", "label", "photos", "known"):
            assert np.array_equal(getattr(part, name), getattr(made(), name)[cut])


def test_large_rasters_are_made_in_parts() -> None:
    parts = tile_orthophoto(album(), WHOLE, most=1)
    for name in ("colour", "label", "photos", "known"):
        assert np.array_equal(getattr(parts, name), getattr(made(), name))
    assert parts.tile == WHOLE


def test_a_cell_that_no_photo_sees_is_filled_and_counted() -> None:
    whole = album()
    height = whole.surface.height.copy()
    height[20:24, 20:24] += 3.0  # photos see the lawn there, three metres lower
    height[100:160, 0:60] = np.nan
    part = tile_orthophoto(replace(whole, surface=HeightField(HEIGHTS, height)), WHOLE)
    assert (part.label[21:23, 21:23] == -1).all()
    assert (part.photos[21:23, 21:23] == 0).all()
    assert part.known[21:23, 21:23].all()
    assert part.colour[21:23, 21:23, 1].min() > 100
    assert not part.known[101:, :59].any()
    assert not part.colour[101:, :59].any()


def test_far_from_visible_cells_there_is_no_colour() -> None:
    known = np.zeros((60, 60), np.bool_)
    known[:, 0] = True
    colour = np.full((60, 60, 3), 9, np.uint8)
    colour[~known] = 0
    result, reached = mosaic.extend_colours(colour, known, np.ones_like(known), EXTENDED_CELLS)
    assert reached[:, : EXTENDED_CELLS + 1].all()
    assert not reached[:, EXTENDED_CELLS + 1 :].any()
    assert (result[reached] == 9).all()


def test_a_photo_without_depths_colours_nothing() -> None:
    whole = plain_album()
    blind = replace(
        whole, sources=[replace(source, depths=None) for source in whole.sources[:3]], levels=PhotoGains.plain(3)
    )
    part = tile_orthophoto(blind, Tile(0, 0, 12, 10))
    assert not part.known.any()
    assert (part.label == -1).all()
    assert np.array_equal(levels(blind).gain, np.ones((3, 3)))
    assert not levels(blind).shading.any()


def test_pixels_of_another_size_are_refused() -> None:
    whole = plain_album()
    odd = replace(whole.sources[0], load=lambda: np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="pixels of"):
        tile_orthophoto(replace(whole, sources=[odd], pixels=LruCache(1)), WHOLE)


def test_a_photo_is_seen_through_its_lens() -> None:
    source = plain_album().sources[0]
    camera, shift = source.camera, 5
    across, down = np.meshgrid(np.arange(0, camera.width + 8, 8.0), np.arange(0, camera.height + 8, 8.0))
    nodes = np.stack([across + shift, down + shift], axis=-1)
    lens = DistortionGrid(camera.width + 2 * shift, camera.height + 2 * shift, 8.0, nodes)
    wide = np.pad(source.load(), ((shift, shift), (shift, shift), (0, 0)), mode="edge")
    seen_through = replace(source, load=lambda: wide, lens=lens)
    part = tile_orthophoto(replace(plain_album(), sources=[seen_through], pixels=LruCache(1)), Tile(120, 10, 8, 8))
    same = tile_orthophoto(replace(plain_album(), sources=[source], pixels=LruCache(1)), Tile(120, 10, 8, 8))
    assert part.known.all()
    assert np.array_equal(part.colour, same.colour)


def test_a_finer_photo_is_softened_and_an_equal_one_is_not() -> None:
    board = np.indices((64, 64)).sum(axis=0) % 2 * 255
    pixels = np.repeat(board[..., None], 3, axis=2).astype(np.uint8)
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[2, 3] = 100.0
    source = PhotoSource(Camera("photo", 64, 64, 100.0, 100.0, 32.0, 32.0, down), lambda: pixels, None)  # 1 m a pixel
    row, column = np.mgrid[4:12, 4:12] + 0.5
    seen = np.ones((8, 8), np.bool_)
    same = sample_colours(source, pixels, (column - 32.0, 32.0 - row, np.zeros((8, 8))), seen, 1.0, PLAIN_TONE)
    assert np.array_equal(same[..., 0], board[4:12, 4:12])
    coarse = (4.0 * column - 32.0, 32.0 - 4.0 * row, np.zeros((8, 8)))
    assert np.ptp(sample_colours(source, pixels, coarse, seen, 4.0, PLAIN_TONE)) <= 1
    seen[2] = False
    assert not sample_colours(source, pixels, coarse, seen, 4.0, PLAIN_TONE)[2].any()


def test_a_seam_runs_where_two_photos_look_alike() -> None:
    colour = np.full((2, 40, 60, 3), 100, np.uint8)
    colour[1, :, 25:29] = 200  # a car that only one of them has
    cost = np.full((2, 40, 60), 300, np.uint16)
    cost[0] += np.arange(60, dtype=np.uint16) * 2  # the first is better on the left, the second on the right
    cost[1] += (59 - np.arange(60, dtype=np.uint16)) * 2
    label = mosaic.compose_mosaic(np.ones(cost.shape, np.bool_), cost, colour, parity=0).label
    crossings = np.flatnonzero(label[20, 1:] != label[20, :-1])
    assert crossings.size == 1
    assert (colour[0, 20, crossings[0]] == colour[1, 20, crossings[0]]).all()


def test_objects_in_one_of_five_photos_are_not_shown() -> None:
    colour = np.full((5, 60, 60, 3), 90, np.uint8)
    colour[3, 20:40, 20:40] = 240  # a car that had driven on; elsewhere this photo is the best
    cost = np.full((5, 60, 60), 300, np.uint16)
    cost[3] = 100
    made = mosaic.compose_mosaic(np.ones(cost.shape, np.bool_), cost, colour, parity=1)
    assert (made.colour[22:38, 22:38] == 90).all()  # colours mix around the seam
    assert (made.label[28:32, 2:4] == 3).all()


def test_of_many_photos_the_best_are_kept() -> None:
    random = np.random.default_rng(0)
    seen, cost = random.random((20, 30, 40)) < 0.7, random.integers(0, 50, (20, 30, 40)).astype(np.uint16)
    count, costs = seen.sum(axis=0), np.where(seen, cost, 9999)
    limit = np.sort(costs, axis=0)[mosaic.MAX_CANDIDATES - 1]
    kept = seen.copy()
    assert np.array_equal(mosaic.keep_best(kept, cost), count)
    assert np.array_equal(kept, seen & (cost <= limit))  # more than so many only where costs are the same


def test_heights_between_cells_are_linear_on_slopes_and_sharp_at_steps() -> None:
    lattice = Lattice(0.0, 2.0, 0.5, 4, 4)
    height = np.tile(np.array([0.0, 0.2, 0.4, 5.0], np.float32), (4, 1))
    field = HeightField(lattice, height)
    at = field.at(np.array([0.5, 1.4, 1.6, 9.0]), np.full(4, 1.0))
    assert np.allclose(at[:3], [0.1, 0.4, 5.0])
    assert np.isnan(at[3])
