"""Similarity metrics between a render and its photo that need no learned weights.

Every metric takes images (h, w, 3) in [0, 1] and an optional mask (h, w), True where a pixel counts. Pixels that do not
count are replaced by the photo's before any neighbourhood is evaluated, so they neither help nor harm. Pictures are
computed in the images' own precision: float32 suffices for images of 8 bits, to a few 1e-7, in half the time. Sums over
pixels are float64, and every one has a fixed order: bit-identical for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

Image = Float[Tensor, "h w 3"]
Mask = Bool[Tensor, "h w"]
Picture = Float[np.ndarray, "h w 3"]
Grey = Float[np.ndarray, "h w"]
Counts = Bool[np.ndarray, "h w"]
Fields = tuple[Float[np.ndarray, "_ _ 3"], Float[np.ndarray, "_ _ 3"]]  # the same pixels of both images

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
SSIM_EPS = 1e-12  # as kornia adds it to the denominator

_MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_GMSD_C = 170.0 / 255.0**2
"""170 for values of 0 to 255 in the authors' code, 0.0026 in the paper for values of 0 to 1."""
_LUMA = (0.299, 0.587, 0.114)
"""ITU-R BT.601 luma from gamma-coded RGB, as in the authors' rgb2gray."""
_EDGE_SHARE = 0.1
_FIELDS = 32  # chessboard fields along an image's longer side: 51 pixels each at 2 megapixels, 19 at 0.27
_STRIP_ROWS = 16  # rows whose windows are compared at a time: a handful of pictures of them fit into a core's cache
NO_PIXEL = "the mask leaves no pixel to measure"
_SHARPNESS_FLOOR = 1.0 / 255.0
"""A gradient of one grey level per pixel: a photo with less has no edges to compare."""


@dataclass(frozen=True, eq=False)
class ImagePair:
    """A render and its photo, prepared once for every metric.

    Attributes:
        x: The render; pixels that do not count are the photo's.
        y: The photo, of the same precision.
        counts: Which pixels count.
    """

    x: Picture
    y: Picture
    counts: Counts

    @cached_property
    def counted(self) -> int:
        """Number of pixels that count."""
        return int(np.count_nonzero(self.counts))

    @cached_property
    def lumas(self) -> tuple[Grey, Grey]:
        """Both images' luma."""
        return _luma(self.x), _luma(self.y)

    @cached_property
    def windows(self) -> WindowSums:
        """The comparison of all windows, the borders reflected, at full size: what SSIM and MS-SSIM share."""
        return _window_sums(self.x, self.y, self.counts)


@dataclass(frozen=True)
class WindowSums:
    """Sums over windows, (red, green, blue) each.

    Attributes:
        around: SSIM over all counting centres, the images' borders reflected.
        similarity: SSIM over the counting centres whose windows lie in the image.
        structure: The contrast · structure factor over the same.
        inner: Number of the latter.
    """

    around: tuple[float, ...]
    similarity: tuple[float, ...]
    structure: tuple[float, ...]
    inner: int


def pair_of(render: Image, photo: Image, mask: Mask | None = None) -> ImagePair:
    """Prepare a render and its photo for the metrics.

    Raises:
        ValueError: if the shapes differ, a value is not finite, or no pixel counts.
    """
    if render.shape != photo.shape or render.ndim != 3 or render.shape[2] != 3:
        raise ValueError(f"render {tuple(render.shape)} and photo {tuple(photo.shape)} are not both (h, w, 3)")
    counts = np.ones(render.shape[:2], np.bool_) if mask is None else mask.numpy(force=True)
    if counts.shape != render.shape[:2]:
        raise ValueError(f"mask {tuple(counts.shape)} is not {tuple(render.shape[:2])}")
    _require_pixels(counts)
    precision = np.float32 if render.dtype == photo.dtype == torch.float32 else np.float64
    x, y = (np.ascontiguousarray(image.numpy(force=True), precision) for image in (render, photo))
    if mask is not None:
        x = np.where(counts[:, :, None], x, y)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("the render or the photo has values that are not finite")
    return ImagePair(x, y, counts)


@dataclass(frozen=True)
class Metric:
    """A metric, called with a render, its photo and their mask, or ``of_pair`` where several share the preparation."""

    of_pair: Callable[[ImagePair], float]

    def __call__(self, render: Image, photo: Image, mask: Mask | None = None) -> float:
        return self.of_pair(pair_of(render, photo, mask))


