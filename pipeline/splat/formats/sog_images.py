"""The contents of a SOG file in memory: Gaussians as bytes in lossless images, and their meta.json."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, UInt8, UInt16
from torch import Tensor

from splatpipe.pipeline.splat.containers.codebooks import fit_codebook, nearest_codes
from splatpipe.pipeline.splat.containers.lossless_pictures import webp_of_pixels
from splatpipe.pipeline.splat.containers.palettes import fit_palette, nearest_entries
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.morton import morton_keys
from splatpipe.pipeline.splat.model.neighbourhoods import reordered
from splatpipe.pipeline.splat.model.position_cost import PositionCost, sizes_of
from splatpipe.pipeline.splat.model.sh import multiply_rows

VERSION = 2
META = "meta.json"
RECORD = "splatpipe"
"""The name of our record in meta.json."""
LEVELS = 65_535  # steps of a coordinate, 16 bits
FIRST_MODE = 252  # a quaternion's alpha value is 252 + which of w, x, y, z is the largest
ENTRIES_A_ROW = 64  # palette entries in a row of its picture
MAX_ENTRIES = 65_536
_HARMONIC_LEVELS = 64  # codebook size for the palette: as good as 256 beside the palette's own error, a quarter smaller
_MAX_LOG_AREA = 80.0  # bound on the natural logarithm of a Gaussian's area
_MAX_WEIGHT_QUANTILE = 0.99
_MIN_WEIGHT = 1e-3  # least weight relative to the mean: what is hardly seen from afar is seen from near
_ROWS_AT_ONCE = 1 << 16
_SIDES = 4  # a picture's sides are multiples of this: what a GPU's textures like


@dataclass(frozen=True)
class SogImages:
    """Files of a SOG.

    Attributes:
        meta: Contents of `meta.json`, which names the images.
        images: Lossless WebP images by file name.
    """

    meta: dict[str, Any]
    images: dict[str, bytes]

    def files(self) -> dict[str, bytes]:
        """All files by name, `meta.json` first."""
        text = json.dumps(self.meta, separators=(",", ":"), allow_nan=False)
        return {META: text.encode("ascii"), **self.images}


def encode_sog(
    gaussians: Gaussians,
    antialias: bool = False,
    record: str = "",
    in_order: bool = False,
    turn: Float64[Tensor, "3 3"] | None = None,
) -> SogImages:
    """Encode Gaussians; deterministic for any number of threads.

    Args:
        gaussians: Finite, on the CPU, in the file's frame (y down, as viewers assume), about an origin near the scene:
            a coordinate's quantum is 1 / 65,535 of its range in ± log(1 + |x|).
        antialias: Whether their opacities account for the screen-space blur.
        record: ``SceneFacts.record()`` for a whole file; empty for the pieces of a streamed one.
        in_order: Keep the order, e.g. if a LOD index refers to it; otherwise sort along a Morton curve, which is
            smaller.
        turn: Rotation to the file's frame, if they are in another.

    Returns:
        meta.json and the images.

    Raises:
        ValueError: if a parameter is not finite.
    """
    gaussians = gaussians.detach().to("cpu", torch.float32)
    if not bool(gaussians.finite().all()):
        raise ValueError("a SOG file holds finite numbers only")
    if len(gaussians) and not (in_order and turn is None):
        order = torch.arange(len(gaussians)) if in_order else _along_a_curve(gaussians.means, turn)
        gaussians = Gaussians.gathered(reordered(gaussians, order, _ROWS_AT_ONCE, turn), gaussians)
    meta: dict[str, Any] = {"version": VERSION, "asset": {"generator": "splatpipe"}, "count": len(gaussians)}
    meta["antialias"] = antialias
    if record:
        meta[RECORD] = json.loads(record)
    images: dict[str, bytes] = {}
    for name, (facts, pictures) in _parts(gaussians).items():
        meta[name] = {**facts, "files": [f"{picture}.webp" for picture in pictures]}
        images |= {f"{picture}.webp": webp_of_pixels(pixels) for picture, pixels in pictures.items()}
    return SogImages(meta, images)


def _along_a_curve(means: Float[Tensor, "n 3"], turn: Float64[Tensor, "3 3"] | None) -> Int64[Tensor, " n"]:
    turned = means if turn is None else multiply_rows(turn, means.double()).to(means.dtype)
    lowest, highest = turned.amin(0), turned.amax(0)
    return torch.argsort(morton_keys(turned, lowest, highest - lowest), stable=True)


_Part = tuple[dict[str, Any], dict[str, UInt8[np.ndarray, "h w c"]]]


def _parts(gaussians: Gaussians) -> dict[str, _Part]:
    weights = _area_weights(gaussians)
    parts = {
        "means": _means(gaussians.means),
        "scales": _scales(gaussians.log_scales, weights),
        "quats": _quats(gaussians.quats),
        "sh0": _colours(gaussians.sh[:, 0], gaussians.opacity_logits, weights),
    }
    if gaussians.sh_degree:
        parts["shN"] = _harmonics(gaussians.sh[:, 1:], weights)
    return parts


def _area_weights(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """Approximate image share of each Gaussian relative to the mean: opacity times area, clipped at a high quantile.

    It weights errors, because an image's error is the sum over the pixels that each Gaussian covers.
    """
    if not len(gaussians):
        return torch.zeros(0)
    sides = gaussians.log_scales.sort(1).values[:, 1:].sum(1).clamp(-_MAX_LOG_AREA, _MAX_LOG_AREA)
    areas = torch.sigmoid(gaussians.opacity_logits).double() * torch.exp(sides.double())
    most = areas.sort().values[int(_MAX_WEIGHT_QUANTILE * (len(areas) - 1))]  # the largest are hidden behind others
    areas = areas.clamp_max(most)
    return (areas / areas.mean().clamp_min(1e-300)).clamp_min(_MIN_WEIGHT).float()


def _means(means: Float[Tensor, "n 3"]) -> _Part:
    logs = _signed_log(means.numpy().astype(np.float64))
    low, high = (logs.min(0), logs.max(0)) if len(logs) else (np.zeros(3), np.zeros(3))
    size = np.where(high > low, high - low, 1.0)
    levels: UInt16[np.ndarray, "n 3"] = np.rint((logs - low) / size * LEVELS).astype(np.uint16)
    pictures = {
        "means_l": _picture((levels & 255).astype(np.uint8)),
        "means_u": _picture((levels >> 8).astype(np.uint8)),
    }
    return {"mins": low.tolist(), "maxs": high.tolist()}, pictures


def position_cost(gaussians: Gaussians) -> PositionCost:
    """What the steps of the positions cost the Gaussians; the same for any axes."""
    means = gaussians.means.numpy().astype(np.float64)
    if not len(means):
        return PositionCost.of(0.0, np.zeros((0, 2)))
    logs = _signed_log(means)
    steps = (logs.max(0) - logs.min(0)) / LEVELS * (1.0 + np.abs(means))
    return PositionCost.of(steps.max(axis=1), sizes_of(gaussians.log_scales))


def _signed_log(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.asarray(np.sign(values) * np.log1p(np.abs(values)))


def _scales(log_scales: Float[Tensor, "n 3"], weights: Float[Tensor, " n"]) -> _Part:
    codebook = fit_codebook(log_scales.numpy().ravel(), weights.repeat_interleave(3).numpy())
    pictures = {"scales": _picture(nearest_codes(log_scales.numpy(), codebook))}
    return {"codebook": _numbers(codebook)}, pictures


def _quats(quats: Float[Tensor, "n 4"]) -> _Part:
    """Encode the three smallest of w, x, y, z over √½, and the index of the fourth."""
    unit = quats.numpy().astype(np.float64)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(axis=1)
    unit *= np.where(np.take_along_axis(unit, largest[:, None], 1) < 0.0, -1.0, 1.0)
    others = np.arange(3) + (np.arange(3) >= largest[:, None])
    rest = np.take_along_axis(unit, others, axis=1)
    codes = np.rint((rest * math.sqrt(0.5) + 0.5) * 255.0).clip(0.0, 255.0)
    pixels = np.concatenate((codes, FIRST_MODE + largest[:, None]), axis=1).astype(np.uint8)
    return {}, {"quats": _picture(pixels)}


def _colours(dc: Float[Tensor, "n 3"], opacity_logits: Float[Tensor, " n"], weights: Float[Tensor, " n"]) -> _Part:
    codebook = fit_codebook(dc.numpy().ravel(), weights.repeat_interleave(3).numpy())
    opacities = torch.sigmoid(opacity_logits).mul(255.0).round().to(torch.uint8).numpy()
    pixels = np.concatenate((nearest_codes(dc.numpy(), codebook), opacities[:, None]), axis=1)
    return {"codebook": _numbers(codebook)}, {"sh0": _picture(pixels)}


def _harmonics(sh: Float[Tensor, "n k 3"], weights: Float[Tensor, " n"]) -> _Part:
    """A palette of vectors of all higher SH coefficients, and the index of each Gaussian's entry."""
    rows = sh.flatten(1)
    palette, fitted = torch.zeros(1, rows.shape[1]), torch.zeros(0, dtype=torch.int64)
    if len(rows):
        palette, fitted = fit_palette(rows, palette_size(len(rows)), weights)
    codebook = fit_codebook(palette.numpy().ravel(), size=_HARMONIC_LEVELS)
    codes = nearest_codes(palette.numpy(), codebook)
    labels = nearest_entries(rows, torch.from_numpy(codebook[codes]), fitted).numpy()
    codes, labels = _by_first_use(codes, labels)
    room = np.zeros((-(-len(codes) // ENTRIES_A_ROW) * ENTRIES_A_ROW, *sh.shape[1:]), np.uint8)
    room[: len(codes)] = codes.reshape(len(codes), *sh.shape[1:])
    split = np.stack((labels & 255, labels >> 8, np.zeros_like(labels)), axis=1).astype(np.uint8)
    pictures = {"shN_centroids": room.reshape(-1, ENTRIES_A_ROW * sh.shape[1], 3), "shN_labels": _picture(split)}
    bands = math.isqrt(sh.shape[1] + 1) - 1
    return {"count": len(codes), "bands": bands, "codebook": _numbers(codebook)}, pictures


def _by_first_use(
    codes: UInt8[np.ndarray, "k d"], labels: Int64[np.ndarray, " n"]
) -> tuple[UInt8[np.ndarray, "m d"], Int64[np.ndarray, " n"]]:
    """Keep only used entries, in order of first use, so that neighbours have similar labels."""
    if not len(labels):
        return codes, labels
    used, first, places = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return codes[used[order]], rank[places]


def palette_size(count: int) -> int:
    """Number of palette entries: the largest power of two up to the number of Gaussians, within the format's limit."""
    return min(1 << (count.bit_length() - 1), MAX_ENTRIES)


def _picture(pixels: UInt8[np.ndarray, "n c"]) -> UInt8[np.ndarray, "h w c"]:
    """Arrange pixels as a nearly square image, padded with zeros."""
    width = max(math.ceil(math.sqrt(len(pixels)) / _SIDES), 1) * _SIDES
    height = max(math.ceil(len(pixels) / width / _SIDES), 1) * _SIDES
    room = np.zeros((width * height, pixels.shape[1]), np.uint8)
    room[: len(pixels)] = pixels
    return room.reshape(height, width, pixels.shape[1])


def _numbers(values: Float32[np.ndarray, " n"]) -> list[float]:
    """Numbers as the shortest decimals that round to these float32 values."""
    return [float(str(value)) for value in values]
