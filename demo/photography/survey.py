"""A survey of the capture: which photos see its targets, and the targets' image marks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from splatpipe.demo.photography.cameras import BrownLens, Pose
from splatpipe.demo.site.mesh import Array
from splatpipe.demo.site.scene import SurveyTarget

BORDER_PX = 12  # a target nearer to the photo's border is not marked
MAX_INCIDENCE_DEG = 72
HIT_TOLERANCE_M = 0.02
Sightings = dict[str, dict[str, Array]]  # point name -> photo name -> pixel (2,)


def sightings(
    points: Sequence[SurveyTarget], poses: Sequence[Pose], lens: BrownLens, first_hit: Callable[[Array, Array], Array]
) -> Sightings:
    """Exact pixels of each point in each photo that sees it.

    Args:
        points: Surveyed points.
        poses: Photos.
        lens: Their camera.
        first_hit: Distance to the first surface along rays, (n, 3) origins and unit directions to (n,).
    """
    xyz = np.stack([p.xyz for p in points])
    normals = np.stack([p.normal for p in points])
    found: Sightings = {p.name: {} for p in points}
    for pose in poses:
        ahead = xyz - pose.centre
        distance = np.linalg.norm(ahead, axis=1)
        direction = ahead / distance[:, None]
        camera = pose.to_camera(xyz)
        facing = -(direction * normals).sum(axis=1) > np.cos(np.deg2rad(MAX_INCIDENCE_DEG))
        hit = np.abs(first_hit(np.broadcast_to(pose.centre, xyz.shape), direction) - distance) < HIT_TOLERANCE_M
        for k in np.flatnonzero(facing & hit & (camera[:, 2] > 1.0)).tolist():
            pixel = lens.project(camera[k : k + 1])[0]
            if (pixel > BORDER_PX).all() and (pixel < np.array([lens.width, lens.height]) - BORDER_PX).all():
                found[points[k].name][pose.name] = pixel
    return found


def gcp_list(epsg: int, utm: dict[str, Array], marks: Sightings) -> str:
    """Format ODM's ground control file: the CRS, then one line ``x y z px py photo name`` per mark."""
    lines = [f"EPSG:{epsg}"]
    for name, photos in marks.items():
        easting, northing, height = utm[name]
        for photo, (px, py) in photos.items():
            lines.append(f"{easting:.4f} {northing:.4f} {height:.4f} {px:.2f} {py:.2f} {photo} {name}")
    return "\n".join(lines) + "\n"
