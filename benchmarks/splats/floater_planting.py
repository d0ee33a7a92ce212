"""Plant floaters of known kinds into a trained model, between its cameras and the surfaces that they see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.reference import project
from splatpipe.pipeline.splat.model.gaussians import Gaussians

KINDS = ("single", "cluster", "near a surface", "haze", "oversized")
SHARE_BY_KIND = (1.0, 1.0, 1.0, 0.5, 0.2)  # planted floaters over the number asked for, by kind: large ones are rare
CLUSTER = 40  # Gaussians per cluster
NEAREST = 0.06  # share of the depth: anything nearer to a camera is haze
SIGMAS = 2.0  # clearance between a floater's extent and the surface
SEEN_ALPHA = 8.0 / 255.0  # at its centre: fainter Gaussians are invisible in photos
DEPTH_MARGIN = 0.03  # share of a depth: a Gaussian this close to the surface belongs to it
TOUCHING = 0.01  # share of a depth: anything this close to the surface in two views is not a floater
CAMERAS = 24  # number whose depths are rendered, spread over the capture
FAR = 2.0  # times an image's median depth: farther surfaces are unreliable
SURE_VIEWS = 2  # that must see a Gaussian at its surface for it to count as building
MAX_DONOR_QUANTILE = 0.9  # quantile of sizes: backgrounds have Gaussians as large as the scene

Points = Float64[np.ndarray, "n 3"]
Depth = Float64[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class FloaterView:
    """What a camera sees of a model.

    Attributes:
        camera: Camera at the size of ``depth``.
        depth: Median depths; 0 where there is no surface.
    """

    camera: Camera
    depth: Depth

    def gaps(self, points: Points) -> Float64[np.ndarray, " n"]:
        """Return each point's distance to the surface behind it, as a share of its depth; NaN outside the image."""
        found = np.full(len(points), np.nan)
        rows, pixels, depths = self.camera.in_view(points)
        surface = self.depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        there = surface > 0.0
        found[rows[there]] = 1.0 - depths[there] / surface[there]
        return found


@dataclass(frozen=True, eq=False)
class FloaterScene:
    """Planted floaters and the model that contains them.

    Attributes:
        model: The trained model, followed by the floaters.
        kinds: Kind of each floater, an index into ``KINDS``.
        trained: Number of Gaussians of the trained model.
        building: Which of these belong to a surface that photos see.
    """

    model: Gaussians
    kinds: Int64[np.ndarray, " f"]
    trained: int
    building: Bool[np.ndarray, " t"]


def render_depths(model: Gaussians, cameras: Sequence[Camera], options: rasterizer.RenderOptions) -> list[FloaterView]:
    """Render depths of a model from some cameras, spread evenly."""
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(CAMERAS, len(cameras))).round().astype(int))
    found = []
    with torch.no_grad():
        for index in chosen:
            depth = rasterizer.render(model, cameras[index], options.for_depths()).median_depth
            found.append(FloaterView(cameras[index], depth.double().numpy()))
    return found


def plant(
    model: Gaussians,
    views: Sequence[FloaterView],
    options: rasterizer.RenderOptions,
    per_kind: int,
    generator: np.random.Generator,
) -> FloaterScene:
    """Plant floaters of each kind: ``per_kind`` of them, or that kind's share of it.

    Each lies on the ray of a random pixel of a random camera, in front of the surface, uniformly distributed in the
    volume that the pixel sees (near a surface: 1.5 to 5 % of the depth in front of it; haze: 6 to 15 % from the
    camera). It keeps twice its size clear of the surface, and no two cameras may see a surface there. It is a copy of a
    surface's Gaussian, with a size of its kind and a realistic opacity. A floater that is visible in no photo
    is planted again elsewhere.
    """
    building = on_surfaces(model, views)
    donors = _donors(model, building)
    parts, kinds = [], []
    for kind in range(len(KINDS)):
        left = round(SHARE_BY_KIND[kind] * per_kind)
        while left > 0:
            part = _attempt(model, donors, views[generator.integers(len(views))], kind, options, generator)
            part = part.select(torch.from_numpy(~_at_surfaces(part, views, TOUCHING)))
            part = part.first(min(left, len(part)))
            left -= len(part)
            parts.append(part)
            kinds += [kind] * len(part)
    return FloaterScene(Gaussians.concat([model, *parts]), np.array(kinds), len(model), building)


def on_surfaces(model: Gaussians, views: Sequence[FloaterView]) -> Bool[np.ndarray, " n"]:
    """Return which Gaussians lie where at least two cameras see a surface."""
    opaque = torch.sigmoid(model.opacity_logits).numpy() > SEEN_ALPHA
    return np.asarray(_at_surfaces(model, views, DEPTH_MARGIN) & opaque)


