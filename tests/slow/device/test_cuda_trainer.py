"""The trainer on a real device: behaviour that cannot be tested where device and host share memory."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from random_scene import random_camera, random_scene
from waiting import never_waiting

from splatpipe.pipeline.photos.pixels.dataset import Split, View
from splatpipe.pipeline.raster.cuda import cuda, cuda_library
from splatpipe.pipeline.raster.device import Device, choose_device, cpu, free_bytes, take_rows
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.photos.upload import Uploader
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.sizing.shortage import iterate_within_memory
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import make_techniques

MISSING = cuda_library.unavailable_reason()
pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(MISSING is not None, reason="" if MISSING is None else MISSING.reason),
]

OPTIONS = TrainConfig(
    iterations=30, max_gaussians=5000, exposure="affine", dropout=0.2, distortion_weight=0.05, sky="off", robust=0.1
)
FEW = OPTIONS.model_copy(
    update={"robust": 0.0, "distortion_weight": 0.0}
)  # these two may read from the device now and then
MEGABYTE = 1 << 20


class Silent:
    """A Reporter that counts warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


@pytest.fixture
def device() -> Iterator[Device]:
    yield choose_device("cuda")
    torch.cuda.set_per_process_memory_fraction(1.0)
    torch.cuda.empty_cache()
    cuda._on_cuda.cache_clear()  # with the forecast from its earlier frames


def views() -> list[View]:
    return [View(replace(random_camera(number), name=f"{number}.png"), Path(), None) for number in range(4)]


def make_training(options: TrainConfig, device: Device, count: int = 2000) -> tuple[TrainState, TrainingPlan]:
    seen = views()
    names = tuple(view.camera.name for view in seen)
    plan = make_plan(options, seen, Split(names, ()), count)
    start = random_scene(0)
    start = start.select(torch.arange(count) % len(start)).to(device.tensors)
    techniques = make_techniques(replace(plan, options=options), None, seen, device=device.tensors)
    return TrainState.begin(start, plan, techniques), plan


def photos(device: Device, count: int) -> list[TrainingPhoto]:
    uploader, generator, found = Uploader(device.tensors), np.random.default_rng(0), []
    for number in range(count):
        camera = views()[number % 4].camera
        pixels = generator.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
        mask = generator.random((camera.height, camera.width)) < 0.9 if number % 2 else None
        photo = TrainingPhoto(camera, *uploader.end(uploader.begin(pixels, mask)))
        found.append(replace(photo, round=4 if number % 4 == 3 else 0))
    return found


def test_photos_on_the_device_are_bit_identical_to_the_cpus(device: Device) -> None:
    for ours, expected in zip(photos(device, 16), photos(cpu(), 16), strict=True):
        assert ours.colour.is_cuda and torch.equal(ours.colour.cpu(), expected.colour)
        assert (ours.mask is None) == (expected.mask is None)
        assert expected.mask is None or torch.equal(ours.mask.cpu(), expected.mask)


@pytest.mark.parametrize("options", [OPTIONS, FEW], ids=("all", "few"))
def test_a_training_has_the_same_bits_twice_and_the_cpus_loss(device: Device, options: TrainConfig) -> None:
    found = []
    for place in (device, device, cpu()):
        training, plan = make_training(options, place)
        with place.deterministic():
            for photo in photos(place, options.iterations):
                iterate(training, plan, photo)
        found.append((training.whole_history().last_loss(), training.finished().tensors()))
    for name, tensor in found[0][1].items():
        assert torch.equal(tensor, found[1][1][name]), name
    assert found[0][0] == found[1][0] == pytest.approx(found[2][0], rel=0.02)


def test_rows_of_a_device_are_the_cpus(device: Device) -> None:
    values, generator = torch.randn(1000, 16, 3), torch.Generator().manual_seed(4)
    for count in (500, 950, 1000, 1500):
        rows = torch.randint(0, 1000, (count,), generator=generator)
        tensors = {"sh": values.to(device.tensors)}
        take_rows(tensors, rows.to(device.tensors))
        assert torch.equal(tensors["sh"].cpu(), values[rows])


def test_an_iteration_waits_for_nothing(device: Device) -> None:
    training, plan = make_training(FEW, device)
    given = photos(device, 5)
    iterate(training, plan, given[0])  # what is loaded and allocated once
    torch.cuda.synchronize()
    with never_waiting(device.tensors):
        for photo in given[1:4]:  # density control follows the fifth
            iterate(training, plan, photo)
    assert training.iteration == 4


def test_a_memory_limit_holds(device: Device) -> None:
    training, plan = make_training(FEW, device, 200_000)
    given = photos(device, 3)
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    limit = torch.cuda.memory_allocated() + 96 * MEGABYTE
    torch.cuda.reset_peak_memory_stats()
    with device.memory_limit(limit):
        free = free_bytes(device.tensors)
        assert free is not None and 0 < free <= 96 * MEGABYTE
        silent = Silent()
        for photo in given:
            iterate_within_memory(training, plan, photo, silent)
    assert training.iteration == 3 and torch.cuda.max_memory_reserved() <= limit + 2 * MEGABYTE
