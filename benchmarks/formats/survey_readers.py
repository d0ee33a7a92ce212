"""Read what `splatpipe export` delivers to surveyors and trainers, with pycolmap and laspy."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pyproj
from jaxtyping import Float64

from splatpipe.pipeline.splat.model.scene import Scene

Check = tuple[str, str, str, str, bool]
"""Reader, format, what is checked, figure, and whether the requirement is met."""
SAME_CENTRE_M = 1e-4
HALF_STEP_M = 0.002  # LAZ is written to a millimetre, and local to projected coordinates are exact to less
SAMPLES = 500


def check_colmap(out: Path) -> Iterator[Check]:
    """Check the dataset's model: as many photos as were registered, and at the poses of `cameras.json`."""
    folder = out / "export/dataset"
    if not (folder / "sparse/0").is_dir():
        yield _not_there("pycolmap", "colmap")
        return
    model = pycolmap.Reconstruction(folder / "sparse/0")
    rows = {row["img_name"]: row for row in json.loads((out / "cameras.json").read_text(encoding="utf-8"))}
    images = {image.name: image for image in model.images.values() if image.has_pose}
    same = sorted(set(rows) & set(images))
    apart = [
        float(np.linalg.norm(images[name].projection_center() - np.array(rows[name]["position"]))) for name in same
    ]
    focal = [abs(model.cameras[images[name].camera_id].focal_length_x - rows[name]["fx"]) for name in same]
    figure = f"{len(same)} of {len(rows)} photos, centres to {1e3 * max(apart, default=np.nan):.4f} mm"
    figure += f", focal lengths to {max(focal, default=np.nan):.4f} px"
    met = len(same) == len(rows) and max(apart) <= SAME_CENTRE_M and max(focal) < 1e-3
    yield "pycolmap", "colmap", "cameras where they are", figure, met
    there = sum((folder / "images" / name).is_file() for name in images)
    yield "pycolmap", "colmap", "photos beside it", f"{there} of {len(images)}", there == len(images)


def check_laz(out: Path, scene: Scene) -> Iterator[Check]:
    """Check the centres: in the run's CRS, where pyproj puts the Gaussians."""
    path = out / "export/centres.laz"
    if not path.is_file():
        yield _not_there("laspy", "laz")
        return
    cloud = laspy.read(path)
    georef = json.loads((out / "georef.json").read_text(encoding="utf-8"))
    crs, wanted = cloud.header.parse_crs(), pyproj.CRS(georef["crs"]["id"])
    horizontal = crs.sub_crs_list[0] if crs is not None and crs.is_compound else crs
    equal = horizontal is not None and horizontal.to_2d().equals(wanted.to_2d(), ignore_axis_order=True)
    yield "laspy", "laz", "its CRS", f"{getattr(crs, 'name', None)}, the run's {wanted.name}", bool(equal)
    found = np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)
    means = scene.gaussians.means.double().numpy()
    sample = means[:: max(1, len(means) // SAMPLES)]
    expected = projected(sample, georef["origin"], wanted)
    apart = [float(np.linalg.norm(found - place, axis=1).min()) for place in expected]
    figure = f"{len(found):,} of {len(means):,} centres, {len(sample)} of them to {1e3 * max(apart):.2f} mm"
    yield "laspy", "laz", "Gaussians where pyproj puts them", figure, max(apart) <= HALF_STEP_M


def projected(
    local_m: Float64[np.ndarray, "n 3"], origin: dict[str, float], crs: pyproj.CRS
) -> Float64[np.ndarray, "n 3"]:
    """Project east, north, up about an origin to a CRS by PROJ's topocentric conversion; heights stay ellipsoidal."""
    step = f"+proj=topocentric +lat_0={origin['latitude']} +lon_0={origin['longitude']} +h_0={origin['height_m']}"
    pipeline = f"+proj=pipeline +step +inv {step} +ellps=WGS84 +step +inv +proj=cart +ellps=WGS84"
    geodetic = pyproj.Transformer.from_pipeline(f"{pipeline} +step +proj=unitconvert +xy_in=rad +xy_out=deg")
    longitude, latitude, height = geodetic.transform(*local_m.T)
    to_crs = pyproj.Transformer.from_crs(pyproj.CRS("EPSG:4326"), crs.to_2d(), always_xy=True)
    east, north = to_crs.transform(longitude, latitude)
    return np.stack([east, north, height], axis=1)


def _not_there(reader: str, name: str) -> Check:
    return reader, name, "is there", f"splatpipe export OUT --format {name}", False
