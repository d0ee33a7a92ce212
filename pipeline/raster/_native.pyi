"""Native kernels, built from `native/`. Arrays are C-contiguous CPU tensors of the dtype named, never copied."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

def set_threads(threads: int) -> None:
    """Threads of the one pool that all kernels share, the caller included; clamped to 1..256."""

def threads() -> int: ...
def isa() -> str:
    """The instruction set in use."""

def isas() -> list[str]:
    """Instruction sets that this CPU has and this build knows, best first."""

def set_isa(name: str) -> None:
    """Use one of `isas()`, or "auto" for the best; for tests and comparisons.

    Raises:
        ValueError: if this CPU or this build lacks it.
    """

class TooManyPairs(OverflowError):
    """The Gaussians cover more tiles of the picture than 32-bit indices hold."""

class Frame:
    """A render and what its backward pass needs; its memory is reused by later ones."""

    def __init__(self) -> None: ...
    def forward(
        self,
        parameters: Sequence[Tensor],
        camera: tuple[np.ndarray[Any, Any], tuple[int, int], tuple[float, float, float, float]],
        options: tuple[int, bool, float, float, tuple[float, float, float]],
        outputs: tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor] | None, Tensor, Tensor],
        window: tuple[int, int, int, int] | None = None,
    ) -> None:
        """Render.

        Args:
            parameters: means (n, 3), log_scales (n, 3), quats (n, 4), opacity_logits (n,), sh (n, k, 3); float32.
            camera: cam_from_world (4, 4) float64; width, height; fx, fy, cx, cy in pixels.
            options: SH degree, antialias, near plane, origin of the squared depths, background.
            outputs: Written: colour (h, w, 3), alpha (h, w); None, or depth_sum, depth_square_sum and median_depth
                (h, w); radii (n,) float32; visible (n,) uint8.
            window: Left and top in the whole picture, its width and height, where the camera's is a part of it; None:
                it is the whole.

        Raises:
            TooManyPairs, MemoryError: if the scene is too much.
            ValueError: if shapes do not fit.
        """

    def blend_backward(self, gradients: Sequence[Tensor | None], magnitudes: bool = False) -> None:
        """From the pictures of the last forward() to the screen.

        Args:
            gradients: dL/d(colour), dL/d(alpha), dL/d(depth_sum), dL/d(depth_square_sum); None for zero.
            magnitudes: Of the gradients by the centres, sum the absolute values over the pixels, x and y apart.
        """

    def project_backward(self, parameters: Sequence[Tensor], outputs: Sequence[Tensor], means2d: Tensor) -> None:
        """From there to the parameters; can be repeated.

        Args:
            parameters: Those that were rendered.
            outputs: Written: gradients of the parameters, laid out like them.
            means2d: Written: dL/d(centres on screen), pixels (n, 2).
        """

    def step(
        self,
        parameters: Sequence[Tensor],
        values: Sequence[Tensor],
        means: Sequence[Tensor],
        squares: Sequence[Tensor],
        rates: Sequence[Tensor],
        options: tuple[float, float, float, int],
        log_scale_limits: tuple[float, float],
        logit_gain: Tensor | None,
        seen: tuple[Tensor, Tensor] | None,
    ) -> int:
        """The same, and a step of Adam of the visible rows at once; no others are touched.

        Args:
            parameters: Those that were rendered.
            values: Those to step, the same or, of the logits, what the rendered ones were made from; or the first rows
                of them alone.
            means: Adam's first moments.
            squares: The second ones.
            rates: As of ``adam_step``.
            options: The same.
            log_scale_limits: The stepped log-scales are held within them.
            logit_gain: The derivative of the rendered logits by those that are stepped; None where they are the same.
            seen: Written: the rows that are stepped, ascending, int64 (visible,), and dL/d(their centres on screen),
                pixels (visible, 2), from the first on; None where not wanted.

        Returns:
            Rows that were left out for their gradients.
        """

    @property
    def pairs(self) -> int:
        """Splat-tile pairs of the render."""

    @property
    def visible(self) -> int:
        """Gaussians that the render shows."""

    def contributing_pairs(self) -> int:
        """Pairs of a pixel and a splat blended into it; slow, for benchmarks."""

def free_frames() -> None:
    """Give back the memory that is kept for renders to come."""

def photo_loss(
    render: Tensor,
    photo: Tensor,
    mask: Tensor | None,
    ssim_weight: float,
    gradient: Tensor,
    inner: tuple[int, int, int, int] | None = None,
) -> float:
    """(1 - w) L1 + w (1 - SSIM) of two float32 (h, w, 3) images; its gradient by the render goes to `gradient`.

    `mask` is uint8 (h, w), zero does not count. `inner`: left, top, right, bottom of what counts; None: all.
    """

def affine_colour(affine: Tensor, picture: Tensor, out: Tensor) -> None:
    """The colours of a float32 (h, w, 3) picture through a (3, 4) affine map, to `out`."""

def affine_colour_backward(
    affine: Tensor, picture: Tensor, upstream: Tensor, gradient: Tensor, by_affine: Tensor
) -> None:
    """Gradients by the picture and by the map, written to the last two, from the one by the result."""

def adam_step(
    values: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    rates: Sequence[Tensor],
    visible: Tensor | None,
    options: tuple[float, float, float, int],
) -> int:
    """One Adam step in place over float32 tensors of the same rows; returns those left out for their gradients.

    `rates` holds the rate of every value of a row; `visible` is uint8 (n,); `options` are beta1, beta2, epsilon and the
    step, counted from 1.
    """

def lay_over(sky: tuple[Any, ...], colour: Tensor, out: Tensor) -> None:
    """A float32 (h, w, 3) render with something else behind it than its background, to `out`.

    `sky`: alpha (h, w), nodes (rows, columns, 3); nodes elsewhere or None; uint8 (h, w) or None: zero where those are
    seen; uint8 (h, w) or None: zero where `nodes` have no gradient; pixels from node to node; background.

    Raises:
        ValueError: if sizes do not fit or the nodes do not reach the last pixel.
    """

def lay_over_backward(sky: tuple[Any, ...], upstream: Tensor, by_alpha: Tensor, by_nodes: Tensor | None) -> None:
    """Gradients by the opacity and the nodes, from the one by the result."""

def patch_match(
    photo: tuple[np.ndarray, np.ndarray],
    others: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
    inverse_range: tuple[float, float],
    iterations: int,
    begun: int,
    seed: int,
    planes: np.ndarray,
    costs: np.ndarray,
) -> None:
    """Depths of a photo by what others show there: a plane for each pixel, on the pool's threads.

    Args:
        photo: Grey values and a mask (not 0 where they count), uint8 (h, w) each.
        others: The same of up to 16 photos, and how pixels get there: p at depth z is turn @ p + shift / z, float32.
        inverse_range: Smallest and largest inverse depth, above 0.
        iterations: At most 64; 0 fills in the costs of the planes given.
        begun: How many times random changes were halved before, at most 64: more where planes are nearly right.
        seed: Of the random planes.
        planes: (3, h, w) float32: inverse depth at the pixel's centre, and its slopes across and down a pixel. Changed
            in place; an inverse depth out of range asks for a random plane.
        costs: (h, w) float32: from 0, alike, to 1, unlike; 2 where no photo tells.

    Raises:
        ValueError: if sizes do not fit, or the range is empty.
    """

SEEN: int
"""Bits of what a photo's depths say about a place: the photo sees it,"""
THROUGH: int
"""sees something behind it,"""
MIXED: int
"""sees it, but a nearer surface lies in the next pixel,"""
UNKNOWN: int
"""or looks there, but has no depth."""
MOSAIC_MARGIN: int
"""Cells around one that its colour in a mosaic depends on."""

