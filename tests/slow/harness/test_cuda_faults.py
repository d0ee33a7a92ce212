"""Every mistake planted in the CUDA kernels' sources is caught by the checks that the sources themselves pass."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from checking import ReferenceResult
from exact import case_of, exact_outcome
from faults import FAULTS, planted
from frames import RenderCase
from random_scene import random_camera, random_scene
from repository import HARNESS
from training import KEY, Draws, Loss

from splatpipe.pipeline.raster.loss import photo_loss_reference
from splatpipe.pipeline.train.densify import _split_offsets
from splatpipe.pipeline.train.random_numbers import SPLIT_POSITION, uniform

MORTON_BITS = 21  # an axis
assert KEY[2] == SPLIT_POSITION


def ending() -> RenderCase:
    """Pixels saturate behind a few of many Gaussians; equal depths; a grid of 3 x 2 tiles with parts of tiles."""
    scene = random_scene(3, 220, 1, size=-0.8)
    scene.opacity_logits += 2.5
    scene.means[:, 2] = (scene.means[:, 2] * 4).round() / 4
    camera = random_camera(3, 45, 19)
    camera.cam_from_world[:] = np.eye(4)  # so that equal depths stay equal
    return case_of(scene, camera, background=(0.9, 0.5, 0.1))


def long() -> RenderCase:
    """More tile rows than one thread processes; a window of an image, at the limits of the whole."""
    scene = random_scene(13, 120, 0, size=-1.5)
    scene.log_scales[:, 0] += 2.0
    return case_of(scene, random_camera(13, 60, 180).crop(15, 10, 20, 150), depths=False, magnitudes=True)


def many() -> RenderCase:
    """More than the blocks of a device of one multiprocessor take in a turn, most of them out of sight."""
    scene = random_scene(8, 7000, 0, size=-3.2)
    scene.means[:, 0] = scene.means[:, 0].abs() * 0.6 + 0.1
    scene.means[::8, :2] *= 0.2  # enough in sight for several blocks
    scene.means[:, 2] = (scene.means[:, 2] * 8).round() / 8
    camera = random_camera(8, 33, 18)
    camera.cam_from_world[:] = np.eye(4)
    return case_of(scene, camera)


def many_tiles() -> RenderCase:
    """More tiles than one digit of their radix sort distinguishes."""
    scene = random_scene(6, 60, 0, size=-2.0)
    scene.means[:, :2] *= 4.0
    return case_of(scene, random_camera(6, 290, 240)).changed(upstream={})


def loss() -> Loss:
    rng = np.random.default_rng(2)
    render, photo = (rng.random((21, 37, 3)).astype(np.float32) for _ in range(2))
    mask = rng.random((21, 37)) > 0.1
    leaf = torch.from_numpy(render).double().requires_grad_()
    inner = (5, 4, 32, 21)
    value = photo_loss_reference(leaf, torch.from_numpy(photo).double(), 0.2, torch.from_numpy(mask), inner)
    value.backward()
    assert leaf.grad is not None
    return Loss(render, photo, mask.astype(np.uint8), inner, 0.2, value.item(), leaf.grad.numpy())


def draws() -> Draws:
    scene = random_scene(4, 60, 0)
    rows = torch.arange(1, 60, 2)
    offsets = _split_offsets(scene, rows, *KEY[:2]).numpy()
    means = np.random.default_rng(1).random((300, 3)).astype(np.float32)
    cells = [[format(int(place * 2**MORTON_BITS), f"0{MORTON_BITS}b") for place in row] for row in means]
    keys = [int("".join(z + y + x for x, y, z in zip(*row, strict=True)), 2) for row in cells]
    return Draws(
        uniform(*KEY, np.arange(300)),
        rows.numpy(),
        scene.log_scales.numpy(),
        scene.quats.numpy(),
        offsets,
        means,
        np.array(keys, np.int64),
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the findings with no fault active, and with each."""
    frames = [(case, exact_outcome(case)) for case in (ending(), long(), many())]
    large = many_tiles()
    truth = ReferenceResult(frames, loss(), draws(), (large, exact_outcome(large, gradients=False)))
    path = tmp_path_factory.mktemp("faults") / "truth.pickle"
    path.write_bytes(pickle.dumps(truth))
    command = [sys.executable, str(HARNESS / "checking.py"), str(planted()), str(path), str(len(FAULTS))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answers: list[str] = json.loads(done.stdout)
    return answers


def test_sources_without_a_fault_pass_every_check(found: list[str]) -> None:
    """Nor is their behaviour undefined: an unaligned load, an error on every GPU, would end the process."""
    assert found[0] == ""


@pytest.mark.parametrize("number", range(len(FAULTS)), ids=[fault.name for fault in FAULTS])
def test_fault_is_found(found: list[str], number: int) -> None:
    assert found[1 + number], FAULTS[number]
