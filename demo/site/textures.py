"""Procedural surface textures: unique for every face, rich in blobs at all scales, and never repeating.

A painter is a function of a `TextureTile` (a rectangle of wall, roof, lawn ...) that returns sRGB reflectances in
[0, 1].
Contrast lies mostly at wavelengths of 0.2 m and more, which stay well sampled in photos of half the size; finer detail
is kept faint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class TextureTile:
    """A rectangle to paint.

    Attributes:
        u: Texel centres along the first axis of the face, metres, shape (w,).
        v: Texel centres along its second axis, metres, shape (h,).
        texel_m: Texel size.
        rng: The face's own random numbers.
    """

    u: Image
    v: Image
    texel_m: float
    rng: np.random.Generator

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.v), len(self.u)


Painter = Callable[[TextureTile], Image]


def colour(hex_code: str) -> Image:
    """``"c8b090"`` as three sRGB floats."""
    return np.array([int(hex_code[i : i + 2], 16) / 255 for i in (0, 2, 4)], np.float32)


def smooth(x: Image, low: float, high: float) -> Image:
    """Smoothstep from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def mix(a: NDArray[Any], b: NDArray[Any], t: NDArray[Any]) -> Image:
    """Blend images or colours ``a`` and ``b`` by a map ``t`` of shape (h, w)."""
    return np.asarray(a + (b - a) * t[..., None], np.float32)


def noise(tile: TextureTile, wavelength_m: float | tuple[float, float]) -> Image:
    """Smooth random field of about unit variance.

    Args:
        tile: The tile to cover.
        wavelength_m: Spacing of the random lattice, along u and v if two are given.
    """
    along_u, along_v = wavelength_m if isinstance(wavelength_m, tuple) else (wavelength_m, wavelength_m)
    h, w = tile.shape
    step_u, step_v = max(along_u / tile.texel_m, 1.0), max(along_v / tile.texel_m, 1.0)
    rows, cols = int(h / step_v) + 4, int(w / step_u) + 4
    lattice = tile.rng.standard_normal((rows, cols)).astype(np.float32)
    size = (max(int(np.ceil(cols * step_u)), w), max(int(np.ceil(rows * step_v)), h))
    field = cv2.resize(lattice, size, interpolation=cv2.INTER_CUBIC)
    top, left = (size[1] - h) // 2, (size[0] - w) // 2
    return np.asarray(field[top : top + h, left : left + w] * 1.4, np.float32)


def fractal(tile: TextureTile, longest_m: float, shortest_m: float, gain: float = 0.75) -> Image:
    """Sum of octaves of noise, of about unit variance; each octave is ``gain`` times the one above it."""
    total = np.zeros(tile.shape, np.float32)
    power, amplitude, wavelength = 0.0, 1.0, longest_m
    while wavelength >= shortest_m:
        total += amplitude * noise(tile, wavelength)
        power += amplitude**2
        amplitude, wavelength = amplitude * gain, wavelength / 2
    return np.asarray(total / np.sqrt(power), np.float32)


def blobs(tile: TextureTile, wavelength_m: float, share: float) -> Image:
    """Patches with soft edges that cover about ``share`` of the tile, as a map in [0, 1]."""
    field = fractal(tile, wavelength_m, wavelength_m / 3, 0.5)
    threshold = float(np.quantile(field[::4, ::4], 1 - share))
    return smooth(field, threshold - 0.15, threshold + 0.25)


@dataclass(frozen=True)
class Cells:
    """Bricks, tiles or planks: each texel's cell and its position in that cell.

    Attributes:
        row, col: Cell indices, shape (h, w).
        along, up: Position in the cell, 0 to 1, shape (h, w).
        edge_m: Distance to the cell's border in metres, shape (h, w).
    """

    row: NDArray[np.int64]
    col: NDArray[np.int64]
    along: Image
    up: Image
    edge_m: Image

    def values(self, rng: np.random.Generator) -> Image:
        """One standard normal number per cell."""
        table = rng.standard_normal((self.row.max() + 1, self.col.max() + 1)).astype(np.float32)
        return np.asarray(table[self.row, self.col], np.float32)


def cells(tile: TextureTile, width_m: float, height_m: float, stagger: float = 0.5, jitter: float = 0.1) -> Cells:
    """Rows of cells, each row shifted by ``stagger`` of a cell and a random ``jitter``."""
    v = tile.v[:, None] - tile.v[0] + 0.37 * height_m
    row = np.floor(v / height_m).astype(np.int64)
    shifts = (np.arange(row.max() + 1) % 2) * stagger + tile.rng.uniform(0, jitter, row.max() + 1)
    u = tile.u[None, :] - tile.u[0] + shifts[row] * width_m
    col = np.floor(u / width_m).astype(np.int64)
    along = (u / width_m - col).astype(np.float32)
    up = np.broadcast_to((v / height_m - row).astype(np.float32), along.shape)
    edge = np.minimum(np.minimum(along, 1 - along) * width_m, np.minimum(up, 1 - up) * height_m)
    return Cells(np.broadcast_to(row, col.shape), col, along, up, edge.astype(np.float32))


