"""train: optimise the Gaussians against the photos, all at once or block by block."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Shard, Summary
from splatpipe.pipeline.geometry.plan_area import read_model_area
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.blocks.assembly import assemble
from splatpipe.pipeline.train.blocks.cells.site_plan import limit_of_whole, load_site_plan
from splatpipe.pipeline.train.blocks.training import BlockTask, SiteParts, train_block
from splatpipe.pipeline.train.options import TrainConfig


def run(config: TrainConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the model, its history, plan and auxiliary models: trained here, or merged from blocks if there are any.

    Raises:
        SplatpipeError: if nothing is left to train on, or a block is missing.
        MachineError: if the requested device is not available.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    if inputs.shards:
        return assemble(inputs, out, report)
    decided = inputs.parts.get("blocks.plan")
    limit = 0 if decided is None else limit_of_whole(decided)
    if limit and not config.max_memory_bytes:
        config = config.model_copy(update={"max_memory_bytes": limit})
    return loop.run(config, inputs, out, report)


class BlockReporter:
    """A reporter that prefixes a block's messages with its number.

    Args:
        report: Receives the messages.
        block: The block.
    """

    def __init__(self, report: Reporter, block: Shard) -> None:
        self._report, self._name = report, f"block {block.number} of {block.count}"

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None:
        """See ``Reporter``."""
        self._report.progress(done, total, f"{self._name}: {what}", unit)

    def metric(self, name: str, value: int | float, step: int | None = None) -> None:
        """See ``Reporter``."""
        self._report.metric(name, value, step)

    def note(self, message: str) -> None:
        """See ``Reporter``."""
        self._report.note(f"{self._name}: {message}")

    def warning(self, message: str, hint: str = "") -> None:
        """See ``Reporter``."""
        self._report.warning(f"{self._name}: {message}", hint)


def run_block(config: TrainConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write one block's model, history and plan; resume from the checkpoint of a killed run if there is one.

    Raises:
        StageError: if the outputs of `blocks` cannot be read.
        MachineError: if the requested device is not available.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    assert inputs.shard is not None
    site, number = load_site_plan(inputs["blocks.plan"]), inputs.shard.index
    area = read_model_area(inputs.parts.get("georef.boundary"))
    parts = SiteParts(
        inputs["undistort.dataset"],
        inputs["split.views"],
        inputs["blocks.coarse"],
        inputs["blocks.prospects"],
        site.partition,
        area,
    )
    limits = site.blocks[number]
    task = BlockTask(number, limits.share, limits.trained, limits.frozen, site.window_pixels)
    return train_block(config, parts, task, inputs.machine, out, BlockReporter(report, inputs.shard))
