"""blocks: decide whether to train the scene whole or in blocks; for blocks, run the coarse pass and lay out cells."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch

from splatpipe.pipeline.engine.files.durable import sync_tree, write_durably
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.machine import available_memory_bytes
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.photos.pixels.dataset import load_split, load_views
from splatpipe.pipeline.raster.device import Device, choose_device
from splatpipe.pipeline.splat.containers.ply import read_splat_header
from splatpipe.pipeline.train.blocks.cells.division import Division, SceneSize, divided, memory_limit
from splatpipe.pipeline.train.blocks.cells.site_plan import whole_json
from splatpipe.pipeline.train.blocks.coarse import TrainingLimits, train_coarse
from splatpipe.pipeline.train.blocks.layout import COARSE, PROSPECTS, lay_out
from splatpipe.pipeline.train.blocks.options import BlocksConfig
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import WINDOW_PIXELS
from splatpipe.pipeline.train.plan.limits import LIBRARIES_BYTES
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.stages.forecast.training import MEGA, CaptureSize, Training


def run(config: BlocksConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `blocks.json`, `coarse/` (the whole scene's model, sky and exposures, where blocks start) and `prospects/`.

    `prospects/` lists what each block trains on. Without blocks, both folders are empty.

    The decision is stored in `division.json` before training starts, so that a resumed run keeps it on any machine.

    Raises:
        MachineError: if the requested device is not available.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    train = TrainConfig.model_validate(
        {name.removeprefix("train."): value for name, value in inputs.settings.items() if name.startswith("train.")}
    )
    device = choose_device(inputs.machine.device, train.unfit_for_cuda(), report.note)
    plan = _whole_plan(train, inputs, device)
    division = stored_division(out / "division.json", lambda: _division(config, train, plan, device))
    report.progress(1, 1, "choosing blocks")
    coarse = out / COARSE
    for folder in (coarse, out / PROSPECTS):
        folder.mkdir(exist_ok=True)
    if division.is_whole:
        limit = _default_limit(division, train, device, report)
        write_file(out / "blocks.json", whole_json(limit))
        return {"blocks": 1} | ({"limit_bytes": limit} if limit else {})
    _report_division(division, train, division.limit_bytes and division.limit_bytes - _host_bytes(device), report)
    finished = out / "coarse.json"
    if not finished.is_file():
        limits = TrainingLimits(division.coarse_cap, division.window_pixels)
        summary = train_coarse(train, inputs, limits, coarse, report)
        sync_tree(coarse)  # before the file that marks it complete, so that a power cut loses nothing
        write_durably(finished, json.dumps(dict(summary)))
    (coarse / "checkpoint.npz").unlink(missing_ok=True)
    site, block_summary = lay_out(train, inputs, division, out, report)
    write_file(out / "blocks.json", site.to_json())
    return {
        "blocks": division.blocks,
        "division": asdict(division),
        **block_summary,
        "coarse": read_json(finished),
    }


def stored_division(path: Path, make: Callable[[], Division]) -> Division:
    """Return the stored division, or make and store one if there is none.

    Args:
        path: File of the division, in a folder that belongs to one key.
        make: Makes the division.
    """
    try:
        return Division.of_facts(read_json(path))
    except (OSError, ValueError, KeyError, TypeError):
        division = make()
        write_durably(path, json.dumps(asdict(division)))
        return division


def _whole_plan(train: TrainConfig, inputs: Inputs, device: Device) -> TrainingPlan:
    """Plan training the whole scene at once, without a memory limit."""
    views, split = load_views(inputs["undistort.dataset"]), load_split(inputs["split.views"])
    start = read_splat_header(inputs["initialize.splat"]).count
    return make_plan(train, views, split, start, WINDOW_PIXELS[device.name])


def _division(config: BlocksConfig, train: TrainConfig, plan: TrainingPlan, device: Device) -> Division:
    if train.time_budget_s:  # a time budget plans a single training
        return divided(_scene(train, plan), 0)
    limit = memory_limit(train.max_memory_bytes, _memory_bytes(device))
    return divided(_scene(train, plan), limit and limit + _host_bytes(device), config.least)


def _default_limit(division: Division, train: TrainConfig, device: Device, report: Reporter) -> int:
    """Memory limit for training the scene whole if the user set none, bytes; 0 if training will not come near it.

    On CUDA, the device's own memory ends growth.
    """
    if not division.is_near or train.max_memory_bytes or device.name == "cuda":
        return 0
    report.note(
        f"too few photos for blocks: trained as one, within {division.limit_bytes / 1e9:.1f} GB of this machine's "
        "memory"
    )
    return division.limit_bytes


def _host_bytes(device: Device) -> int:
    """Bytes of training memory that are not on the device: the libraries', if it is a GPU."""
    return LIBRARIES_BYTES if device.name == "cuda" else 0


def _memory_bytes(device: Device) -> int:
    if device.name == "cuda":
        return int(torch.cuda.get_device_properties(device.tensors).total_memory)
    return available_memory_bytes()


def _scene(train: TrainConfig, plan: TrainingPlan) -> SceneSize:
    window = max(plan.footage.largest(stretch.training_size) for stretch in plan.schedule.stretches)
    photos = sum(count for _width, _height, count in plan.sizes)
    pixels = sum(width * height * count for width, height, count in plan.sizes) / max(photos, 1)
    size = CaptureSize(photos, pixels / MEGA, True, _shape(plan))
    expected = Training.of(size, train).as_divided().grown
    return SceneSize(train.max_gaussians, expected, window, train.sh_degree, photos)


def _shape(plan: TrainingPlan) -> float:
    """Ratio of shorter to longer side of the most common photo size."""
    width, height, _count = max(plan.sizes, key=lambda size: size[2])
    return min(width, height) / max(width, height)


def _report_division(division: Division, train: TrainConfig, limit_bytes: int, report: Reporter) -> None:
    """Report the decision to the user, with the memory limit as the user gave it."""
    text = f"{division.cap:,} Gaussians are trained in {division.blocks} blocks"
    if limit_bytes:
        text += f", each within {limit_bytes / 1e9:.1f} GB"
    report.note(f"{text}, after a coarse pass with {division.coarse_cap:,}")
    if division.cap < train.max_gaussians:
        report.warning(
            f"{limit_bytes / 1e9:.2f} GB hold {division.cap:,} Gaussians in {division.blocks} blocks, fewer "
            f"than the {train.max_gaussians:,} of train.max_gaussians; there are too few photos for more blocks.",
            hint="For a finer model, give more with --max-memory.",
        )
