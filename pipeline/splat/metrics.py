"""Similarity metrics between a render and its photo that need no learned weights.

Every metric takes images (h, w, 3) in [0, 1] and an optional mask (h, w), True where a pixel counts. Pixels that do not
count are replaced by the photo's before any neighbourhood is evaluated, so they neither help nor harm. Everything is
float64, and every sum has a fixed order: bit-identical for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable

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


def psnr(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio, 10 log10(1 / MSE) over all counting pixels and channels.

    Returns:
        Decibels; infinite for equal images.

    Raises:
        ValueError: if the shapes differ, a value is not finite, or no pixel counts (likewise for every metric here).
    """
    x, y, counts = _prepare(render, photo, mask)
    errors = (_sum((a - b).square_(), counts) for a, b in zip(x, y, strict=True))
    error = math.fsum(errors) / (3 * int(counts.sum()))
    return 10.0 * math.log10(1.0 / error) if error > 0.0 else math.inf


def psnr_cc(render: Image, photo: Image, mask: Mask | None = None) -> float:
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
    x, y, counts = _prepare(render, photo, mask)
    board = _chessboard(counts.shape[0], counts.shape[1])
    halves = (counts & board, counts & ~board)
    maps = _colour_maps(x, y, halves)
    errors = []
    for colour, scored in zip(reversed(maps), halves, strict=True):
        for channel, into in zip(y, colour.T.tolist(), strict=True):
            corrected = into[0] * x[0] + into[1] * x[1] + into[2] * x[2] + into[3]
            errors.append(_sum((corrected.clamp_(0.0, 1.0) - channel).square_(), scored))
    error = math.fsum(errors) / (3 * int(counts.sum()))
    return 10.0 * math.log10(1.0 / error) if error > 0.0 else math.inf


