"""What a model is rendered and trained on: the CPU's native kernels, or a CUDA device's."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.raster import cuda_driver, cuda_library, rasterizer
from splatpipe.pipeline.raster.cuda import kernels_of
from splatpipe.pipeline.raster.cuda_forecast import most_pairs_of

DEVICES = ("auto", "cpu", "cuda")
CPU = torch.device("cpu")
COLUMNS = 8  # of float32 that are moved at a time: what a device reads of a row at least
MOST = 0.9  # of the rows that stay at least, for the memory of the others to be left where it is
SAME_BITS = "the same bits for one seed"
CUBLAS_WORKSPACE = ("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # with which cuBLAS adds in one order, as its manual says

Note = Callable[[str], None]


@dataclass(frozen=True)
class Device:
    """Where the model is, and what computes on it.

    Attributes:
        name: ``cpu`` or ``cuda``.
        tensors: Where they lie.
    """

    name: str
    tensors: torch.device

    @property
    def kernels(self) -> str:
        """The instruction set, or the architecture, device and driver: with others, the last bits differ."""
        return rasterizer.kernels_name(self.tensors)

    def facts(self) -> dict[str, JSON]:
        """What a manifest says of it."""
        told: dict[str, JSON] = {"device": self.name, "instruction_set": self.kernels, "mode": SAME_BITS}
        if self.tensors.type == "cuda":
            told["device_peak_memory_bytes"] = torch.cuda.max_memory_allocated(self.tensors)
        return told

    def wait(self) -> None:
        """Until everything asked of the device is done; needed for nothing but clocks."""
        if self.tensors.type == "cuda":
            torch.cuda.synchronize(self.tensors)

    @contextmanager
    def memory_limit(self, limit_bytes: int) -> Iterator[None]:
        """Let tensors take no more of the device's own memory, as long as this lasts.

        Args:
            limit_bytes: The most; 0 for all of it.
        """
        if not limit_bytes:
            yield
            return
        kernels, on_cuda = kernels_of(self.tensors), self.tensors.type == "cuda"
        before = 0 if kernels is None else kernels.forecast.most_pairs
        if kernels is not None:  # pairs get their share of the limit, not of the card
            kernels.forecast.most_pairs = min(before, most_pairs_of(limit_bytes))
        if on_cuda:
            whole = torch.cuda.get_device_properties(self.tensors).total_memory
            torch.cuda.set_per_process_memory_fraction(min(1.0, limit_bytes / whole), self.tensors)
        try:
            yield
        finally:
            if kernels is not None:
                kernels.forecast.most_pairs = before
            if on_cuda:
                torch.cuda.set_per_process_memory_fraction(1.0, self.tensors)

    @contextmanager
    def one_order(self) -> Iterator[None]:
        """Let torch refuse whatever adds in another order each time; on the CPU nothing that is used does."""
        if self.tensors.type != "cuda":
            yield
            return
        torch.use_deterministic_algorithms(True)
        # Kernels write all of what they are given.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(False)


def cpu() -> Device:
    """The CPU."""
    return Device("cpu", CPU)


def choose_device(wanted: str, unfit: str = "", note: Note | None = None) -> Device:
    """The device that is asked for; ``auto`` takes CUDA where it works.

    Args:
        wanted: ``auto``, ``cpu`` or ``cuda``.
        unfit: Why the work cannot be done on a CUDA device; empty where it can.
        note: Is told why ``auto`` leaves a graphics card alone, where there is one.

    Raises:
        MachineError: for ``cuda`` where it does not work, with the reason.
        UsageError: for another name, and for ``cuda`` where the work cannot be done there.
    """
    if wanted not in DEVICES:
        raise UsageError(f'There is no device "{wanted[:20]}".', hint=f"Choose {', '.join(DEVICES)}.")
    if wanted == "cuda" and unfit:
        raise UsageError(unfit, hint="Leave --device out, or give --device cpu.")
    if wanted == "cpu":
        return cpu()
    os.environ.setdefault(*CUBLAS_WORKSPACE)  # read when its first product is computed
    missing = _why_not(unfit)
    if wanted == "cuda" and missing is not None:
        raise missing.error()
    if missing is not None:
        if note is not None and cuda_driver.has_card():
            note(f"computing on the CPU, not on the NVIDIA graphics card: {missing.reason} {missing.hint}".rstrip())
        return cpu()
    # NVIDIA's containers round what is multiplied to TF32's 10 bits (TORCH_ALLOW_TF32_CUBLAS_OVERRIDE); a sky has more.
    torch.backends.cuda.matmul.allow_tf32 = False
    return Device("cuda", torch.device("cuda", torch.cuda.current_device()))


def _why_not(unfit: str) -> cuda_library.NoCuda | None:
    if unfit:
        return cuda_library.NoCuda(unfit, "")
    return cuda_library.why_not() or cuda_library.cannot_compute()


def free_bytes(tensors: torch.device) -> int | None:
    """How much more tensors may take of a device's own memory; None for the CPU."""
    if tensors.type != "cuda":
        return None
    free, whole = torch.cuda.mem_get_info(tensors)
    taken = torch.cuda.memory_allocated(tensors)
    allowed = int(whole * torch.cuda.get_per_process_memory_fraction(tensors))
    return min(free + torch.cuda.memory_reserved(tensors), allowed) - taken


