"""PNG files, read back by OpenCV and Pillow."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from splatpipe.pipeline.render.png import coded_png


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 5, 3), (64, 100, 3), (1, 1), (7, 5), (64, 100)])
def test_pixels_are_read_back_as_they_were(shape):
    pixels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    data = coded_png(pixels)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels)
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read if read.ndim == 2 else read[:, :, ::-1], pixels)


def test_indices_are_read_back_as_their_colours():
    random = np.random.default_rng(0)
    pixels, palette = (random.integers(0, 256, shape, np.uint8) for shape in ((30, 41), (256, 3)))
    data = coded_png(pixels, palette)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data)).convert("RGB")), palette[pixels])
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(read[:, :, ::-1], palette[pixels])