_Camera = tuple[np.ndarray, tuple[int, int], tuple[float, float, float, float]]
"""cam_from_world (4, 4) float64; width, height; fx, fy, cx, cy in pixels."""
_Places = tuple[np.ndarray, np.ndarray, np.ndarray]
"""East, north, up, float64, of one size."""

class CellVotes:
    """Heights that photos found in the cells of a tile; the same bits in any window, and in any tile.

    Args:
        lattice: East and north of the first cell's outer corner; side of a cell.
        tile: First row and column, rows and columns: 2^26 cells at most.
        relief: Lowest and highest height that counts, 13 km apart at most.

    Raises:
        ValueError: if there are no cells, or too many.
    """

    def __init__(
        self, lattice: tuple[float, float, float], tile: tuple[int, int, int, int], relief: tuple[float, float]
    ) -> None: ...
    def add(
        self, depth: np.ndarray, confidence: np.ndarray, camera: _Camera, window: tuple[int, int, int, int]
    ) -> None:
        """A photo's votes.

        Args:
            depth: Along the camera's z, metres, 0 where none; float32 (h, w).
            confidence: How many other photos confirm it; uint8 (h, w).
            camera: In the depths' grid.
            window: Left, top, right, bottom of the pixels that may lie in the tile.

        Raises:
            ValueError: if sizes do not match.
        """

    def layers(self, height: np.ndarray, count: np.ndarray, cover: np.ndarray) -> None:
        """Surfaces that enough photos agree on, from the top.

        Args:
            height: Written: of the middle vote, nan where there is none; float64 (3, cells).
            count: Written: votes; int32 (3, cells).
            cover: Written: what share of the cell it covers; float64 (3, cells).
        """

    def fit(self, start: np.ndarray, height: np.ndarray, sigma: np.ndarray, photos: np.ndarray) -> None:
        """Robust means of the votes about a start.

        Args:
            start: Heights; nan where none; float64 (cells,).
            height: Written: the means, nan where there is none; float64 (cells,).
            sigma: Written: expected deviations; float64 (cells,).
            photos: Written: how many agree; int32 (cells,).
        """

