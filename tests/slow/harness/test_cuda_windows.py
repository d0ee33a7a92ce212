"""Training on windows of photos with the CUDA kernels, verified with their sources on the CPU."""

from __future__ import annotations

from pathlib import Path

import pytest
import tiny_scene
import torch
from building import FORWARD, SHUFFLED, build_on_cpu, load
from on_cpu import kernels_on_cpu
from torch import Tensor

from splatpipe.pipeline.photos.pixels.dataset import View, load_views
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import make_techniques

OPTIONS = tiny_scene.plain(
    iterations=400, exposure="affine", antialias=True, robust=0.1, distortion_weight=0.05, dropout=0.2
)
SIZES = [TrainingSize(1)] * 3 + [TrainingSize(0, 800)] * 9
"""Whole photos, then windows: six per photo, some of a masked photo."""
STEP_SHARE = 1e-3  # L2 of the parameters' displacements: 5e-6 here; Adam's first step depends only on the sign
SCORE_RTOL = 1e-4  # L2 of the gradients on the screen, after as many steps


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    folder = tmp_path_factory.mktemp("scene") / "dataset"
    return load_views(tiny_scene.write_dataset(folder, masked="flight 1/photo_5.png"))


def trained(views: list[View], cache: Path, kernels: CudaKernels | None) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Parameters and exposures, and what density control has observed, after every iteration of ``SIZES``."""
    plan = make_plan(OPTIONS, views, tiny_scene.split_of(views), tiny_scene.GAUSSIANS)
    with use_kernels(kernels), same_bits(1), PhotoStream.over(views, SIZES, 0, 1, cache) as photos:
        training = TrainState.begin(tiny_scene.true_model(), plan, make_techniques(plan, views=views))
        assert plan.schedule.density.first > len(SIZES), "the Gaussians stay the same"
        for photo in photos:
            iterate(training, plan, photo)
    beside = {name: torch.as_tensor(array) for name, array in training.techniques.to_arrays().items()}
    model = {name: tensor.detach() for name, tensor in training.gaussians.tensors().items()}
    observed = {name: torch.as_tensor(array).clone() for name, array in training.density.to_arrays().items()}
    return model | beside, observed


def test_windows_on_cuda_give_the_cpus_results(views: list[View], tmp_path: Path) -> None:
    ours, theirs = (trained(views, tmp_path, kernels) for kernels in (kernels_on_cpu(), None))
    start = tiny_scene.true_model().tensors()
    for name, expected in theirs[0].items():
        if name.startswith(("robust.", "distortion.")):
            continue  # values that are not there yet are not finite
        before = start.get(name, torch.zeros_like(expected)).double()
        moved = torch.linalg.vector_norm(expected.double() - before)
        assert torch.linalg.vector_norm(ours[0][name].double() - expected) <= STEP_SHARE * moved, name
    assert float(theirs[1]["seen"].sum()) > 0
    for name, expected in theirs[1].items():
        apart = torch.linalg.vector_norm(ours[1][name].double() - expected.double())
        assert apart <= SCORE_RTOL * torch.linalg.vector_norm(expected.double()), name


def test_windows_on_cuda_have_the_same_bits_in_any_order_of_threads(views: list[View], tmp_path: Path) -> None:
    library = load(build_on_cpu())
    first = trained(views, tmp_path, kernels_on_cpu())
    library.harness_order(SHUFFLED, 5)
    try:
        second = trained(views, tmp_path, kernels_on_cpu())
    finally:
        library.harness_order(FORWARD, 0)
    for one, other in zip(first, second, strict=True):
        for name, tensor in one.items():
            assert tensor.numpy().tobytes() == other[name].numpy().tobytes(), name
