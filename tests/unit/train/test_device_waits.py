"""Techniques on a device neither wait for it nor mix its tensors with the CPU's.

Shown on torch's meta device, whose tensors have no values: asking for one, or for the number of those that are
wanted, fails, as does adding a tensor of the CPU's.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import skies
import torch

from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask
from splatpipe.pipeline.train.appearance.exposure import Exposure
from splatpipe.pipeline.train.appearance.robust import RobustMask
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.schedule import ScheduleStep, resolve_schedule
from splatpipe.pipeline.train.random_numbers import ELSEWHERE
from splatpipe.pipeline.train.techniques.distortion_loss import CENTRE_EVERY, DistortionLoss
from splatpipe.pipeline.train.techniques.dropout import Dropout

META = torch.device("meta")
CAMERAS = [
    replace(skies.camera_towards(heading_deg=10.0 * number).scaled(160, 120), name=f"{number}.jpg")
    for number in range(3)
]
NAMES = [camera.name for camera in CAMERAS]


def a_moment(iteration: int = CENTRE_EVERY - 1) -> ScheduleStep:
    return resolve_schedule(TrainConfig(iterations=2 * CENTRE_EVERY, dropout=0.3)).at(iteration, 0)


def a_shot() -> RenderedView:
    camera = CAMERAS[1]
    height, width = camera.height, camera.width
    colour = torch.empty(height, width, 3, device=META, requires_grad=True)
    flat = [torch.empty(height, width, device=META, requires_grad=True) for _ in range(4)]
    seen = torch.empty(7, device=META)
    photo = TrainingPhoto(camera, torch.empty(height, width, 3, device=META), None)
    settings = RenderOptions(0, background=(0.1, 0.2, 0.3), depth=True, depth_origin=3.0)
    return RenderedView(photo, Render(colour, *flat, seen.bool(), seen), settings, a_moment())


def sky() -> Technique:
    mask = np.zeros((30, 40), bool)
    mask[:12] = True
    return SkyModel(skies.UP, np.full((ROWS * COLUMNS, 3), 0.5, np.float32), {NAMES[1]: SkyMask.packed(mask)})


def robust() -> Technique:
    made = RobustMask(NAMES, 0.1, 5)
    made.watch(CAMERAS)
    return made


def distortion() -> Technique:
    made, model = DistortionLoss(0.1, after=0), Gaussians.empty(5, 0)
    made.settings(RenderOptions(0), model, CAMERAS[0], a_moment(1))  # its first look is allowed to wait
    return made


@pytest.mark.parametrize("make", [sky, robust, distortion, lambda: Exposure(NAMES)], ids=lambda make: make.__name__)
def test_iteration_of_a_technique_reads_nothing_from_the_device(make: Callable[[], Technique]) -> None:
    technique, shot = make(), a_shot()
    technique.move_to(META)
    model = Gaussians.empty(7, 0)
    model.means = torch.empty(7, 3, device=META)
    technique.settings(shot.settings, model, shot.photo.camera, shot.now)
    picture = technique.apply_appearance(shot.rendered.colour, shot)
    counted = technique.mask_pixels(shot.photo, picture, shot)
    penalty = technique.penalty(shot)
    loss = (picture - counted.colour).abs().mean()
    (loss if penalty is None else loss + penalty).backward()
    assert all(tensor.device == META for name, tensor in technique.to_arrays().items() if name not in KEPT_HERE)


KEPT_HERE = ("centre", "adam.step")


def test_dropout_reads_nothing_from_the_device() -> None:
    model = Gaussians.empty(50, 0)
    model.opacity_logits = torch.empty(50, device=META, requires_grad=True)
    found = Dropout(resolve_schedule(TrainConfig(iterations=100, dropout=0.3))).before_render(model, a_moment())
    found.opacity_logits.sum().backward()
    assert found.opacity_logits.device == META


def test_meta_tensors_fail_on_waiting_or_mixing() -> None:
    """The assumption of the tests above."""
    tensor = torch.empty(3, device=META)
    for waits in (lambda: float(tensor[0]), lambda: bool((tensor > 0).any()), lambda: tensor[tensor > 0]):
        with pytest.raises((RuntimeError, NotImplementedError)):
            waits()
    with pytest.raises(RuntimeError, match="device"):
        tensor + torch.zeros(3)


def test_the_iteration_includes_the_sky() -> None:
    made = sky()
    assert isinstance(made, SkyModel) and made.seen(CAMERAS[1]) is not None
    assert a_moment().colour(ELSEWHERE) != a_moment(3).colour(ELSEWHERE)
