"""WGS84: geodetic coordinates, earth-centred ones (ECEF, EPSG:4978) and the local east-north-up frame. All in float64.

Formulas: geodetic to ECEF is exact (Hofmann-Wellenhof et al., GNSS, 2008, ch. 8); the inverse is Bowring's (Survey
Review 28, 1985), iterated until it is exact to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

SEMI_MAJOR_M = 6_378_137.0  # defining constants of WGS84
FLATTENING = 1.0 / 298.257223563
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
SECOND_ECCENTRICITY_2 = ECCENTRICITY_2 / (1.0 - ECCENTRICITY_2)
BOWRING_ROUNDS = 4  # the first leaves 1e-9 rad on the ground and 1e-7 rad in orbit; each gains five digits


def ecef_from_geodetic(geodetic: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Geodetic to earth-centred coordinates.

    Args:
        geodetic: Latitude and longitude in degrees, ellipsoidal height in metres.

    Returns:
        X, Y, Z in metres.
    """
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    height = geodetic[:, 2]
    sin, cos = np.sin(latitude), np.cos(latitude)
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * sin**2)
    across = (normal + height) * cos
    z = (normal * (1.0 - ECCENTRICITY_2) + height) * sin
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), z], axis=1)


def geodetic_from_ecef(ecef: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Earth-centred to geodetic coordinates, for points some kilometres or more away from the earth's centre.

    Args:
        ecef: X, Y, Z in metres.

    Returns:
        Latitude and longitude in degrees, ellipsoidal height in metres.
    """
    x, y, z = ecef.T
    across = np.hypot(x, y)
    reduced = np.arctan2(z, across * (1.0 - FLATTENING))
    latitude = reduced
    for _ in range(BOWRING_ROUNDS):
        latitude = np.arctan2(
            z + SECOND_ECCENTRICITY_2 * SEMI_MINOR_M * np.sin(reduced) ** 3,
            across - ECCENTRICITY_2 * SEMI_MAJOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1.0 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    sin, cos = np.sin(latitude), np.cos(latitude)
    height = across * cos + z * sin - SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY_2 * sin**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)


@dataclass(frozen=True)
class Origin:
    """Where a local east-north-up frame has its zero.

    Attributes:
        latitude: Degrees north, WGS84.
        longitude: Degrees east, WGS84.
        height_m: In the vertical datum of the positions it was computed from; treated as ellipsoidal in the formulas,
            which changes nothing within the local frame by more than a part in 100,000.
    """

    latitude: float
    longitude: float
    height_m: float

    def ecef_from_enu(self) -> Float64[np.ndarray, "4 4"]:
        """The rigid transform that places the local frame on the earth (a 3D Tiles root transform)."""
        latitude, longitude = np.radians(self.latitude), np.radians(self.longitude)
        east = [-np.sin(longitude), np.cos(longitude), 0.0]
        up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = east, np.cross(up, east), up
        matrix[:3, 3] = ecef_from_geodetic(np.array([[self.latitude, self.longitude, self.height_m]]))[0]
        return matrix

    def enu_from_geodetic(self, geodetic: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Latitude, longitude (degrees) and height (metres) to east, north, up in metres."""
        matrix = self.ecef_from_enu()
        return np.asarray((ecef_from_geodetic(geodetic) - matrix[:3, 3]) @ matrix[:3, :3])

    def geodetic_from_enu(self, enu: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """East, north, up in metres to latitude, longitude (degrees) and height (metres)."""
        matrix = self.ecef_from_enu()
        return geodetic_from_ecef(enu @ matrix[:3, :3].T + matrix[:3, 3])