def _at_surfaces(gaussians: Gaussians, views: Sequence[FloaterView], margin: float) -> Bool[np.ndarray, " n"]:
    means, agreeing = gaussians.means.double().numpy(), np.zeros(len(gaussians), int)
    for view in views:
        agreeing += np.abs(view.gaps(means)) < margin  # NaN is not near
    return np.asarray(agreeing >= min(SURE_VIEWS, len(views)))


def _donors(model: Gaussians, building: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " d"]:
    size = model.log_scales.max(dim=1).values.numpy()
    return np.flatnonzero(building & (size < np.quantile(size[building], MAX_DONOR_QUANTILE)))


def _attempt(
    model: Gaussians,
    donors: Int64[np.ndarray, " d"],
    view: FloaterView,
    kind: int,
    options: rasterizer.RenderOptions,
    generator: np.random.Generator,
) -> Gaussians:
    """Create some floaters of a kind in front of one camera; fewer, or none, where they do not meet the conditions."""
    count = CLUSTER if KINDS[kind] == "cluster" else 8
    rows, columns = np.nonzero((view.depth > 0.0) & (view.depth < FAR * np.median(view.depth[view.depth > 0.0])))
    pick = generator.integers(len(rows), size=1 if KINDS[kind] == "cluster" else count)
    pixels = np.stack([columns[pick], rows[pick]], axis=1) + generator.random((len(pick), 2))
    surface = view.depth[rows[pick], columns[pick]]
    share = _share_of_way(kind, len(pick), generator)
    centres = view.camera.unproject(pixels, share * surface)
    centres = np.repeat(centres, count // len(pick), axis=0)
    surface = np.repeat(surface, count // len(pick))
    if KINDS[kind] == "cluster":
        centres += generator.normal(size=centres.shape) * generator.uniform(0.004, 0.02) * surface[:, None]
    found = model.select(torch.from_numpy(donors[generator.integers(len(donors), size=count)]))
    found = replace(
        found,
        means=torch.from_numpy(centres).float(),
        log_scales=_sizes(found, kind, surface, generator),
        opacity_logits=_logits(kind, count, generator),
    )
    return found.select(torch.from_numpy(_stands(found, view, options)))


def _share_of_way(kind: int, count: int, generator: np.random.Generator) -> Float64[np.ndarray, " n"]:
    """Return the distance from the camera as a share of the depth."""
    if KINDS[kind] == "near a surface":
        return 1.0 - generator.uniform(0.015, 0.05, count)
    if KINDS[kind] == "haze":
        return generator.uniform(NEAREST, 0.15, count)
    return np.asarray((NEAREST**3 + (1.0 - NEAREST**3) * generator.random(count)) ** (1.0 / 3.0))


def _sizes(
    donor: Gaussians, kind: int, surface: Float64[np.ndarray, " n"], generator: np.random.Generator
) -> Float[torch.Tensor, "n 3"]:
    """Return log scales: the donor's, or its shape with a size relative to the depth."""
    shares = {"haze": (0.004, 0.02), "oversized": (0.04, 0.12)}.get(KINDS[kind])
    if shares is None:
        return donor.log_scales.clone()
    wanted = np.log(generator.uniform(*shares, len(surface)) * surface)
    largest = donor.log_scales.max(dim=1, keepdim=True).values
    shape = (donor.log_scales - largest).clamp(min=math.log(0.3))  # blobs: thin Gaussians are not haze
    return shape + torch.from_numpy(wanted).float()[:, None]


def _logits(kind: int, count: int, generator: np.random.Generator) -> Float[torch.Tensor, " n"]:
    low, high = {"haze": (0.05, 0.25), "oversized": (0.05, 0.2)}.get(KINDS[kind], (0.15, 0.9))
    opacity = generator.uniform(low, high, count)
    return torch.from_numpy(np.log(opacity / (1.0 - opacity))).float()


def _stands(found: Gaussians, view: FloaterView, options: rasterizer.RenderOptions) -> Bool[np.ndarray, " n"]:
    """Return which are clear of the surface, in front of the camera, and visible."""
    means = found.means.double().numpy()
    depth = view.camera.depths(means)
    reach = SIGMAS * np.exp(found.log_scales.max(dim=1).values.double().numpy()) / np.maximum(depth, 1e-9)
    with np.errstate(invalid="ignore"):
        clear = view.gaps(means) > np.minimum(reach, 0.5)
    splats = project(found, view.camera, options)
    visible = splats.usable & (splats.opacities >= SEEN_ALPHA)
    return np.asarray(clear & visible.numpy() & (depth > 0.0))
