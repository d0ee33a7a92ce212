"""Pictures of others: what their headers claim is checked before anything is decoded."""

import io
import struct

import pytest

from splatpipe.pipeline.photos.files.picture_file import open_picture

LONG = 4  # the type of a tag


def tiled(width: int, length: int) -> io.BytesIO:
    """The header of a grey TIFF of 100 × 100 pixels with tiles."""
    tags = {256: 100, 257: 100, 258: 8, 259: 1, 262: 1, 277: 1, 322: width, 323: length, 324: 8, 325: 100}
    entries = [struct.pack("<HHII", tag, LONG, 1, value) for tag, value in tags.items()]
    return io.BytesIO(b"II*\0" + struct.pack("<IH", 8, len(tags)) + b"".join(entries) + bytes(1000))


def test_tiles_of_usual_sizes_are_opened() -> None:
    for side in (16, 256, 4096):
        with open_picture(tiled(side, side)) as picture:
            assert picture.size == (100, 100)


@pytest.mark.parametrize("sides", [(40_000, 40_000), (4097, 16), (16, 4097)])
def test_tiles_larger_than_the_picture_are_refused(sides: tuple[int, ...]) -> None:
    with pytest.raises(OSError, match="larger than the picture"):
        open_picture(tiled(*sides))
