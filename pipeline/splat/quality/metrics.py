"""Similarity metrics between a render and its photo that need no learned weights.

Every metric takes images (h, w, 3) in [0, 1] and an optional mask (h, w), True where a pixel counts. Pixels that do not
count are replaced by the photo's before any neighbourhood is evaluated, so they neither help nor harm. Everything is
float64, and every sum has a fixed order: bit-identical for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

Image = Float[Tensor, "h w 3"]
Mask = Bool[Tensor, "h w"]

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
_STRIP_ROWS = 64  # rows whose windows are compared at a time: they fit into a core's cache
_SHARPNESS_FLOOR = 1.0 / 255.0
"""A gradient of one grey level per pixel: a photo with less has no edges to compare."""


@dataclass(frozen=True, eq=False)
class ImagePair:
    """A render and its photo, prepared once for every metric.

    Attributes:
        x: The render's channels; pixels that do not count are the photo's.
        y: The photo's channels.
        counts: Which pixels count.
    """

    x: Float[Tensor, "3 h w"]
    y: Float[Tensor, "3 h w"]
    counts: Bool[Tensor, "h w"]

    @cached_property
    def lumas(self) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Both images' luma."""
        return _luma(self.x), _luma(self.y)

    @cached_property
    def windows(self) -> list[list[float]]:
        """For each channel: the sum of SSIM over all counting pixels with the borders reflected; and the sums of SSIM
        and of its contrast · structure factor over the whole windows, as the finest scale of MS-SSIM needs them."""
        radius = SSIM_WINDOW // 2
        whole = self.counts.clone()
        for border in (whole[:radius], whole[-radius:], whole[:, :radius], whole[:, -radius:]):
            border.zero_()
        sums = []
        for channel in zip(self.x, self.y, strict=True):
            around_x, around_y = (pad(image[None], [radius] * 4, mode="reflect")[0] for image in channel)
            sums.append(_window_sums(around_x, around_y, (self.counts, whole, whole)))
        return sums


def pair_of(render: Image, photo: Image, mask: Mask | None = None) -> ImagePair:
    """Prepare a render and its photo for the metrics.

    Raises:
        ValueError: if the shapes differ, a value is not finite, or no pixel counts.
    """
    if render.shape != photo.shape or render.ndim != 3 or render.shape[2] != 3:
        raise ValueError(f"render {tuple(render.shape)} and photo {tuple(photo.shape)} are not both (h, w, 3)")
    counts = torch.ones(render.shape[:2], dtype=torch.bool) if mask is None else mask.cpu()
    if counts.shape != render.shape[:2]:
        raise ValueError(f"mask {tuple(counts.shape)} is not {tuple(render.shape[:2])}")
    _require_pixels(counts)
    if not bool(torch.isfinite(photo).all() and (torch.isfinite(render).all() if mask is None else True)):
        raise ValueError("the render or the photo has values that are not finite")
    x, y = (_planes(image.detach().cpu()) for image in (render, photo))
    if mask is not None:
        for channel, other in zip(x, y, strict=True):
            channel.copy_(torch.where(counts, channel, other))
            if not bool(torch.isfinite(channel).all()):
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
    x, y, counts = pair.x, pair.y, pair.counts
    errors = (_sum((a - b).square_(), counts) for a, b in zip(x, y, strict=True))
    error = math.fsum(errors) / (3 * int(counts.sum()))
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
    x, y, counts = pair.x, pair.y, pair.counts
    board = _chessboard(counts.shape[0], counts.shape[1])
    halves = (counts & board, counts & ~board)
    maps = _colour_maps(x, y, halves)
    errors = []
    for colour, scored in zip(reversed(maps), halves, strict=True):
        for source, target in _chosen_strips(x, y, scored):
            for channel, into in zip(target, colour.T.tolist(), strict=True):
                corrected = into[0] * source[0] + into[1] * source[1] + into[2] * source[2] + into[3]
                errors.append(float((corrected.clamp_(0.0, 1.0) - channel).square_()[None].sum(dim=1)))
    error = math.fsum(errors) / (3 * int(counts.sum()))
    return 10.0 * math.log10(1.0 / error) if error > 0.0 else math.inf


