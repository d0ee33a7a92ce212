"""SPZ, the compressed splat file that viewers read most widely: written here, versions 3 and 2.

Specification: the README of github.com/nianticlabs/spz. A 16-byte header and six arrays, one after another, all within
one gzip stream: positions (24-bit fixed point), opacities, colours, logarithms of the scales (8 bits each), rotations
(the smallest three components, 10 bits each; in version 2 x, y, z, 8 bits each) and spherical harmonics (8 bits). Its
frame is x right, y up, z back.
"""

from __future__ import annotations

import gzip
import math
import struct

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8

from splatpipe.pipeline.splat.gaussians import Gaussians

MAGIC = 0x5053474E  # "NGSP"
VERSION = 3
FIRST_THREE_VERSION = 2
"""The one before, which CesiumJS reads in tiles: rotations in three bytes, off by up to a degree and more."""
ANTIALIASED = 1
"""The header's flag: trained with opacities that allow for the blur on screen."""
SPZ_FROM_Z_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Rotation from a world with z up (east, north, up) to SPZ's y up."""
POSITION_STEPS = 2**23 - 1
MOST_FRACTIONAL_BITS = 20
RANGE_PER_SCENE = 16.0  # of the distances of nearly all Gaussians: what is beyond is brought in
SCENE_QUANTILE = 0.99
COLOUR_SCALE = 0.15
LEAST_LOG_SCALE, LOG_SCALE_STEPS = -10.0, 16.0
ROTATION_STEPS = 511
SH_STEPS = 128.0
SH_BITS = (6, 5)  # of degree 1 and of the rest, one more than the reference writer keeps: a fifth larger, 3 dB better
GZIP_LEVEL = 6
ARRAYS = 6  # after the header


def spz_bytes(
    gaussians: Gaussians,
    antialias: bool,
    sh_bits: tuple[int, int] = SH_BITS,
    turn: Float[torch.Tensor, "3 3"] | None = None,
    version: int = VERSION,
) -> bytes:
    """Code Gaussians; the same bytes for the same Gaussians.

    A Gaussian far beyond all others is brought in along its ray from the origin and shrunk alike, so that it looks the
    same from the scene and leaves the positions' 24 bits to the scene.

    Args:
        gaussians: Finite; in the file's frame (y up: see ``SPZ_FROM_Z_UP``), about an origin near the scene.
        antialias: Whether their opacities allow for the blur on screen.
        sh_bits: Kept of the harmonics of degree 1, and of the others; at most 8.
        turn: Rotation to the file's frame, where they are in another.
        version: 3, or 2 for readers that know no other.

    Returns:
        The file.

    Raises:
        ValueError: if a parameter is not finite, or of another version.
    """
    if version not in (FIRST_THREE_VERSION, VERSION):
        raise ValueError(f"SPZ version {version} is not written")
    if not all(bool(piece.finite().all()) for piece in gaussians.pieces()):
        raise ValueError("an SPZ file holds finite numbers only")
    gaussians = gaussians.detach()
    means = [np.zeros((0, 3)), *(_turned(piece, turn).means.numpy() for piece in gaussians.pieces())]
    bits, shrink = _range(np.concatenate(means, dtype=np.float64))
    header = struct.pack(
        "<IIIBBBB", MAGIC, version, len(gaussians), gaussians.sh_degree, bits, ANTIALIASED if antialias else 0, 0
    )
    coded: list[list[bytes]] = [[] for _ in range(ARRAYS)]
    done = 0
    for piece in gaussians.pieces():
        arrays = _coded(_turned(piece, turn), bits, shrink[done : done + len(piece)], sh_bits, version)
        for kept, array in zip(coded, arrays, strict=True):
            kept.append(array.tobytes())
        done += len(piece)
    return gzip.compress(b"".join((header, *(data for kept in coded for data in kept))), GZIP_LEVEL, mtime=0)


