"""Writer of SPZ, the compressed splat format that most viewers read; versions 3 and 2.

Specification: the README of github.com/nianticlabs/spz. A 16-byte header and six consecutive arrays, all in one gzip
stream: positions (24-bit fixed point), opacities, colours, log scales (8 bits each), rotations (the smallest three
components, 10 bits each; in version 2 x, y, z, 8 bits each) and spherical harmonics (8 bits). Its frame is x right, y
up, z back.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable
from itertools import chain

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.splat.containers.bounded import all_finite
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.position_cost import PositionCost, sizes_of, two_digits

MAGIC = 0x5053474E  # "NGSP"
VERSION = 3
FIRST_THREE_VERSION = 2
"""The previous version, which CesiumJS reads in tiles: rotations in three bytes, off by a degree and more."""
ANTIALIASED = 1
"""Header flag: trained with opacities that account for the screen-space blur."""
SPZ_FROM_Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Rotation from a world with z up (east, north, up) to SPZ's y up."""
RECORD_FIELD = b"sp"
"""ID of the record in gzip's extra field (RFC 1952, 2.3.1.1), which SPZ readers skip."""
POSITION_STEPS = 2**23 - 1
MIN_FRACTIONAL_BITS, MAX_FRACTIONAL_BITS = 12, 20  # the reference's: a quarter of a millimetre in metres
FINEST_QUANTILE, STEPS_PER_SIZE = 0.05, 16.0  # nearly all Gaussians are as many steps large: finer ones are noise
RANGE_PER_SCENE = 16.0  # coordinate range over the distance of nearly all Gaussians: kept even if steps become coarser
SCENE_QUANTILE = 0.99
COLOUR_SCALE = 0.15
MIN_LOG_SCALE, LOG_SCALE_STEPS = -10.0, 16.0
MAX_LOG_SCALE = MIN_LOG_SCALE + 255.0 / LOG_SCALE_STEPS
# share of Gaussians with cut scales above which the user is warned: single huge ones are haze
MIN_REPORTED_SHARE = 0.001
ROTATION_STEPS = 511
SH_STEPS = 128.0
SH_STEP = 10.0
"""Of a Gaussian of middling weight, in SH_STEPS: files as large as the reference writer's, 2 dB better on the demo."""
MIN_SH_DOUBLINGS, MAX_SH_DOUBLINGS = 1, 6
SH_COUNTS = 8  # coefficients apart that Gaussians of one group have
MIN_WEIGHED_OPACITY = 1.0 / 255.0
GZIP_LEVEL = 6
ARRAYS = 6  # after the header


def spz_bytes(
    gaussians: Gaussians,
    antialias: bool,
    sh_step: float | None = SH_STEP,
    turn: Float[torch.Tensor, "3 3"] | None = None,
    version: int = VERSION,
    record: str = "",
) -> bytes:
    """Encode Gaussians, reordered for compression; deterministic.

    A Gaussian so far beyond all others that the 24 bits of positions would no longer do for the scene is moved in along
    its ray from the origin and scaled down by the same factor, so that it looks the same from there; ``position_cost``
    counts them. SH coefficients are
    rounded to power-of-two steps according to a Gaussian's contribution to images, and Gaussians with the same step are
    stored together.

    Args:
        gaussians: Finite; in the file's frame (y up: see ``SPZ_FROM_Z_UP``), about an origin near the scene.
        antialias: Whether their opacities account for the screen-space blur.
        sh_step: SH step of a Gaussian of median weight, in 1/128; None keeps all 8 bits.
        turn: Rotation to the file's frame, if they are in another.
        version: 3, or 2 for readers that support no other.
        record: ASCII record stored in the file, at most 65,000 characters.

    Returns:
        The file's bytes.

    Raises:
        ValueError: if a parameter is not finite, or the version is another one.
    """
    if version not in (FIRST_THREE_VERSION, VERSION):
        raise ValueError(f"SPZ version {version} is not written")
    if not all_finite(gaussians):
        raise ValueError("an SPZ file holds finite numbers only")
    gaussians = gaussians.detach()
    means = [np.zeros((0, 3)), *(_turned(piece, turn).means.numpy() for piece in gaussians.pieces())]
    distances = np.linalg.norm(np.concatenate(means, dtype=np.float64), axis=1)
    bits, shrink = _range(distances, _finest_size(gaussians.log_scales))
    doublings = _sh_doublings(gaussians, sh_step)
    header = struct.pack(
        "<IIIBBBB", MAGIC, version, len(gaussians), gaussians.sh_degree, bits, ANTIALIASED if antialias else 0, 0
    )
    coded: list[list[UInt8[np.ndarray, ...]]] = [[] for _ in range(ARRAYS)]
    done = 0
    for piece in gaussians.pieces():
        rows = slice(done, done + len(piece))
        arrays = _coded(_turned(piece, turn), bits, shrink[rows], doublings[rows], version)
        for kept, array in zip(coded, arrays, strict=True):
            kept.append(array.reshape(len(piece), -1))
        done += len(piece)
    whole = [np.concatenate(kept) for kept in coded if kept]
    order = _order(whole[1], whole[5], doublings) if whole else np.zeros(0, np.int64)
    return _gzip(chain([header], (array[order].tobytes() for array in whole)), record)