def _chessboard(height: int, width: int) -> Bool[Tensor, "h w"]:
    side = math.ceil(max(height, width) / _FIELDS)
    rows, columns = (torch.arange(size) // side for size in (height, width))
    return (rows[:, None] + columns[None]) % 2 == 0


def _colour_maps(x: Tensor, y: Tensor, halves: tuple[Tensor, Tensor]) -> list[Float[Tensor, "4 3"]]:
    """The least-squares map from ``x`` to ``y`` for each half; the last row is the offset."""
    solutions = []
    for half in halves:
        _require_pixels(half)
        sums = torch.zeros(4, 7, dtype=torch.float64)  # products of (x, 1) with (x, 1, y), summed
        for source, target in _chosen_strips(x, y, half):
            every = torch.cat([source, torch.ones_like(source[:1]), target])  # (7, n)
            sums += torch.stack([(one * every).sum(dim=1) for one in every[:4]])
        # gelsd returns the minimum-norm solution: a render of one colour leaves the map undetermined
        solutions.append(torch.linalg.lstsq(sums[:, :4], sums[:, 4:], driver="gelsd").solution)
    return solutions


def _chosen_strips(x: Tensor, y: Tensor, chosen: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """The chosen pixels (3, n) of both images, strip by strip."""
    for top in range(0, chosen.shape[0], _STRIP_ROWS):
        rows = slice(top, top + _STRIP_ROWS)
        places = torch.nonzero(chosen[rows].reshape(-1))[:, 0]
        source, target = (image[:, rows].reshape(3, -1).index_select(1, places) for image in (x, y))
        yield source, target


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
    return math.fsum(sums[0] for sums in pair.windows) / (3 * int(pair.counts.sum()))


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
        inner = counts[radius:-radius, radius:-radius]
        if min(x.shape[1:]) < SSIM_WINDOW or not bool(inner.any()):
            break
        if not scales:
            sums = [channel[1:] for channel in pair.windows]
        else:
            sums = [_window_sums(*channel, (inner, inner)) for channel in zip(x, y, strict=True)]
        similarity, structure = ([total[k] / int(inner.sum()) for total in sums] for k in (0, 1))
        scales.append((similarity, structure))
        x, y = avg_pool2d(x, 2), avg_pool2d(y, 2)
        counts = _halved(counts)
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
    gx, gy = (_gradient(avg_pool2d(luma[None], 2)[0], (1.0, 1.0, 1.0)) for luma in pair.lumas)
    similarity = (2.0 * gx * gy + _GMSD_C) / (gx.square() + gy.square() + _GMSD_C)
    mean = _mean(similarity[None], counts)
    return math.sqrt(_mean((similarity - mean).square()[None], counts))


@Metric
def sharpness(pair: ImagePair) -> float:
    """Sharpness of the photo's edges in the render: 1 as in the photo, less if blurred, more if overshooting.

    The ratio of the RMS Sobel gradients (Tenengrad: Krotkov, Focusing, IJCV 1, 1987) of the luma, over the tenth of the
    counting pixels where the photo's gradient is largest.
    """
    gx, gy = (_gradient(pad(luma[None], [1] * 4, mode="replicate")[0], (1.0, 2.0, 1.0)) for luma in pair.lumas)
    gx, gy = (gradient[1:-1, 1:-1].masked_select(pair.counts) for gradient in (gx, gy))  # (pixels,)
    edges = max(1, math.ceil(_EDGE_SHARE * gy.numel()))
    least = float(np.partition(gy.numpy(), gy.numel() - edges)[gy.numel() - edges])
    above, level = torch.nonzero(gy > least)[:, 0], torch.nonzero(gy == least)[:, 0]
    chosen = torch.cat([above, level[: edges - above.numel()]])  # among equal ones, the first
    rms = [math.sqrt(math.fsum(g[chosen].square().tolist()) / edges) for g in (gx, gy)]
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


def _ssim_window() -> Float[Tensor, " 11"]:
    """The taps of SSIM's Gaussian window, which sum to one."""
    offset = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    taps = torch.exp(-0.5 * (offset / SSIM_SIGMA).square())
    return taps / taps.sum()


def _planes(image: Tensor) -> Float[Tensor, "3 h w"]:
    """The channels as float64 planes, converted one at a time, because large images take much memory in float64."""
    planes = torch.empty((3, *image.shape[:2]), dtype=torch.float64)
    for plane, channel in zip(planes, image.unbind(2), strict=True):
        plane.copy_(channel)
    return planes


def _require_pixels(counts: Tensor) -> None:
    if not bool(counts.any()):
        raise ValueError("the mask leaves no pixel to measure")


def _sum(values: Float[Tensor, "h w"], counts: Bool[Tensor, "h w"]) -> float:
    """Sum over counting pixels: torch sums a row in one thread, and fsum is exact."""
    return math.fsum(torch.where(counts, values, 0.0).sum(dim=1).tolist())


def _mean(values: Float[Tensor, "c h w"], counts: Bool[Tensor, "h w"]) -> float:
    """Mean over channels and counting pixels."""
    return math.fsum(_sum(channel, counts) for channel in values) / (values.shape[0] * int(counts.sum()))


def _window_sums(
    x: Float[Tensor, "h w"], y: Float[Tensor, "h w"], counts: Sequence[Bool[Tensor, "h-10 w-10"]]
) -> list[float]:
    """Sums of SSIM, for each of the ``counts`` but the last, and of its contrast · structure factor, for the last,
    over the whole windows whose centres count."""
    rows: list[list[float]] = [[] for _ in counts]
    for top in range(0, counts[0].shape[0], _STRIP_ROWS):
        strip = slice(top, top + _STRIP_ROWS + SSIM_WINDOW - 1)
        similarity, structure = _similarity(x[strip], y[strip])
        values = [similarity] * (len(counts) - 1) + [structure]
        for found, one, valid in zip(rows, values, counts, strict=True):
            found += torch.where(valid[top : top + _STRIP_ROWS], one, 0.0).sum(dim=1).tolist()
    return [math.fsum(found) for found in rows]


def _blur(image: Float[Tensor, "h w"]) -> Tensor:
    """Means of whole windows (h - 10, w - 10), by OpenCV's separable filter, which runs in one thread."""
    taps, radius = _ssim_window().numpy(), SSIM_WINDOW // 2
    blurred = cv2.sepFilter2D(np.ascontiguousarray(image.numpy()), cv2.CV_64F, taps, taps)
    return torch.from_numpy(np.asarray(blurred))[radius:-radius, radius:-radius]


def _similarity(x: Float[Tensor, "h w"], y: Float[Tensor, "h w"]) -> tuple[Tensor, Tensor]:
    """SSIM of every whole window, and its contrast · structure factor: (h - 10, w - 10) each."""
    mx, my = _blur(x), _blur(y)
    product = mx * my
    squares = mx.square_().add_(my.square_())
    up = (_blur(x * y) - product).mul_(2.0).add_(SSIM_C2)
    down = (_blur((x * x).add_(y * y)) - squares).add_(SSIM_C2)
    structure = up / down
    similarity = product.mul_(2.0).add_(SSIM_C1).mul_(up)
    return similarity.div_(squares.add_(SSIM_C1).mul_(down).add_(SSIM_EPS)), structure


def _luma(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    return image[0] * _LUMA[0] + image[1] * _LUMA[1] + image[2] * _LUMA[2]


def _halved(counts: Bool[Tensor, "h w"]) -> Tensor:
    """The 2 × 2 blocks (h // 2, w // 2) all of whose pixels count."""
    h, w = counts.shape[0] // 2 * 2, counts.shape[1] // 2 * 2
    block = counts[:h, :w]
    return block[::2, ::2] & block[1::2, ::2] & block[::2, 1::2] & block[1::2, 1::2]


def _gradient(image: Float[Tensor, "h w"], across: tuple[float, float, float]) -> Float[Tensor, "h w"]:
    """Magnitude of the 3 × 3 gradient smoothed by ``across`` (normalised to sum 1), with zero padding."""
    around = pad(image, [1] * 4)
    weights = [weight / sum(across) for weight in across]
    dx = around[:, 2:] - around[:, :-2]  # (h + 2, w)
    dy = around[2:, :] - around[:-2, :]  # (h, w + 2)
    dx = weights[0] * dx[:-2] + weights[1] * dx[1:-1] + weights[2] * dx[2:]
    dy = weights[0] * dy[:, :-2] + weights[1] * dy[:, 1:-1] + weights[2] * dy[:, 2:]
    return (dx.square() + dy.square()).sqrt()
