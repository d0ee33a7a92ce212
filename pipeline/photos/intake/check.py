"""Check one photo: read it once, hash it, decode it in full, and extract its metadata."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from jaxtyping import Shaped
from PIL import Image

from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.photos.files.extra_formats import DNG_REASON, EXTRA_FORMATS, is_dng
from splatpipe.pipeline.photos.files.picture_file import (
    STRIP_ROWS,
    load_stored,
    open_picture,
    sparse_data_reason,
    strips_of,
    turn_to_decode,
)
from splatpipe.pipeline.photos.files.scan import Candidate, ExcludedPhoto
from splatpipe.pipeline.photos.metadata.exif import Exif, read_exif
from splatpipe.pipeline.photos.metadata.xmp import find_packet, parse_xmp

MAX_FILE_BYTES = 2 << 30
DRAFT = 8  # libjpeg reads every coefficient of a JPEG, whatever the scale of the pixels that it computes
FINGERPRINT_STEP = 8
TAG_ORIENTATION = 274
TIFF_MAGIC = (b"II*\0", b"MM\0*")
TAG_BITS_PER_SAMPLE = 258
TAGS_GEOTIFF = (33550, 34735)  # ModelPixelScale, GeoKeyDirectory: the size of a map's pixels on the ground, its CRS
PANORAMA = re.compile(r"(?:^|[ ._-])pano(?:rama)?(?:[ ._-]|\d|$)")  # in the names of stitched ones
PANORAMA_ASPECT = 1.9  # a sphere's is 2; of the pictures of other cameras, 1.78 is the widest
DEEP_GREY_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
GREY_MODES = ("1", "L", "LA", "La", *DEEP_GREY_MODES)
COLOUR_MODES = ("RGB", "RGBA")
READ_MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", *DEEP_GREY_MODES)
RANGE_QUANTILES = (0.001, 0.999)  # quantiles of a deep image's values taken as its range: excludes hot and dead pixels


@dataclass(frozen=True)
class PictureLimits:
    """Limits on an image's size: ``min_side`` (of the longer side, pixels) and ``max_pixels``."""

    min_side: int
    max_pixels: int


@dataclass(frozen=True)
class CheckedPhoto:
    """A photo that was decoded in full.

    Attributes:
        name: As in the scan.
        path: Where it is.
        sha256: Of the file.
        width: Of the stored grid, pixels.
        height: Likewise.
        fingerprint: Equal for images with equal pixels, and hardly ever otherwise.
        plain: Whether it is an 8-bit RGB or grey image that every reader supports.
        transparent: Whether it has pixels with an opacity below half.
        deep_range: Lowest and highest value of an image with more than 8 bits per channel, else None.
        exif: Its EXIF.
        xmp: Its XMP properties.
        grey: Whether it has no colours.
    """

    name: str
    path: Path
    sha256: str
    width: int
    height: int
    fingerprint: str
    plain: bool
    transparent: bool
    deep_range: tuple[float, float] | None
    exif: Exif
    xmp: Mapping[str, str]
    grey: bool = False


def check_photo(candidate: Candidate, limits: PictureLimits) -> CheckedPhoto | ExcludedPhoto:
    """Read, hash and decode a file whole.

    Args:
        candidate: The file.
        limits: Limits on the image's size.

    Returns:
        The photo, or why it is left out.
    """
    try:
        data, sha256 = _read_once(candidate.path)
    except OSError as error:
        return ExcludedPhoto(candidate.name, f"cannot be read ({error.strerror or error})")
    except ValueError as error:
        return ExcludedPhoto(candidate.name, str(error))
    try:
        picture = open_picture(BytesIO(data))
    except Exception as error:  # Pillow's readers raise almost anything on broken images
        return ExcludedPhoto(candidate.name, _decode_problem(error, data[:4]))
    with picture:
        reason = _refusal_reason(picture, data, limits) or sparse_data_reason(picture, data)
        return ExcludedPhoto(candidate.name, reason) if reason else _decode(candidate, data, sha256, picture)


