"""Decoded photos as tensors for training: immediately on the CPU, overlapped with computation on a CUDA device."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatpipe.pipeline.photos.pixels.images import Mask, Pixels

QUEUED = 3  # most iterations queued on the device: enough to keep it busy, with few photos held in memory
STEP = float(np.float32(1.0 / 255.0))  # step of 8-bit values, colours in 0..1: the same float32 on every device


@dataclass(frozen=True, eq=False)
class Upload:
    """A photo being uploaded.

    Attributes:
        colour: In [0, 1]; 8-bit during the upload.
        mask: True where the photo counts; None if all of it does.
        sent: Event recorded on the device when both have arrived; None while they are in host memory.
    """

    colour: Float[Tensor, "h w 3"] | UInt8[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None
    sent: torch.cuda.Event | None


class Uploader:
    """Moves photos to the training device.

    They go to a CUDA device from pinned memory, 8 bits per value, on a separate stream: neither the host nor the
    computation waits for them. Only when the host is ``QUEUED`` iterations ahead does it wait for the oldest of these:
    each holds its photo on the device, and the launch queue has room for dozens.

    Args:
        device: The training device.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._lead = RunAheadLimit(QUEUED)
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None  # type: ignore[no-untyped-call]

    def begin(self, pixels: Pixels, mask: Mask | None) -> Upload:
        """Start the upload of a photo; may be called from any thread, and the arrays are not needed afterwards.

        Args:
            pixels: (h, w, 3).
            mask: (h, w).
        """
        if self._stream is None:
            # A fresh array each time: as fast as a ring of buffers here, and never overwritten while in use.
            colours = pixels.astype(np.float32)
            colours *= np.float32(STEP)
            return Upload(torch.from_numpy(colours), None if mask is None else torch.from_numpy(mask.copy()), None)
        colour, counts = _pinned(pixels), None if mask is None else _pinned(mask)
        try:
            with torch.cuda.stream(self._stream):
                there = self._uploaded(colour, counts)
                sent = torch.cuda.Event()  # type: ignore[no-untyped-call]
                sent.record(self._stream)
        except torch.OutOfMemoryError:  # during an iteration; between iterations more memory is free
            return Upload(colour, counts, None)
        return Upload(*there, sent)

    def end(self, upload: Upload) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"] | None]:
        """Return the photo, ready in stream order, with colours in [0, 1]; call it from the computing thread."""
        if self._stream is None:
            return upload.colour, upload.mask
        begun = torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]
        begun.record(torch.cuda.current_stream(self._device))  # reached when the previous iterations are done
        self._lead.add(begun)
        if upload.sent is None:
            colour, mask = self._uploaded(upload.colour, upload.mask)
            return colours_of(colour), mask
        current = torch.cuda.current_stream(self._device)
        current.wait_event(upload.sent)
        for tensor in (upload.colour, upload.mask):
            if tensor is not None:
                tensor.record_stream(current)  # its memory is the other stream's and must not be reused before then
        return colours_of(upload.colour), upload.mask

    def _uploaded(self, colour: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Copies on the device, in order of the current stream."""
        there = colour.to(self._device, non_blocking=True)
        return there, None if mask is None else mask.to(self._device, non_blocking=True)


@runtime_checkable
class DeviceEvent(Protocol):
    """Interface of ``torch.cuda.Event``."""

    def synchronize(self) -> None:
        """Wait until the event has been reached."""


class RunAheadLimit:
    """Limits how far the host runs ahead of a device, while keeping the device busy.

    Args:
        most: Maximum number of pending events.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._ahead: deque[DeviceEvent] = deque()

    def add(self, event: DeviceEvent) -> None:
        """Add the latest event; waits for the oldest if there are too many."""
        self._ahead.append(event)
        if len(self._ahead) > self._most:
            self._ahead.popleft().synchronize()


def colours_of(pixels: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """8-bit colours as values in [0, 1], on their device: bit-identical to the CPU's."""
    return pixels.to(torch.float32).mul_(STEP)


def _pinned(array: Pixels | Mask) -> Tensor:
    """A copy in pinned memory; torch keeps it until the transfer is done."""
    copy = torch.empty(array.shape, dtype=torch.bool if array.dtype == np.bool_ else torch.uint8, pin_memory=True)
    np.copyto(copy.numpy(), array)
    return copy
