"""Kernels, built from the sources here. Arrays are C-contiguous, of the given dtype, never copied."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

Array = Tensor | np.ndarray[Any, Any]
"""A tensor on the CPU, or its memory as an array, which is taken in a tenth of the time."""

def set_threads(threads: int) -> None:
    """Set the size of the thread pool that all kernels share, including the caller; clamped to 1..256."""

def threads() -> int: ...
def isa() -> str:
    """The instruction set in use."""

def isas() -> list[str]:
    """Instruction sets supported by this CPU and this build, best first."""

def set_isa(name: str) -> None:
    """Use one of `isas()`, or "auto" for the best; for tests and comparisons.

    Raises:
        ValueError: if this CPU or this build lacks it.
    """

class TooManyPairs(OverflowError):
    """The Gaussians cover more tiles of the image than 32-bit indices allow."""

class Frame:
    """A render and the data for its backward pass; its memory is reused by later renders."""

    def __init__(self) -> None: ...
    def forward(
        self,
        parameters: Sequence[Array],
        camera: tuple[np.ndarray[Any, Any], tuple[int, int], tuple[float, float, float, float]],
        options: tuple[int, bool, float, float, tuple[float, float, float]],
        outputs: tuple[Array, Array, Sequence[Array] | None, Array, Array],
        window: tuple[int, int, int, int] | None = None,
    ) -> None:
        """Render.

        Args:
            parameters: means (n, 3), log_scales (n, 3), quats (n, 4), opacity_logits (n,), sh (n, k, 3); float32.
            camera: cam_from_world (4, 4) float64; width, height; fx, fy, cx, cy in pixels.
            options: SH degree, antialias, near plane, origin of the squared depths, background.
            outputs: Written: colour (h, w, 3), alpha (h, w); None, or depth_sum, depth_square_sum and median_depth
                (h, w); radii (n,) float32; visible (n,) uint8.
            window: Left and top in the whole image, and the whole image's width and height, if the camera is a window
                of it; None otherwise.

        Raises:
            TooManyPairs, MemoryError: if the scene is too large.
            ValueError: if shapes do not match.
        """

    def blend_backward(self, gradients: Sequence[Array | None], magnitudes: bool = False) -> None:
        """From the images of the last forward() to screen-space gradients.

        Args:
            gradients: dL/d(colour), dL/d(alpha), dL/d(depth_sum), dL/d(depth_square_sum); None for zero.
            magnitudes: For the gradients of the centres, sum absolute values over the pixels, separately in x and y.
        """

    def project_backward(self, parameters: Sequence[Array], outputs: Sequence[Array], means2d: Array) -> None:
        """From there to the parameters; can be repeated.

        Args:
            parameters: The rendered parameters.
            outputs: Written: gradients of the parameters, in the same layout.
            means2d: Written: dL/d(centres on screen), pixels (n, 2).
        """

    def step(
        self,
        parameters: Sequence[Array],
        values: Sequence[Array],
        means: Sequence[Array],
        squares: Sequence[Array],
        rates: Sequence[Array],
        options: tuple[float, float, float, int],
        log_scale_limits: tuple[float, float],
        far: tuple[float, float, float, float] | None,
        logit_gain: Array | None,
        seen: Sequence[Array] | None,
    ) -> int:
        """The same, fused with a step of Adam of the visible rows; no other rows are changed.

        Args:
            parameters: The rendered parameters.
            values: The parameters to step: the same or, for the logits, those that the rendered ones were made from; or
                only their first rows.
            means: Adam's first moments.
            squares: Adam's second moments.
            rates: As for ``adam_step``.
            options: As for ``adam_step``.
            log_scale_limits: The stepped log-scales are clamped to these.
            far: Centre x, y, z and unit of ``FarSteps``, which lengthens the steps of far positions; None for none.
            logit_gain: Derivative of the rendered logits with respect to the stepped ones; None if they are the same.
            seen: Written: the stepped rows, ascending, int64 (visible,), and dL/d(their centres on screen), pixels
                (visible, 2), from the first entry on; None if not needed.

        Returns:
            Number of rows skipped for their gradients.
        """

    @property
    def pairs(self) -> int:
        """Number of splat-tile pairs in the render."""

    @property
    def visible(self) -> int:
        """Number of visible Gaussians in the render."""

    def contributing_pairs(self) -> int:
        """Number of blended pixel-splat pairs; slow, for benchmarks."""

def free_frames() -> None:
    """Free the memory kept for later renders."""

def project_activated(
    gaussians: Sequence[Array],
    camera: tuple[np.ndarray[Any, Any], tuple[float, ...], tuple[int, int], tuple[float, float, float, float]],
    options: tuple[float, ...],
    outputs: Sequence[Array | None],
) -> None:
    """Project activated Gaussians to one view.

    Args:
        gaussians: means (n, 3), quats (n, 4), scales (n, 3), opacities (n,); float32.
        camera: cam_from_world (4, 4) float64; centre of projection; width, height; fx, fy, cx, cy in pixels.
        options: near, far, blur in px², plane sigmas, floor of the compensations' squares, clipped radius.
        outputs: Written: means2d (n, 2), depths (n,), covariances (n, 3), determinants (n,); compensations (n,) and
            slants (n, 2), or None each; radii (n, 2) int32. Zeros where not visible.

    Raises:
        ValueError: if shapes do not match.
    """

def project_activated_backward(
    gaussians: Sequence[Array],
    camera: tuple[np.ndarray[Any, Any], tuple[float, ...], tuple[int, int], tuple[float, float, float, float]],
    options: tuple[float, ...],
    radii: Array,
    gradients: Sequence[Array | None],
    outputs: Sequence[Array],
) -> None:
    """Add the gradients of means, quats and scales to `outputs`.

    Args:
        gaussians: As in the projection, as are the camera and the options.
        camera: See above.
        options: See above.
        radii: Of the projection.
        gradients: Of means2d, depths, covariances, compensations and slants; None for zero.
        outputs: Those of the gradients of means (n, 3), quats (n, 4) and scales (n, 3).

    Raises:
        ValueError: if shapes do not match.
    """

def sh_colours(
    means: Array,
    sh: Array,
    radii: Array,
    camera: tuple[np.ndarray[Any, Any], tuple[float, ...], tuple[int, int], tuple[float, float, float, float]],
    degree: int,
    colours: Array,
) -> None:
    """Colours (n, 3) of sh (n, k, 3) from a view, clamped at 0; zeros where radii are. Writes `colours`."""

def sh_colours_backward(
    means: Array,
    sh: Array,
    radii: Array,
    camera: tuple[np.ndarray[Any, Any], tuple[float, ...], tuple[int, int], tuple[float, float, float, float]],
    degree: int,
    gradients: Array,
    by_means: Array,
    by_sh: Array,
) -> None:
    """Add the gradients by means and coefficients to the last two arguments, from those of the colours."""

class FeatureFrame:
    """A view's blended features and the data for the backward pass; its memory is reused by later ones.

    `splats`: means2d (n, 2), depths (n,), covariances (n, 3), determinants (n,), opacities (n,), features (n, d);
    slants (n, 2) or None; radii (n, 2) int32.
    """

    def __init__(self) -> None: ...
    def forward(
        self,
        splats: Sequence[Array | None],
        size: tuple[int, int],
        alpha_max: float,
        background: Array | None,
        outputs: tuple[Array, Array],
    ) -> None:
        """Blend; writes the images (h, w, d) and alpha (h, w). The background is (d,), or None for zeros.

        Raises:
            TooManyPairs, MemoryError: if the splats cover too much.
            ValueError: if shapes do not match.
        """

    def backward(
        self,
        splats: Sequence[Array | None],
        gradients: Sequence[Array | None],
        outputs: Sequence[Array | None],
    ) -> None:
        """Add gradients to `outputs`, from those of the images and alpha (None for zero).

        Args:
            splats: Those of the last forward().
            gradients: Of the images and of alpha.
            outputs: Gradients of means2d, covariances, opacities, features and slants, and the sums of each pixel's
                absolute gradient by means2d (n, 2); None for the last where not wanted, and for slants without any.

        Raises:
            MemoryError: if there is not enough.
            ValueError: if shapes do not match, or forward() rendered something else.
        """

def photo_loss(
    render: Array,
    photo: Array,
    mask: Array | None,
    ssim_weight: float,
    gradient: Array,
    inner: tuple[int, int, int, int] | None = None,
) -> float:
    """(1 - w) L1 + w (1 - SSIM) of two float32 (h, w, 3) images; its gradient for the render goes to `gradient`.

    `mask` is uint8 (h, w), zero does not count. `inner`: left, top, right, bottom of the part that counts; None for
    all.
    """

def affine_colour(affine: Array, picture: Array, out: Array) -> None:
    """Apply a (3, 4) affine map to the colours of a float32 (h, w, 3) image; writes `out`."""

def affine_colour_backward(affine: Array, picture: Array, upstream: Array, gradient: Array, by_affine: Array) -> None:
    """Gradients for the image and the map, written to the last two arguments, from the gradient for the result."""

def adam_step(
    values: Sequence[Array],
    gradients: Sequence[Array],
    means: Sequence[Array],
    squares: Sequence[Array],
    rates: Sequence[Array],
    visible: Array | None,
    options: tuple[float, float, float, int],
) -> int:
    """One Adam step in place over float32 tensors with common rows; returns the number skipped for their gradients.

    `rates` holds the rate of every value of a row; `visible` is uint8 (n,); `options` are beta1, beta2, epsilon and the
    step, counted from 1.
    """

def lay_over(sky: tuple[Any, ...], colour: Array, out: Array) -> None:
    """Replace the background of a float32 (h, w, 3) render; writes `out`.

    `sky`: alpha (h, w), nodes (rows, columns, 3); other nodes or None; uint8 (h, w) or None: zero where those are used;
    uint8 (h, w) or None: zero where `nodes` have no gradient; node spacing in pixels; background.

    Raises:
        ValueError: if sizes do not match or the nodes do not reach the last pixel.
    """

def lay_over_backward(sky: tuple[Any, ...], upstream: Array, by_alpha: Array, by_nodes: Array | None) -> None:
    """Gradients for the opacity and the nodes, from the gradient for the result."""

def nearest_descriptors(
    queries: tuple[np.ndarray, np.ndarray],
    values: tuple[np.ndarray, np.ndarray],
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """The nearest and second nearest of descriptors by their products, group by group, on the calling thread.

    Args:
        queries: Descriptors, uint8 (n, 128), and the bounds of their groups, int64 (groups + 1,).
        values: The same of those that each group's queries are compared with.
        found: For each query the row of the nearest, counted from its group's start, int64 (n,), the first of equal
            ones; its product, and the largest product of the others (0 without any), int32 (n,). Those of queries
            in no group, or in one without values, are left as they are.

    Raises:
        ValueError: if sizes do not fit, or bounds are out of order or range.
    """

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
    """Depths of a photo by PatchMatch with other photos: a plane for each pixel, on the pool's threads.

    Args:
        photo: Grey values and a mask (not 0 where they count), uint8 (h, w) each.
        others: The same of up to 16 photos, and the mapping to them: p at depth z is turn @ p + shift / z, float32.
        inverse_range: Smallest and largest inverse depth, above 0.
        iterations: At most 64; 0 fills in the costs of the planes given.
        begun: Number of times random changes were halved before, at most 64: more if planes are nearly right.
        seed: Seed of the random planes.
        planes: (3, h, w) float32: inverse depth at the pixel's centre, and its slopes across and down a pixel. Changed
            in place; an inverse depth out of range requests a random plane.
            costs: (h, w) float32: from 0 (similar) to 1 (dissimilar); 2 where no photo constrains the plane.

    Raises:
        ValueError: if sizes do not fit, or the range is empty.
    """

SEEN: int
"""Bits of a photo's visibility of a place: the photo sees it,"""
THROUGH: int
"""sees something behind it,"""
MIXED: int
"""sees it, but a nearer surface lies in the next pixel,"""
UNKNOWN: int
"""or covers it, but has no depth there."""
MOSAIC_MARGIN: int
"""Cells around a cell that its colour in a mosaic depends on."""

