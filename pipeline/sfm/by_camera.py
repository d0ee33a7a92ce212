"""Captures with several cameras: a summary of each, and cameras with too few photos to be calibrated."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.stage import JSON, Reporter
from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.sfm.judging.judging import TRUSTED_SOURCES
from splatpipe.pipeline.sfm.lenses.focal import adjust_within
from splatpipe.pipeline.sfm.model.structure import read_observations
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

MAX_CAMERAS_REPORTED = 10  # cameras listed on the console; the report lists them all
MIN_CAMERA_PHOTOS = 3  # photos of a camera below which focal length and distance are not separable
MAX_STATED_DEVIATION = 0.05  # maximum relative deviation from a trusted focal length
MAX_SIBLING_DEVIATION = 0.02  # maximum relative deviation from a focal length calibrated with the same body and zoom


def reset_underdetermined_focals(
    model: pycolmap.Reconstruction, verified: ViewGraph, cameras: Sequence[JSON]
) -> list[int]:
    """Reset the focal lengths of cameras with one or two photos to known values, and adjust, in place.

    A single photo, far from others or of a flat object, does not determine its focal length, which may run away in
    mapping. The known value is the calibration from other photos of the same body and zoom (of another size or
    orientation), or else a trusted one from the metadata. A model that needs no reset stays as it is, bit for bit.

    Args:
        model: The result of mapping.
        verified: Its view graph, with the cameras as they were before mapping.
        cameras: The camera groups of ``ingest.cameras``; COLMAP's ids count them from 1.

    Returns:
        COLMAP's ids of the cameras that were reset.
    """
    placed = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    few = [number for number, count in sorted(placed.items()) if count < MIN_CAMERA_PHOTOS]
    if 2 * sum(placed[number] for number in few) > model.num_reg_images():
        return []  # a collection of many people's photos: its cameras constrain each other
    strayed = {}
    for number in few:
        known = _known(number, model, verified, cameras, placed)
        if known is not None and abs(model.cameras[number].mean_focal_length() / known[0] - 1.0) > known[1]:
            strayed[number] = known[0]
    if strayed:
        adjust_within(model, strayed, MAX_SIBLING_DEVIATION)
    return list(strayed)


def _known(
    number: int,
    model: pycolmap.Reconstruction,
    verified: ViewGraph,
    cameras: Sequence[JSON],
    placed: Mapping[int, int],
) -> tuple[float, float] | None:
    """Return a camera's focal length known from other sources, pixels, and its tolerance; None if there is none."""
    own, body = verified.cameras[number].mean_focal_length(), _body(cameras, number)
    changes = [
        model.cameras[other].mean_focal_length() / verified.cameras[other].mean_focal_length()
        for other, count in sorted(placed.items())
        if count >= MIN_CAMERA_PHOTOS and body[1] and _body(cameras, other) == body
    ]
    if changes:
        return own * float(np.median(changes)), MAX_SIBLING_DEVIATION
    return (own, MAX_STATED_DEVIATION) if body[2] in TRUSTED_SOURCES else None


def _body(cameras: Sequence[JSON], number: int) -> tuple[str, str, str, float]:
    """Return make, model, source of the focal length, and the focal length over the longer side (the zoom)."""
    group = cameras[number - 1] if number <= len(cameras) else {}
    longer = max(group.get("width", 1), group.get("height", 1))
    zoom = round(float(group.get("focal_px", 0.0)) / longer, 2)
    return str(group.get("make", "")), str(group.get("model_name", "")), str(group.get("focal_source", "")), zoom


def camera_rows(model: pycolmap.Reconstruction, verified: ViewGraph, cameras: Sequence[JSON]) -> list[JSON]:
    """Return a row per camera in the model: name, photos, photos placed, focal lengths, reprojection error."""
    placed = Counter(model.images[number].camera_id for number in model.reg_image_ids())
    photos = Counter(verified.camera_of.values())
    errors = _errors_px(model, verified)
    rows = []
    for number, camera in sorted(model.cameras.items()):
        group = cameras[number - 1] if number <= len(cameras) else {}
        prior = verified.cameras[number]
        rows.append(
            {
                "id": number,
                "name": f"{group.get('make', '')} {group.get('model_name', '')}".strip(),
                "photos": photos[number],
                "placed": placed[number],
                "model": camera.model_name,
                "focal_px": round(camera.mean_focal_length(), 2),
                "prior_focal_px": round(prior.mean_focal_length(), 2),
                "has_prior": prior.has_prior_focal_length,
                "focal_source": str(group.get("focal_source", "")),
                "error_px": errors.get(number),
            }
        )
    return rows


def report_cameras(rows: Sequence[Mapping[str, JSON]], report: Reporter) -> None:
    """Report the result for each camera if there are several."""
    for row in rows[:MAX_CAMERAS_REPORTED] if len(rows) > 1 else ():
        focal = f"{row['focal_px']:.0f} px ({row['focal_source'] or 'stated'}: {row['prior_focal_px']:.0f})"
        placed = f"{row['placed']} of {row['photos']} photos"
        error = "" if row["error_px"] is None else f", error {row['error_px']:.2f} px"
        report.note(f"Camera {row['id']}, {row['name'] or 'unknown'}: {placed}, focal length {focal}{error}.")


def _errors_px(model: pycolmap.Reconstruction, verified: ViewGraph) -> dict[int, float]:
    """Return the mean reprojection error of each camera's observations, pixels."""
    seen = read_observations(model)
    totals, counts = dict.fromkeys(sorted(model.cameras), 0.0), Counter[int]()
    for image in (model.images[number] for number in sorted(model.reg_image_ids())):
        mine = seen.of(image.image_id)
        pose = np.asarray(image.cam_from_world().matrix(), np.float64)
        projected, _ = project_through_lens(image.camera, pose, seen.points[seen.row[mine]])
        off = np.linalg.norm(projected - verified.keypoints[image.image_id][seen.keypoint[mine]], axis=1)
        sound = np.isfinite(off)
        totals[image.camera_id] += float(off[sound].sum())
        counts[image.camera_id] += int(sound.sum())
    known = [number for number, total in totals.items() if counts[number] and math.isfinite(total)]
    return {number: round(totals[number] / counts[number], 4) for number in known}
