"""The surface's native kernels: against their definitions, on every instruction set, and input they reject."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from house_site import cameras, depths_of, photo_of, true_height

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.depths.photo_samples import (
    PLAIN_TONE,
    DistortionGrid,
    PhotoSource,
    rate_points,
    sample_colours,
)
from splatpipe.pipeline.surface.depths.point_visibility import Points, classify_points, project_points
from splatpipe.pipeline.surface.depths.sources import HeightRange, PhotoWindow, PosedDepthMap, window_of
from splatpipe.pipeline.surface.heights.votes import HeightVotes
from splatpipe.pipeline.surface.ortho.mosaic import MARGIN, compose_mosaic, keep_best
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

LATTICE = Lattice(-6.02, 5.03, 0.1, 120, 100)
TILE = Tile(-3, -2, 70, 80)
RELIEF = HeightRange(-1.0, 8.0)
WHOLE = PhotoWindow(0, 0, 240, 180)


@cache
def maps() -> tuple[PosedDepthMap, ...]:
    """Exact depths with holes and noise."""
    random, found = np.random.default_rng(3), [depths_of(camera) for camera in cameras()[::3]]
    for each in found:
        each.depth[:] *= 1.0 + random.normal(0, 0.002, each.depth.shape).astype(np.float32)
        each.depth[random.random(each.depth.shape) < 0.1] = 0.0
        each.confidence[:] = random.integers(0, 9, each.depth.shape)
    return tuple(found)


def votes(window: PhotoWindow = WHOLE, tile: Tile = TILE) -> HeightVotes:
    made = HeightVotes(LATTICE, tile, RELIEF)
    for found in maps():
        made.add(found, window)
    return made


def places() -> Points:
    """Return points on the true surface in the tile's cells, and some off it."""
    east, north = np.moveaxis(LATTICE.centres(TILE), -1, 0)
    up = true_height(east, north)
    up[5, 7:9] = np.nan
    return np.ascontiguousarray(east), np.ascontiguousarray(north), up


def everything() -> list[np.ndarray]:
    """Return the results of all kernels."""
    made, points = votes(), places()
    layers = made.layers()
    fit = made.fit(layers[0].height)
    found = [part for layer in layers for part in (layer.height, layer.count, layer.cover)]
    found += [fit.height, fit.sigma, fit.photos]
    offers = []
    for camera, depths in zip(cameras()[::3], maps(), strict=True):
        flags = classify_points(depths, points, 0.05).flags
        cost, seen = rate_points(camera, points, 0.1, flags)
        source = PhotoSource(camera, lambda: np.zeros((0, 0, 3), np.uint8), None)
        offers.append((seen, cost, sample_colours(source, photo_of(camera, 1), points, seen, 0.1, PLAIN_TONE)))
    stacked = [np.stack(column) for column in zip(*offers, strict=True)]
    mosaic = compose_mosaic(*(part.copy() for part in stacked), parity=1)
    best = stacked[0].copy()
    return [*found, mosaic.label, mosaic.colour, keep_best(best, stacked[1]), best, *stacked]


@cache
def everything_at_best() -> list[np.ndarray]:
    return everything()


def test_every_instruction_set_gives_the_same_bits(isa: str) -> None:
    expected = everything_at_best()
    assert any(np.isfinite(part).any() for part in expected)
    for one, other in zip(everything(), expected, strict=True):
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def test_a_larger_window_and_another_tile_change_no_bit() -> None:
    tight = Tile(20, 30, 10, 12)
    whole, part = votes().layers(), votes(tile=tight).layers()
    cut = np.s_[20 + 3 : 30 + 3, 30 + 2 : 42 + 2]
    for one, other in zip(part, whole, strict=False):
        assert np.array_equal(one.height.reshape(10, 12), other.height.reshape(70, 80)[cut], equal_nan=True)
    made = HeightVotes(LATTICE, tight, RELIEF)
    for found in maps():
        made.add(found, window_of(found.camera, LATTICE, tight, RELIEF) or WHOLE)
    for one, other in zip(made.layers(), part, strict=True):
        assert np.array_equal(one.height, other.height, equal_nan=True)
        assert np.array_equal(one.cover, other.cover)


def test_heights_are_those_of_the_planes_through_pixels() -> None:
    found = depths_of(cameras()[4])  # looks straight down on the roof
    made = HeightVotes(LATTICE, TILE, RELIEF)
    made.add(found, WHOLE)
    layer = made.layers()[0]
    east, north = np.moveaxis(LATTICE.centres(TILE), -1, 0)
    flat = (np.abs(north) > 0.3) & (np.abs(north) < 3.0) & (np.abs(east) < 4.0)
    height = layer.height.reshape(flat.shape)[flat]
    assert np.abs(height - true_height(east, north)[flat]).max() < 2e-4  # heights are whole steps of 0.1 mm
    assert layer.cover.reshape(flat.shape)[flat].mean() == pytest.approx(1.0, abs=0.05)  # cut to 128ths


