"""Training one block of a scene: its own Gaussians, on the windows that show its cell, with all else frozen.

It continues where the coarse pass ended (``schedules.py``), with that pass's sky and exposures. Its output covers only
its cell and margin; ``assembly.py`` joins the cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.stage import JSON, Machine, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.photos.pixels.dataset import View, load_split, load_views
from splatpipe.pipeline.raster.device import Device, choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import MIP_COMMENT, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import read_panorama
from splatpipe.pipeline.train.appearance.exposure import Exposure, read_exposures
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.appearance.sky_file import read_skies
from splatpipe.pipeline.train.blocks.block_windows import Parts, WindowScheme
from splatpipe.pipeline.train.blocks.cells.fence import Fence
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.coarse import SKIES
from splatpipe.pipeline.train.blocks.schedules import block_schedule
from splatpipe.pipeline.train.blocks.scope import BlockScope, ScopeReader, read_free_space, rows_of
from splatpipe.pipeline.train.hooks import Technique
from splatpipe.pipeline.train.loop import TrainingSetup, run_training, summary_of
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import TrainingPlan, footage_of, load_or_write_plan, make_plan, sizes_of
from splatpipe.pipeline.train.plan.training_order import TrainingOrder, WindowOrder
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.state.history import History
from splatpipe.pipeline.train.techniques.floater_pruning import FloaterPruning
from splatpipe.pipeline.train.techniques.techniques import Techniques, make_techniques


@dataclass(frozen=True, eq=False)
class SiteParts:
    """The files that all blocks of a scene share.

    Attributes:
        dataset: The photos and the sparse points.
        split: Which photos are trained on.
        coarse: Output folder of the coarse pass.
        prospects: Folder of the blocks' scopes.
        partition: The cells.
        area: Area of interest, in the model's frame; None for everything.
    """

    dataset: Path
    split: Path
    coarse: Path
    prospects: Path
    partition: Partition
    area: PlanArea | None = None


@dataclass(frozen=True)
class BlockTask:
    """One block and its limits.

    Attributes:
        number: Number of its cell.
        share: Maximum number of Gaussians in its cell.
        trained: Maximum number of trained Gaussians, including the margin.
        frozen: Maximum number of frozen Gaussians rendered around it.
        window_pixels: Most pixels of a photo that an iteration uses.
    """

    number: int
    share: int
    trained: int
    frozen: int
    window_pixels: int


def train_block(
    config: TrainConfig, parts: SiteParts, task: BlockTask, machine: Machine, out: Path, report: Reporter
) -> Summary:
    """Write the block's model, history and plan; resumes from the checkpoint of a killed run.

    Args:
        config: The training options, as for ``train_coarse``.
        parts: The scene.
        task: The block.
        machine: Affects only speed.
        out: Output folder, also of the checkpoint and decoded photos.
        report: Receives progress and messages.

    Raises:
        SplatpipeError: if a file is missing or broken.
        MachineError: if the requested device is not available, or memory is short.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    device = choose_device(machine.device, config.unfit_for_cuda(), report.note)
    with same_bits(machine.threads), device.deterministic(), device.memory_limit(config.max_memory_bytes):
        block = Block.of(config, parts, task, device)
        scope = block.scope_reader.scope()
        windows = scope.windows
        plan = load_or_write_plan(out / "plan.json", lambda: block.plan(windows))
        if plan.schedule.iterations == 0:
            report.note("there is nothing to train")
            return _leave(block, plan, out, (block.start(), History())) | device.facts()
        report.note(f"{len(plan.train_views)} photos, {plan.described()}")
        state = run_training(block.setup(plan, scope, out), out, report)
        left = _leave(block, plan, out, (state.finished(), state.whole_history()))
    return summary_of(state, plan) | left | device.facts()