def _chessboard(height: int, width: int) -> Bool[Tensor, "h w"]:
    side = math.ceil(max(height, width) / _FIELDS)
    rows, columns = (torch.arange(size) // side for size in (height, width))
    return (rows[:, None] + columns[None]) % 2 == 0


def _colour_maps(x: Tensor, y: Tensor, halves: tuple[Tensor, Tensor]) -> list[Float[Tensor, "4 3"]]:
    """The least-squares map from ``x`` to ``y`` for each half; the last row is the offset."""
    for half in halves:
        _require_pixels(half)
    source = [*x, torch.ones_like(x[0])]
    normal, right = torch.zeros(2, 4, 4, dtype=torch.float64), torch.zeros(2, 4, 3, dtype=torch.float64)
    for i, one in enumerate(source):
        for j, other in enumerate((*source[: i + 1], *y)):
            product = one * other
            for k, half in enumerate(halves):
                value = _sum(product, half)
                if j <= i:
                    normal[k, i, j] = normal[k, j, i] = value
                else:
                    right[k, i, j - i - 1] = value
    # gelsd returns the minimum-norm solution: a render of one colour leaves the map undetermined
    return [torch.linalg.lstsq(normal[k], right[k], driver="gelsd").solution for k in range(2)]


def ssim(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Mean structural similarity: ``kornia.metrics.ssim`` with window 11 and "same" padding, to rounding.

    Wang, Bovik, Sheikh, Simoncelli: Image Quality Assessment: From Error Visibility to Structural Similarity, IEEE TIP
    13(4), 2004: a Gaussian window of 11 × 11 and σ 1.5, K1 = 0.01, K2 = 0.03, per channel.

    Raises:
        ValueError: also if a side is under 6 pixels, which is too short to reflect by half a window.
    """
    x, y, counts = _prepare(render, photo, mask)
    radius = SSIM_WINDOW // 2
    if min(x.shape[1:]) <= radius:
        raise ValueError(f"SSIM needs images of {radius + 1} pixels a side, got {tuple(x.shape[1:])}")
    sums = []
    for channel in zip(x, y, strict=True):
        around_x, around_y = (pad(image[None], [radius] * 4, mode="reflect")[0] for image in channel)
        sums.append(_window_sums(around_x, around_y, counts)[0])
    return math.fsum(sums) / (3 * int(counts.sum()))


def ms_ssim(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Multi-scale structural similarity.

    Wang, Simoncelli, Bovik: Multi-scale Structural Similarity for Image Quality Assessment, Asilomar 2003: five
    scales, halved by 2 × 2 means, whole windows only; contrast and structure of each scale and luminance of the
    coarsest, to the published powers. Computed per channel, then averaged. If at some scale no window with a counting
    centre fits into the image, only the finer scales are used, with powers normalised to a sum of one.

    Raises:
        ValueError: also if not even one window fits.
    """
    x, y, counts = _prepare(render, photo, mask)
    radius = SSIM_WINDOW // 2
    scales: list[tuple[list[float], list[float]]] = []  # (similarity, contrast · structure) of each channel
    for _ in _MS_SSIM_WEIGHTS:
        inner = counts[radius:-radius, radius:-radius]
        if min(x.shape[1:]) < SSIM_WINDOW or not bool(inner.any()):
            break
        sums = [_window_sums(*channel, inner) for channel in zip(x, y, strict=True)]
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


def gmsd(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Gradient magnitude similarity deviation: 0 for equal images, larger is worse.

    Xue, Zhang, Mou, Bovik: Gradient Magnitude Similarity Deviation: A Highly Efficient Perceptual Image Quality Index,
    IEEE TIP 23(2), 2014: luma, 2 × 2 means, Prewitt gradients, standard deviation (over N) of their similarity.

    Raises:
        ValueError: also if the images are under 2 pixels a side.
    """
    x, y, counts = _prepare(render, photo, mask)
    if min(x.shape[1:]) < 2:
        raise ValueError(f"GMSD needs images of 2 pixels a side, got {tuple(x.shape[1:])}")
    counts = _halved(counts)
    _require_pixels(counts)
    gx, gy = (_gradient(avg_pool2d(_luma(image)[None], 2)[0], (1.0, 1.0, 1.0)) for image in (x, y))
    similarity = (2.0 * gx * gy + _GMSD_C) / (gx.square() + gy.square() + _GMSD_C)
    mean = _mean(similarity[None], counts)
    return math.sqrt(_mean((similarity - mean).square()[None], counts))


def sharpness(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Sharpness of the photo's edges in the render: 1 as in the photo, less if blurred, more if overshooting.

    The ratio of the RMS Sobel gradients (Tenengrad: Krotkov, Focusing, IJCV 1, 1987) of the luma, over the tenth of the
    counting pixels where the photo's gradient is largest.
    """
    x, y, counts = _prepare(render, photo, mask)
    lumas = (_luma(x), _luma(y))
    del x, y
    gx, gy = (_gradient(pad(luma[None], [1] * 4, mode="replicate")[0], (1.0, 2.0, 1.0)) for luma in lumas)
    gx, gy = gx[1:-1, 1:-1][counts], gy[1:-1, 1:-1][counts]  # (pixels,)
    edges = max(1, math.ceil(_EDGE_SHARE * gy.numel()))
    order = torch.sort(gy, descending=True, stable=True).indices[:edges]
    rms = [math.sqrt(math.fsum(g[order].square().tolist()) / edges) for g in (gx, gy)]
    return (rms[0] + _SHARPNESS_FLOOR) / (rms[1] + _SHARPNESS_FLOOR)


METRICS: dict[str, Callable[..., float]] = {
    "psnr": psnr,
    "psnr_cc": psnr_cc,
    "ssim": ssim,
    "ms_ssim": ms_ssim,
    "gmsd": gmsd,
    "sharpness": sharpness,
}
"""Every metric by its name in metrics.json."""


def ssim_window(dtype: torch.dtype = torch.float64) -> Float[Tensor, " 11"]:
    """The taps of SSIM's Gaussian window, which sum to one."""
    offset = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    taps = torch.exp(-0.5 * (offset / SSIM_SIGMA).square())
    return (taps / taps.sum()).to(dtype)


def _prepare(render: Tensor, photo: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Render (masked pixels taken from the photo) and photo as (3, h, w) in float64, and which pixels count."""
    if render.shape != photo.shape or render.ndim != 3 or render.shape[2] != 3:
        raise ValueError(f"render {tuple(render.shape)} and photo {tuple(photo.shape)} are not both (h, w, 3)")
    counts = torch.ones(render.shape[:2], dtype=torch.bool) if mask is None else mask.cpu()
    if counts.shape != render.shape[:2]:
        raise ValueError(f"mask {tuple(counts.shape)} is not {tuple(render.shape[:2])}")
    _require_pixels(counts)
    x, y = (_planes(image.detach().cpu()) for image in (render, photo))
    for channel, other in zip(x, y, strict=True):
        if mask is not None:
            channel.copy_(torch.where(counts, channel, other))
        if not bool(torch.isfinite(channel).all() and torch.isfinite(other).all()):
            raise ValueError("the render or the photo has values that are not finite")
    return x, y, counts


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
    x: Float[Tensor, "h w"], y: Float[Tensor, "h w"], counts: Bool[Tensor, "h-10 w-10"]
) -> tuple[float, float]:
    """Sums of SSIM and of its contrast · structure factor over the whole windows whose centres count."""
    rows: tuple[list[float], list[float]] = ([], [])
    for top in range(0, counts.shape[0], _STRIP_ROWS):
        strip = slice(top, top + _STRIP_ROWS + SSIM_WINDOW - 1)
        here = counts[top : top + _STRIP_ROWS]
        for found, values in zip(rows, _similarity(x[strip], y[strip]), strict=True):
            found += torch.where(here, values, 0.0).sum(dim=1).tolist()
    return math.fsum(rows[0]), math.fsum(rows[1])


def _blur(image: Float[Tensor, "h w"]) -> Tensor:
    """Means of whole windows (h - 10, w - 10), tap by tap: elementwise, so independent of the threads."""
    for dim in (1, 0):
        length = image.shape[dim] - SSIM_WINDOW + 1
        parts = (tap * image.narrow(dim, i, length) for i, tap in enumerate(ssim_window().tolist()))
        total = next(parts)
        for part in parts:
            total = total.add_(part)
        image = total
    return image


def _similarity(x: Float[Tensor, "h w"], y: Float[Tensor, "h w"]) -> tuple[Tensor, Tensor]:
    """SSIM of every whole window, and its contrast · structure factor: (h - 10, w - 10) each."""
    mx, my = _blur(x), _blur(y)
    sxx, syy, sxy = _blur(x * x) - mx * mx, _blur(y * y) - my * my, _blur(x * y) - mx * my
    up, down = 2.0 * sxy + SSIM_C2, sxx + syy + SSIM_C2
    luminance_up, luminance_down = 2.0 * mx * my + SSIM_C1, mx * mx + my * my + SSIM_C1
    return luminance_up * up / (luminance_down * down + SSIM_EPS), up / down


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
