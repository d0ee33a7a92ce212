"""A block trained with the CUDA kernels, in the harness."""

from collections import Counter
from pathlib import Path

import pytest
import tiny_scene
import torch
from block_sites import CONFIG, PARTITION, TASK, WINDOW, Kill, step_with, surveyed, trained
from on_cpu import kernels_on_cpu

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS
from splatpipe.pipeline.train.blocks.coarse import TrainingLimits, train_coarse
from splatpipe.pipeline.train.blocks.training import Block, SiteParts
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import initialize

STEP_SHARE = 1e-3  # L2 of the parameters' displacements, as for windows without blocks


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> SiteParts:
    """A scene with its coarse pass."""
    folder = tmp_path_factory.mktemp("site")
    tiny_scene.write_dataset(folder / "dataset", masked="flight 1/photo_5.png")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    parts |= {"initialize.splat": folder / "init.ply", **tiny_scene.split_part(folder / "dataset", 4)}
    (folder / "coarse").mkdir()
    inputs = Inputs(parts, folder, machine=Machine("cpu", 1))
    train_coarse(CONFIG, inputs, TrainingLimits(150, WINDOW), folder / "coarse", tiny_scene.Recorder())
    return surveyed(
        SiteParts(folder / "dataset", parts["split.views"], folder / "coarse", folder / "prospects", PARTITION)
    )


@pytest.fixture(scope="module")
def undisturbed(site: SiteParts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(site, tmp_path_factory.mktemp("undisturbed"))


def test_block_trains_with_cuda_kernels_as_on_the_cpu(site: SiteParts, undisturbed: Path, tmp_path: Path) -> None:
    """With the fused step, which stores no gradient of a parameter."""
    frozen, models = read_splat(undisturbed / "frozen.ply"), []
    calls, call = Counter[str](), CudaKernels.call

    def count_call(kernels: CudaKernels, name: str, *arguments: object) -> None:
        calls[name] += 1
        call(kernels, name, *arguments)

    def observe(state: TrainState, photo: TrainingPhoto) -> None:
        if state.iteration == 8:  # density control has not acted yet
            models.append(state.gaussians.detach().clone())
            around = state.drawn.detach().after(len(state.gaussians))
            assert all(torch.equal(getattr(around, name), getattr(frozen, name)) for name in PARAMETERS)
            raise Kill

    for kernels in (kernels_on_cpu(), None):
        out = tmp_path / str(len(models))
        out.mkdir()
        for name in ("plan.json", "frozen.ply"):
            (out / name).write_bytes((undisturbed / name).read_bytes())
        with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill), use_kernels(kernels):
            patch.setattr(CudaKernels, "call", count_call)
            step_with(patch, observe)
            trained(site, out)
    assert calls["splat_step"] == calls["splat_forward"] == 8 and calls["splat_project_backward"] == 0
    begun = Block.of(CONFIG, site, TASK, cpu()).start()
    for name in PARAMETERS:
        ours, theirs, before = (getattr(model, name).double() for model in (*models, begun))
        moved = torch.linalg.vector_norm(theirs - before)
        assert moved > 0.0 and torch.linalg.vector_norm(ours - theirs) <= STEP_SHARE * moved, name