def deep_pixels(data: bytes, picture: Image.Image, orientation: int) -> Shaped[np.ndarray, "h w *channels"] | None:
    """Decode the values of an image with more than 8 bits per channel, in the stored grid.

    Args:
        data: The file.
        picture: The file, opened and not yet loaded.
        orientation: EXIF orientation, 1 to 8.

    Returns:
        (h, w) grey, or (h, w, 3 or 4) RGB or RGBA; None for an 8-bit image, or one that only Pillow can read.
    """
    if picture.mode in DEEP_GREY_MODES:
        return np.asarray(load_stored(picture, orientation))
    if picture.mode not in COLOUR_MODES or _bits(data, picture) <= 8:
        return None
    # Pillow keeps only the upper byte of 16-bit colours. OpenCV keeps both, but fails on TIFFs with an orientation.
    encoded = np.frombuffer(_without_orientation(data) if picture.format == "TIFF" else data, np.uint8)
    pixels: Any = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype == np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        return None
    order = [2, 1, 0, 3][: pixels.shape[2]]
    for top in range(0, len(pixels), STRIP_ROWS):  # in place: a second array would be of gigabytes
        pixels[top : top + STRIP_ROWS] = pixels[top : top + STRIP_ROWS][:, :, order]
    return np.asarray(pixels)


def stored_orientation(exif: Exif, picture: Image.Image) -> int:
    """The orientation that Pillow applies when it loads a TIFF (its own tag only), else EXIF's."""
    if picture.format != "TIFF":
        return exif.orientation
    value = _tiff_tag(picture, TAG_ORIENTATION, 1)
    return int(value) if value in range(1, 9) else 1


def _read_once(path: Path) -> tuple[bytes, str]:
    sha = hashlib.sha256()
    with open_regular(path) as file:
        data = file.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise ValueError(f"is larger than {MAX_FILE_BYTES >> 30} GiB")
    sha.update(data)
    return data, sha.hexdigest()


def _refusal_reason(picture: Image.Image, data: bytes, limits: PictureLimits) -> str:
    """Why an opened image must not be decoded; empty if it may be."""
    width, height = picture.size
    if width * height > limits.max_pixels:
        return f"claims {width} × {height} pixels, more than ingest.max_megapixels={limits.max_pixels / 1e6:g} allows"
    if max(width, height) < limits.min_side or 8 * min(width, height) < limits.min_side:
        return f"is only {width} × {height} pixels, less than ingest.min_size={limits.min_side}"
    if picture.format == "TIFF" and is_dng(data):
        return DNG_REASON
    if picture.format == "TIFF" and None not in (_tiff_tag(picture, tag, None) for tag in TAGS_GEOTIFF):
        return "is a map (GeoTIFF), made from photos: give the photos themselves"
    if picture.mode not in READ_MODES:
        return f"has an unsupported colour mode ({picture.mode}): convert it to 8-bit RGB"
    return ""


def _decode(candidate: Candidate, data: bytes, sha256: str, picture: Image.Image) -> CheckedPhoto | ExcludedPhoto:
    exif = read_exif(picture)
    xmp = parse_xmp(find_packet(_xmp_bytes(picture)) or find_packet(data))
    if xmp.get("GPano:ProjectionType") or _is_named_panorama(candidate.name, picture):
        return ExcludedPhoto(candidate.name, "is a stitched panorama: give the original photos")
    orientation = stored_orientation(exif, picture)
    width, height = picture.size
    turned = picture.format == "TIFF" and orientation != 1
    if turned and orientation >= 5:
        width, height = height, width
    with turn_to_decode(width * height):
        try:
            loaded = _load(data, picture, orientation)
        except MemoryError:
            return ExcludedPhoto(candidate.name, "is too large for this machine's memory")
        except Exception as error:  # as above
            return ExcludedPhoto(candidate.name, _decode_problem(error))
        pixels = _deep_facts(loaded) if isinstance(loaded, np.ndarray) else _plain_facts(loaded, (width, height))
    if pixels is None:
        return ExcludedPhoto(candidate.name, "has no valid pixel")
    return CheckedPhoto(
        name=candidate.name,
        path=candidate.path,
        sha256=sha256,
        width=width,
        height=height,
        fingerprint=pixels.fingerprint,
        plain=picture.format not in EXTRA_FORMATS
        and picture.mode in ("RGB", "L")
        and pixels.deep_range is None
        and not turned,
        transparent=pixels.transparent,
        deep_range=pixels.deep_range,
        exif=exif,
        xmp=xmp,
        grey=picture.mode in GREY_MODES,
    )


@dataclass(frozen=True)
class _Facts:
    fingerprint: str
    transparent: bool
    deep_range: tuple[float, float] | None


