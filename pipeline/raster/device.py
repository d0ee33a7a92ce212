"""The compute device for rendering and training: the CPU's native kernels, or a CUDA device's."""

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
from splatpipe.pipeline.raster.cuda import cuda_driver, cuda_library
from splatpipe.pipeline.raster.cuda.cuda import kernels_of
from splatpipe.pipeline.raster.cuda.cuda_forecast import most_pairs_of
from splatpipe.pipeline.raster.isa import isa_name

DEVICES = ("auto", "cpu", "cuda")
CPU = torch.device("cpu")
COLUMNS = 8  # float32 columns moved at a time: a device reads at least that much of a row
MIN_IN_PLACE_SHARE = 0.9  # minimum share of rows kept for moving them in place, which does not free the others' memory
SAME_BITS = "the same bits for one seed"
CUBLAS_WORKSPACE = ("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # makes cuBLAS deterministic, according to its manual

Note = Callable[[str], None]


@dataclass(frozen=True)
class Device:
    """A compute device.

    Attributes:
        name: ``cpu`` or ``cuda``.
        tensors: The torch device of the tensors.
    """

    name: str
    tensors: torch.device

    @property
    def kernels(self) -> str:
        """The instruction set, or the architecture, device and driver: the last bits depend on these.

        Raises:
            ValueError: if there are no kernels for the device.
        """
        kernels = kernels_of(self.tensors)
        if kernels is not None:
            return kernels.facts.described()
        if self.tensors.type != "cpu":
            raise ValueError(f"there are no kernels for {self.tensors}")
        return isa_name()

    def facts(self) -> dict[str, JSON]:
        """The device's entries in a manifest."""
        found: dict[str, JSON] = {"device": self.name, "instruction_set": self.kernels, "mode": SAME_BITS}
        if self.tensors.type == "cuda":
            found["device_peak_memory_bytes"] = torch.cuda.max_memory_allocated(self.tensors)
        return found

    def wait(self) -> None:
        """Wait until the device has finished all work; needed only for timing."""
        if self.tensors.type == "cuda":
            torch.cuda.synchronize(self.tensors)

    @contextmanager
    def memory_limit(self, limit_bytes: int) -> Iterator[None]:
        """Limit the device memory used by tensors within the context.

        Args:
            limit_bytes: The limit; 0 for all of it.
        """
        if not limit_bytes:
            yield
            return
        kernels, on_cuda = kernels_of(self.tensors), self.tensors.type == "cuda"
        before = 0 if kernels is None else kernels.forecast.most_pairs
        if kernels is not None:  # pairs get their share of the limit, not of the whole card
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
    def deterministic(self) -> Iterator[None]:
        """Make torch reject nondeterministic operations; on the CPU none that are used are nondeterministic."""
        if self.tensors.type != "cuda":
            yield
            return
        torch.use_deterministic_algorithms(True)
        # Kernels write all of their outputs.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
        try:
            yield
        finally:
            torch.use_deterministic_algorithms(False)


def cpu() -> Device:
    """The CPU."""
    return Device("cpu", CPU)


def choose_device(wanted: str, unfit: str = "", note: Note | None = None) -> Device:
    """The requested device; ``auto`` takes CUDA if it works.

    Args:
        wanted: ``auto``, ``cpu`` or ``cuda``.
        unfit: Why the work cannot be done on a CUDA device; empty if it can.
        note: Receives the reason why ``auto`` does not use an existing graphics card.

    Raises:
        MachineError: for ``cuda`` if it does not work, with the reason.
        UsageError: for an unknown name, and for ``cuda`` if the work cannot be done there.
    """
    if wanted not in DEVICES:
        raise UsageError(f'There is no device "{wanted[:20]}".', hint=f"Choose {', '.join(DEVICES)}.")
    if wanted == "cuda" and unfit:
        raise UsageError(unfit, hint="Leave --device out, or give --device cpu.")
    if wanted == "cpu":
        return cpu()
    os.environ.setdefault(*CUBLAS_WORKSPACE)  # read when its first product is computed
    missing = _unavailable(unfit)
    if wanted == "cuda" and missing is not None:
        raise missing.error()
    if missing is not None:
        if note is not None and cuda_driver.has_card():
            note(f"computing on the CPU, not on the NVIDIA graphics card: {missing.reason} {missing.hint}".rstrip())
        return cpu()
    # NVIDIA's containers round factors to TF32's 10 bits (TORCH_ALLOW_TF32_CUBLAS_OVERRIDE), too few for the sky.
    torch.backends.cuda.matmul.allow_tf32 = False
    return Device("cuda", torch.device("cuda", torch.cuda.current_device()))


def _unavailable(unfit: str) -> cuda_library.NoCuda | None:
    if unfit:
        return cuda_library.NoCuda(unfit, "")
    return cuda_library.unavailable_reason() or cuda_library.cannot_compute()


def free_bytes(tensors: torch.device) -> int | None:
    """Device memory still available for tensors, bytes; None for the CPU."""
    if tensors.type != "cuda":
        return None
    free, whole = torch.cuda.mem_get_info(tensors)
    taken = torch.cuda.memory_allocated(tensors)
    allowed = int(whole * torch.cuda.get_per_process_memory_fraction(tensors))
    return min(free + torch.cuda.memory_reserved(tensors), allowed) - taken


def take_rows(tensors: dict[str, Tensor], rows: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> None:
    """Replace each tensor by some of its rows, one tensor at a time, so that only one exists twice at a time.

    Args:
        tensors: Tensors by name; changed.
        rows: An index or a mask.

    Raises:
        torch.OutOfMemoryError: if memory runs out; some tensors have the new rows and the others do not.
        MachineError: if it runs out within a tensor, which is lost.
    """
    for name in tuple(tensors):
        tensors[name] = _taken(tensors, name, rows)


def taken_in_place(tensor: Float[Tensor, "n ..."], rows: Int[Tensor, " m"]) -> Float[Tensor, "m ..."]:
    """Select rows of a tensor in its own memory, some columns at a time: a model at its cap needs no second copy.

    It cannot be retried after failing midway: some columns then have the new rows and the others the old ones. That
    failure is therefore not an OutOfMemoryError, which training handles, but one that ends it without a checkpoint.
    On the CPU rows are copied instead.

    Args:
        tensor: Contiguous; overwritten.
        rows: At most as many as the tensor has.

    Raises:
        torch.OutOfMemoryError: if memory is too short to begin; the tensor is unchanged.
        MachineError: if memory runs out midway; the tensor is lost.
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
    in_place = tensors[name].is_cuda and rows.dtype == torch.int64 and MIN_IN_PLACE_SHARE * count <= len(rows) <= count
    try:
        return taken_in_place(tensors[name], rows) if in_place else tensors[name][rows]
    except torch.OutOfMemoryError:  # old and new do not fit side by side: move the old one to host memory
        device = tensors[name].device
        tensors[name] = tensors[name].cpu()
    return tensors[name][rows.cpu()].to(device)