def take_rows(tensors: dict[str, Tensor], rows: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> None:
    """Put rows of each tensor in its place, one after the other: two of the largest are never there at once twice.

    Args:
        tensors: By name; changed.
        rows: An index or a mask.

    Raises:
        torch.OutOfMemoryError: if memory ends; some of the tensors have the rows, and the others do not.
        MachineError: if it ends within a tensor, which is lost.
    """
    for name in tuple(tensors):
        tensors[name] = _taken(tensors, name, rows)


def taken_in_place(tensor: Float[Tensor, "n ..."], rows: Int[Tensor, " m"]) -> Float[Tensor, "m ..."]:
    """Rows of a tensor in its own memory, some columns at a time: at its cap, a model needs no second one.

    Never to be tried again where it fails midway: then some columns have the new rows and the others the old ones. So
    that is no OutOfMemoryError, which a training answers, but one that ends it, without a checkpoint of what is left.
    The CPU does without this: there rows are copied.

    Args:
        tensor: Contiguous; overwritten.
        rows: No more than it has.

    Raises:
        torch.OutOfMemoryError: if memory is too short to begin; the tensor is as it was.
        MachineError: if memory ends midway; the tensor is lost.
    """
    flat = tensor.view(len(tensor), -1)
    for first in range(0, flat.shape[1], COLUMNS):
        columns = flat[:, first : first + COLUMNS]
        try:
            moved = columns[rows]
        except torch.OutOfMemoryError as error:
            if first == 0:
                raise
            raise MachineError(
                f"The graphics card ran out of memory while {len(rows):,} Gaussians were moved in it.",
                hint=(
                    "Close other programs that use the card, or lower train.max_gaussians; run again to resume "
                    "from here."
                ),
            ) from error
        columns[: len(rows)] = moved
        del moved  # before the next ones
    return tensor[: len(rows)]


def _taken(tensors: dict[str, Tensor], name: str, rows: Tensor) -> Tensor:
    count = len(tensors[name])
    in_place = tensors[name].is_cuda and rows.dtype == torch.int64 and MOST * count <= len(rows) <= count
    try:
        return taken_in_place(tensors[name], rows) if in_place else tensors[name][rows]
    except torch.OutOfMemoryError:  # old and new do not fit side by side: the old one waits in the host's memory
        device = tensors[name].device
        tensors[name] = tensors[name].cpu()
    return tensors[name][rows.cpu()].to(device)
