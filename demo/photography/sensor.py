"""The sensor of the demo's camera: from radiance to 8-bit photos."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatpipe.demo.site.mesh import Array

GAIN = 3.6  # radiance to sensor, at 0 EV
WHITE_BALANCE = np.array([0.93, 1.0, 1.10])


def coded(light: Array) -> NDArray[np.uint8]:
    """Encode light on the sensor (h, w, 3) as 8-bit sRGB, with soft highlights."""
    light = np.where(light < 0.7, light, 0.7 + 0.3 * np.tanh((light - 0.7) / 0.3))
    light = np.clip(light, 0, 1)
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(values * 255 + 0.5, np.uint8)
