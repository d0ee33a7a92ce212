"""The sky mask of a training photo, at its training size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask

SURE = 0.9  # minimum share of sky in a pixel, interpolated from the mask: keeps roof edges out
RIM_PX = 3  # around the sky, at ``WORK_MEGAPIXELS``: sky missed by detection, and thin objects in front of it


@dataclass(frozen=True)
class PhotoSky:
    """A photo's sky.

    Attributes:
        mask: Pixels that are certainly sky.
        around: The same, dilated by the rim.
    """

    mask: Bool[Tensor, "h w"]
    around: Bool[Tensor, "h w"]


class PhotoSkies:
    """The skies of all photos.

    Args:
        masks: Sky masks by photo name; photos without sky may be left out.

    Attributes:
        masks: The masks that contain sky.
    """

    def __init__(self, masks: Mapping[str, SkyMask]) -> None:
        self.masks: Mapping[str, SkyMask] = {name: mask for name, mask in masks.items() if mask.any()}
        self._bits: dict[str, UInt8[Tensor, " n"]] = {}  # on a device, where photos are trained on one

    def __len__(self) -> int:
        """Number of photos that show sky."""
        return len(self.masks)

    def on(self, device: torch.device) -> PhotoSkies:
        """The same for training on a device: the masks are kept there, one bit per pixel."""
        moved = PhotoSkies(self.masks)
        if device.type != "cpu":
            moved._bits = {name: torch.from_numpy(mask.bits).to(device) for name, mask in self.masks.items()}
        return moved

    def seen(self, camera: Camera) -> PhotoSky | None:
        """The sky of a photo at the size of ``camera``; None if it shows none."""
        found = self.masks.get(camera.name)
        if found is None:
            return None
        bits = self._bits.get(camera.name)
        return photo_sky_on_cpu(found, camera) if bits is None else photo_sky_on_device(bits, found.shape, camera)


def photo_sky_on_cpu(found: SkyMask, camera: Camera) -> PhotoSky:
    """A photo's sky at the size of ``camera``, or in its window."""
    share = found.unpacked()
    if camera.window is not None and camera.uncropped().height >= share.shape[0]:
        return _seen_in_window(share, camera)
    wider = _widened(share)
    return PhotoSky(_certain_sky(share, camera), _certain_sky(wider, camera))


def _widened(share: Bool[np.ndarray, "_ _"]) -> Bool[np.ndarray, "_ _"]:
    """The mask dilated by the rim."""
    return np.asarray(cv2.dilate(share.view(np.uint8), np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8))).view(bool)


def _seen_in_window(share: Bool[np.ndarray, "_ _"], camera: Camera) -> PhotoSky:
    """The same for a window of a photo larger than its mask: only the window's part of the mask is processed."""
    taken, places = [], []
    for old, (new, pixels) in zip(share.shape, _sides(camera), strict=True):
        step = old / new
        first, last = (0.5 * step - 0.5 + step * pixel for pixel in (pixels.start, pixels.stop - 1))
        begin = max(0, int(first) - RIM_PX - 1)
        taken.append(slice(begin, int(last) + RIM_PX + 3))
        places.append((step, first - begin))
    part = np.ascontiguousarray(share[taken[0], taken[1]])
    if not part.any() or part.all():
        everywhere = torch.full((camera.height, camera.width), bool(part.any()))
        return PhotoSky(everywhere, everywhere)
    (down, top), (right, left) = places
    from_window = np.array([[right, 0.0, left], [0.0, down, top]])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (camera.width, camera.height)
    mask, around = (
        cv2.warpAffine(sky.astype(np.float32), from_window, size, flags=how, borderMode=cv2.BORDER_REPLICATE) > SURE
        for sky in (part, _widened(part))
    )
    return PhotoSky(torch.from_numpy(mask), torch.from_numpy(around))


def photo_sky_on_device(bits: UInt8[Tensor, " n"], shape: tuple[int, int], camera: Camera) -> PhotoSky:
    """The same from a mask's bits, computed on their device; only rounding may differ.

    Args:
        bits: ``SkyMask.bits``.
        shape: ``SkyMask.shape``.
        camera: Camera of a training photo.
    """
    places = torch.arange(7, -1, -1, dtype=torch.uint8, device=bits.device)  # the first pixel is the highest bit
    flat = torch.bitwise_and(torch.bitwise_right_shift(bits[:, None], places), 1).flatten()
    share = flat[: shape[0] * shape[1]].reshape(1, *shape).float()
    wider = functional.max_pool2d(share, 2 * RIM_PX + 1, stride=1, padding=RIM_PX)
    down, right = (_resizing(old, *side, share) for old, side in zip(shape, _sides(camera), strict=True))
    mask, around = down @ torch.cat((share, wider)) @ right.T > SURE
    return PhotoSky(mask, around)


def _sides(camera: Camera) -> tuple[tuple[int, slice], tuple[int, slice]]:
    """The whole image's height and the camera's rows of it; its width and the camera's columns."""
    whole, part = camera.uncropped(), camera.window
    top, left = (0, 0) if part is None else (part.top, part.left)
    return (whole.height, slice(top, top + camera.height)), (whole.width, slice(left, left + camera.width))


def _certain_sky(sky: Bool[np.ndarray, "_ _"], camera: Camera) -> Bool[Tensor, "h w"]:
    (height, rows), (width, columns) = _sides(camera)
    share = sky.astype(np.float32)
    if share.shape != (height, width):
        way = cv2.INTER_AREA if height < share.shape[0] else cv2.INTER_LINEAR
        share = np.asarray(cv2.resize(share, (width, height), interpolation=way), np.float32)
    return torch.from_numpy(share[rows, columns] > SURE)


def _resizing(old: int, new: int, rows: slice, like: Tensor) -> Float[Tensor, "rows old"]:
    """Weights of the old pixels for new ones along a side: by overlap when shrinking, otherwise bilinear."""
    step = old / new
    before = torch.arange(old, dtype=like.dtype, device=like.device)
    after = torch.arange(rows.start, rows.stop, dtype=like.dtype, device=like.device)[:, None] * step
    if step > 1.0:
        overlap = torch.minimum(after + step, before + 1.0) - torch.maximum(after, before)
        return overlap.clamp(min=0.0) / step
    middle = (after + (0.5 * step - 0.5)).clamp(0.0, old - 1.0)
    return (1.0 - (middle - before).abs()).clamp(min=0.0)
