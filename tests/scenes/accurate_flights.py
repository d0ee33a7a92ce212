"""Stated positions of survey flights over flat ground with an accurate receiver, as metadata."""

from collections.abc import Sequence

import numpy as np

from splatpipe.pipeline.survey.adjustment.predicted_flight import FlightCamera
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.positions.photo_positions import Position

CAMERA = FlightCamera(1600, 1300, 1950.0, 0.01)
PLACE = Origin(47.0, 13.0, 400.0)
RTK_M, SINGLE_M = (0.015, 0.025), (3.0, 5.0)


def flight(
    rows: int = 5,
    columns: int = 7,
    height: float = 44.0,
    lift: float = 0.0,
    yaws: Sequence[float] = (90.0, 270.0),
    pitches: Sequence[float] = (-90.0,),
    sigmas: tuple[float, float] = RTK_M,
) -> list[Position]:
    """Strips flown back and forth, 14 m apart, with a photo each 8 m.

    Args:
        rows: Number of strips.
        columns: Photos in each.
        height: Above ground and take-off, metres.
        lift: By which every second strip is higher.
        yaws: Of the camera in even and odd strips, in turn.
        pitches: Of one photo after the other, in turn.
        sigmas: Stated standard deviations.
    """
    photos = []
    for row in range(rows):
        for step in range(columns):
            column = step if row % 2 == 0 else columns - 1 - step
            above = height + lift * (row % 2)
            latitude, longitude, altitude = PLACE.geodetic_from_enu(np.array([[8.0 * column, 14.0 * row, above]]))[0]
            number = len(photos)
            photos.append(
                Position(
                    f"P{number:04d}.JPG",
                    float(latitude),
                    float(longitude),
                    float(altitude),
                    "exif",
                    above,
                    *sigmas,
                    "fixed" if sigmas == RTK_M else None,
                    yaws[row % len(yaws)],
                    pitches[number % len(pitches)],
                    0.0,
                    None,
                    None,
                    None,
                    1,
                )
            )
    return photos
