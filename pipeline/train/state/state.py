"""The state of a training between iterations: everything a resumed run needs for a bit-identical result."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.engine.errors import card_fault
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.device import CPU, take_rows
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.raster.step_lengths import FarSteps
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians
from splatpipe.pipeline.splat.model.sh import coefficient_count
from splatpipe.pipeline.train.densify import (
    RESET_OPACITY,
    DensifiedGaussians,
    DensityEvent,
    along_curve,
    reset_opacity,
    room_at,
    unchanged,
)
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import ScheduleStep
from splatpipe.pipeline.train.state.checkpoint import BrokenCheckpointError, Checkpoint, HostArrays
from splatpipe.pipeline.train.state.density import Density
from splatpipe.pipeline.train.state.history import History
from splatpipe.pipeline.train.state.memory import within_room
from splatpipe.pipeline.train.techniques.techniques import Techniques

SMALLEST_SCALE = 1e-6  # smallest scale over the scene's extent: float32 covariances stay non-singular
LARGEST_SCALE = 1e2  # the sky is no farther than that

_ADAM = "adam."
_DENSITY = "density."


@dataclass
class TrainState:
    """Parameters, optimizer moments, density statistics and history.

    Attributes:
        gaussians: The model's raw parameters; its tensors are autograd leaves.
        adam: The optimizer's moments.
        density: Density control, with what it has observed since its last step.
        history: The training's history so far.
        iteration: The last completed iteration.
        seconds: Spent so far, over all runs; does not influence the result.
        buffers: Memory of the gradients.
        techniques: The optional techniques in use.
        whole: What is rendered if there are frozen Gaussians: autograd leaves whose first rows are those of
            ``gaussians``, in the same memory; None without frozen Gaussians.
    """

    gaussians: Gaussians
    adam: Adam
    density: Density
    history: History
    iteration: int = 0
    seconds: float = 0.0
    buffers: GradientBuffers = field(default_factory=GradientBuffers)
    techniques: Techniques = field(default_factory=Techniques)
    whole: Gaussians | None = None

    @staticmethod
    def begin(
        start: Gaussians, plan: TrainingPlan, techniques: Techniques, frozen: Gaussians | None = None
    ) -> TrainState:
        """The state before the first iteration.

        Args:
            start: The initial Gaussians, from ``InitialGaussians.within`` the plan's cap, on the training device.
            plan: The training plan.
            techniques: The plan's techniques, untrained.
            frozen: Gaussians of the plan's SH degree that are rendered too but not trained; None for none.
        """
        columns = coefficient_count(plan.options.sh_degree)
        sh = torch.zeros(len(start), columns, 3, device=start.sh.device)
        shared = min(columns, start.sh.shape[1])
        sh[:, :shared] = start.sh[:, :shared]
        model = start.clone()
        model.sh = sh
        return TrainState.of(model, History(), techniques, frozen)

    @staticmethod
    def of(
        gaussians: Gaussians,
        history: History,
        techniques: Techniques,
        frozen: Gaussians | None = None,
    ) -> TrainState:
        """A state of these Gaussians with everything else untrained."""
        density = Density(len(gaussians), gaussians.means.device)
        state = TrainState(gaussians, Adam(gaussians.tensors()), density, history, techniques=techniques)
        state._draw(gaussians, frozen)
        return state

    def _draw(self, trained: Gaussians, frozen: Gaussians | None) -> None:
        """Set the Gaussians that are trained and rendered."""
        if frozen is None or len(frozen) == 0:
            self.gaussians, self.whole = trained.requires_grad_(), None
            return
        self.whole = Gaussians.concat([trained.detach(), frozen.detach()]).requires_grad_()
        self.gaussians = self.whole.detach().first(len(trained))

    @property
    def drawn(self) -> Gaussians:
        """The rendered Gaussians: the trained ones, then the frozen ones."""
        return self.gaussians if self.whole is None else self.whole

    def of_trained(self, rendered: Render) -> Render:
        """A render of ``drawn`` whose per-Gaussian values are cut down to the trained Gaussians."""
        if self.whole is None:
            return rendered
        count = len(self.gaussians)
        return replace(rendered, visible=rendered.visible[:count], radii=rendered.radii[:count])

    def screen_probe(self) -> Float[Tensor, "n 2"]:
        """Zeros that receive the gradient with respect to the rendered Gaussians' image-plane means.

        It is there once the parameters are stepped; the trained Gaussians come first.
        """
        zero = torch.zeros(1, 2, device=self.gaussians.means.device)
        return zero.expand(len(self.drawn), 2).requires_grad_()  # its values are never read

    def step(self, gradient_rows: Bool[Tensor, " n"], now: ScheduleStep, plan: TrainingPlan, camera: Camera) -> None:
        """Take an optimizer step, then drop the gradients, including those in ``buffers``.

        Args:
            gradient_rows: The Gaussians that the photo saw.
            now: The schedule's values for this iteration.
            plan: The training plan.
            camera: The photo's camera.
        """
        given, extent = plan.schedule.rates, plan.extent
        colour = given.boost * given.sh
        rates: dict[str, float | Tensor] = {
            "means": extent * now.means_rate,
            "log_scales": given.boost * given.scales,
            "quats": given.boost * given.quats,
            "opacity_logits": given.opacity,
            "sh": sh_rates(self.gaussians.sh.shape[1], colour, colour / given.sh_rest_divisor),
        }
        limits = {"log_scales": (math.log(SMALLEST_SCALE * extent), math.log(LARGEST_SCALE * extent))}
        self._hand_gradients()
        tensors, rows = self.gaussians.tensors(), gradient_rows if given.sparse else None
        x, y, z = camera.centre().tolist()
        far = FarSteps((x, y, z), extent) if given.by_distance else None
        self.adam.step(tensors, rates, rows, buffers=self.buffers, limits=limits, far=far)
        self._drop_gradients()

    def _hand_gradients(self) -> None:
        """Give the trained Gaussians their part of the gradients of everything rendered."""
        if self.whole is None:
            return
        drawn = self.whole.tensors()
        for name, tensor in self.gaussians.tensors().items():
            gradient = drawn[name].grad
            tensor.grad = None if gradient is None else gradient[: len(tensor)]

    def _drop_gradients(self) -> None:
        for tensor in (*self.gaussians.tensors().values(), *self.drawn.tensors().values()):
            tensor.grad = None

    def roll_back(self) -> None:
        """Discard an iteration that did not reach its step, and whatever its backward pass left behind."""
        self.buffers = GradientBuffers()
        self._drop_gradients()
        self.techniques.roll_back()

    def control_density(self, plan: TrainingPlan, iteration: int) -> None:
        """Grow, prune and reset if this iteration calls for it; once growth has ended, only prune and reset.

        Args:
            plan: The training plan.
            iteration: The iteration that ends.
        """
        density = plan.schedule.density
        with torch.no_grad():
            if density.is_step(iteration):
                limit = 0
                if not self.history.growth_ended:
                    wanted = room_at(density, plan.initial_gaussians, iteration)
                    limit = within_room(wanted, self.gaussians, len(self.drawn) - len(self.gaussians))
                    self.history.growth_ended = iteration if limit < wanted else 0
                self._densify(plan, limit, iteration)
            elif not self.history.flat_at:
                self._clear(iteration)
            if density.is_reset(iteration):
                reset_opacity(self.gaussians.opacity_logits.detach(), RESET_OPACITY)
                self.adam.zero_state(names=("opacity_logits",))
                self.history.resets.append(iteration)

    def _densify(self, plan: TrainingPlan, limit: int, iteration: int) -> None:
        """Give the model the rows that density control chooses, at most ``limit`` if it adds any."""
        _native.free_frames()  # they change size in this step, and memory is tight until then
        try:
            growth, counts = self.density.control(  # no name for the old model: it is freed part by part below
                self.gaussians.detach(), plan.schedule.density, plan.extent, limit, iteration, self.techniques
            )
            growth = along_curve(growth)
        except torch.OutOfMemoryError:  # the device has not even room to select what to grow
            self.history.growth_ended = self.history.growth_ended or iteration
            return
        self._adopt_growth(growth)
        self.history.add_density(DensityEvent(iteration, gaussians=len(self.gaussians), **counts))

    def _clear(self, iteration: int) -> None:
        """Remove the Gaussians that a technique rejects; this goes on after the last step of density control."""
        try:
            gone = self.techniques.prune_mask(self.gaussians.detach(), iteration)
        except torch.OutOfMemoryError:  # on a device; the next check finds the floaters
            return
        if gone is not None and bool(gone.any()) and not bool(gone.all()):
            self._remove(gone, iteration)

    def keep_most_opaque(self, count: int) -> None:
        """Keep only the ``count`` most opaque Gaussians; call it between two iterations."""
        order = torch.argsort(self.gaussians.opacity_logits.detach().cpu(), descending=True, stable=True)
        gone = torch.ones(len(order), dtype=torch.bool)
        gone[order[:count]] = False
        with torch.no_grad():
            self._remove(gone.to(self.gaussians.means.device), self.iteration)

    def _remove(self, gone: Bool[Tensor, " n"], iteration: int) -> None:
        self._adopt_growth(unchanged(self.gaussians.detach(), ~gone))
        self.history.add_density(DensityEvent(iteration, 0, 0, int(gone.sum()), 0, gaussians=len(self.gaussians)))

    def _adopt_growth(self, growth: DensifiedGaussians) -> None:
        """Adopt the rows of a growth with their moments, one tensor after the other because memory is tight."""
        self.buffers = GradientBuffers()
        frozen = None if self.whole is None else self.whole.detach().after(len(self.gaussians)).clone()
        rest = {name: getattr(self.gaussians, name).detach() for name in ("quats", "sh")}
        self.gaussians, self.whole = Gaussians.empty(0, 0), None  # only `rest` holds the old ones now
        take_rows(rest, growth.source)
        grown = Gaussians(growth.means, growth.log_scales, rest["quats"], growth.opacity_logits, rest["sh"])
        self._draw(grown, frozen)
        self.adam.select(growth.source)
        self.adam.zero_state(rows=growth.fresh)
        self.density.restart(len(grown))

    def finished(self) -> Gaussians:
        """The trained model, on the CPU: finite, with unit quaternions."""
        model = self.gaussians.detach().to(CPU)
        finite = model.finite()
        model = model if bool(finite.all()) else model.select(finite)  # a copy takes as much memory as the model
        model.quats = model.quats / torch.linalg.vector_norm(model.quats, dim=1, keepdim=True).clamp(min=1e-30)
        return model

    def whole_history(self) -> History:
        """The history with the optimizer's count of skipped gradients; waits for the device."""
        self.history.skipped_gradients += self.adam.take_skipped()
        return self.history

    def checkpoint(self, instruction_set: str) -> Checkpoint:
        """The whole state as a checkpoint; not copied.

        Args:
            instruction_set: The instruction set it was computed with.
        """
        tensors = dict(self.gaussians.detach().tensors())
        tensors |= {_ADAM + name: tensor for name, tensor in self.adam.state_dict().items()}
        tensors |= {_DENSITY + name: tensor for name, tensor in self.density.to_arrays().items()}
        tensors |= self.techniques.to_arrays()
        facts = {"iteration": self.iteration, "seconds": self.seconds, "history": self.whole_history().state()}
        facts["instruction_set"] = instruction_set
        return Checkpoint(HostArrays(tensors), facts)

    @staticmethod
    def restore(
        checkpoint: Checkpoint,
        plan: TrainingPlan,
        techniques: Techniques,
        device: torch.device = CPU,
        frozen: Gaussians | None = None,
    ) -> TrainState:
        """The inverse of ``checkpoint``.

        Args:
            checkpoint: The checkpoint, as written.
            plan: The training plan.
            techniques: The plan's techniques, which load their state from the checkpoint; unusable if that fails.
            device: Where training resumes, whichever device the checkpoint was written on.
            frozen: The frozen Gaussians that the training began with, on the device.

        Raises:
            BrokenCheckpointError: if something is missing or does not match.
            torch.OutOfMemoryError: if the device has no room for it; the checkpoint itself is fine then.
            RuntimeError: if the graphics card failed; likewise.
        """
        try:
            tensors = {name: torch.from_numpy(array) for name, array in checkpoint.arrays.items()}
            model = Gaussians.from_tensors({name: tensors[name] for name in PARAMETERS})
            gaussians = model.to(device)
            if gaussians.sh.shape[1] != coefficient_count(plan.options.sh_degree):
                raise ValueError("another degree of spherical harmonics")
            state = TrainState.of(gaussians, History(**checkpoint.facts["history"]), techniques, frozen)
            state.adam.load_state_dict(_under(_ADAM, tensors))
            state.iteration, state.seconds = int(checkpoint.facts["iteration"]), float(checkpoint.facts["seconds"])
            state.density.load(_under(_DENSITY, tensors))
            techniques.load(tensors)
        except torch.OutOfMemoryError:
            raise
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            if card_fault(error) is not None:  # the checkpoint is fine, and must not be replaced
                raise
            raise BrokenCheckpointError(f"it is incomplete ({error})") from error
        return state


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
