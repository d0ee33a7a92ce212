"""The state of a training after a whole iteration: everything a resumed run needs to end with the same bits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import GradientBuffers
from splatpipe.pipeline.splat.free_space import FreeSpace
from splatpipe.pipeline.splat.gaussians import PARAMETERS, Gaussians
from splatpipe.pipeline.splat.sh import coefficient_count
from splatpipe.pipeline.train.checkpoint import BrokenCheckpointError, Checkpoint
from splatpipe.pipeline.train.clearing import is_clearing_step, unwanted
from splatpipe.pipeline.train.densify import (
    RESET_OPACITY,
    DensityEvent,
    Growth,
    reset_opacity,
    room_at,
    unchanged,
)
from splatpipe.pipeline.train.density import Density, DensityStep
from splatpipe.pipeline.train.exposure import Exposure
from splatpipe.pipeline.train.history import History
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import Plan
from splatpipe.pipeline.train.robust import Robust, share_at
from splatpipe.pipeline.train.schedule import Schedule
from splatpipe.pipeline.train.sky import SkyModel
from splatpipe.pipeline.train.smoothing import REFRESH_EVERY, Sampling, raw_opacity_limits, smoothed

SMALLEST_SCALE = 1e-6  # of a Gaussian over the scene's extent: float32 covariances stay regular
LARGEST_SCALE = 1e2  # a sky is no farther than that

_ADAM = "adam."
_FILTER = "filter_sigmas"


@runtime_checkable
class Stateful(Protocol):
    """What a checkpoint keeps tensors of."""

    def to_arrays(self) -> dict[str, Tensor]: ...
    def load(self, arrays: Mapping[str, Tensor]) -> None: ...


@dataclass
class TrainState:
    """Parameters, moments, statistics and history.

    Attributes:
        gaussians: The model, raw; its tensors are leaves of autograd.
        adam: The optimiser's moments.
        density: Density control, with what it has observed since its last step.
        history: What happened so far.
        iteration: The last whole one.
        seconds: Spent so far, over all runs; of no influence.
        buffers: Memory of the gradients.
        exposure: The photos' colours, where they are modelled.
        sky: Trained beside the Gaussians; None where there is none.
        robust: What of each photo the others contradict; None without `robust`.
        sampling: The training cameras, with `filter_3d`; not in the checkpoint.
        free_space: What photos look through, with `prune_free_space`; not in the checkpoint.
        filter_sigmas: Of the 3D filter, a Gaussian each, world units; None before the first and after density control.
    """

    gaussians: Gaussians
    adam: Adam
    density: Density
    history: History
    iteration: int = 0
    seconds: float = 0.0
    buffers: GradientBuffers = field(default_factory=GradientBuffers)
    exposure: Exposure | None = None
    sky: SkyModel | None = None
    robust: Robust | None = None
    sampling: Sampling | None = None
    free_space: FreeSpace | None = None
    filter_sigmas: Float[Tensor, " n"] | None = None

    @staticmethod
    def begin(start: Gaussians, plan: Plan, sky: SkyModel | None = None) -> TrainState:
        """The state before the first iteration.

        Args:
            start: The Gaussians to start with; evenly thinned where there are more than the cap allows.
            plan: The training's.
            sky: As it begins.
        """
        options = plan.options
        if len(start) > options.max_gaussians:
            start = start.select(torch.arange(options.max_gaussians) * len(start) // options.max_gaussians)
        columns = coefficient_count(options.sh_degree)
        sh = torch.zeros(len(start), columns, 3)
        shared = min(columns, start.sh.shape[1])
        sh[:, :shared] = start.sh[:, :shared]
        model = start.clone()
        model.sh = sh
        gaussians = model.requires_grad_()
        return TrainState.of(gaussians, plan, History(), sky)

    @staticmethod
    def of(gaussians: Gaussians, plan: Plan, history: History, sky: SkyModel | None) -> TrainState:
        """Gaussians with everything that the plan wants beside them, nothing of it trained."""
        options = plan.options
        density = Density(len(gaussians), options.density == "absolute")
        state = TrainState(gaussians, Adam(gaussians.tensors()), density, history)
        state.exposure = Exposure(plan.train_views) if options.exposure == "affine" else None
        state.robust = Robust(plan.train_views) if options.robust else None
        state.sky = sky
        return state

    def rendered_model(self, options: TrainConfig) -> Gaussians:
        """What an iteration renders: the raw Gaussians, or what the 3D filter makes of them."""
        assert (self.sampling is not None) == options.filter_3d, "the 3D filter needs the training cameras"
        if self.iteration % REFRESH_EVERY == 0:
            self.filter_sigmas = None
        return self._filtered(self.gaussians)

    def _filtered(self, gaussians: Gaussians) -> Gaussians:
        return gaussians if self.sampling is None else smoothed(gaussians, self._filter(self.sampling))

    def _filter(self, sampling: Sampling) -> Float[Tensor, " n"]:
        """``filter_sigmas``, made where there are none."""
        if self.filter_sigmas is None:
            self.filter_sigmas = sampling.filter_sigmas(self.gaussians.means)
        return self.filter_sigmas

    def step(self, gradient_rows: Bool[Tensor, " n"], means_rate: float, extent: float, schedule: Schedule) -> None:
        """Step the parameters against their gradients, which are dropped.

        Args:
            gradient_rows: The Gaussians that the photo saw.
            means_rate: Learning rate of positions, world units.
            extent: Of the scene, world units.
            schedule: The training's.
        """
        given = schedule.rates
        colour = given.boost * given.sh
        rates: dict[str, float | Tensor] = {
            "means": means_rate,
            "log_scales": given.boost * given.scales,
            "quats": given.boost * given.quats,
            "opacity_logits": given.opacity,
            "sh": sh_rates(self.gaussians.sh.shape[1], colour, colour / given.sh_rest_divisor),
        }
        tensors = self.gaussians.tensors()
        rows = gradient_rows if given.sparse else None
        self.history.skipped_gradients += self.adam.step(tensors, rates, rows)
        for tensor in tensors.values():
            tensor.grad = None
        self.gaussians.log_scales.detach().clamp_(math.log(SMALLEST_SCALE * extent), math.log(LARGEST_SCALE * extent))

    def end_epoch(self, iteration: int, plan: Plan) -> None:
        """After the last iteration of an epoch, with `robust`: take its threshold."""
        if self.robust is not None and iteration % len(plan.train_views) == 0:
            self.robust.end_epoch(share_at(plan.options.robust, plan.schedule.density.first, iteration))

    def probe(self) -> Float[Tensor, "n 2"]:
        """Zeros whose gradient a render makes the one by the means on the image plane."""
        return torch.zeros(len(self.gaussians), 2, requires_grad=True)

    def control_density(self, plan: Plan, iteration: int) -> None:
        """Grow, prune and reset where this iteration is one for it; only prune and reset once growth has ended.

        Args:
            plan: The training's.
            iteration: The one that ends.
        """
        density = plan.schedule.density
        with torch.no_grad():
            if density.is_step(iteration):
                growing = not self.history.growth_ended
                limit = room_at(density, plan.initial_gaussians, iteration) if growing else 0
                self._densify(plan, limit, iteration)
            elif not self.history.flat_at and is_clearing_step(self.free_space, plan.schedule, iteration):
                self._clear(plan.schedule, iteration)
            if density.is_reset(iteration):
                self._reset_opacity()
                self.adam.zero_state(names=("opacity_logits",))
                self.history.resets.append(iteration)

    def _reset_opacity(self) -> None:
        """Leave no opacity as it is rendered above ``RESET_OPACITY``."""
        logits = self.gaussians.opacity_logits.detach()
        if self.sampling is None:
            reset_opacity(logits, RESET_OPACITY)
        else:
            logits.clamp_(max=raw_opacity_limits(self.gaussians, self._filter(self.sampling), RESET_OPACITY))

    def _densify(self, plan: Plan, limit: int, iteration: int) -> None:
        """Give the model the rows that density control chooses, at most ``limit`` where it adds any."""
        self.buffers = GradientBuffers()  # of another size by the end of this, and memory is tight meanwhile
        gaussians = self.gaussians.detach()
        rendered = self._filtered(gaussians)
        gone = unwanted(rendered, self.free_space, plan.schedule, iteration)
        step = DensityStep(plan.schedule.density, plan.extent, limit, iteration, rendered, gone)
        growth, counts = self.density.control(gaussians, step)
        self._become(growth)
        self.history.add_density(DensityEvent(iteration, gaussians=len(self.gaussians), **counts))

    def _clear(self, schedule: Schedule, iteration: int) -> None:
        """Remove what hangs in free space, after the last step of density control, too."""
        gaussians = self.gaussians.detach()
        gone = unwanted(self._filtered(gaussians), self.free_space, schedule, iteration)
        if bool(gone.any()) and not bool(gone.all()):
            self._become(unchanged(gaussians, ~gone))
            pruned = int(gone.sum())
            self.history.add_density(DensityEvent(iteration, 0, 0, pruned, 0, gaussians=len(self.gaussians)))

    def _become(self, growth: Growth) -> None:
        """Take the rows of a growth, with their moments."""
        self.buffers = GradientBuffers()
        grown = self.gaussians.detach().select(growth.source)
        grown.means, grown.log_scales, grown.opacity_logits = growth.means, growth.log_scales, growth.opacity_logits
        self.gaussians, self.filter_sigmas = grown.requires_grad_(), None
        self.adam.select(growth.source)
        self.adam.zero_state(rows=growth.fresh)
        self.density.restart(len(grown))

    def finished(self) -> Gaussians:
        """The trained model as it is rendered, with its 3D filter: finite, with unit quaternions."""
        model = self._filtered(self.gaussians.detach())
        model = model.select(model.finite())
        model.quats = model.quats / torch.linalg.vector_norm(model.quats, dim=1, keepdim=True).clamp(min=1e-30)
        return model

    def _parts(self) -> dict[str, Stateful]:
        """What has tensors of its own beside the Gaussians and their moments, by its name in a checkpoint."""
        parts: dict[str, Stateful | None] = {
            "density": self.density,
            "exposure": self.exposure,
            "robust": self.robust,
            "sky": self.sky,
        }
        return {name: part for name, part in parts.items() if part is not None}

    def checkpoint(self, instruction_set: str) -> Checkpoint:
        """All of it for a file; not copied.

        Args:
            instruction_set: That it was computed with.
        """
        tensors = dict(self.gaussians.detach().tensors())
        tensors |= {_ADAM + name: tensor for name, tensor in self.adam.state_dict().items()}
        for part, stateful in self._parts().items():
            tensors |= {f"{part}.{name}": tensor for name, tensor in stateful.to_arrays().items()}
        if self.filter_sigmas is not None:
            tensors[_FILTER] = self.filter_sigmas
        facts = {"iteration": self.iteration, "seconds": self.seconds, "history": self.history.state()}
        facts["instruction_set"] = instruction_set
        return Checkpoint({name: tensor.numpy() for name, tensor in tensors.items()}, facts)

    @staticmethod
    def restore(checkpoint: Checkpoint, plan: Plan, sky: SkyModel | None = None) -> TrainState:
        """The inverse of ``checkpoint``.

        Args:
            checkpoint: As it was written.
            plan: The training's.
            sky: As it began; takes the checkpoint's colours.

        Raises:
            BrokenCheckpointError: if something is missing or does not fit.
        """
        try:
            tensors = {name: torch.from_numpy(array) for name, array in checkpoint.arrays.items()}
            gaussians = Gaussians.from_tensors({name: tensors[name] for name in PARAMETERS}).requires_grad_()
            if gaussians.sh.shape[1] != coefficient_count(plan.options.sh_degree):
                raise ValueError("another degree of spherical harmonics")
            state = TrainState.of(gaussians, plan, History(**checkpoint.facts["history"]), sky)
            state.adam.load_state_dict(_under(_ADAM, tensors))
            state.iteration, state.seconds = int(checkpoint.facts["iteration"]), float(checkpoint.facts["seconds"])
            state.filter_sigmas = tensors.get(_FILTER)
            for part, stateful in state._parts().items():  # the sky last: what fails before leaves it as it began
                stateful.load(_under(f"{part}.", tensors))
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise BrokenCheckpointError(f"it is incomplete ({error})") from error
        return state


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