def _turned(gaussians: Gaussians, turn: Float[torch.Tensor, "3 3"] | None) -> Gaussians:
    return gaussians if turn is None else gaussians.transformed(1.0, turn, torch.zeros(3, dtype=torch.float64))


def _coded(
    gaussians: Gaussians, bits: int, shrink: Float64[np.ndarray, " n"], sh_bits: tuple[int, int], version: int
) -> tuple[UInt8[np.ndarray, ...], ...]:
    """The file's arrays of some Gaussians."""
    log_scales = gaussians.log_scales.numpy() + np.log(shrink).astype(np.float32)[:, None]
    return (
        _fixed_point(gaussians.means.numpy().astype(np.float64) * shrink[:, None], bits),
        _to_byte(torch.sigmoid(gaussians.opacity_logits).numpy() * 255.0),
        _to_byte(gaussians.sh[:, 0].numpy() * (COLOUR_SCALE * 255.0) + 127.5),
        _to_byte((log_scales - LEAST_LOG_SCALE) * LOG_SCALE_STEPS),
        (_smallest_three if version == VERSION else _first_three)(gaussians.quats.numpy()),
        _harmonics(gaussians.sh[:, 1:].numpy(), sh_bits),
    )


def _range(means: Float64[np.ndarray, "n 3"]) -> tuple[int, Float64[np.ndarray, " n"]]:
    """Fractional bits of the positions, and by how much each is brought in, 0..1."""
    distance = np.linalg.norm(means, axis=1)
    if not len(distance) or not distance.max() > 0.0:
        return MOST_FRACTIONAL_BITS, np.ones(len(means))
    nearly_all = float(np.quantile(distance, SCENE_QUANTILE, method="lower"))
    reach = min(float(distance.max()), RANGE_PER_SCENE * nearly_all or math.inf)
    bits = min(max(math.floor(math.log2(POSITION_STEPS / reach)), 0), MOST_FRACTIONAL_BITS)
    reach = min(reach, POSITION_STEPS / 2.0**bits)
    return bits, np.asarray(reach / np.maximum(distance, reach))


def _to_byte(values: Float32[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8))


def _fixed_point(means: Float64[np.ndarray, "n 3"], bits: int) -> UInt8[np.ndarray, "n 9"]:
    """Little-endian, three bytes a coordinate, in two's complement."""
    steps = np.rint(means * 2.0**bits).clip(-POSITION_STEPS, POSITION_STEPS).astype("<i4")
    return np.ascontiguousarray(steps[:, :, None].view(np.uint8)[:, :, :3]).reshape(len(means), 9)


def _smallest_three(quats: Float32[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n 4"]:
    """Which of x, y, z, w is the largest, in the upper 2 bits, then sign and 9 bits of each other one, over √½."""
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
    """x, y, z of the one of both quaternions whose w is not negative, a byte each."""
    ordered = _normalized(quats)
    ordered *= np.where(ordered[:, 3:] < 0.0, -1.0, 1.0)
    return _to_byte(ordered[:, :3].astype(np.float32) * 127.5 + 127.5)


def _normalized(quats: Float32[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Of length one, in the order x, y, z, w."""
    ordered = quats[:, [1, 2, 3, 0]].astype(np.float64)
    return np.asarray(ordered / np.maximum(np.linalg.norm(ordered, axis=1, keepdims=True), 1e-30))


def _harmonics(sh: Float32[np.ndarray, "n k 3"], bits: tuple[int, int]) -> UInt8[np.ndarray, "n k 3"]:
    """Bytes about 128, rounded to as many bits as are kept."""
    coded = np.empty(sh.shape, np.uint8)
    for columns, kept in ((slice(0, 3), bits[0]), (slice(3, None), bits[1])):
        step = float(1 << (8 - kept))
        coded[:, columns] = np.clip(np.rint(sh[:, columns] * (SH_STEPS / step)) * step + SH_STEPS, 0.0, 255.0)
    return coded
