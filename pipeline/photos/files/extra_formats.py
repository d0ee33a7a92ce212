"""HEIC and DNG photos, read by libraries that are installed on request only: pi-heif (libheif) and rawpy (LibRaw).

Each is imported when such a photo comes. What they give is a Pillow picture like any other, opened without decoding.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image, ImageFile

HEIC_MODULE, RAW_MODULE = "pi_heif", "rawpy"
HEIC_REASON = (
    "is a HEIC picture: convert it to JPEG, or install its reader (pip install pi-heif) and run with "
    "--rerun-from ingest"
)
DNG_REASON = (
    "is a camera's raw file: develop it to JPEG or TIFF, or install its reader (pip install rawpy) and run "
    "with --rerun-from ingest"
)
MODULES = {HEIC_REASON: HEIC_MODULE, DNG_REASON: RAW_MODULE}  # which reader makes a photo of such a file
EXTRA_FORMATS = ("HEIF", "DNG")  # as the pictures call themselves; other readers do not know these files
HEIC_BRANDS = (b"heic", b"heix", b"mif1", b"msf1", b"hevc")
TIFF_HEADS = (b"II*\0", b"MM\0*")
TAG_DNG_VERSION = 50706


def is_heic(head: bytes) -> bool:
    """Whether a file's first bytes are those of a HEIC picture."""
    return head[4:8] == b"ftyp" and head[8:12] in HEIC_BRANDS


def is_installed(module: str) -> bool:
    """Whether a reader is installed; does not import it."""
    return importlib.util.find_spec(module) is not None


def open_heic(source: Any) -> Image.Image:
    """Open a HEIC picture; its turns are applied, and EXIF's orientation is 1.

    Args:
        source: A path or a binary file object.

    Raises:
        OSError: if there is no reader, or it cannot read the file.
    """
    if not is_installed(HEIC_MODULE):
        raise OSError("no reader of HEIC pictures is installed: pip install pi-heif")
    reader = importlib.import_module(HEIC_MODULE)
    try:
        picture: Image.Image = reader.HeifImageFile(source)
    except (ValueError, SyntaxError, RuntimeError, EOFError) as error:
        raise OSError(f"a HEIC picture that cannot be read: {error}") from error
    return picture


def is_dng(data: bytes) -> bool:
    """Whether a file is a camera's raw file (DNG), which is a kind of TIFF."""
    return data.startswith(TIFF_HEADS) and TAG_DNG_VERSION in _exif_of(data)


def open_dng(data: bytes) -> Image.Image:
    """The photo in a camera's raw file (DNG), in the stored grid, developed with the camera's white balance.

    Brightness is not adjusted to each photo, so that photos of one exposure stay alike.

    Raises:
        OSError: if it cannot be read.
    """
    return _RawPicture(BytesIO(data))


class _RawPicture(ImageFile.ImageFile):
    """A raw file that is developed when its pixels are asked for."""

    format = "DNG"

    def _open(self) -> None:
        with self._raw() as raw:
            self._size = (int(raw.sizes.width), int(raw.sizes.height))
        self._mode = "RGB"
        self.tile = []

    @contextlib.contextmanager
    def _raw(self) -> Iterator[Any]:
        reader = importlib.import_module(RAW_MODULE)
        assert isinstance(self.fp, BytesIO)
        try:
            with reader.imread(BytesIO(self.fp.getvalue())) as raw:
                yield raw
        except reader.LibRawError as error:
            raise OSError("a raw file that is broken, or truncated") from error

    def getexif(self) -> Image.Exif:
        """The EXIF of the file."""
        assert isinstance(self.fp, BytesIO)
        return _exif_of(self.fp.getvalue())

    def load(self) -> Any:
        """Develop the photo."""
        if self._im is None:
            with self._raw() as raw:
                pixels = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8, user_flip=0)
            if pixels.shape != (self.height, self.width, 3):
                raise OSError("a raw file whose picture has another size than it states")
            self.im = Image.fromarray(np.ascontiguousarray(pixels)).im
        return Image.Image.load(self)


def _exif_of(data: bytes) -> Image.Exif:
    """The tags of a TIFF; none if they are broken."""
    exif = Image.Exif()
    with contextlib.suppress(Exception):  # Pillow raises almost anything on hostile tags
        exif.load_from_fp(BytesIO(data))
    return exif
