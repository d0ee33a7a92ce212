"""Vertical facets: small planes fitted to photos' depths, from which walls are detected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.sources import MIN_CONFIRMED, DepthSource, PosedDepthMap

BLOCKS_PER_PHOTO = 20_000  # blocks of pixels, each fitted with a plane: 20 cm of a wall in photos with a GSD of 3 cm
MIN_BLOCK = 6  # pixels per side: a smaller block's slope is noise
MIN_SHARE = 0.6  # share of a block's pixels that need a confirmed depth
MAX_SCATTER_PX = 3.0  # pixel widths by which a block's depths may scatter about its plane: more means two surfaces
MAX_NORMAL_UP = 0.35  # largest vertical component of a normal: 20°, three standard deviations for a small block
MAX_PIXEL_TIMES = 2.0  # times the median pixel: coarser pixels show houses beyond the survey area
STRIP_PIXELS = 1 << 20  # fitted at a time: about 100 MB
MAX_FACETS = 1_000_000  # kept in all photos together; more are thinned evenly


@dataclass(frozen=True)
class Facets:
    """Small vertical planes.

    Attributes:
        places: Centres, local metres.
        facing: Outward unit normals in plan.
        areas: Areas, square metres.
        pixels_m: Size of a depth pixel at each, perpendicular to the ray, metres.
    """

    places: Float64[np.ndarray, "n 3"]
    facing: Float64[np.ndarray, "n 2"]
    areas: Float64[np.ndarray, " n"]
    pixels_m: Float64[np.ndarray, " n"]

    def select(self, rows: Bool[np.ndarray, " n"] | Int64[np.ndarray, " k"]) -> Facets:
        """The facets of these rows."""
        return Facets(self.places[rows], self.facing[rows], self.areas[rows], self.pixels_m[rows])

    def __len__(self) -> int:
        return len(self.areas)


def upright_facets(sources: Sequence[DepthSource], threads: int) -> Facets:
    """Vertical facets of all photos, without those of coarse pixels; bit-identical for any number of threads.

    Args:
        sources: Depths of photos, always in the same order.
        threads: Photos in parallel.
    """
    share = max(1, math.ceil(len(sources) * BLOCKS_PER_PHOTO / 4 / MAX_FACETS))  # at most a quarter are vertical

    def load_facets(source: DepthSource) -> Facets:
        found = facets_of(source.load())
        return found.select(np.arange(0, len(found), share))

    every = _concatenate(list(ordered_map(load_facets, sources, threads)))
    return every.select(every.pixels_m <= MAX_PIXEL_TIMES * np.median(every.pixels_m)) if len(every) else every


def facets_of(found: PosedDepthMap) -> Facets:
    """Vertical facets of one photo: least-squares planes through its inverse depths, block by block.

    Inverse depth is linear in a plane's pixels: w = n · (x, y, 1) for the plane n · X = 1.
    """
    camera = found.camera
    side = max(MIN_BLOCK, round(math.sqrt(camera.width * camera.height / BLOCKS_PER_PHOTO)))
    strip = max(1, STRIP_PIXELS // (side * camera.width)) * side
    parts = [_strip_facets(found, top, strip, side) for top in range(0, camera.height - side + 1, strip)]
    return _concatenate(parts)


def _strip_facets(found: PosedDepthMap, top: int, rows: int, side: int) -> Facets:
    """Facets in some rows of the photo."""
    camera, strip = found.camera, np.s_[top : top + rows]
    depth = found.depth[strip].astype(np.float64)
    inverse = _blocks(np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0.0), side)
    sure = _blocks(np.where(depth > 0.0, found.confidence[strip], 0), side) >= MIN_CONFIRMED
    row, column = np.nonzero(sure.mean(axis=(2, 3)) >= MIN_SHARE)
    weight, values = (part[row, column].reshape(len(row), side * side) for part in (sure.astype(float), inverse))
    off = np.arange(side) + 0.5
    x = np.tile(off, side) + (column * side)[:, None]
    y = np.repeat(off, side) + (top + row * side)[:, None]
    terms = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    normal = _planes(terms, values, weight)
    misfit = np.square(np.einsum("bpk,bk->bp", terms, normal) - values)
    total = weight.sum(axis=1)
    middle = (weight[..., None] * terms).sum(axis=1) / total[:, None]
    w = (middle * normal).sum(axis=1)
    rough = np.sqrt((weight * misfit).sum(axis=1) / total)
    good = (w > 0.0) & (rough * camera.fx <= MAX_SCATTER_PX * w)
    return _upright_only(camera, middle[good], normal[good], side)


def _concatenate(parts: Sequence[Facets]) -> Facets:
    every = [Facets(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0)), *parts]
    fields = ("places", "facing", "areas", "pixels_m")
    return Facets(*(np.concatenate([getattr(part, name) for part in every]) for name in fields))


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """Whole blocks as (rows, columns, side, side); remaining pixels at the right and bottom are dropped."""
    rows, columns = values.shape[0] // side, values.shape[1] // side
    return values[: rows * side, : columns * side].reshape(rows, side, columns, side).swapaxes(1, 2)


def _planes(
    terms: Float64[np.ndarray, "b p 3"], values: Float64[np.ndarray, "b p"], weight: Float64[np.ndarray, "b p"]
) -> Float64[np.ndarray, "b 3"]:
    """Least squares for each block about its middle, which decouples the equations."""
    total = weight.sum(axis=1)
    middle = np.einsum("bp,bpk->bk", weight, terms) / total[:, None]
    mean = (weight * values).sum(axis=1) / total
    off = (terms - middle[:, None])[..., :2]
    matrix = np.einsum("bp,bpi,bpj->bij", weight, off, off)
    slope = np.linalg.solve(matrix, np.einsum("bp,bpi,bp->bi", weight, off, values - mean[:, None])[..., None])[..., 0]
    return np.column_stack([slope, mean - (slope * middle[:, :2]).sum(axis=1)])


def _upright_only(
    camera: Camera,
    rays: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    side: int,
) -> Facets:
    """Facets of planes with level normals, facing the camera.

    Args:
        camera: The photo's camera.
        rays: Rays to the centres, (x, y, 1) in the camera frame.
        normals: n of n · X = 1, in the camera frame, pointing away from the camera.
        side: Side of the blocks, pixels.
    """
    length = np.linalg.norm(normals, axis=1)
    w = (rays * normals).sum(axis=1)
    turn = camera.cam_from_world[:3, :3]
    places = (rays / w[:, None]) @ turn + camera.centre()
    towards = -(normals / length[:, None]) @ turn
    pixels_m = 1.0 / (w * math.sqrt(camera.fx * camera.fy))
    areas = np.square(side * pixels_m) * length / w  # over the cosine against the view axis, as pixels are counted
    plan = np.linalg.norm(towards[:, :2], axis=1)
    kept = np.abs(towards[:, 2]) <= MAX_NORMAL_UP
    return Facets(places[kept], towards[kept, :2] / plan[kept, None], areas[kept], pixels_m[kept])