def plaster(base: str, stain: str, strength: float = 1.0) -> Painter:
    """Rendered wall: clouds, patched areas, rain streaks."""

    def paint(tile: TextureTile) -> Image:
        body = colour(base) * (1 + 0.045 * strength * fractal(tile, 1.6, 0.08, 0.8))[..., None]
        body = mix(body, colour(stain), 0.5 * strength * blobs(tile, 1.1, 0.22))
        body = mix(body, colour(base) * 1.12, 0.7 * strength * blobs(tile, 0.6, 0.12))
        streaks = smooth(noise(tile, (0.25, 2.5)), 0.5, 2.0)
        body = mix(body, colour(stain) * 0.8, 0.35 * strength * streaks)
        spots = smooth(noise(tile, 0.16), 1.9, 2.4)
        return mix(body, colour(stain) * 0.55, 0.6 * strength * spots)

    return paint


def bricks(palette: Sequence[str], mortar: str, width_m: float = 0.3, height_m: float = 0.15) -> Painter:
    """Brick wall: each brick its own colour, areas of newer bricks, weathering."""

    def paint(tile: TextureTile) -> Image:
        grid = cells(tile, width_m, height_m)
        which = np.clip((grid.values(tile.rng) * 0.30 + 0.5) * len(palette), 0, len(palette) - 1e-3)
        body = np.stack([colour(c) for c in palette])[which.astype(np.int64)]
        body = body * (1 + 0.07 * grid.values(tile.rng) + 0.05 * fractal(tile, 0.8, 0.1))[..., None]
        body = mix(body, colour(mortar), 0.55 * (1 - smooth(grid.edge_m, 0.004, 0.016)))
        body = mix(body, body * 0.62, blobs(tile, 1.3, 0.18))
        return mix(body, colour("d8cfc0"), 0.35 * blobs(tile, 0.9, 0.10))

    return paint


def roof_tiles(palette: Sequence[str], width_m: float = 0.34, height_m: float = 0.36) -> Painter:
    """Tiled roof: each tile its own tone, a shadow under each row, moss and lichen."""

    def paint(tile: TextureTile) -> Image:
        grid = cells(tile, width_m, height_m, jitter=0.0)
        which = np.clip((grid.values(tile.rng) * 0.32 + 0.5) * len(palette), 0, len(palette) - 1e-3)
        body = np.stack([colour(c) for c in palette])[which.astype(np.int64)]
        shape = 1 - 0.22 * smooth(np.abs(grid.along - 0.5), 0.3, 0.5) - 0.38 * (1 - smooth(grid.up, 0.0, 0.16))
        body = body * (shape * (1 + 0.08 * grid.values(tile.rng) + 0.05 * fractal(tile, 1.5, 0.15)))[..., None]
        body = mix(body, colour("5d6142"), 0.6 * blobs(tile, 0.9, 0.14))
        body = mix(body, colour("3c302a"), 0.45 * blobs(tile, 2.2, 0.16))
        return mix(body, colour("b9ad90"), 0.5 * smooth(noise(tile, 0.2), 2.0, 2.6))

    return paint


def planks(palette: Sequence[str], width_m: float = 0.2, length_m: float = 1.9) -> Painter:
    """Boards that run along u."""

    def paint(tile: TextureTile) -> Image:
        grid = cells(tile, length_m, width_m, jitter=0.9)
        which = np.clip((grid.values(tile.rng) * 0.3 + 0.5) * len(palette), 0, len(palette) - 1e-3)
        body = np.stack([colour(c) for c in palette])[which.astype(np.int64)]
        grain = 0.07 * noise(tile, (0.7, 0.05)) + 0.06 * noise(tile, (0.35, 0.1)) + 0.05 * grid.values(tile.rng)
        body = body * (1 + grain)[..., None]
        body = mix(body, body * 0.45, 0.8 * (1 - smooth(grid.edge_m, 0.004, 0.018)))
        body = mix(body, body * 0.6, blobs(tile, 0.7, 0.15))
        return mix(body, colour("4a3726"), 0.8 * smooth(noise(tile, 0.15), 2.0, 2.4))

    return paint


