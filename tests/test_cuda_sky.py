"""The sky by the CUDA backend's kernels, in the harness and on a device, against the CPU's."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda_library import why_not
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.raster.sky import SkyLayer, laid_over_nodes
from splatpipe.pipeline.splat.panorama import COLUMNS, ROWS
from splatpipe.pipeline.splat.sky_mask import SkyMask
from splatpipe.pipeline.train.photo_sky import PhotoSky
from splatpipe.pipeline.train.sky import SkyModel

sys.path.insert(0, str(Path(__file__).parent / "harness"))
sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import skies
from building import FORWARD, REVERSE, SHUFFLED, build_on_cpu, load
from on_cpu import kernels_on_cpu
from waiting import never_waiting

ATOL = 2e-6  # of colours up to 1, and of sums over 15 x 15 pixels with weights up to 1
DEVICE_ATOL = 1e-3  # there the place between two cells is float32, the CPU's is float64; of sums of hundreds
CPU = torch.device("cpu")
BACKGROUND, ELSEWHERE = (0.2, 0.5, 0.1), (0.9, 0.3, 0.6)
SIZES = [(81, 57), (82, 50), (33, 5), (1, 9)]  # a last node at the last pixel, outside, one row of cells, one column


@pytest.fixture(scope="module")
def kernels() -> CudaKernels:
    return kernels_on_cpu()


@pytest.fixture(params=["harness", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Where the kernels run."""
    if request.param == "harness":
        with use_kernels(kernels_on_cpu()):
            yield CPU
        return
    if why_not() is not None:
        pytest.skip("no CUDA device")
    yield torch.device("cuda", 0)


def composed(camera: Camera, mask: Tensor | None, device: torch.device = CPU) -> list[Tensor]:
    """The composite, and the gradients by the render's colour and alpha and by the cells; brought to the CPU."""
    generator = torch.Generator().manual_seed(camera.width)
    sky = SkyModel(skies.UP, np.zeros((ROWS * COLUMNS, 3), np.float32), {})
    with torch.no_grad():
        sky.panorama.colours.copy_(torch.rand(ROWS * COLUMNS, 3, generator=generator))
    sky.move_to(device)
    shape = (camera.height, camera.width)
    colour = torch.rand(*shape, 3, generator=generator).to(device).requires_grad_()
    alpha = torch.rand(shape, generator=generator).to(device).requires_grad_()
    weight = torch.rand(*shape, 3, generator=generator).to(device)
    none, mask = torch.zeros(0, device=device), None if mask is None else mask.to(device)
    with never_waiting(device):
        rendered = Render(colour, alpha, alpha, alpha, alpha, none.bool(), none)
        seen = None if mask is None else PhotoSky(mask, mask | mask.roll(1, 0))
        picture = sky.composite(rendered, camera, seen, BACKGROUND, ELSEWHERE)
        (weight * picture).sum().backward()
    cells = sky.tensors["colours"].grad
    assert colour.grad is not None and alpha.grad is not None
    found = [picture.detach(), colour.grad, alpha.grad, torch.zeros(()) if cells is None else cells]
    return [tensor.cpu() for tensor in found]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [False, True])
def test_sky_and_its_gradients_are_those_of_the_cpu(device: torch.device, size: tuple[int, int], masked: bool) -> None:
    camera = skies.look(heading_deg=160.0, pitch_deg=15.0).scaled(*size)
    mask = None
    if masked:
        mask = torch.rand(size[1], size[0], generator=torch.Generator().manual_seed(1)) > 0.3
        mask[:, size[0] // 2 + 1 :] = False
    with use_kernels(None):
        expected = composed(camera, mask)
    found = composed(camera, mask, device)
    for ours, right in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, right, rtol=1e-5, atol=ATOL if device == CPU else DEVICE_ATOL)
    assert masked == bool(found[3].any())


def test_gradients_of_the_nodes_have_the_same_bits_in_every_order_of_threads(kernels: CudaKernels) -> None:
    harness = load(build_on_cpu())
    camera = skies.look(pitch_deg=15.0).scaled(40, 30)
    mask = torch.rand(30, 40, generator=torch.Generator().manual_seed(1)) > 0.3
    found = []
    with use_kernels(kernels):
        for order, seed in ((FORWARD, 0), (REVERSE, 0), (SHUFFLED, 3)):
            harness.harness_order(order, seed)
            found.append(composed(camera, mask))
    harness.harness_order(FORWARD, 0)
    assert all(torch.equal(one, other) for one, other in zip(found[0], found[1], strict=True))
    assert all(torch.equal(one, other) for one, other in zip(found[0], found[2], strict=True))


def test_sky_is_trained_as_on_the_cpu(kernels: CudaKernels) -> None:
    camera = skies.look(pitch_deg=30.0).scaled(40, 30)
    mask = np.zeros((30, 40), bool)
    mask[:15] = True
    learnt = []
    for chosen in (None, kernels):
        sky = SkyModel(skies.UP, np.full((ROWS * COLUMNS, 3), 0.5, np.float32), {camera.name: SkyMask.packed(mask)})
        blank, none = torch.zeros(30, 40), torch.zeros(0)
        rendered = Render(torch.zeros(30, 40, 3), blank, blank, blank, blank, none.bool(), none)
        with use_kernels(chosen):
            for number in range(5):
                seen = sky.seen(camera)
                picture = sky.composite(rendered, camera, seen, BACKGROUND, ELSEWHERE)
                ((picture - 0.25).abs().mean() + sky.loss(blank, seen)).backward()
                sky.step(number / 5)
        learnt.append(sky.panorama.colours.detach().clone())
    assert float((learnt[0] - 0.5).abs().max()) > 0.01
    torch.testing.assert_close(learnt[1], learnt[0], rtol=0, atol=1e-4)


def test_nodes_that_do_not_reach_the_last_pixel_are_refused(kernels: CudaKernels) -> None:
    colour, alpha = torch.zeros(20, 20, 3), torch.zeros(20, 20)
    for rows, step in ((3, 8), (20, 9)):
        with use_kernels(kernels), pytest.raises(Exception, match="argument"):
            laid_over_nodes(colour, alpha, torch.zeros(rows, 4, 3), SkyLayer(BACKGROUND, step=step))


def test_nothing_beyond_the_nodes_is_read(kernels: CudaKernels) -> None:
    colour, alpha = torch.zeros(17, 9, 3), torch.zeros(17, 9)  # the last nodes lie at the last pixels
    guarded = torch.full((4, 2, 3), torch.nan)
    guarded[:3] = torch.rand(3, 2, 3, generator=torch.Generator().manual_seed(2))
    with use_kernels(kernels):
        picture = laid_over_nodes(colour, alpha, guarded[:3], SkyLayer((0.0, 0.0, 0.0)))
    torch.testing.assert_close(picture[::8, ::8], guarded[:3], rtol=0, atol=1e-6)
    assert bool(picture.isfinite().all())