def look(
    depth: np.ndarray, camera: _Camera, places: _Places, sines: np.ndarray | None, least: float, said: np.ndarray
) -> None:
    """What a photo's depths say about places.

    Args:
        depth: As of ``CellVotes.add``.
        camera: In the depths' grid.
        places: nan is nowhere.
        sines: Of the rays' angles against the surface, float64; None: against the ground.
        least: Differences up to it are none, metres.
        said: Written: bits as above; uint8.

    Raises:
        ValueError: if sizes do not match.
    """

def confirm(
    inverse: np.ndarray,
    camera: _Camera,
    places: _Places,
    agreeing: tuple[float, float, float, float],
    sums: np.ndarray,
    votes: np.ndarray,
) -> None:
    """Where a photo's inverse depths put places along its rays, and whether that is where they are.

    Args:
        inverse: (height, width), float32; 0 where there is none.
        camera: In that grid.
        places: One-dimensional.
        agreeing: Share of the depth within which two agree; far away as many pixels in the other photo, at most another
            share; and the two photos' parallax of something one unit deep, pixels.
        sums: (n, 3), float64; the place is added where they agree.
        votes: (n,), uint8; grows by one there.

    Raises:
        ValueError: if sizes do not match.
    """

def rate(camera: _Camera, places: _Places, cell: float, said: np.ndarray, cost: np.ndarray, seen: np.ndarray) -> int:
    """What it costs to colour places by a photo, and whether it sees them; returns how many it sees.

    Args:
        camera: The photo's camera.
        places: As above.
        cell: Side of their cells, metres.
        said: What its depths say of them.
        cost: Written: 4000 at most, and where the photo does not look; uint16.
        seen: Written: 0 or 1; uint8.
    """

def sample_photo(
    photo: tuple[np.ndarray, np.ndarray, _Camera, tuple[float, np.ndarray] | None],
    places: _Places,
    cell: float,
    seen: np.ndarray,
    colour: np.ndarray,
) -> None:
    """Colours of places in a photo by a cubic, at a scale that fits.

    Args:
        photo: Pixels, uint8 (h, w, 3); what becomes of their values, uint8 (256, 3); the camera, a pinhole; and None,
            or how many of the pinhole's pixels from node to node of the photo's lens, and columns and rows in the
            photo, float64 (rows, columns, 2).
        places: As above.
        cell: Side of their cells, metres.
        seen: 0 where no colour is wanted; uint8.
        colour: Written: uint8, three a place; black where none is wanted.

    Raises:
        ValueError: if sizes do not match.
    """

def keep_best(seen: np.ndarray, cost: np.ndarray, most: int, seen_by: np.ndarray) -> None:
    """Leave each cell the photos of least cost that see it.

    Args:
        seen: Where each photo sees the cells, 0 or 1; uint8 (n, h, w), n at most 32,767. Changed.
        cost: Of colouring them by it; uint16 (n, h, w).
        most: So many, 16 at most; more where costs are the same.
        seen_by: Written: how many photos saw the cell, 255 at most; uint8 (h, w).

    Raises:
        ValueError: if sizes do not match.
    """

def compose_mosaic(
    seen: np.ndarray,
    cost: np.ndarray,
    colour: np.ndarray,
    parity: int,
    label: np.ndarray,
    blended: np.ndarray,
) -> None:
    """Colour cells by photos, with seams where these look alike.

    Args:
        seen: Where each photo sees the cells, 0 or 1; uint8 (n, h, w), n at most 32,767.
        cost: Of colouring them by it; uint16 (n, h, w). Changed.
        colour: Of each photo; uint8 (n, h, w, 3).
        parity: Of the first cell's row plus column in the whole picture.
        label: Written: number of the photo, -1 where none; int16 (h, w).
        blended: Written: uint8 (h, w, 3).

    Raises:
        ValueError: if sizes do not match.
    """