@Metric
def psnr(pair: ImagePair) -> float:
    """Peak signal-to-noise ratio, 10 log10(1 / MSE) over all counting pixels and channels.

    Returns:
        Decibels; infinite for equal images.

    Raises:
        ValueError: if the shapes differ, a value is not finite, or no pixel counts (likewise for every metric here).
    """
    error = _square_error(pair.x, pair.y) / (3 * pair.counted)  # 0 where pixels do not count
    return 10.0 * math.log10(1.0 / error) if error > 0.0 else math.inf


@Metric
def psnr_cc(pair: ImagePair) -> float:
    """PSNR after an affine colour map (3 × 4) of the render, fitted by least squares on the other half of the image.

    It ignores differences in exposure and white balance between photos. A map is fitted on each half and scored on the
    other, so no pixel is scored with a map that was fitted to it; the errors of all pixels are averaged. If the image
    were split along one line, lighting and vignetting would differ between the halves and count as error. So the halves
    are the fields of a chessboard, `_FIELDS` along the longer side: both contain every brightness, colour and distance
    from the centre equally, and a field is much larger than the blur between neighbouring pixels. The corrected render
    is clamped to [0, 1].

    Raises:
        ValueError: also if one half has no pixel that counts.
    """
    halves = tuple(list(_fields(pair, half)) for half in (0, 1))
    maps = [_colour_map(half) for half in halves]
    errors = []
    for colour, scored in zip(reversed(maps), halves, strict=True):
        for source, target in scored:
            corrected = np.asarray(cv2.transform(source, colour.T))
            errors.append(_square_error(np.clip(corrected, 0.0, 1.0, out=corrected), target))
    error = math.fsum(errors) / (3 * pair.counted)
    return 10.0 * math.log10(1.0 / error) if error > 0.0 else math.inf


def _fields(pair: ImagePair, half: int) -> Iterator[Fields]:
    """The counting pixels of both images on the chessboard's fields of one colour, a row of fields at a time."""
    height, width = pair.counts.shape
    side = math.ceil(max(height, width) / _FIELDS)
    colour = np.arange(width) // side % 2
    for row, top in enumerate(range(0, height, side)):
        rows, columns = slice(top, top + side), colour == (row + half) % 2
        source, target, counts = (image[rows].compress(columns, axis=1) for image in (pair.x, pair.y, pair.counts))
        if not counts.all():
            source, target = source[counts][None], target[counts][None]
        if source.size:
            yield source, target


def _colour_map(half: Sequence[Fields]) -> Float64[np.ndarray, "4 3"]:
    """The least-squares map from the first images to the second ones; the last row is the offset.

    Raises:
        ValueError: if there is no pixel.
    """
    if not half:
        raise ValueError(NO_PIXEL)
    sums = np.zeros((4, 7))  # products of (x, 1) with (x, 1, y), summed
    for source, target in half:
        every = np.ones((7, source.shape[0] * source.shape[1]))
        every[:3], every[4:] = source.reshape(-1, 3).T, target.reshape(-1, 3).T
        sums += np.einsum("in,jn->ij", every[:4], every)  # in one thread, in a fixed order
    # gelsd returns the minimum-norm solution: a render of one colour leaves the map undetermined
    normal, wanted = torch.from_numpy(sums[:, :4].copy()), torch.from_numpy(sums[:, 4:].copy())
    return np.asarray(torch.linalg.lstsq(normal, wanted, driver="gelsd").solution.numpy())


@Metric
def ssim(pair: ImagePair) -> float:
    """Mean structural similarity: ``kornia.metrics.ssim`` with window 11 and "same" padding, to rounding.

    Wang, Bovik, Sheikh, Simoncelli: Image Quality Assessment: From Error Visibility to Structural Similarity, IEEE TIP
    13(4), 2004: a Gaussian window of 11 × 11 and σ 1.5, K1 = 0.01, K2 = 0.03, per channel.

    Raises:
        ValueError: also if a side is under 6 pixels, which is too short to reflect by half a window.
    """
    radius = SSIM_WINDOW // 2
    if min(pair.counts.shape) <= radius:
        raise ValueError(f"SSIM needs images of {radius + 1} pixels a side, got {tuple(pair.counts.shape)}")
    return math.fsum(pair.windows.around) / (3 * pair.counted)