_Camera = tuple[np.ndarray, tuple[int, int], tuple[float, float, float, float]]
"""cam_from_world (4, 4) float64; width, height; fx, fy, cx, cy in pixels."""
_Places = tuple[np.ndarray, np.ndarray, np.ndarray]
"""East, north, up, float64, of one size."""

class CellVotes:
    """Heights from photos in the cells of a tile; bit-identical in any window and tile.

    Args:
        lattice: East and north of the first cell's outer corner; side of a cell.
        tile: First row and column, rows and columns: at most 2^26 cells.
        relief: Lowest and highest height that counts, at most 13 km apart.

    Raises:
        ValueError: if there are no cells, or too many.
    """

    def __init__(
        self, lattice: tuple[float, float, float], tile: tuple[int, int, int, int], relief: tuple[float, float]
    ) -> None: ...
    def add(
        self, depth: np.ndarray, confidence: np.ndarray, camera: _Camera, window: tuple[int, int, int, int]
    ) -> None:
        """Add a photo's votes.

        Args:
            depth: Along the camera's z, metres, 0 where none; float32 (h, w).
            confidence: Number of other photos that confirm it; uint8 (h, w).
            camera: In the depths' grid.
            window: Left, top, right, bottom of the pixels that may lie in the tile.

        Raises:
            ValueError: if sizes do not match.
        """

    def layers(self, height: np.ndarray, count: np.ndarray, cover: np.ndarray) -> None:
        """Surfaces that enough photos agree on, from the top.

        Args:
            height: Written: height of the middle vote, nan if there is none; float64 (3, cells).
            count: Written: number of votes; int32 (3, cells).
            cover: Written: share of the cell that it covers; float64 (3, cells).
        """

    def fit(self, start: np.ndarray, height: np.ndarray, sigma: np.ndarray, photos: np.ndarray) -> None:
        """Robust means of the votes about a start.

        Args:
            start: Heights; nan where none; float64 (cells,).
            height: Written: the means, nan where there is none; float64 (cells,).
            sigma: Written: expected deviations; float64 (cells,).
            photos: Written: number of photos that agree; int32 (cells,).
        """