def _is_named_panorama(name: str, picture: Image.Image) -> bool:
    """Whether a wide picture is called a panorama, as those whose XMP was lost; its tiles are not wide."""
    stem = PurePosixPath(name).stem.casefold()
    return picture.width >= PANORAMA_ASPECT * picture.height and PANORAMA.search(stem) is not None


def _load(data: bytes, picture: Image.Image, orientation: int) -> np.ndarray | Image.Image:
    """Decode the whole file: the values of a deep image, or an 8-bit image, which for a JPEG has a reduced scale."""
    deep = deep_pixels(data, picture, orientation)
    if deep is not None:
        return deep
    picture.draft(None, (max(1, picture.width // DRAFT), max(1, picture.height // DRAFT)))
    return load_stored(picture, orientation)


def _deep_facts(values: np.ndarray) -> _Facts | None:
    """The facts of a deep image; None if no pixel has a value (a float image of NaN)."""
    sample = values[::FINGERPRINT_STEP, ::FINGERPRINT_STEP]
    finite = sample[..., :3][np.isfinite(sample[..., :3])] if values.ndim == 3 else sample[np.isfinite(sample)]
    if finite.size == 0:
        return None
    low, high = np.quantile(finite, RANGE_QUANTILES)
    transparent = False
    if values.ndim == 3 and values.shape[2] == 4:
        transparent = bool((values[:, :, 3] < np.iinfo(values.dtype).max // 2).any())
    return _Facts(_fingerprint(str(values.dtype), values.shape, sample), transparent, (float(low), float(high)))


def _plain_facts(loaded: Image.Image, size: tuple[int, int]) -> _Facts:
    transparent = False
    if loaded.has_transparency_data:
        transparent = any(bool((np.asarray(strip.convert("RGBA"))[:, :, 3] < 128).any()) for strip in strips_of(loaded))
    step = FINGERPRINT_STEP if loaded.size == size else 1  # a JPEG is decoded at a reduced scale
    sample = np.concatenate([np.asarray(strip)[::step, ::step] for strip in strips_of(loaded)])
    return _Facts(_fingerprint(loaded.mode, size, sample), transparent, None)


def _fingerprint(kind: str, size: tuple[int, ...], pixels: np.ndarray) -> str:
    return hashlib.sha256(f"{kind} {size} ".encode() + np.ascontiguousarray(pixels).tobytes()).hexdigest()


def _bits(data: bytes, picture: Image.Image) -> int:
    if picture.format == "PNG":
        return data[24]  # IHDR: 8 bytes signature, 8 chunk head, 8 size, then the bit depth
    if picture.format == "TIFF":
        bits = _tiff_tag(picture, TAG_BITS_PER_SAMPLE, (8,))
        return max(int(value) for value in bits) if isinstance(bits, tuple) else int(bits)
    return 8


def _tiff_tag(picture: Image.Image, tag: int, default: Any) -> Any:
    tags: Mapping[int, Any] = getattr(picture, "tag_v2", {})
    try:
        return tags.get(tag, default)
    except Exception:  # Pillow decodes tags lazily, and raises almost anything on hostile ones
        return default


def _without_orientation(data: bytes) -> bytes:
    """A classic TIFF's bytes with the orientation of its first directory set to 1."""
    order = "little" if data[:2] == b"II" else "big"

    def number(start: int, size: int) -> int:
        return int.from_bytes(data[start : start + size], order)  # type: ignore[arg-type]

    start = number(4, 4)
    if number(2, 2) != 42:
        return data
    for entry in range(start + 2, start + 2 + 12 * number(start, 2), 12):
        if number(entry, 2) == TAG_ORIENTATION:
            one = (1).to_bytes(2, order)  # type: ignore[arg-type]
            return data[: entry + 8] + one + data[entry + 10 :]
    return data


def _xmp_bytes(picture: Image.Image) -> bytes:
    packet = picture.info.get("xmp", b"")
    return packet if isinstance(packet, bytes) else str(packet).encode()


def _decode_problem(error: Exception, magic: bytes = b"") -> str:
    text = str(error)
    if "truncated" in text.lower() or isinstance(error, EOFError):
        return "is truncated: it ends before its last pixel; copy it again from the camera"
    if "cannot identify" in text and magic in TIFF_MAGIC:
        return "is damaged, or a TIFF of a kind that is not read: save it with 8 or 16 bits for each colour"
    if "cannot identify" in text:
        return "is damaged: its header cannot be read"
    detail = " ".join(text.split())[:120]
    return f"is damaged and cannot be decoded ({detail or type(error).__name__})"