def slabs(palette: Sequence[str], joint: str, width_m: float, height_m: float, dirt: float = 0.5) -> Painter:
    """Paving: each slab its own tone, dirty patches, joints."""

    def paint(tile: TextureTile) -> Image:
        grid = cells(tile, width_m, height_m, jitter=0.3)
        which = np.clip((grid.values(tile.rng) * 0.32 + 0.5) * len(palette), 0, len(palette) - 1e-3)
        body = np.stack([colour(c) for c in palette])[which.astype(np.int64)]
        body = body * (1 + 0.06 * grid.values(tile.rng) + 0.06 * fractal(tile, 1.2, 0.1))[..., None]
        body = mix(body, colour(joint), 0.7 * (1 - smooth(grid.edge_m, 0.006, 0.024)))
        body = mix(body, body * 0.55, dirt * blobs(tile, 1.0, 0.2))
        return mix(body, colour(joint) * 0.6, 0.7 * smooth(noise(tile, 0.2), 1.8, 2.3))

    return paint


def mottled(palette: Sequence[str], longest_m: float, shortest_m: float, contrast: float = 0.08) -> Painter:
    """Soil, asphalt, lawn, leaves: patches of a few colours over each other and clouds of brightness."""

    def paint(tile: TextureTile) -> Image:
        body = np.broadcast_to(colour(palette[0]), (*tile.shape, 3))
        wavelength = longest_m
        for code in palette[1:]:
            body = mix(body, colour(code), 0.75 * blobs(tile, wavelength, 0.28))
            wavelength = max(wavelength * 0.6, 2.5 * shortest_m)
        return np.asarray(body * (1 + contrast * fractal(tile, longest_m, shortest_m, 0.85))[..., None], np.float32)

    return paint


def painted(base: str, strength: float = 0.6) -> Painter:
    """Painted metal or wood: nearly even, with scuffs and clouds."""

    def paint(tile: TextureTile) -> Image:
        body = colour(base) * (1 + 0.05 * strength * fractal(tile, 0.6, 0.06, 0.8))[..., None]
        body = mix(body, body * 0.72, 0.7 * strength * blobs(tile, 0.45, 0.12))
        return mix(body, np.minimum(colour(base) * 1.2, 1), 0.7 * strength * blobs(tile, 0.3, 0.08))

    return paint


def target(tile: TextureTile) -> Image:
    """Survey target: four quadrants in black and white that meet at the centre."""
    u, v = tile.u - tile.u.mean(), tile.v - tile.v.mean()
    width = 0.6 * tile.texel_m  # edges as soft as a texel, so that the centre is not biased by aliasing
    quadrant = np.tanh(u / width)[None, :] * np.tanh(v / width)[:, None]
    return np.asarray((0.45 + 0.4 * quadrant)[..., None] * np.ones(3), np.float32)


def interior(wall: str, curtain: str) -> Painter:
    """The interior behind a window: a dark room, curtains at the sides, a lamp or plants on the sill, a blind."""

    def paint(tile: TextureTile) -> Image:
        width, height = float(tile.u.max()), float(tile.v.max())
        u, v = tile.u[None, :] / width, tile.v[:, None] / height
        rng = tile.rng
        body = colour(wall) * (0.38 + 0.25 * v + 0.06 * fractal(tile, 0.8, 0.12))[..., None]
        for _ in range(3):  # furniture and pictures
            left, low = rng.uniform(0.1, 0.7), rng.uniform(0.0, 0.6)
            inside = smooth(np.minimum(u - left, left + rng.uniform(0.15, 0.4) - u), 0, 0.02)
            inside = inside * smooth(np.minimum(v - low, low + rng.uniform(0.15, 0.4) - v), 0, 0.02)
            body = mix(body, rng.uniform(0.1, 0.6, 3).astype(np.float32), 0.8 * inside)
        folds = 1 + 0.12 * np.sin(tile.u[None, :] * 40 + 2 * noise(tile, 0.5))
        left, right = rng.uniform(0.08, 0.3), 1 - rng.uniform(0.08, 0.3)
        sides = smooth(left + 0.06 * noise(tile, 0.4) - u, -0.01, 0.01) + smooth(
            u - right - 0.06 * noise(tile, 0.4), -0.01, 0.01
        )
        body = mix(body, colour(curtain) * folds[..., None], np.clip(sides, 0, 1))
        blind = smooth(v - rng.uniform(0.55, 1.3), 0.0, 0.02) * np.ones_like(u)
        slats = 0.82 + 0.1 * np.sign(np.sin(tile.v[:, None] * 45)) * np.ones_like(u)
        body = mix(body, colour("d9d2c3") * slats[..., None], blind)
        plants = smooth(0.22 + 0.12 * noise(tile, 0.2) - v, -0.02, 0.02) * smooth(noise(tile, 0.5), 0.1, 0.4)
        return mix(body, colour(rng.choice(["4f7a3a", "6c8b41", "b0564a", "c8963e"])), 0.85 * plants)

    return paint
