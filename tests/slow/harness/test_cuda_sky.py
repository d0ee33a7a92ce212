"""The sky by the CUDA backend's kernels, in the harness: orders of threads, training, limits."""

import numpy as np
import pytest
import skies
import torch
from building import FORWARD, REVERSE, SHUFFLED, build_on_cpu, load
from cuda_skies import BACKGROUND, ELSEWHERE, composed
from on_cpu import kernels_on_cpu

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.raster.sky import SkyLayer, laid_over_nodes
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask
from splatpipe.pipeline.train.appearance.sky import SkyModel


@pytest.fixture(scope="module")
def kernels() -> CudaKernels:
    return kernels_on_cpu()


def test_gradients_of_the_nodes_have_the_same_bits_in_every_order_of_threads(kernels: CudaKernels) -> None:
    harness = load(build_on_cpu())
    camera = skies.camera_towards(pitch_deg=15.0).scaled(40, 30)
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
    camera = skies.camera_towards(pitch_deg=30.0).scaled(40, 30)
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