def test_the_robust_mean_is_tukeys() -> None:
    made = votes()
    start = made.layers()[0].height
    fit = made.fit(start)
    again = made.fit(fit.height)  # six rounds rather than three
    known = np.isfinite(fit.height)
    assert known.mean() > 0.9
    assert np.abs(again.height - fit.height)[known].max() < 0.01
    assert np.median(np.abs(again.height - fit.height)[known]) < 1e-5
    assert np.array_equal(np.isnan(fit.sigma), ~known)
    assert not fit.photos[~known].any()
    assert np.isnan(made.fit(np.full_like(start, np.nan)).height).all()


@pytest.mark.parametrize("number", range(3))
def test_sight_agrees_with_its_definition(number: int) -> None:
    found, points = maps()[number], places()
    place = project_points(found.camera, *points)
    row, column = (np.where(place.inside, at, 0.0).astype(np.int64) for at in (place.row, place.column))
    near = found.depth[row, column].astype(np.float64)
    least = np.asarray(cv2.erode(found.depth, np.ones((3, 3), np.uint8)))[row, column].astype(np.float64)
    limit = np.maximum(3.0 * place.depth / found.camera.fx / np.maximum(place.sine, 0.2), 0.02)
    seen = place.inside & (near > 0.0) & (np.abs(near - place.depth) <= limit)
    view = classify_points(found, points, 0.02)
    assert np.array_equal(view.seen, seen)
    assert np.array_equal(view.through, place.inside & (least > 0.0) & (least - place.depth > limit) & ~seen)
    assert np.array_equal(view.mixed, seen & (least > 0.0) & (least < place.depth - limit))
    assert np.array_equal(view.unknown, place.inside & (near <= 0.0))
    assert np.array_equal(classify_points(found, points, 0.02, place.sine).flags, view.flags)
    assert seen.any() and view.unknown.any()