def position_cost(gaussians: Gaussians) -> PositionCost:
    """What the steps of the positions and the ranges of positions and scales cost the Gaussians; in any axes."""
    gaussians = gaussians.detach()
    sizes = sizes_of(gaussians.log_scales)
    distances = np.linalg.norm(gaussians.means.numpy().astype(np.float64), axis=1)
    bits, shrink = _range(distances, _finest_size(gaussians.log_scales))
    notes, moved = [], shrink < 1.0
    if moved.any():
        reach = float((distances * shrink).max())
        notes.append(
            f"Moved in to a distance of {reach:,.0f} from the origin and made smaller, as SPZ has no room for them "
            f"beside such small Gaussians: {int(moved.sum()):,} of {len(gaussians):,} Gaussians, up to "
            f"{distances.max():,.0f} away. A PLY or GLB keeps them; splatpipe edit --crop-box removes them."
        )
    largest = gaussians.log_scales.numpy().max(axis=1, initial=-math.inf) + np.log(shrink)
    for count, what, limit in (
        (int((largest > MAX_LOG_SCALE).sum()), "largest", MAX_LOG_SCALE),
        (int((np.log(np.maximum(sizes[:, 0], 1e-300)) < MIN_LOG_SCALE).sum()), "smallest", MIN_LOG_SCALE),
    ):
        if count > MIN_REPORTED_SHARE * len(gaussians):
            notes.append(
                f"Given SPZ's {what} size, {two_digits(math.exp(limit))}: {count:,} of {len(gaussians):,} Gaussians."
            )
    return PositionCost.of(2.0**-bits, sizes, notes=tuple(notes))