@Metric
def ms_ssim(pair: ImagePair) -> float:
    """Multi-scale structural similarity.

    Wang, Simoncelli, Bovik: Multi-scale Structural Similarity for Image Quality Assessment, Asilomar 2003: five
    scales, halved by 2 × 2 means, whole windows only; contrast and structure of each scale and luminance of the
    coarsest, to the published powers. Computed per channel, then averaged. If at some scale no window with a counting
    centre fits into the image, only the finer scales are used, with powers normalised to a sum of one.

    Raises:
        ValueError: also if not even one window fits.
    """
    x, y, counts = pair.x, pair.y, pair.counts
    radius = SSIM_WINDOW // 2
    scales: list[tuple[list[float], list[float]]] = []  # (similarity, contrast · structure) of each channel
    for _ in _MS_SSIM_WEIGHTS:
        if min(counts.shape) < SSIM_WINDOW or not counts[radius:-radius, radius:-radius].any():
            break
        sums = _window_sums(x, y, counts) if scales else pair.windows
        similarity, structure = ([total / sums.inner for total in part] for part in (sums.similarity, sums.structure))
        scales.append((similarity, structure))
        x, y, counts = _half_size(x), _half_size(y), _halved(counts)
    if not scales:
        raise ValueError(f"MS-SSIM needs a window of {SSIM_WINDOW} pixels a side to fit")
    weights = _MS_SSIM_WEIGHTS[: len(scales)]
    if len(scales) < len(_MS_SSIM_WEIGHTS):
        weights = tuple(weight / math.fsum(weights) for weight in weights)
    product = [1.0, 1.0, 1.0]
    for i, (similarity, structure) in enumerate(scales):
        values = similarity if i == len(scales) - 1 else structure
        product = [p * max(v, 0.0) ** weights[i] for p, v in zip(product, values, strict=True)]
    return math.fsum(product) / 3.0


@Metric
def gmsd(pair: ImagePair) -> float:
    """Gradient magnitude similarity deviation: 0 for equal images, larger is worse.

    Xue, Zhang, Mou, Bovik: Gradient Magnitude Similarity Deviation: A Highly Efficient Perceptual Image Quality Index,
    IEEE TIP 23(2), 2014: luma, 2 × 2 means, Prewitt gradients, standard deviation (over N) of their similarity.

    Raises:
        ValueError: also if the images are under 2 pixels a side.
    """
    if min(pair.counts.shape) < 2:
        raise ValueError(f"GMSD needs images of 2 pixels a side, got {tuple(pair.counts.shape)}")
    counts = _halved(pair.counts)
    _require_pixels(counts)
    gx, gy = (np.sqrt(_square_gradient(_half_size(luma), (1.0, 1.0, 1.0), cv2.BORDER_CONSTANT)) for luma in pair.lumas)
    similarity = (2.0 * gx * gy + _GMSD_C) / (gx * gx + gy * gy + _GMSD_C)
    return float(cv2.meanStdDev(similarity, mask=_as_mask(counts))[1].item())


@Metric
def sharpness(pair: ImagePair) -> float:
    """Sharpness of the photo's edges in the render: 1 as in the photo, less if blurred, more if overshooting.

    The ratio of the RMS Sobel gradients (Tenengrad: Krotkov, Focusing, IJCV 1, 1987) of the luma, over the tenth of the
    counting pixels where the photo's gradient is largest.
    """
    gx, gy = (_square_gradient(luma, (1.0, 2.0, 1.0), cv2.BORDER_REPLICATE) for luma in pair.lumas)
    gx, gy = (gradient[pair.counts] for gradient in (gx, gy))  # (pixels,)
    edges = max(1, math.ceil(_EDGE_SHARE * gy.size))
    least = np.partition(gy, gy.size - edges)[gy.size - edges]
    above, level = np.flatnonzero(gy > least), np.flatnonzero(gy == least)
    chosen = np.concatenate([above, level[: edges - above.size]])  # among equal ones, the first
    rms = [math.sqrt(gradient[chosen].sum(dtype=np.float64) / edges) for gradient in (gx, gy)]
    return (rms[0] + _SHARPNESS_FLOOR) / (rms[1] + _SHARPNESS_FLOOR)


METRICS: dict[str, Metric] = {
    "psnr": psnr,
    "psnr_cc": psnr_cc,
    "ssim": ssim,
    "ms_ssim": ms_ssim,
    "gmsd": gmsd,
    "sharpness": sharpness,
}
"""Every metric by its name in metrics.json."""


def _ssim_window() -> Float64[np.ndarray, " 11"]:
    """The taps of SSIM's Gaussian window, which sum to one."""
    offset = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    taps = np.exp(-0.5 * (offset / SSIM_SIGMA) ** 2)
    return np.asarray(taps / taps.sum())


def _require_pixels(counts: Counts) -> None:
    if not counts.any():
        raise ValueError(NO_PIXEL)


