"""The device's sky, computed by matrix products, against the CPU's method: on the CPU."""

import numpy as np
import pytest
import skies
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, PanoramaView, gather_view, matrix_view
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask
from splatpipe.pipeline.train.appearance.photo_sky import PhotoSkies, photo_sky_on_cpu, photo_sky_on_device
from splatpipe.pipeline.train.appearance.sky import SkyModel

TILTED = np.array([0.36, -0.48, 0.8])
BACKGROUND = (0.1, 0.7, 0.3)
PICTURE_ATOL = 2e-5  # colours up to 1 in float32: the place between two cells is rounded to it
EXACT_ATOL = 1e-9  # in float64, but for the CPU's weights, which are float32 there, too
WEIGHTS_ATOL = 1e-6


def cells(dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(ROWS * COLUMNS, 3, generator=generator, dtype=dtype).requires_grad_()


def seen_and_gradient(view: PanoramaView, colours: Tensor) -> tuple[Tensor, Tensor]:
    seen = view.behind(colours, BACKGROUND)
    weight = torch.rand(seen.shape, generator=torch.Generator().manual_seed(2), dtype=seen.dtype)
    (gradient,) = torch.autograd.grad((weight * seen).sum(), colours)
    return seen.detach(), gradient


VIEWS = [
    skies.aimed_camera(heading_deg=170.0, pitch_deg=20.0).scaled(83, 61),  # over the seam of the azimuth
    skies.aimed_camera(heading_deg=20.0, pitch_deg=5.0, roll_deg=50.0).scaled(80, 57),
    skies.aimed_camera(pitch_deg=88.0).scaled(64, 48),  # with the pole in the picture
]


@pytest.mark.parametrize("camera", VIEWS)
@pytest.mark.parametrize("up", [skies.UP, TILTED])
def test_panorama_and_its_gradient_are_those_of_the_cpu(camera: Camera, up: np.ndarray) -> None:
    for dtype, picture_atol in ((torch.float32, PICTURE_ATOL), (torch.float64, WEIGHTS_ATOL)):
        colours = cells(dtype)
        expected, gradient = seen_and_gradient(gather_view(camera, up, colours), colours)
        seen, own = seen_and_gradient(matrix_view(camera, up, colours), colours)
        torch.testing.assert_close(seen, expected, rtol=0, atol=picture_atol)
        assert torch.linalg.vector_norm(own - gradient) < picture_atol * torch.linalg.vector_norm(gradient)


def test_weights_of_a_direction_sum_to_one() -> None:
    view = matrix_view(VIEWS[2], TILTED, torch.zeros(0, dtype=torch.float64))
    ones = view.cells.mixed(torch.ones(ROWS * COLUMNS, 3, dtype=torch.float64))
    torch.testing.assert_close(ones, torch.ones_like(ones), rtol=0, atol=EXACT_ATOL)


@pytest.mark.parametrize("size", [(320, 240), (801, 603), (97, 61), (201, 240)])
def test_masks_are_those_of_the_cpu_at_every_size(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    mask = np.zeros((240, 320), bool)
    mask[:90] = True
    mask[60:90, 40:130] = False
    mask[rng.integers(0, 90, 30), rng.integers(0, 320, 30)] = False
    found = SkyMask.packed(mask)
    camera = skies.aimed_camera().scaled(*size)
    cpu, device = (
        photo_sky_on_cpu(found, camera),
        photo_sky_on_device(torch.from_numpy(found.bits), found.shape, camera),
    )
    for ours, expected in ((device.mask, cpu.mask), (device.around, cpu.around)):
        assert ours.shape == (size[1], size[0])
        assert (ours != expected).float().mean() < 1e-3  # pixels whose share is SURE but for rounding
    assert bool((device.around | ~device.mask).all())


def test_photos_without_sky_have_none_and_moving_to_a_device_keeps_it() -> None:
    camera = skies.aimed_camera()
    mask = np.ones((60, 80), bool)
    masks = PhotoSkies({camera.name: SkyMask.packed(mask), "other": SkyMask.packed(~mask)})
    sky = SkyModel(skies.UP, np.full((ROWS * COLUMNS, 3), 0.5, np.float32), {camera.name: SkyMask.packed(mask)})
    sky.move_to(torch.device("cpu"))
    assert sky.panorama.colours is sky.tensors["colours"] and sky.panorama.colours.requires_grad
    assert len(masks) == len(masks.on(torch.device("cpu"))) == sky.photos == 1
    moved = masks.on(torch.device("meta"))
    assert moved.seen(skies.aimed_camera(heading_deg=77.0)) is None
