"""The sky in training: a panorama behind the Gaussians, and no Gaussians where photos show sky.

A colour that depends on direction only, and a loss on the opacity of rays into the sky, are from Rematas et al., "Urban
Radiance Fields", CVPR 2022; an explicit map of directions behind Gaussians is from Yan et al., "Street Gaussians", ECCV
2024. Here the sky is segmented without a network (``splat.sky.sky_mask``), the map has cells of a few degrees and
starts from the colours in the photos, and only pixels known to be sky train it: a wall that the Gaussians do not cover
yet is not painted into the sky. Away from the sky a random colour replaces it, so that no wall can borrow the sky's
colour.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, Shaped
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_points
from splatpipe.pipeline.photos.pixels.images import reduced_sky
from splatpipe.pipeline.photos.pixels.small_views import small_view
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.raster.sky import SkyLayer, laid_over_nodes
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, Panorama, cells_of
from splatpipe.pipeline.splat.sky.sky_mask import WORK_MEGAPIXELS, SkyMask, SkyPhoto, directions, find_skies, up_of
from splatpipe.pipeline.train.appearance.auxiliary_model import AuxiliaryModel
from splatpipe.pipeline.train.appearance.photo_sky import PhotoSkies, PhotoSky
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.photos.stream import EVERYWHERE
from splatpipe.pipeline.train.random_numbers import ELSEWHERE

MIN_TRACK = 3  # minimum track length of points used in sky detection
MAX_ERROR_PX = 2.0
OPACITY_WEIGHT = 0.1  # loss weight for the mean opacity in front of the sky; judgement
SMOOTHNESS = 1.0  # weight of the mean squared difference between neighbouring cells: fills areas no photo covers
FIRST_RATE, LAST_RATE = 5e-3, 5e-4  # learning rates of the colours at the start and end of the schedule
EPSILON = 1e-8  # Adam's: cells with hardly any gradient stay where they are
FILL_ROUNDS = ROWS * ROWS // 2  # rounds of averaging neighbours: unseen cells above the horizon are smooth by then
MIN_EVIDENCE = 4.0  # pixels of ``WORK_MEGAPIXELS`` that a cell's first colour must at least average

RGB = tuple[float, float, float]

_COLOURS = "colours"


class SkyModel(AuxiliaryModel, Technique):
    """The trained panorama and the photos' sky masks.

    Attributes:
        panorama: Its colours are an autograd leaf.
    """

    name = "sky"

    def __init__(
        self, up: Float64[np.ndarray, " 3"], colours: Float32[np.ndarray, "cells 3"], masks: Mapping[str, SkyMask]
    ) -> None:
        """Begin with the given colours.

        Args:
            up: Unit vector against gravity.
            colours: Initial colours of the panorama's cells.
            masks: Sky masks by photo name; photos without sky may be left out.
        """
        super().__init__({_COLOURS: torch.from_numpy(colours)}, EPSILON)
        self.panorama = Panorama(up, self.tensors[_COLOURS])
        self._skies = PhotoSkies(masks)
        self._seen: PhotoSky | None = None  # the current photo's sky

    def copied(self) -> SkyModel:
        """A copy with its own tensors; the immutable masks are shared."""
        return copy.deepcopy(self, {id(self._skies): self._skies})

    def move_to(self, device: torch.device) -> None:
        """Move the colours and the masks to the training device."""
        super().move_to(device)
        self.panorama = Panorama(self.panorama.up, self.tensors[_COLOURS])
        self._skies = self._skies.on(device)

    @property
    def photos(self) -> int:
        """Number of photos that show sky."""
        return len(self._skies)

    @property
    def masks(self) -> Mapping[str, SkyMask]:
        """The sky masks, by the names of the photos that show sky."""
        return self._skies.masks

    @staticmethod
    def given(panorama: Panorama, masks: Mapping[str, SkyMask]) -> SkyModel:
        """A panorama trained elsewhere and now fixed."""
        found = SkyModel(panorama.up, panorama.colours.detach().cpu().numpy(), masks)
        found.give()
        return found

    @staticmethod
    def begin(views: Sequence[View], dataset: Path, threads: int) -> SkyModel | None:
        """Detect the sky in photos and start with its colours there; None if no photo shows sky.

        Args:
            views: Views to train on.
            dataset: The photos' dataset, for its sparse points.
            threads: Number of threads that read photos.

        Raises:
            StageError: if a photo is missing or broken.
        """
        points = load_points(dataset)
        believed = points.xyz[(points.track_lengths >= MIN_TRACK) & (points.errors_px <= MAX_ERROR_PX)]
        cameras = [view.camera for view in views]

        def photo(index: int) -> SkyPhoto:
            camera, pixels, mask = small_view(views[index], WORK_MEGAPIXELS)
            drawn = reduced_sky(views[index], WORK_MEGAPIXELS)
            return SkyPhoto(camera, pixels, None if mask is None else ~mask, drawn)

        up = up_of(cameras, photo, believed, threads)
        masks = find_skies(cameras, photo, believed, up, threads)
        with_sky = [index for index, mask in enumerate(masks) if mask.any()]
        if not with_sky:
            return None
        colours = first_colours(((photo(index), masks[index].unpacked()) for index in with_sky), up)
        return SkyModel(up, colours, {camera.name: mask for camera, mask in zip(cameras, masks, strict=True)})

    def apply_appearance(self, picture: Float[Tensor, "h w 3"], rendered_view: RenderedView) -> Float[Tensor, "h w 3"]:
        """The render over the sky, or over another colour where the photo shows none."""
        camera, behind = rendered_view.photo.camera, rendered_view.settings.background
        self._seen = self.seen(camera)
        return self.composite(rendered_view.rendered, camera, self._seen, behind, rendered_view.now.colour(ELSEWHERE))

    def penalty(self, rendered_view: RenderedView) -> Float[Tensor, ""]:
        """Opacity in front of the sky, and the sky's roughness."""
        return self.loss(rendered_view.rendered.alpha, self._seen, rendered_view.photo.inside)

    def after_step(self, rendered_view: RenderedView) -> None:
        """Step the colours."""
        if not self.is_given:
            self.step(rendered_view.now.share)

    def summary(self) -> dict[str, int | float]:
        """Number of photos that show sky."""
        return {"sky_photos": self.photos}

    def composite(
        self, rendered: Render, camera: Camera, seen: PhotoSky | None, background: RGB, elsewhere: RGB
    ) -> Float[Tensor, "h w 3"]:
        """The render as the photo shows it: over the sky where the sky may be visible, over ``elsewhere`` otherwise.

        If the sky were behind walls too, any part of a wall as bright as the sky would stay transparent.

        Args:
            rendered: Over ``background``.
            camera: Camera of a training photo.
            seen: Its sky, from ``seen``.
            background: Stays behind everything below the horizon.
            elsewhere: A different colour each time, so that only an opaque wall can match the photo.
        """
        panorama_view = self.panorama.view_from(camera)
        nodes, how = panorama_view.at_nodes(self.panorama.colours, background), SkyLayer(background)
        if seen is not None:
            how = SkyLayer(background, panorama_view.flat_at_nodes(elsewhere, background), seen.around, seen.mask)
        return laid_over_nodes(rendered.colour, rendered.alpha, nodes, how)

    def loss(
        self, alpha: Float[Tensor, "h w"], seen: PhotoSky | None, inside: tuple[slice, slice] = EVERYWHERE
    ) -> Float[Tensor, ""]:
        """The term added to the photo's loss: opacity in front of the sky, per pixel, and the sky's roughness.

        Args:
            alpha: Alpha of the render.
            seen: The photo's sky, from ``seen``.
            inside: Rows and columns that count.
        """
        loss = SMOOTHNESS * roughness(self.panorama.colours)
        if seen is None:
            return loss
        return loss + OPACITY_WEIGHT * torch.where(seen.mask, alpha, 0.0)[inside].mean()

    def seen(self, camera: Camera) -> PhotoSky | None:
        """The sky of a training photo at the size of ``camera``; None if it shows none."""
        return self._skies.seen(camera)

    def step(self, share: float) -> None:
        """Take an optimizer step on the colours, then drop their gradient.

        Args:
            share: Fraction of the schedule done, 0..1.
        """
        rate = math.exp(math.log(FIRST_RATE) * (1.0 - share) + math.log(LAST_RATE) * share)
        self.descend({_COLOURS: rate})
        self.panorama.colours.detach().clamp_(0.0, 1.0)