def test_colours_are_opencvs_cubic() -> None:
    camera, points = cameras()[4], places()
    pixels = np.random.default_rng(1).integers(0, 256, (180, 240, 3)).astype(np.uint8)
    source = PhotoSource(camera, lambda: pixels, None)
    place = project_points(camera, *points)
    column, row = (np.nan_to_num(at - 0.5).astype(np.float32) for at in (place.column, place.row))
    expected = cv2.remap(pixels.astype(np.float32), column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    found = sample_colours(source, pixels, points, place.inside, 0.1, PLAIN_TONE)
    off = np.abs(found - np.clip(expected, 0, 255))[place.inside]
    assert off.mean() < 2.0  # OpenCV rounds places to a 32nd of a pixel
    assert np.percentile(off, 99) < 6.0
    assert not found[~place.inside].any()


def test_cells_away_from_the_rim_do_not_depend_on_it() -> None:
    offers = everything_at_best()[-3:]
    whole = compose_mosaic(*(part.copy() for part in offers), parity=0)
    part = compose_mosaic(*(part[:, 5:, 7:].copy() for part in offers), parity=0)
    inner = np.s_[5 + MARGIN : -MARGIN, 7 + MARGIN : -MARGIN]
    assert np.array_equal(whole.label[inner], part.label[MARGIN:-MARGIN, MARGIN:-MARGIN])
    assert np.array_equal(whole.colour[inner], part.colour[MARGIN:-MARGIN, MARGIN:-MARGIN])


def test_no_photos_are_no_colours() -> None:
    made = compose_mosaic(
        np.zeros((0, 4, 5), bool), np.zeros((0, 4, 5), np.uint16), np.zeros((0, 4, 5, 3), np.uint8), 0
    )
    assert (made.label == -1).all()
    assert not made.colour.any()


def refused(call: Callable[..., object], *given: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        call(*given)


def test_votes_of_mismatched_arrays_are_refused() -> None:
    found, good = maps()[0], native_camera(maps()[0].camera)
    lattice, tile, relief = (0.0, 0.0, 0.1), (0, 0, 8, 9), (0.0, 5.0)
    for bad in ((0.0, 0.0, 0.0), (0.0, np.nan, 0.1), (0.0, 0.0, np.inf)):
        refused(_native.CellVotes, bad, tile, relief)
    for bad in ((0, 0, 0, 9), (0, 0, 1 << 20, 1 << 20), (1 << 31, 0, 8, 9), (-(1 << 31), 0, 8, 9)):
        refused(_native.CellVotes, lattice, bad, relief)
    for bad in ((5.0, 5.0), (0.0, 14000.0), (np.nan, 1.0), (0.0, np.inf)):
        refused(_native.CellVotes, lattice, tile, bad)
    made = _native.CellVotes(lattice, tile, relief)
    whole = (0, 0, 240, 180)
    refused(made.add, found.depth[1:].copy(), found.confidence, good, whole)
    refused(made.add, found.depth, found.confidence[:, 1:].copy(), good, whole)
    refused(made.add, found.depth.astype(np.float64), found.confidence, good, whole)
    refused(made.add, found.depth[:, ::-1], found.confidence, good, whole)
    for window in ((-1, 0, 240, 180), (0, 0, 241, 180), (5, 0, 5, 180), (0, 9, 240, 8)):
        refused(made.add, found.depth, found.confidence, good, window)
    pose, size, lens = good
    for bad in ((pose * np.nan, size, lens), (pose, (0, 180), lens), (pose, size, (0.0, 1.0, 0.0, 0.0))):
        refused(made.add, found.depth, found.confidence, bad, whole)
    heights, counts = np.zeros((3, 72)), np.zeros((3, 72), np.int32)
    refused(made.layers, heights, counts, heights[:2])
    refused(made.layers, heights, counts.astype(np.int64), heights)
    row = np.zeros(72)
    refused(made.fit, row[1:], row, row, counts[0])
    refused(made.fit, row, row, row, counts[0, 1:])


def test_hostile_depths_are_no_heights() -> None:
    found = depths_of(cameras()[4])
    for value in (np.inf, -np.inf, np.nan, -5.0, 1e-38, 3e38):
        depth = np.full_like(found.depth, value)
        made = _native.CellVotes((-6.0, 5.0, 0.1), (0, 0, 100, 120), (-1.0, 8.0))
        made.add(depth, found.confidence, native_camera(found.camera), (0, 0, 240, 180))
        height, count, cover = np.empty((3, 12000)), np.empty((3, 12000), np.int32), np.empty((3, 12000))
        made.layers(height, count, cover)
        assert not count.any()
        assert not (_said(depth) & _native.SEEN).any()


def _said(depth: np.ndarray) -> np.ndarray:
    points, flags = places(), np.empty(TILE.height * TILE.width, np.uint8)
    _native.look(depth, native_camera(cameras()[4]), points, None, 0.0, flags)
    return flags


def test_photos_that_do_not_fit_are_refused() -> None:
    camera, points = native_camera(cameras()[4]), places()
    size = points[0].shape
    pixels, flags, cost = np.zeros((180, 240, 3), np.uint8), np.zeros(size, np.uint8), np.zeros(size, np.uint16)
    depth, colour = np.ones((180, 240), np.float32), np.zeros((*size, 3), np.uint8)
    refused(_native.look, depth[1:], camera, points, None, 0.0, flags)
    refused(_native.look, depth, camera, points, None, 0.0, flags[1:])
    refused(_native.look, depth, camera, points, np.zeros(3), 0.0, flags)
    refused(_native.look, depth, camera, (points[0][1:], *points[1:]), None, 0.0, flags)
    refused(_native.rate, camera, points, 0.0, flags, cost, flags)
    refused(_native.rate, camera, points, 0.1, flags, cost[1:], flags)
    nodes = np.zeros((3, 3, 2))
    for photo in (
        (pixels[1:], PLAIN_TONE, camera, None),
        (pixels, PLAIN_TONE[1:], camera, None),
        (pixels, PLAIN_TONE, camera, (0.0, nodes)),
        (pixels, PLAIN_TONE, camera, (8.0, nodes[:1])),
        (pixels[:0], PLAIN_TONE, camera, (8.0, nodes)),
    ):
        refused(_native.sample_photo, photo, points, 0.1, flags, colour)
    refused(_native.sample_photo, (pixels, PLAIN_TONE, camera, None), points, 0.1, flags, colour[1:])
    refused(_native.sample_photo, (pixels, PLAIN_TONE, camera, None), points, np.nan, flags, colour)
    seen, many = np.zeros((2, 6, 7), np.uint8), np.zeros((2, 6, 7), np.uint16)
    colours, label, counts = np.zeros((2, 6, 7, 3), np.uint8), np.zeros((6, 7), np.int16), np.zeros((6, 7), np.uint8)
    refused(_native.keep_best, seen, many[:1], 8, counts)
    refused(_native.keep_best, seen, many, 8, counts[1:])
    for most in (0, -1, 17):
        refused(_native.keep_best, seen, many, most, counts)
    refused(_native.compose_mosaic, seen, many[:1], colours, 0, label, colours[0])
    refused(_native.compose_mosaic, seen, many, colours, 2, label, colours[0])
    refused(_native.compose_mosaic, seen, many, colours, 0, label[1:], colours[0])
    refused(_native.compose_mosaic, seen, many, colours, 0, label, colours)


def test_a_lens_that_leads_beyond_the_photo_ends_at_its_rim() -> None:
    camera, points = cameras()[4], places()
    pixels = np.full((50, 40, 3), 77, np.uint8)
    for nodes in (np.full((3, 3, 2), 1e9), np.full((3, 3, 2), -np.inf), np.full((3, 3, 2), np.nan)):
        source = PhotoSource(camera, lambda: pixels, None, DistortionGrid(40, 50, 100.0, nodes))
        seen = project_points(camera, *points).inside
        assert (sample_colours(source, pixels, points, seen, 0.1, PLAIN_TONE)[seen] == 77).all()
