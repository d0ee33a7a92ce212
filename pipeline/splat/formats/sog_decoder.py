"""Decodes Gaussians from a SOG's untrusted meta.json and images."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.bounded import check_expansion
from splatpipe.pipeline.splat.containers.codebooks import CODEBOOK_SIZE
from splatpipe.pipeline.splat.containers.lossless_pictures import pixels_of_picture
from splatpipe.pipeline.splat.formats.sog_images import ENTRIES_A_ROW, FIRST_MODE, LEVELS, MAX_ENTRIES, VERSION
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import MAX_DEGREE, coefficient_count

MAX_EXPANSION = 40.0
"""With SH of degree 3 a Gaussian takes 15 of 236 bytes, in simple scenes half as many."""
_SPARE_PIXELS = 1 << 16  # allowed beyond four times the pixels needed
_HEADER_BYTES = 1 << 12  # allowed for a picture's header
_PIXEL_BYTES = 5  # allowed per pixel: a picture that does not compress, and some more
_MAX_LOG = 1e3  # largest logarithm of a coordinate: larger values are caught after decoding
_MIN_OPACITY = 1e-6  # a byte of 0 or 255 is read as this far from 0 or 1, as PlayCanvas does
_ROWS_AT_ONCE = 1 << 16
_AGAIN = "Copy or export it again."


@dataclass(frozen=True)
class SogDecoder:
    """Decoder of one SOG.

    Attributes:
        path: For error messages.
        meta: Contents of its meta.json.
        load: Returns an image's bytes by name, up to a maximum size.
        stored_bytes: Total size of its files.
    """

    path: Path
    meta: Mapping[str, Any]
    load: Callable[[str, int], bytes]
    stored_bytes: int

    def gaussians(self) -> Gaussians:
        """Decode all Gaussians, with positions of float64; their values are not checked.

        Raises:
            SplatpipeError: if it has another version, is damaged, or is a decompression bomb.
        """
        self._check_version()
        count, bands = self._whole(self.meta, "count", 0, 1 << 31), 0
        harmonics = self._part("shN") if "shN" in self.meta else None
        if harmonics is not None:
            bands = self._whole(harmonics, "bands", 1, MAX_DEGREE)
        check_expansion(self.path, count * (11 + 3 * coefficient_count(bands)) * 4, self.stored_bytes, MAX_EXPANSION)
        gaussians = Gaussians.empty(count, bands)
        gaussians.means = torch.from_numpy(self._means(count))
        gaussians.quats[:] = torch.from_numpy(self._quats(count))
        gaussians.log_scales[:] = torch.from_numpy(self._coded("scales", self._pixels("scales", count)[:, :3]))
        colours = self._pixels("sh0", count)
        gaussians.sh[:, 0] = torch.from_numpy(self._coded("sh0", colours[:, :3]))
        opacities = torch.from_numpy(colours[:, 3] / 255.0).clamp(_MIN_OPACITY, 1.0 - _MIN_OPACITY)
        gaussians.opacity_logits[:] = torch.logit(opacities).float()
        if harmonics is not None:
            self._fill_harmonics(gaussians, harmonics)
        return gaussians

    def _check_version(self) -> None:
        version = self.meta.get("version")
        if version == VERSION and not isinstance(version, bool | float):
            return
        if "lodLevels" in self.meta:
            raise SplatpipeError(
                f"{self.path} is the index of a streamed SOG.", hint="Give the meta.json in one of its folders."
            )
        if version is None and "means" in self.meta:
            raise SplatpipeError(
                f"{self.path} is a SOG of version 1; version {VERSION} can be read.",
                hint="Convert it with splat-transform, or export it again.",
            )
        raise self._wrong("it does not say that it is of version 2")

    def _means(self, count: int) -> Float64[np.ndarray, "n 3"]:
        part = self._part("means")
        low, high = (self._numbers("means", part.get(name), 3) for name in ("mins", "maxs"))
        if max(np.abs(low).max(), np.abs(high).max()) > _MAX_LOG:
            raise self._wrong("its positions have no sensible range")
        levels = self._pixels("means", count, 1, 2)[:, :3].astype(np.float64) * 256.0
        levels += self._pixels("means", count, 0, 2)[:, :3]
        logs = low + (high - low) * (levels / LEVELS)
        with np.errstate(over="ignore"):  # an infinity is caught among the values
            return np.asarray(np.sign(logs) * np.expm1(np.abs(logs)))

    def _quats(self, count: int) -> Float32[np.ndarray, "n 4"]:
        pixels = self._pixels("quats", count)
        if count and pixels[:, 3].min() < FIRST_MODE:
            raise self._wrong("a quaternion's mode is not 252 to 255")
        rest = (pixels[:, :3] / 255.0 - 0.5) * math.sqrt(2.0)
        largest = pixels[:, 3].astype(np.int64) - FIRST_MODE
        quats = np.empty((count, 4), np.float32)
        np.put_along_axis(quats, np.arange(3) + (np.arange(3) >= largest[:, None]), rest.astype(np.float32), axis=1)
        missing = np.sqrt(np.maximum(1.0 - (rest * rest).sum(axis=1), 0.0)).astype(np.float32)
        np.put_along_axis(quats, largest[:, None], missing[:, None], axis=1)
        return quats

    def _fill_harmonics(self, gaussians: Gaussians, part: Mapping[str, Any]) -> None:
        count, per_entry = self._whole(part, "count", 1, MAX_ENTRIES), gaussians.sh.shape[1] - 1
        rows = -(-count // ENTRIES_A_ROW)
        picture = self._picture("shN", 0, 2, rows * ENTRIES_A_ROW * per_entry)
        if picture.shape[1] != ENTRIES_A_ROW * per_entry:
            raise self._wrong("the picture of its palette has another width than its bands need")
        codes = picture.reshape(-1, per_entry, 4)[:count, :, :3]
        palette = torch.from_numpy(self._coded("shN", codes))
        pixels = self._pixels("shN", len(gaussians), 1, 2)
        labels: Int64[np.ndarray, " n"] = pixels[:, 0].astype(np.int64) | pixels[:, 1].astype(np.int64) << 8
        if len(labels) and labels.max() >= count:
            raise self._wrong(f"entry {labels.max()} is none of the {count} of its palette")
        for start in range(0, len(labels), _ROWS_AT_ONCE):
            part_of = slice(start, start + _ROWS_AT_ONCE)
            gaussians.sh[part_of, 1:] = palette[torch.from_numpy(labels[part_of])]

    def _coded(self, name: str, codes: UInt8[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
        """Look up codes in a part's codebook."""
        book = self._part(name).get("codebook")
        if isinstance(book, list) and len(book) > 2 and book[0] is None:
            book = [0.0, *book[1:]]
            numbers = self._numbers(name, book)
            numbers[0] = numbers[1] + (numbers[1] - numbers[-1]) / (CODEBOOK_SIZE - 1)  # what PlayCanvas takes it for
        else:
            numbers = self._numbers(name, book)
        if codes.size and codes.max() >= len(numbers):
            raise self._wrong(f"its codebook of {name} is too short")
        return np.asarray(numbers.astype(np.float32)[codes])

    def _numbers(self, name: str, value: Any, count: int | None = None) -> Float64[np.ndarray, " m"]:
        """A list of numbers."""
        right = isinstance(value, list) and 0 < len(value) <= CODEBOOK_SIZE and count in (None, len(value))
        if not right or not all(isinstance(number, int | float) and abs(number) < 1e30 for number in value):
            raise self._wrong(f"its numbers of {name} are none")
        return np.array(value, dtype=np.float64)

    def _pixels(self, name: str, count: int, which: int = 0, of: int = 1) -> UInt8[np.ndarray, "n 4"]:
        return self._picture(name, which, of, count).reshape(-1, 4)[:count]

    def _picture(self, name: str, which: int, of: int, least: int) -> UInt8[np.ndarray, "h w 4"]:
        files = self._part(name).get("files")
        if not isinstance(files, list) or len(files) != of or not all(isinstance(file, str) for file in files):
            raise self._wrong(f"it does not name the pictures of {name}")
        most = 4 * least + _SPARE_PIXELS
        data = self.load(files[which], _HEADER_BYTES + _PIXEL_BYTES * most)
        return pixels_of_picture(self.path, files[which], data, least, most)

    def _part(self, name: str) -> Mapping[str, Any]:
        part = self.meta.get(name)
        if not isinstance(part, dict):
            raise self._wrong(f"it says nothing of {name}")
        return part

    def _whole(self, part: Mapping[str, Any], name: str, least: int, most: int) -> int:
        value = part.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise self._wrong(f"its {name} is no number from {least} to {most:,}")
        return value

    def _wrong(self, what: str) -> SplatpipeError:
        return SplatpipeError(f"{self.path} is not a complete SOG: {what}.", hint=_AGAIN)