@dataclass(frozen=True, eq=False)
class Block:
    """A block and its scene.

    Attributes:
        parts: The scene's files.
        task: Which block.
        device: The compute device.
        whole: The plan of the whole scene, with the block's options.
        scope_reader: Reads its windows and surroundings.
        exposures: The photos' colour maps, as in `exposures.json`.
    """

    parts: SiteParts
    task: BlockTask
    device: Device
    whole: TrainingPlan
    scope_reader: ScopeReader
    exposures: Mapping[str, list[list[float]]]

    @staticmethod
    def of(config: TrainConfig, parts: SiteParts, task: BlockTask, device: Device) -> Block:
        """Read the scene's files and return the block.

        Raises:
            SplatpipeError: if a file is missing or broken.
        """
        views, split = load_views(parts.dataset), load_split(parts.split)
        kept = set(split.train)
        trained_on = [view for view in views if view.camera.name in kept]
        exposures = read_exposures(parts.coarse / "exposures.json", "blocks")
        exposure = "affine" if exposures else "off"
        # The cap limits its memory: other memory of the process, e.g. of earlier blocks, must not end its growth.
        decided = {
            "max_gaussians": task.trained,
            "max_memory_bytes": 0,
            "time_budget_s": 0.0,
            "exposure": exposure,
        }
        whole = make_plan(config.model_copy(update=decided), views, split, 0, task.window_pixels)
        cut = WindowScheme.of(whole.options, whole.footage, whole.megapixels)
        scope_reader = ScopeReader(
            parts.prospects, parts.coarse, parts.partition, task.number, trained_on, cut, task.frozen
        )
        return Block(parts, task, device, whole, scope_reader, exposures)

    def start(self) -> Gaussians:
        """The initial Gaussians."""
        return self.scope_reader.start(self.task.trained)

    def views(self, windows: Parts) -> list[View]:
        """The photos of its windows, in dataset order."""
        return [self.scope_reader.views[row] for row in rows_of(windows)]

    def plan(self, windows: Parts) -> TrainingPlan:
        """The block's plan; without iterations if it has no photos or nothing to train."""
        options, cameras = self.whole.options, [view.camera for view in self.views(windows)]
        sizes = sizes_of(cameras)
        count = len(self.start())
        planned = replace(
            self.whole,
            train_views=tuple(camera.name for camera in cameras),
            initial_gaussians=count,
            sizes=sizes,
            last_iteration=0,
        )
        if not cameras or not count:
            return replace(planned, schedule=replace(planned.schedule, iterations=0))
        seen = footage_of(sizes, self.whole.megapixels, self.whole.window_pixels)
        pieces = {level: len(pairs) for level, pairs in windows.items()}
        schedule = block_schedule(options, self.whole.footage, seen, pieces, count / self.task.trained)
        size = round(1e-6 * seen.pixels(TrainingSize(schedule.finest.level)), 4)
        return replace(planned, schedule=schedule, last_iteration=schedule.iterations, train_megapixels=size)

    def setup(self, plan: TrainingPlan, scope: BlockScope, out: Path) -> TrainingSetup:
        """The block's training setup.

        Args:
            plan: The block's plan.
            scope: The block's scope.
            out: Folder of its frozen Gaussians.
        """
        windows = scope.windows
        views, place = self.views(windows), {row: place for place, row in enumerate(rows_of(windows))}
        cut, every = self.scope_reader.cut, self.scope_reader.views
        cells = {place[row]: grid for row, grid in scope.sample_masks.items()}
        pieces = {
            level: [(place[row], cut.frames(every[row].camera, level)[window]) for row, window in pairs.tolist()]
            for level, pairs in windows.items()
        }

        def order_of(sizes: Sequence[TrainingSize]) -> TrainingOrder:
            cameras = [view.camera for view in views]
            return WindowOrder(cameras, sizes, plan.options.seed, plan.megapixels, pieces, cells)

        return TrainingSetup(
            plan,
            self.device,
            views,
            order_of,
            techniques=lambda: self.techniques(plan, views),
            start=self.start,
            frozen=lambda: self.scope_reader.frozen(out),
        )

    def techniques(self, plan: TrainingPlan, views: Sequence[View]) -> Techniques:
        """The techniques set by the options; sky and exposures come from the coarse pass.

        Args:
            plan: The block's plan.
            views: The photos of its windows.
        """
        names, where = set(plan.train_views), self.device.tensors
        panorama = read_panorama(self.parts.coarse / "sky.npz")
        sky = None if panorama is None else SkyModel.given(panorama, read_skies(self.parts.coarse / SKIES, names))
        made = make_techniques(plan, sky, views, device=where, area=self.parts.area)
        if plan.options.exposure == "affine":
            exposure = Exposure.given({name: self.exposures[name] for name in plan.train_views})
            exposure.move_to(where)
            made = made.with_given(exposure)
        more: list[Technique] = [self.fence(plan)]
        if plan.options.prune_free_space:
            cameras = [view.camera for view in self.scope_reader.views]
            more.append(FloaterPruning(read_free_space(self.parts.prospects, cameras), plan.schedule))
        return Techniques((*made, *more))

    def fence(self, plan: TrainingPlan) -> Fence:
        """The technique that keeps its Gaussians within cell and margin."""
        return Fence(self.parts.partition, self.task.number, self.task.share, plan.schedule.density)


def _leave(block: Block, plan: TrainingPlan, out: Path, trained: tuple[Gaussians, History]) -> dict[str, JSON]:
    """Write the results: only the Gaussians within the block's shares."""
    gaussians, history = trained
    gaussians = gaussians.select(block.fence(plan).kept(gaussians))
    write_splat(out / "model.ply", gaussians, [MIP_COMMENT] if plan.options.antialias else [])
    write_file(out / "history.json", history.to_json())
    return {"gaussians": len(gaussians), "photos": len(plan.train_views)}
