"""The CUDA kernels on torch's memory and stream, and which tensors they support."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.cuda.cuda_api import (
    ADAM_TENSORS,
    SplatAdam,
    SplatRectangle,
    SplatRows,
    SplatShot,
    SplatStream,
)
from splatpipe.pipeline.raster.cuda.cuda_forecast import Forecast, most_pairs_of
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary, load, unavailable_reason
from splatpipe.pipeline.splat.model.upload import upload

ALIGNMENT = 256  # bytes, of memory passed to kernels
FEATURE_PAIR = 2  # times the memory of a pair, if features are blended: up to 27 floats backward


class CudaKernels:
    """The library on a device. Nothing synchronizes, and everything runs in order on torch's current stream there.

    Args:
        library: The loaded library.
        device: A CUDA device, torch's current one or another; the CPU for a library that runs there, in tests.

    Attributes:
        device: As given.
        index: Its number.
        forecast: Forecast of frame allocations.
        feature_forecast: The same for frames of features.
        facts: The device, as the library sees it.
    """

    def __init__(self, library: CudaLibrary, device: torch.device) -> None:
        self._library = library
        self.device, self.index = device, device.index or 0
        code, self.facts = library.device(self.index)
        if code:
            raise MachineError(f"The CUDA kernels cannot use {self.facts.name or device}: {library.error(code)}.")
        self.forecast = Forecast(most_pairs_of(self.facts.memory_bytes))
        self.feature_forecast = Forecast(most_pairs_of(self.facts.memory_bytes // FEATURE_PAIR))

    def stream(self) -> SplatStream:
        """Torch's current stream on the device."""
        on_cuda = self.device.type == "cuda"
        return SplatStream(torch.cuda.current_stream(self.device).cuda_stream if on_cuda else None, self.index)

    def empty(self, size_bytes: int) -> Tensor:
        """Uninitialized memory from torch, aligned for kernels.

        Raises:
            torch.OutOfMemoryError: if the device has no more.
        """
        memory = torch.empty(size_bytes + ALIGNMENT, dtype=torch.uint8, device=self.device)
        return memory[-memory.data_ptr() % ALIGNMENT :]

    def at(self, tensor: Tensor | None) -> int | None:
        """Pointer to a tensor's memory; None for None and for an empty tensor.

        Raises:
            ValueError: if kernels cannot access it.
        """
        if tensor is None:
            return None
        if tensor.device != self.device or not tensor.is_contiguous():
            raise ValueError(f"a tensor on {tensor.device} is not a contiguous one on {self.device}")
        return tensor.data_ptr() or None

    def rows(self, tensors: Sequence[Tensor]) -> SplatRows:
        """Tensors in the order of ``PARAMETERS`` in the form that the library takes."""
        return SplatRows(*map(self.at, tensors))

    def call(self, name: str, *arguments: object) -> None:
        """Call a function of ``cuda_api.CALLS`` with the current stream as last argument; errors as ``CudaLibrary``."""
        # The library makes the device the thread's current one: what torch has as such is restored afterwards.
        with torch.cuda.device(self.device) if self.device.type == "cuda" else nullcontext():
            self._library.call(name, *arguments, ctypes.byref(self.stream()))

    def frame_bytes(self, view: SplatShot, count: int, capacity: int) -> int:
        """Memory of a frame, from its render onward, bytes."""
        return self._library.size("splat_frame_bytes", ctypes.byref(view), count, capacity)

    def back_bytes(self, view: SplatShot, count: int, capacity: int) -> int:
        """Additional memory of its backward pass, bytes."""
        return self._library.size("splat_back_bytes", ctypes.byref(view), count, capacity)

    def feature_back_bytes(self, view: SplatShot, count: int, capacity: int, channels: int) -> int:
        """Additional memory of the backward pass of a frame of features, bytes."""
        return self._library.size("splat_feature_back_bytes", ctypes.byref(view), count, capacity, channels)

    def photo_loss(
        self,
        render: Float[Tensor, "h w 3"],
        photo: Float[Tensor, "h w 3"],
        mask: Tensor | None,
        ssim_weight: float,
        inner: tuple[int, int, int, int] | None = None,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
        """The loss, as a float32 on the device, and its gradient for the render.

        Args:
            render: Contiguous float32, like the photo.
            photo: The photo to compare with.
            mask: (h, w) uint8, zero where a pixel does not count; None if all do.
            ssim_weight: Weight of 1 - SSIM.
            inner: Left, top, right, bottom of the part that counts; None for all.
        """
        height, width = render.shape[:2]
        gradient = torch.empty_like(render)
        value = torch.empty((), dtype=torch.float64, device=self.device)
        size = self._library.size("splat_loss_bytes", width, height)
        memory = self.empty(size)
        rectangle = None if inner is None else ctypes.byref(SplatRectangle(*inner))
        pictures = (self.at(render), self.at(photo), self.at(mask), width, height)
        weighted = (rectangle, ssim_weight)
        self.call("splat_photo_loss", *pictures, *weighted, self.at(gradient), self.at(value), self.at(memory), size)
        return value.to(torch.float32), gradient

    def affine_colour(self, affine: Float[Tensor, "3 4"], picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """The image's colours with the map applied; both contiguous float32."""
        out = torch.empty_like(picture)
        pixels = picture.numel() // 3
        self.call("splat_affine_colour", self.at(affine), self.at(picture), pixels, self.at(out))
        return out

    def affine_colour_backward(
        self, affine: Float[Tensor, "3 4"], picture: Float[Tensor, "h w 3"], upstream: Float[Tensor, "h w 3"]
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "3 4"]]:
        """Gradients for the image and for the map; all contiguous float32."""
        gradient, by_affine = torch.empty_like(picture), torch.empty_like(affine)
        pixels = picture.numel() // 3
        size = self._library.size("splat_affine_bytes", pixels)
        memory = self.empty(size)
        inputs = (self.at(affine), self.at(picture), self.at(upstream), pixels)
        outputs = (self.at(gradient), self.at(by_affine), self.at(memory), size)
        self.call("splat_affine_colour_backward", *inputs, *outputs)
        return gradient, by_affine

    def adam(self, rows: AdamRows, options: tuple[float, float, float, int], skipped: Int64[Tensor, ""]) -> None:
        """One step in place over rows of float32 tensors.

        Args:
            rows: The tensors to step.
            options: Beta 1, beta 2, epsilon and the step, counted from 1.
            skipped: Counter to which the visible rows skipped for their gradients are added.

        Raises:
            ValueError: for more tensors than one call takes.
        """
        if len(rows.values) > ADAM_TENSORS:
            raise ValueError(f"{len(rows.values)} tensors of the same rows, more than {ADAM_TENSORS}")
        widths = [rate.numel() for rate in rows.rates]
        ends = [sum(widths[: number + 1]) for number in range(len(widths))]
        rates = torch.cat([rate.to("cpu") for rate in rows.rates]) if widths else torch.empty(0)
        rates = upload(rates, self.device)  # one copy, not one per tensor
        given = SplatAdam(tensors=len(widths), rows=len(rows.values[0]) if widths else 0)
        for number, end in enumerate(ends):
            given.widths[number] = widths[number]
            given.values[number] = self.at(rows.values[number])
            given.gradients[number] = self.at(rows.gradients[number])
            given.means[number] = self.at(rows.means[number])
            given.squares[number] = self.at(rows.squares[number])
            given.rates[number] = self.at(rates[end - widths[number] :])
        given.visible, given.skipped = self.at(rows.visible), self.at(skipped)
        given.beta1, given.beta2, given.epsilon, given.step = options
        self.call("splat_adam", ctypes.byref(given))

    def uniform(self, seed: int, step: int, stream: int, count: int) -> Float64[Tensor, " n"]:
        """``train.random_numbers.uniform`` of the indices 0 to count - 1."""
        out = torch.empty(count, dtype=torch.float64, device=self.device)
        self.call("splat_uniform", *_words(seed, step, stream), count, self.at(out))
        return out

    def split_offsets(
        self,
        draw: tuple[int, int, int],
        rows: Int64[Tensor, " k"],
        log_scales: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
    ) -> Float[Tensor, "two_k 3"]:
        """Two positions within each parent, relative to its mean: all first ones, then all second ones.

        Args:
            draw: Seed, step and stream, as in ``train.random_numbers``.
            rows: The parents' rows in the model.
            log_scales: The model's log-scales.
            quats: The model's quaternions.
        """
        out = torch.empty(2 * len(rows), 3, device=self.device)
        rows, log_scales, quats = rows.contiguous(), log_scales.contiguous(), quats.contiguous()
        parents = (self.at(rows), len(rows), self.at(log_scales), self.at(quats))
        self.call("splat_split_offsets", *_words(*draw), *parents, self.at(out))
        return out

    def morton(
        self, means: Float[Tensor, "n 3"], lowest: Sequence[float], size: Sequence[float]
    ) -> Int64[Tensor, " n"]:
        """Morton codes in the box from ``lowest`` with sides of ``size``."""
        out = torch.empty(len(means), dtype=torch.int64, device=self.device)
        box = (ctypes.c_float * 3)(*lowest), (ctypes.c_float * 3)(*size)
        means = means.contiguous()
        self.call("splat_morton", self.at(means), len(means), *box, self.at(out))
        return out


@dataclass(frozen=True, eq=False)
class AdamRows:
    """Tensors with common rows, contiguous float32, with everything that a step of Adam takes.

    Attributes:
        values: Values to step in place, (rows, ...) each.
        gradients: Gradient of each.
        means: First moments of each, changed in place.
        squares: Second moments of each, changed in place.
        rates: Learning rates of each, (width,): one for every value of a row.
        visible: (rows,) uint8, zero for rows to skip; None to step all.
    """

    values: Sequence[Tensor]
    gradients: Sequence[Tensor]
    means: Sequence[Tensor]
    squares: Sequence[Tensor]
    rates: Sequence[Tensor]
    visible: Tensor | None


_ON_CPU: ContextVar[CudaKernels | None] = ContextVar("cuda_kernels_on_cpu", default=None)


@contextmanager
def use_kernels(kernels: CudaKernels | None) -> Iterator[None]:
    """Use kernels that run on the CPU (the CUDA sources, built for tests) for its float32 tensors."""
    token = _ON_CPU.set(kernels)
    try:
        yield
    finally:
        _ON_CPU.reset(token)


def kernels_of(device: torch.device) -> CudaKernels | None:
    """The kernels for a device's float32 tensors; None if there are no CUDA kernels for it."""
    if device.type != "cuda":
        return _ON_CPU.get() if device.type == "cpu" else None
    return _on_cuda(torch.cuda.current_device() if device.index is None else device.index)


@functools.cache
def _on_cuda(index: int) -> CudaKernels | None:
    return None if unavailable_reason() else CudaKernels(load(), torch.device("cuda", index))


def _words(*numbers: int) -> tuple[int, ...]:
    """Each number reduced to 64 bits, as in ``train.random_numbers``."""
    return tuple(number & (1 << 64) - 1 for number in numbers)
