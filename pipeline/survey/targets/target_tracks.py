"""Group detections of one target in several photos into the point of the model where their rays meet."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.triangulation import Rays, triangulate
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.targets.target_finds import TargetFind

MIN_TOLERANCE_PX = 3.0
MAX_ERROR_RATIO = 4.0  # error of a sighting over the model's mean reprojection error, at most
MIN_UNNAMED = 3  # photos of a target without a number: two rays can meet by chance
MIN_CODED = 2
MAX_PARTNERS = 40  # partners of a detection that are tried as hypotheses
MAX_SEEDS = 4000
DEPTH_MARGIN = 2.0  # factor by which a target may be farther or nearer than the sparse points in a photo


@dataclass(frozen=True, eq=False)
class Track:
    """A target in several photos.

    Attributes:
        kind: ``quadrant``, or its dictionary.
        number: Id of a coded target.
        finds: One per photo, by the photos' names.
        place: Position in the model.
    """

    kind: str
    number: int | None
    finds: tuple[TargetFind, ...]
    place: Float64[np.ndarray, " 3"]


@dataclass(frozen=True)
class _PosedFinds:
    """Detections in photos that have a pose, with their rays."""

    finds: tuple[TargetFind, ...]
    rays: Rays
    tolerance_px: float

    def only(self, chosen: Bool[np.ndarray, " n"]) -> _PosedFinds:
        kept = tuple(find for find, keep in zip(self.finds, chosen.tolist(), strict=True) if keep)
        return _PosedFinds(kept, self.rays.only(chosen), self.tolerance_px)


def coded_tracks(finds: Sequence[TargetFind], model: SparseModel, photos: Mapping[str, Photo]) -> list[Track]:
    """Tracks of coded targets; if a number occurs in several places, the one that most photos show."""
    groups: defaultdict[tuple[str, int], list[TargetFind]] = defaultdict(list)
    for find in finds:
        if find.number is not None:
            groups[find.kind, find.number].append(find)
    tracks = []
    for _, group in sorted(groups.items()):
        seen = _seen(group, model, photos)
        track = None if seen is None else _track(seen, MIN_CODED)
        if track is not None:
            tracks.append(track)
    return tracks


def unnamed_tracks(finds: Sequence[TargetFind], model: SparseModel, photos: Mapping[str, Photo]) -> list[Track]:
    """Tracks of targets without a number: detections are grouped by geometry alone."""
    seen = _seen(finds, model, photos)
    tracks: list[Track] = []
    if seen is None:
        return tracks
    reach = _reach(seen, model)
    free = np.ones(len(seen.finds), dtype=bool)
    for seed in range(min(len(seen.finds), MAX_SEEDS)):
        if not free[seed]:
            continue
        group = _group(seen, seed, free, reach)
        track = None if group.sum() < MIN_UNNAMED else _track(seen.only(group), MIN_UNNAMED)
        if track is not None:
            used = set(track.finds)
            free &= np.array([find not in used for find in seen.finds])
            tracks.append(track)
        free[seed] = False
    return tracks


def _seen(finds: Sequence[TargetFind], model: SparseModel, photos: Mapping[str, Photo]) -> _PosedFinds | None:
    index = {name: k for k, name in enumerate(model.names)}
    posed = [find for find in finds if find.photo in index and find.photo in photos]
    views = [model.view(index[find.photo], photos[find.photo].width) for find in posed]
    rays = [view.ray(np.array([find.x, find.y])) for view, find in zip(views, posed, strict=True)]
    pixels = [view.pixels_by_ray(ray) for view, ray in zip(views, rays, strict=True)]
    good = [k for k in range(len(posed)) if np.isfinite(rays[k]).all() and np.isfinite(pixels[k]).all()]
    if len(good) < 2:
        return None
    poses = np.stack([views[k].cam_from_model for k in good])
    error = model.reconstruction.compute_mean_reprojection_error() / min(views[k].scale for k in good)
    found = Rays(poses, np.stack([rays[k] for k in good]), np.stack([pixels[k] for k in good]))
    return _PosedFinds(tuple(posed[k] for k in good), found, max(MIN_TOLERANCE_PX, MAX_ERROR_RATIO * float(error)))


def _track(seen: _PosedFinds, least: int) -> Track | None:
    """The target where the rays meet; None where the rays of too few photos do."""
    found = triangulate(seen.rays, seen.tolerance_px)
    if found is None:
        return None
    errors = np.linalg.norm(found.residuals_px, axis=1)
    nearest: dict[str, int] = {}
    for k in np.flatnonzero(found.agree).tolist():
        photo = seen.finds[k].photo
        if photo not in nearest or errors[k] < errors[nearest[photo]]:
            nearest[photo] = k
    if len(nearest) < least:
        return None
    chosen = tuple(seen.finds[nearest[photo]] for photo in sorted(nearest))
    return Track(chosen[0].kind, chosen[0].number, chosen, found.xyz)


def _reach(seen: _PosedFinds, model: SparseModel) -> Float64[np.ndarray, "n 2"]:
    """The smallest and largest plausible depth for each detection, by its photo."""
    depths: dict[str, tuple[float, float]] = {}
    for name, number in zip(model.names, model.image_ids, strict=True):
        image = model.reconstruction.images[number]
        observed = [model.reconstruction.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        pose = np.asarray(image.cam_from_world().matrix(), np.float64)
        depth = np.array(observed).reshape(-1, 3) @ pose[2, :3] + pose[2, 3]
        low, high = np.percentile(depth, [1.0, 99.0]) if len(depth) else (0.0, np.inf)
        depths[name] = float(low) / DEPTH_MARGIN, float(high) * DEPTH_MARGIN
    return np.array([depths[find.photo] for find in seen.finds])


def _group(
    seen: _PosedFinds, seed: int, free: Bool[np.ndarray, " n"], reach: Float64[np.ndarray, "n 2"]
) -> Bool[np.ndarray, " n"]:
    """The largest set of detections whose rays meet at one point on the seed's ray, by photos, then by mean error."""
    directions, centres = seen.rays.directions(), seen.rays.centres()
    apart = np.array([find.photo != seen.finds[seed].photo for find in seen.finds])
    partners = np.flatnonzero(free & apart)
    best, group = (0, 0.0), np.zeros(len(seen.finds), dtype=bool)
    d, e, between = directions[seed], directions[partners], centres[partners] - centres[seed]
    cosine = e @ d
    sine = np.maximum(1.0 - cosine**2, 1e-9)
    along = (between @ d - cosine * np.einsum("ni,ni->n", between, e)) / sine
    points = centres[seed] + along[:, None] * d
    depth = points @ seen.rays.cam_from_world[seed, 2, :3] + seen.rays.cam_from_world[seed, 2, 3]
    cameras, pixels, rays = (v[partners] for v in (seen.rays.cam_from_world, seen.rays.pixels, seen.rays.rays))
    there = np.einsum("nij,nj->ni", cameras[:, :, :3], points) + cameras[:, :, 3]
    ahead = there[:, 2] > 0.0
    projected = there[:, :2] / np.where(ahead, there[:, 2], 1.0)[:, None]
    gap = np.where(ahead, np.linalg.norm(np.einsum("nij,nj->ni", pixels, projected - rays), axis=1), np.inf)
    meets = (depth > reach[seed, 0]) & (depth < reach[seed, 1]) & (gap < seen.tolerance_px) & (sine > 3e-4)
    for point in points[meets][:MAX_PARTNERS]:
        errors = np.linalg.norm(seen.rays.residuals_px(point), axis=1)
        near = (errors < seen.tolerance_px) & free
        score = len({seen.finds[k].photo for k in np.flatnonzero(near).tolist()}), -float(errors[near].mean())
        if score > best:
            best, group = score, near
    return group
