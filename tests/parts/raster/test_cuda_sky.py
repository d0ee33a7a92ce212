"""The sky by the CUDA backend's kernels, in the harness and on a device, against the CPU's."""

from collections.abc import Iterator

import pytest
import skies
import torch
from cuda_skies import CPU, composed
from on_cpu import kernels_on_cpu

from splatpipe.pipeline.raster.cuda.cuda import use_kernels
from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason

ATOL = 2e-6  # colours are at most 1, and sums go over 15 x 15 pixels with weights up to 1


DEVICE_ATOL = 1e-3  # there the place between two cells is float32, the CPU's is float64; of sums of hundreds


SIZES = [(81, 57), (82, 50), (33, 5), (1, 9)]  # a last node at the last pixel, outside, one row of cells, one column


@pytest.fixture(params=["harness", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Where the kernels run."""
    if request.param == "harness":
        with use_kernels(kernels_on_cpu()):
            yield CPU
        return
    if unavailable_reason() is not None:
        pytest.skip("no CUDA device")
    yield torch.device("cuda", 0)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [False, True])
def test_sky_and_its_gradients_are_those_of_the_cpu(device: torch.device, size: tuple[int, int], masked: bool) -> None:
    camera = skies.aimed_camera(heading_deg=160.0, pitch_deg=15.0).scaled(*size)
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
