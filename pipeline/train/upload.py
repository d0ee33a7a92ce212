"""Decoded photos as the trainer's tensors: on the CPU at once, to a CUDA device beside what is computed there."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatpipe.pipeline.photos.images import Mask, Pixels

QUEUED = 3  # iterations that wait for the device at most: enough for it never to wait, and few photos beside them
STEP = float(np.float32(1.0 / 255.0))  # of 8 bits: the same float32 wherever it is multiplied by


@dataclass(frozen=True, eq=False)
class Upload:
    """A photo on its way.

    Attributes:
        colour: In [0, 1]; of 8 bits while it is sent.
        mask: True where the photo counts; None where all of it does.
        sent: Happens on the device when both are there; None where they still are in the host's memory.
    """

    colour: Float[Tensor, "h w 3"] | UInt8[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None
    sent: torch.cuda.Event | None


class Uploader:
    """Takes photos to where they are trained on.

    To a CUDA device they go from pinned memory, 8 bits a value, on a stream of their own: neither the host nor what is
    computed meanwhile waits for them. Only where the host is ``QUEUED`` iterations ahead does it wait, for the oldest
    of them: each holds its photo on the device, and the queue of launches has room for dozens.

    Args:
        device: Where to.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._lead = RunAheadLimit(QUEUED)
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None  # type: ignore[no-untyped-call]

    def begin(self, pixels: Pixels, mask: Mask | None) -> Upload:
        """Send a photo; from any thread, the arrays are not needed afterwards.

        Args:
            pixels: (h, w, 3).
            mask: (h, w).
        """
        if self._stream is None:
            # A fresh array each: as fast as a ring of buffers here, and none is overwritten while the trainer holds it.
            colours = pixels.astype(np.float32)
            colours *= np.float32(STEP)
            return Upload(torch.from_numpy(colours), None if mask is None else torch.from_numpy(mask.copy()), None)
        colour, counts = _pinned(pixels), None if mask is None else _pinned(mask)
        try:
            with torch.cuda.stream(self._stream):
                there = self._sent(colour, counts)
                sent = torch.cuda.Event()  # type: ignore[no-untyped-call]
                sent.record(self._stream)
        except torch.OutOfMemoryError:  # beside an iteration; between two there is more
            return Upload(colour, counts, None)
        return Upload(*there, sent)

    def end(self, upload: Upload) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"] | None]:
        """A photo that is there when the device comes to it, its colours in [0, 1]; from the thread that computes."""
        if self._stream is None:
            return upload.colour, upload.mask
        begun = torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]
        begun.record(torch.cuda.current_stream(self._device))  # happens when the iterations before are done
        self._lead.add(begun)
        if upload.sent is None:
            colour, mask = self._sent(upload.colour, upload.mask)
            return colours_of(colour), mask
        current = torch.cuda.current_stream(self._device)
        current.wait_event(upload.sent)
        for tensor in (upload.colour, upload.mask):
            if tensor is not None:
                tensor.record_stream(current)  # its memory is the other stream's, and not to be had until then
        return colours_of(upload.colour), upload.mask

    def _sent(self, colour: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Copies on the device, made in the order of the current stream."""
        there = colour.to(self._device, non_blocking=True)
        return there, None if mask is None else mask.to(self._device, non_blocking=True)


@runtime_checkable
class DeviceEvent(Protocol):
    """As ``torch.cuda.Event``."""

    def synchronize(self) -> None:
        """Wait until it has happened."""


class RunAheadLimit:
    """Keeps the host from running ahead of a device without end, and the device busy all the same.

    Args:
        most: Events that may not have happened yet.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._ahead: deque[DeviceEvent] = deque()

    def add(self, event: DeviceEvent) -> None:
        """Take what the device comes to later than all before; waits for the oldest where there are too many."""
        self._ahead.append(event)
        if len(self._ahead) > self._most:
            self._ahead.popleft().synchronize()


def colours_of(pixels: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Colours in [0, 1] of 8 bits, on their device: the values that the CPU has."""
    return pixels.to(torch.float32).mul_(STEP)


def _pinned(array: Pixels | Mask) -> Tensor:
    """A copy in memory that the device reads by itself; torch keeps it until that is done."""
    copy = torch.empty(array.shape, dtype=torch.bool if array.dtype == np.bool_ else torch.uint8, pin_memory=True)
    np.copyto(copy.numpy(), array)
    return copy