def roughness(colours: Float[Tensor, "cells 3"]) -> Float[Tensor, ""]:
    """Mean squared difference between neighbouring cells, along rows (wrapping around) and columns."""
    grid = colours.reshape(ROWS, COLUMNS, 3)
    along, up = grid - grid.roll(1, dims=1), grid[1:] - grid[:-1]
    return 0.5 * (along.square().mean() + up.square().mean())


def first_colours(
    skies: Iterable[tuple[SkyPhoto, Bool[np.ndarray, "h w"]]], up: Float64[np.ndarray, " 3"]
) -> Float32[np.ndarray, "cells 3"]:
    """Each cell's mean colour over the photos' skies; cells without colours are filled smoothly from their neighbours.

    Args:
        skies: Photos and their sky masks; pixels excluded by the user's masks have no colour.
        up: The panorama's pole.
    """
    total = np.zeros((ROWS * COLUMNS, 4))
    for photo, mask in skies:
        usable = mask if photo.ignored is None else mask & ~photo.ignored
        cells, weights = cells_of(directions(photo.camera)[usable], up)
        colour = photo.pixels[usable] / 255.0
        for channel in range(3):
            total[:, channel] += _sums(cells, weights * colour[:, channel, None])
        total[:, 3] += _sums(cells, weights)
    return filled(total)


def filled(total: Float64[np.ndarray, "cells 4"]) -> Float32[np.ndarray, "cells 3"]:
    """Colours from sums of colour and weight; cells of little weight become the mean of their neighbours."""
    known = (total[:, 3] >= MIN_EVIDENCE).reshape(ROWS, COLUMNS, 1)
    whole = total[:, :3].sum(axis=0) / max(total[:, 3].sum(), 1e-12)
    mean = (total[:, :3] / np.maximum(total[:, 3:], 1e-12)).reshape(ROWS, COLUMNS, 3)
    grid = np.where(known, mean, whole)
    for _ in range(FILL_ROUNDS):
        padded = np.pad(grid, ((1, 1), (0, 0), (0, 0)), mode="edge")
        around = padded[:-2] + padded[2:] + np.roll(grid, 1, axis=1) + np.roll(grid, -1, axis=1)
        grid = np.where(known, grid, 0.25 * around)
    return np.asarray(grid.reshape(-1, 3).astype(np.float32))


def _sums(cells: Int64[np.ndarray, "n 4"], values: Shaped[np.ndarray, "n 4"]) -> Float64[np.ndarray, " cells"]:
    sums = np.bincount(cells.ravel(), values.ravel(), minlength=ROWS * COLUMNS)
    return sums.astype(np.float64)  # without input, bincount returns integers
