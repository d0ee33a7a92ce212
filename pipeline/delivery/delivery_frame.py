"""A splat and its cameras in the world frame in which they are delivered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea, read_world_area
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import SceneFacts, SplatOrigin
from splatpipe.pipeline.survey.crs.crs import utm_of
from splatpipe.pipeline.survey.crs.frames import Frame, Origin, Similarity
from splatpipe.pipeline.survey.crs.georeference import georeference


def in_world(gaussians: Gaussians, frame: Frame) -> Gaussians:
    """The model in the world frame: finite, its quaternions of unit length.

    Args:
        gaussians: In the model's frame.
        frame: georef's.
    """
    return Gaussians.gathered((_in_world(piece, frame) for piece in gaussians.pieces()), gaussians)


def _in_world(gaussians: Gaussians, frame: Frame) -> Gaussians:
    similarity = frame.world_from_model
    moved = gaussians.transformed(
        float(similarity.scale),
        torch.from_numpy(np.ascontiguousarray(similarity.rotation, np.float64)),
        torch.from_numpy(np.ascontiguousarray(similarity.translation, np.float64)),
    )
    length = torch.linalg.vector_norm(moved.quats, dim=1, keepdim=True)
    moved.quats = moved.quats / length.clamp(min=1e-30)
    return moved.select(moved.finite() & (length[:, 0] > 0.0))


def facts_of(frame: Frame, antialias: bool) -> SceneFacts:
    """The facts that files state about a splat in the world frame.

    Args:
        frame: georef's.
        antialias: Whether its opacities compensate for the screen-space blur.
    """
    origin, place = frame.origin, None
    if origin is not None:
        crs = frame.crs or utm_of(origin.latitude, origin.longitude).text
        where = (origin.latitude, origin.longitude, origin.height_m)
        place = SplatOrigin(*where, frame.vertical_datum, crs, frame.approximate_crs)
    return SceneFacts("z up", antialias, frame.in_metres, place)


def frame_of(place: SplatOrigin) -> Frame:
    """The frame, z up, of a splat with this origin, for ``open_world``."""
    origin = Origin(place.latitude, place.longitude, place.height_m)
    return Frame(
        kind="enu",
        world_from_model=Similarity.identity(),
        origin=origin,
        vertical_datum=place.vertical_datum,
        crs=place.crs,
        approximate_crs=place.approximate_crs,
    )


def inside_first(gaussians: Gaussians, area: PlanArea | None) -> tuple[Gaussians, int | None]:
    """Sort a splat so that what lies inside a boundary comes before its backdrop, and can be used alone.

    Args:
        gaussians: In the world frame.
        area: The boundary; None without one.

    Returns:
        The splat, and how many Gaussians lie inside; None without a boundary, where nothing changes.
    """
    if area is None:
        return gaussians, None
    inside = torch.from_numpy(area.contains(gaussians.means.double().numpy()))
    rows = torch.cat([torch.nonzero(inside).flatten(), torch.nonzero(~inside).flatten()])
    return gaussians.select(rows), int(inside.sum())


def bounded_comments(inside: int | None, gaussians: int) -> list[str]:
    """Header lines that state how many Gaussians lie inside a boundary; none without one."""
    if inside is None:
        return []
    return [f"boundary: the first {inside} Gaussians lie inside, the other {gaussians - inside} are a backdrop"]


def georef_facts(frame: Frame, box: Float64[np.ndarray, "2 3"], boundary: Path | None) -> dict[str, Any]:
    """The `georef.json` next to a delivered scene: its place, its accuracy, and a boundary if there is one.

    Args:
        frame: georef's.
        box: Bounding box of what is delivered, in the world frame.
        boundary: `georef.boundary`; None where the run has no such part.

    Raises:
        StageError: if the boundary cannot be read.
    """
    area = read_world_area(boundary)
    bounded = {} if area is None or boundary is None else {"boundary": _boundary_facts(area, boundary)}
    return {**georeference(frame, box), "uncertainty": frame.residuals.get("uncertainty"), **bounded}


def _boundary_facts(area: PlanArea, part: Path) -> dict[str, Any]:
    """A boundary's size and its polygons, in the world frame and as GeoJSON's rings.

    Args:
        area: In the world frame.
        part: `georef.boundary`.
    """
    degrees = read_json(part)["degrees"]
    closed = [[[*ring, ring[0]] for ring in polygon] for polygon in degrees]
    return {
        "area_m2": round(area.size(), 3),
        "east_north_m": area.facts()["polygons"],
        "wgs84": {"type": "MultiPolygon", "coordinates": closed},
    }


def cameras_json(cameras: Sequence[Camera], frame: Frame) -> list[dict[str, Any]]:
    """The cameras as 3DGS viewers read them: world-from-camera rotation and centre, in the splat's frame."""
    listed = []
    for index, camera in enumerate(cameras):
        rotation, centre = pose_in_world(camera, frame)
        listed.append(
            {
                "id": index,
                "img_name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "position": centre.tolist(),
                "rotation": rotation.tolist(),
                "fx": camera.fx,
                "fy": camera.fy,
            }
        )
    return listed


def pose_in_world(camera: Camera, frame: Frame) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """A camera's world-from-camera rotation (3, 3) and centre (3,) in the world frame."""
    similarity = frame.world_from_model
    rotation = np.asarray(similarity.rotation) @ camera.cam_from_world[:3, :3].T
    return np.asarray(rotation), np.asarray(similarity.apply(camera.centre()[None])[0])
