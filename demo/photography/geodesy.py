"""Convert local east-north-up metres to WGS84 and UTM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from splatpipe.demo.site.mesh import Array


@dataclass(frozen=True)
class Origin:
    """Origin of the local frame: WGS84 degrees and ellipsoidal height (EPSG:4979)."""

    latitude: float = 47.8412
    longitude: float = 13.5127
    height_m: float = 512.0
    utm_epsg: int = 32633

    def geodetic(self, enu: Array) -> Array:
        """Convert east, north, up (n, 3) to latitude, longitude, ellipsoidal height (n, 3)."""
        pipeline = (
            "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84"
            f" +lat_0={self.latitude} +lon_0={self.longitude} +h_0={self.height_m}"
            " +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        east, north, up = enu.T
        longitude, latitude, height = Transformer.from_pipeline(pipeline).transform(east, north, up)
        return np.stack([latitude, longitude, height], axis=1)

    def utm(self, enu: Array) -> Array:
        """Convert east, north, up (n, 3) to UTM easting, northing and ellipsoidal height (n, 3)."""
        latitude, longitude, height = self.geodetic(enu).T
        easting, northing = Transformer.from_crs(4326, self.utm_epsg, always_xy=True).transform(longitude, latitude)
        return np.stack([easting, northing, height], axis=1)