def _as_mask(counts: Counts) -> UInt8[np.ndarray, "h w"] | None:
    """The pixels that count as OpenCV takes them, whose functions are faster where none is left out."""
    return None if counts.all() else np.ascontiguousarray(counts).view(np.uint8)


def _square_error(x: Picture, y: Picture) -> float:
    """Sum of the squared differences over pixels and channels: OpenCV's is float64, in one thread."""
    return float(cv2.norm(x, y, cv2.NORM_L2SQR)) if x.size else 0.0


def _window_sums(x: Picture, y: Picture, counts: Counts) -> WindowSums:
    """Compare the windows around all pixels, a strip at a time."""
    radius, height = SSIM_WINDOW // 2, counts.shape[0]
    apart, squares = x - y, x * x
    squares += y * y
    blurred = [_blur(image) for image in (x, y, np.multiply(apart, apart, out=apart), squares)]
    whole = np.zeros_like(counts)
    whole[radius:-radius, radius:-radius] = counts[radius:-radius, radius:-radius]
    around, inner, factor = [], [], []
    for top in range(0, height, _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        similarity, structure = _similarity(*(image[rows] for image in blurred))
        around.append(_sums(similarity, counts[rows]))
        inner.append(_sums(similarity, whole[rows]))
        factor.append(_sums(structure, whole[rows]))
    of_around, of_inner, of_factor = (
        tuple(math.fsum(channel) for channel in zip(*each, strict=True)) for each in (around, inner, factor)
    )
    return WindowSums(of_around, of_inner, of_factor, int(np.count_nonzero(whole)))


def _sums(values: Picture, counts: Counts) -> tuple[float, ...]:
    """Each channel's sum over counting pixels."""
    mask, pixels = _as_mask(counts), int(np.count_nonzero(counts))
    return tuple(pixels * mean for mean in cv2.mean(values, mask)[:3]) if pixels else (0.0, 0.0, 0.0)


def _blur(image: Picture) -> Picture:
    """Means over the windows around all pixels, the borders reflected, by OpenCV's separable filter."""
    taps = _ssim_window()
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101))


def _similarity(mx: Picture, my: Picture, of_difference: Picture, of_squares: Picture) -> tuple[Picture, Picture]:
    """SSIM and its contrast · structure factor from the windows' means of x, y, (x - y)² and x² + y².

    The covariance comes from the variance of the difference, 2 σxy = σx² + σy² - σ(x-y)², because in float32 the mean
    of x y less the product of the means would lose 1e-7, which is much where σ² is less than C2.
    """
    product, squares, apart = mx * my, mx * mx, mx - my
    squares += my * my
    apart *= apart
    down = of_squares - squares
    down += SSIM_C2
    up = down - of_difference
    up += apart
    structure = up / down
    product *= 2.0
    product += SSIM_C1
    product *= up
    squares += SSIM_C1
    squares *= down
    squares += SSIM_EPS
    product /= squares
    return product, structure


def _luma(image: Picture) -> Grey:
    return np.asarray(cv2.transform(image, np.array([_LUMA])))


def _half_size(image: np.ndarray) -> np.ndarray:
    """Means of the 2 × 2 blocks (h // 2, w // 2)."""
    h, w = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image[: 2 * h, : 2 * w], (w, h), interpolation=cv2.INTER_AREA))


def _halved(counts: Counts) -> Bool[np.ndarray, "h//2 w//2"]:
    """The 2 × 2 blocks (h // 2, w // 2) all of whose pixels count."""
    h, w = counts.shape[0] // 2 * 2, counts.shape[1] // 2 * 2
    block = counts[:h, :w]
    return np.asarray(block[::2, ::2] & block[1::2, ::2] & block[::2, 1::2] & block[1::2, 1::2])


def _square_gradient(image: Grey, across: tuple[float, float, float], border: int) -> Grey:
    """Squared magnitude of the 3 × 3 gradient smoothed by ``across`` (normalised to sum 1); what lies around is 0 or
    replicated, by OpenCV's ``border``."""
    along, smooth = np.array([-1.0, 0.0, 1.0]), np.array(across) / sum(across)
    dx = np.asarray(cv2.sepFilter2D(image, -1, along, smooth, borderType=border))
    dy = np.asarray(cv2.sepFilter2D(image, -1, smooth, along, borderType=border))
    np.multiply(dx, dx, out=dx)
    np.multiply(dy, dy, out=dy)
    return np.asarray(np.add(dx, dy, out=dx))
