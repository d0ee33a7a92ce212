"""Merging trained blocks into the output of a whole training: model, history, plan and auxiliary models.

A block trains its cell and a margin, so that Gaussians at its border are trained with those on the other side; only
the Gaussians whose centres lie in its cell are used. Blocks are merged in order of their numbers, whatever the order of
training. Models are read one at a time, once to count and once to write.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter, Summary
from splatpipe.pipeline.render.rendering import load_rendering
from splatpipe.pipeline.splat.containers.ply import MIP_COMMENT, read_splat, write_splat_parts
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.site_plan import SitePlan, load_site_plan

OF_ALL = ("sky.npz", "exposures.json", "rendering.json")  # copied from the coarse pass, which covers the whole scene
FROM_COARSE = ("sky_photos", "device", "instruction_set", "mode")


def assemble(inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the output of the stage `train` from its shards and the coarse pass.

    Args:
        inputs: The stage's inputs.
        out: Output folder.
        report: Receives progress.

    Raises:
        StageError: if a block is missing or one of its files is broken.
    """
    site, coarse = load_site_plan(inputs["blocks.plan"]), inputs["blocks.coarse"]
    read = _BlockReader(inputs.shards, report)
    _require_all(site, inputs.shards)
    count, sh_degree = count_and_degree(site.partition, read)
    comments = [MIP_COMMENT] if load_rendering(coarse / "rendering.json").antialias else []
    write_splat_parts(out / "model.ply", own_pieces(site.partition, read), count, sh_degree, comments)
    for name in OF_ALL:
        shutil.copyfile(coarse / name, out / name)
    histories = [_read(folder / "history.json") for folder in inputs.shards]
    history = joint_history(_read(coarse / "history.json"), histories)
    write_file(out / "history.json", json.dumps(history, indent=1, allow_nan=False) + "\n")
    plans = {"coarse": _read(coarse / "plan.json"), "blocks": [_read(each / "plan.json") for each in inputs.shards]}
    write_file(out / "plan.json", json_text(plans))
    most = sum(block.share for block in site.blocks)
    return {"gaussians": count, "blocks": len(inputs.shards), **_summary(inputs, history, most)}


def owned(partition: Partition, block: int, gaussians: Gaussians) -> Gaussians:
    """The Gaussians of a block's model that lie in its own cell, in their order.

    Args:
        partition: The cells.
        block: The block's number.
        gaussians: The trained model: cell, margin, and Gaussians that moved out of both.
    """
    owners = partition.owners(gaussians.means.detach().double().numpy(force=True))
    return gaussians.select(torch.from_numpy(np.flatnonzero(owners == block)))


def count_and_degree(partition: Partition, read: Callable[[int], Gaussians]) -> tuple[int, int]:
    """The number of Gaussians of the whole scene, and their SH degree.

    Args:
        partition: The cells.
        read: As for ``own_pieces``.

    Raises:
        ValueError: if the SH degrees differ.
    """
    found = [_count(partition, block, read(block)) for block in range(len(partition.cells))]
    if len({degree for _count_of_own, degree in found}) != 1:
        raise ValueError("blocks are of several SH degrees")
    return sum(count for count, _degree in found), found[0][1]


def own_pieces(partition: Partition, read: Callable[[int], Gaussians]) -> Iterator[Gaussians]:
    """The whole scene, piece by piece; each model is freed before the next is read.

    Args:
        partition: The cells.
        read: Reads a block's trained model by number, without frozen Gaussians.
    """
    for block in range(len(partition.cells)):
        yield from (owned(partition, block, piece) for piece in read(block).pieces())


def _count(partition: Partition, block: int, model: Gaussians) -> tuple[int, int]:
    """Number of a model's Gaussians in its own cell, and its SH degree."""
    means = (piece.means.detach().double().numpy(force=True) for piece in model.pieces())
    return sum(int((partition.owners(each) == block).sum()) for each in means), model.sh_degree


def _require_all(site: SitePlan, shards: Sequence[Path]) -> None:
    """Check that each block has written its model.

    Raises:
        StageError: if one has not.
    """
    there = {number for number, folder in enumerate(shards, 1) if (folder / "model.ply").is_file()}
    missing = [str(number) for number in range(1, len(site.blocks) + 1) if number not in there]
    if missing or len(shards) > len(site.blocks):
        problem = f"block {', '.join(missing)} has no model" if missing else f"{len(shards)} models are here"
        raise StageError(
            f"The {len(site.blocks)} blocks cannot be merged: {problem}.",
            hint="Run again with --rerun-from train: missing blocks are trained.",
        )


