"""The state of a training after a whole iteration: everything a resumed run needs to end with the same bits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster import GradientBuffers
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.scene.gaussians import PARAMETERS, Gaussians
from splatpipe.pipeline.scene.sh import coefficient_count
from splatpipe.stages.line import TrainConfig
from splatpipe.stages.train.checkpoint import BrokenCheckpointError, Checkpoint
from splatpipe.stages.train.densify import DensityEvent, is_density_step, is_opacity_reset, reset_opacity, room_at
from splatpipe.stages.train.density import Density, DensityStep, make_density
from splatpipe.stages.train.density.decay import add_decay
from splatpipe.stages.train.exposure import Exposure
from splatpipe.stages.train.history import History
from splatpipe.stages.train.plan import Plan

SMALLEST_SCALE = 1e-6  # of a Gaussian over the scene's extent: float32 covariances stay regular
LARGEST_SCALE = 1e2  # a sky is no farther than that

_ADAM = "adam."
_DENSITY = "density."
_EXPOSURE = "exposure."


@dataclass
class TrainState:
    """Parameters, moments, statistics and history.

    Attributes:
        gaussians: The model; its tensors are leaves of autograd.
        adam: The optimiser's moments.
        density: The strategy of density control, with what it has observed since its last step.
        history: What happened so far.
        iteration: The last whole one.
        seconds: Spent so far, over all runs; of no influence.
        buffers: Memory of the gradients.
        exposure: The photos' colours, where they are modelled.
    """

    gaussians: Gaussians
    adam: Adam
    density: Density
    history: History
    iteration: int = 0
    seconds: float = 0.0
    buffers: GradientBuffers = field(default_factory=GradientBuffers)
    exposure: Exposure | None = None

    @staticmethod
    def begin(start: Gaussians, plan: Plan) -> TrainState:
        """The state before the first iteration.

        Args:
            start: The Gaussians to start with; evenly thinned where there are more than the cap allows.
            plan: The training's.
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
        adam, density = Adam(gaussians.tensors()), make_density(options, len(start))
        return TrainState(gaussians, adam, density, History(), exposure=new_exposure(plan))

    def step(self, gradient_rows: Bool[Tensor, " n"], means_rate: float, extent: float, options: TrainConfig) -> None:
        """Step the parameters against their gradients, which are dropped.

        Args:
            gradient_rows: The Gaussians that the photo saw.
            means_rate: Learning rate of positions, world units.
            extent: Of the scene, world units.
            options: Resolved.
        """
        boost = float(options.lr_boost)
        colour = boost * options.lr_sh
        rates: dict[str, float | Tensor] = {
            "means": means_rate,
            "log_scales": boost * options.lr_scales,
            "quats": boost * options.lr_quats,
            "opacity_logits": options.lr_opacity,
            "sh": sh_rates(self.gaussians.sh.shape[1], colour, colour / options.lr_sh_rest_divisor),
        }
        add_decay(self.gaussians, options)
        tensors = self.gaussians.tensors()
        rows = gradient_rows if options.sparse_adam else None
        self.history.skipped_gradients += self.adam.step(tensors, rates, rows)
        for tensor in tensors.values():
            tensor.grad = None
        self.gaussians.log_scales.detach().clamp_(math.log(SMALLEST_SCALE * extent), math.log(LARGEST_SCALE * extent))
        self.density.stepped(self.gaussians.detach(), options, means_rate, self.iteration + 1)

    def probe(self) -> Float[Tensor, "n 2"]:
        """Zeros whose gradient a render makes the one by the means on the image plane."""
        return torch.zeros(len(self.gaussians), 2, requires_grad=True)

    def control_density(self, options: TrainConfig, extent: float, initial: int, iteration: int) -> None:
        """Grow, prune and reset where this iteration is one for it.

        Args:
            options: Resolved.
            extent: Of the scene, world units.
            initial: Gaussians that the training began with.
            iteration: The one that ends.
        """
        with torch.no_grad():
            if is_density_step(options, iteration):
                self._densify(options, extent, room_at(options, initial, iteration), iteration)
            if is_opacity_reset(options, iteration):
                reset_opacity(self.gaussians.opacity_logits.detach(), options.reset_opacity)
                self.adam.zero_state(names=("opacity_logits",))
                self.history.resets.append(iteration)

    def _densify(self, options: TrainConfig, extent: float, limit: int, iteration: int) -> None:
        """Give the model the rows that the strategy chooses, at most ``limit``."""
        self.buffers = GradientBuffers()  # of another size by the end of this, and memory is tight meanwhile
        gaussians = self.gaussians.detach()
        growth, counts = self.density.control(gaussians, DensityStep(options, extent, limit, iteration))
        grown = gaussians.select(growth.source)
        grown.means, grown.log_scales, grown.opacity_logits = growth.means, growth.log_scales, growth.opacity_logits
        self.gaussians = grown.requires_grad_()
        self.adam.select(growth.source)
        self.adam.zero_state(rows=growth.fresh)
        self.density.restart(len(grown))
        self.history.add_density(DensityEvent(iteration, gaussians=len(grown), **counts))

    def finished(self) -> Gaussians:
        """The trained model: finite, with unit quaternions."""
        model = self.gaussians.detach()
        model = model.select(model.finite())
        model.quats = model.quats / torch.linalg.vector_norm(model.quats, dim=1, keepdim=True).clamp(min=1e-30)
        return model

    def checkpoint(self, instruction_set: str) -> Checkpoint:
        """All of it for a file; not copied.

        Args:
            instruction_set: That it was computed with.
        """
        tensors = dict(self.gaussians.detach().tensors())
        tensors |= {_ADAM + name: tensor for name, tensor in self.adam.state_dict().items()}
        tensors |= {_DENSITY + name: tensor for name, tensor in self.density.to_arrays().items()}
        if self.exposure is not None:
            tensors |= {_EXPOSURE + name: tensor for name, tensor in self.exposure.arrays().items()}
        facts = {"iteration": self.iteration, "seconds": self.seconds, "history": self.history.state()}
        facts["instruction_set"] = instruction_set
        return Checkpoint({name: tensor.numpy() for name, tensor in tensors.items()}, facts)

    @staticmethod
    def restore(checkpoint: Checkpoint, plan: Plan) -> TrainState:
        """The inverse of ``checkpoint``.

        Raises:
            BrokenCheckpointError: if something is missing or does not fit.
        """
        try:
            tensors = {name: torch.from_numpy(array) for name, array in checkpoint.arrays.items()}
            gaussians = Gaussians.from_tensors({name: tensors[name] for name in PARAMETERS}).requires_grad_()
            if gaussians.sh.shape[1] != coefficient_count(plan.options.sh_degree):
                raise ValueError("another degree of spherical harmonics")
            adam = Adam(gaussians.tensors())
            adam.load_state_dict(_under(_ADAM, tensors))
            density = make_density(plan.options, len(gaussians))
            density.load(_under(_DENSITY, tensors))
            exposure = new_exposure(plan)
            if exposure is not None:
                exposure.load(_under(_EXPOSURE, tensors))
            history = History(**checkpoint.facts["history"])
            counts = (int(checkpoint.facts["iteration"]), float(checkpoint.facts["seconds"]))
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise BrokenCheckpointError(f"it is incomplete ({error})") from error
        return TrainState(gaussians, adam, density, history, *counts, exposure=exposure)


def new_exposure(plan: Plan) -> Exposure | None:
    """The exposures' model before the first iteration, if the plan has one."""
    return Exposure(plan.train_views) if plan.options.exposure != "off" else None


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