def _gzip(parts: Iterable[bytes], record: str) -> bytes:
    """A gzip file (RFC 1952).

    Only runs of a single byte are matched: on the zero runs of SH this compresses better than any level of deflate, in
    an eighth of the time, and elsewhere there are no repetitions.
    """
    extra = b"" if not record else RECORD_FIELD + struct.pack("<H", len(record)) + record.encode("ascii")
    made = [b"\x1f\x8b\x08", bytes([4 if extra else 0]), b"\0\0\0\0\0\xff"]  # no time stamp, no system
    made += [struct.pack("<H", len(extra)), extra] if extra else []
    deflate = zlib.compressobj(GZIP_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
    check, size = 0, 0
    for part in parts:
        made.append(deflate.compress(part))
        check, size = zlib.crc32(part, check), size + len(part)
    return b"".join([*made, deflate.flush(), struct.pack("<II", check, size & 0xFFFFFFFF)])


def _finest_size(log_scales: Float[torch.Tensor, "n 3"]) -> float:
    """The logarithm of the size that nearly all Gaussians exceed."""
    if not len(log_scales):
        return math.log(STEPS_PER_SIZE / 2.0**MIN_FRACTIONAL_BITS)
    middling = np.sort(log_scales.numpy(), axis=1)[:, 1]
    return float(np.quantile(middling, FINEST_QUANTILE, method="lower"))


def _sh_doublings(gaussians: Gaussians, sh_step: float | None) -> UInt8[np.ndarray, " n"]:
    """How many times each Gaussian's SH step of 1/128 is doubled.

    Squared errors add up in an image, so bits are spent best if step² times weight is the same for all. The weight is
    opacity times size: wrong for the image share of hidden Gaussians, but good enough.
    """
    if sh_step is None or not len(gaussians):
        return np.zeros(len(gaussians), np.uint8)
    log_scales = np.sort(gaussians.log_scales.numpy(), axis=1)
    opacity = np.maximum(torch.sigmoid(gaussians.opacity_logits).numpy(), np.float32(MIN_WEIGHED_OPACITY))
    weight = (np.log(opacity) + 0.5 * (log_scales[:, 1] + log_scales[:, 2])) / math.log(2.0)
    middling = float(np.quantile(weight, 0.5, method="lower"))
    doublings = np.rint(math.log2(sh_step) - 0.5 * (weight - middling))
    return np.asarray(doublings.clip(MIN_SH_DOUBLINGS, MAX_SH_DOUBLINGS).astype(np.uint8))


def _order(
    alphas: UInt8[np.ndarray, "n 1"], sh: UInt8[np.ndarray, "n c"], doublings: UInt8[np.ndarray, " n"]
) -> Int64[np.ndarray, " n"]:
    """An order that groups Gaussians by SH step, by number of non-zero coefficients, and by opacity."""
    filled = (sh != SH_STEPS).sum(axis=1, dtype=np.int64) // SH_COUNTS
    key = (doublings.astype(np.int64) * 8 + filled) * 256 + alphas[:, 0]
    return np.asarray(np.argsort(key.astype(np.uint16), kind="stable"))


def _turned(gaussians: Gaussians, turn: Float[torch.Tensor, "3 3"] | None) -> Gaussians:
    return gaussians if turn is None else gaussians.transformed(1.0, turn, torch.zeros(3, dtype=torch.float64))


def _coded(
    gaussians: Gaussians,
    bits: int,
    shrink: Float64[np.ndarray, " n"],
    doublings: UInt8[np.ndarray, " n"],
    version: int,
) -> tuple[UInt8[np.ndarray, ...], ...]:
    """The file's arrays for some Gaussians."""
    log_scales = gaussians.log_scales.numpy() + np.log(shrink).astype(np.float32)[:, None]
    return (
        _fixed_point(gaussians.means.numpy().astype(np.float64) * shrink[:, None], bits),
        _to_byte(torch.sigmoid(gaussians.opacity_logits).numpy() * 255.0),
        _to_byte(gaussians.sh[:, 0].numpy() * (COLOUR_SCALE * 255.0) + 127.5),
        _to_byte((log_scales - MIN_LOG_SCALE) * LOG_SCALE_STEPS),
        (_smallest_three if version == VERSION else _first_three)(gaussians.quats.numpy()),
        _harmonics(gaussians.sh[:, 1:].numpy(), doublings),
    )


def _range(distance: Float64[np.ndarray, " n"], finest: float) -> tuple[int, Float64[np.ndarray, " n"]]:
    """Fractional bits of the positions, and the factor by which each Gaussian is moved in, 0..1.

    Args:
        distance: Distances from the origin.
        finest: The logarithm of the size that nearly all Gaussians exceed: bits beyond ``STEPS_PER_SIZE`` are noise.
    """
    fine_bits = math.ceil((math.log(STEPS_PER_SIZE) - finest) / math.log(2.0))
    most_bits = min(max(fine_bits, MIN_FRACTIONAL_BITS), MAX_FRACTIONAL_BITS)
    if not len(distance) or not distance.max() > 0.0:
        return most_bits, np.ones(len(distance))
    nearly_all = float(np.quantile(distance, SCENE_QUANTILE, method="lower"))
    for_nothing = POSITION_STEPS / 2.0 ** min(max(fine_bits, 0), MAX_FRACTIONAL_BITS)  # beyond it, steps become coarser
    reach = min(float(distance.max()), max(RANGE_PER_SCENE * nearly_all, for_nothing))
    bits = min(max(math.floor(math.log2(POSITION_STEPS / reach)), 0), most_bits)
    reach = min(reach, POSITION_STEPS / 2.0**bits)
    return bits, np.asarray(reach / np.maximum(distance, reach))


def _to_byte(values: Float32[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8))


def _fixed_point(means: Float64[np.ndarray, "n 3"], bits: int) -> UInt8[np.ndarray, "n 9"]:
    """Fixed-point positions: little-endian, three bytes per coordinate, two's complement."""
    steps = np.rint(means * 2.0**bits).clip(-POSITION_STEPS, POSITION_STEPS).astype("<i4")
    return np.ascontiguousarray(steps[:, :, None].view(np.uint8)[:, :, :3]).reshape(len(means), 9)


def _smallest_three(quats: Float32[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n 4"]:
    """Index of the largest of x, y, z, w in the upper 2 bits, then sign and 9 bits of each other one, over √½."""
    ordered = _normalized(quats)
    largest = np.abs(ordered).argmax(axis=1)
    rows = np.arange(len(ordered))
    ordered *= np.where(ordered[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    others = (np.arange(3) + (np.arange(3) >= largest[:, None])).astype(np.int64)  # the three but the largest, in order
    rest = np.take_along_axis(ordered, others, axis=1)
    magnitude = np.rint(np.minimum(np.abs(rest) * math.sqrt(2.0), 1.0) * ROTATION_STEPS).astype(np.uint32)
    signed = magnitude | ((rest < 0.0).astype(np.uint32) << 9)
    word = (largest.astype(np.uint32) << 30) | (signed[:, 0] << 20) | (signed[:, 1] << 10) | signed[:, 2]
    return np.asarray(word.astype("<u4")[:, None].view(np.uint8))


def _first_three(quats: Float32[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n 3"]:
    """x, y, z of the quaternion with non-negative w, one byte each."""
    ordered = _normalized(quats)
    ordered *= np.where(ordered[:, 3:] < 0.0, -1.0, 1.0)
    return _to_byte(ordered[:, :3].astype(np.float32) * 127.5 + 127.5)


def _normalized(quats: Float32[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Unit quaternions in the order x, y, z, w."""
    ordered = quats[:, [1, 2, 3, 0]].astype(np.float64)
    return np.asarray(ordered / np.maximum(np.linalg.norm(ordered, axis=1, keepdims=True), 1e-30))


def _harmonics(sh: Float32[np.ndarray, "n k 3"], doublings: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, "n k 3"]:
    """SH bytes about 128, rounded to each Gaussian's step."""
    step = np.exp2(doublings.astype(np.float32))[:, None, None]
    return np.asarray(
        np.clip(np.rint(sh * (np.float32(SH_STEPS) / step)) * step + SH_STEPS, 0.0, 255.0).astype(np.uint8)
    )