def look(
    depth: np.ndarray, camera: _Camera, places: _Places, sines: np.ndarray | None, least: float, said: np.ndarray
) -> None:
    """The visibility of places according to a photo's depths.

    Args:
        depth: As for ``CellVotes.add``.
        camera: In the depths' grid.
        places: nan for no place.
        sines: Sines of the rays' angles to the surface, float64; None for those to the ground.
        least: Differences up to this count as none, metres.
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
    """Positions of places along a photo's rays by its inverse depths, and whether they agree with the places.

    Args:
        inverse: (height, width), float32; 0 where there is none.
        camera: In that grid.
        places: One-dimensional.
        agreeing: Share of the depth within which two agree; for distant places this many pixels in the other photo, at
            most another share; and the two photos' parallax of an object one unit deep, pixels.
        sums: (n, 3), float64; the position is added where they agree.
        votes: (n,), uint8; grows by one there.

    Raises:
        ValueError: if sizes do not match.
    """

def rate(camera: _Camera, places: _Places, cell: float, said: np.ndarray, cost: np.ndarray, seen: np.ndarray) -> int:
    """Cost of colouring places from a photo, and whether it sees them; returns how many it sees.

    Args:
        camera: The photo's camera.
        places: As above.
        cell: Side of their cells, metres.
        said: Their visibility by its depths, from ``look``.
        cost: Written: at most 4000, which also stands for not visible; uint16.
        seen: Written: 0 or 1; uint8.
    """

def sample_photo(
    photo: tuple[np.ndarray, np.ndarray, _Camera, tuple[float, np.ndarray] | None],
    places: _Places,
    cell: float,
    seen: np.ndarray,
    colour: np.ndarray,
) -> None:
    """Colours of places in a photo by cubic interpolation, at a suitable scale.

    Args:
        photo: Pixels, uint8 (h, w, 3); tone curves of their values, uint8 (256, 3); the camera, a pinhole; and None,
            or the node spacing of the photo's lens in the pinhole's pixels, and the nodes' columns and rows in the
            photo, float64 (rows, columns, 2).
        places: As above.
        cell: Side of their cells, metres.
        seen: 0 where no colour is needed; uint8.
        colour: Written: uint8, three per place; black where none is needed.

    Raises:
        ValueError: if sizes do not match.
    """

def keep_best(seen: np.ndarray, cost: np.ndarray, most: int, seen_by: np.ndarray) -> None:
    """Keep for each cell the photos of lowest cost that see it.

    Args:
        seen: Where each photo sees the cells, 0 or 1; uint8 (n, h, w), n at most 32,767. Changed.
        cost: Of colouring them by it; uint16 (n, h, w).
        most: Number of photos to keep, at most 16; more if costs are equal.
        seen_by: Written: number of photos that saw the cell, at most 255; uint8 (h, w).

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