class _BlockReader:
    """Reads trained blocks and reports progress: each is read twice, to count and to write."""

    def __init__(self, folders: Sequence[Path], report: Reporter) -> None:
        self._folders, self._report, self._done = folders, report, 0

    def __call__(self, block: int) -> Gaussians:
        self._report.progress(self._done, 2 * len(self._folders), "merging blocks", "steps")
        self._done += 1
        return read_splat(self._folders[block] / "model.ply")


def joint_history(coarse: Mapping[str, Any], blocks: Sequence[Mapping[str, Any]]) -> dict[str, JSON]:
    """The history of the coarse pass, followed by that of all blocks as if they had been trained in parallel.

    A point of the curve has the total iterations, the mean loss and the total Gaussians of all blocks; each block's own
    history is included too.

    Args:
        coarse: The coarse pass's `history.json`.
        blocks: The blocks', in their order.
    """
    before = list(coarse["curve"])
    done = int(before[-1]["iteration"]) if before else 0
    curves = [block["curve"] for block in blocks if block["curve"]]
    return {
        "curve": [*before, *_side_by_side(curves, done)],
        "density": [],
        "resets": list(coarse["resets"]),
        "growth_ended": 0,
        "skipped_gradients": sum(int(each["skipped_gradients"]) for each in (coarse, *blocks)),
        "coarse_iterations": done,
        "blocks": [dict(block) for block in blocks],
    }


def _side_by_side(curves: Sequence[Sequence[Mapping[str, Any]]], before: int) -> list[dict[str, JSON]]:
    found = []
    length = max(map(len, curves), default=0)
    for step in range(1, length + 1):
        points = [curve[math.ceil(step * len(curve) / length) - 1] for curve in curves]
        losses = [(float(point["loss"]), float(point["iteration"])) for point in points if point["loss"] is not None]
        weight = sum(iterations for _, iterations in losses)
        found.append(
            {
                "iteration": before + sum(int(point["iteration"]) for point in points),
                "loss": sum(loss * iterations for loss, iterations in losses) / weight if weight else None,
                "gaussians": sum(int(point["gaussians"]) for point in points),
                "sh_degree": max(int(point["sh_degree"]) for point in points),
                "width": max(int(point["width"]) for point in points),
            }
        )
    return found


def _summary(inputs: Inputs, history: Mapping[str, Any], most: int) -> dict[str, JSON]:
    """The training's summary: sums over its blocks and the coarse pass; the loss is that of the blocks."""
    first = inputs.summaries.get("blocks", {}).get("coarse", {})
    each = [inputs.summaries.get(f"train.{number}", {}) for number in range(1, len(inputs.shards) + 1)]
    losses = [point["loss"] for point in history["curve"] if point["loss"] is not None]
    parts = [first, *each]
    found: dict[str, JSON] = {
        "iterations": sum(int(part.get("iterations", 0)) for part in parts),
        "planned_iterations": sum(int(part.get("planned_iterations", 0)) for part in parts),
        "loss": losses[-1] if losses else None,
        "train_seconds": round(sum(float(part.get("train_seconds", 0.0)) for part in parts), 1),
        "peak_memory_bytes": max(int(part.get("peak_memory_bytes", 0)) for part in parts),
    }
    if sizes := [float(part["train_megapixels"]) for part in each if part.get("train_megapixels")]:
        found["train_megapixels"] = max(sizes)
    if flat := {name: ended for name, part in _named(first, each).items() if (ended := _ended_flat(part))}:
        found["flat"] = flat
    if robust := [part for part in each if "robust_left_out" in part]:
        photos = sum(part["photos"] for part in robust)
        found["robust_left_out"] = round(sum(part["photos"] * part["robust_left_out"] for part in robust) / photos, 5)
    plan = {**first.get("plan", {}), "max_gaussians": most, "blocks": len(each)}
    return found | {name: first[name] for name in FROM_COARSE if name in first} | {"plan": plan}


def _named(coarse: Summary, blocks: Sequence[Summary]) -> dict[str, Summary]:
    return {"coarse": coarse, **{str(number): block for number, block in enumerate(blocks, 1)}}


def _ended_flat(part: Summary) -> dict[str, JSON]:
    """The entries of a part's summary about early ends of the training or of a photo size after a flat loss."""
    return {name: part[name] for name in ("flat_at", "sizes_ended") if part.get(name)}


def _read(path: Path) -> Any:
    try:
        return read_json(path)
    except (OSError, ValueError) as error:
        raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from train.") from error
