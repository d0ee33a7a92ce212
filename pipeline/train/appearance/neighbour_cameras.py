"""Values that a photo's nearest neighbours have at the places it shows; computed without synchronizing the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera


@dataclass(frozen=True)
class NeighbourCameras:
    """Cameras of some photos, of any image size, and each one's nearest neighbours.

    Attributes:
        rotations: (n, 3, 3) rotations of ``cam_from_world``.
        shifts: (n, 3) translations of ``cam_from_world``.
        lenses: (n, 4) fx, fy, cx, cy as fractions of the image's width and height.
        nearest: (n, k) indices of the other photos, nearest first.
    """

    rotations: Float64[Tensor, "n 3 3"]
    shifts: Float64[Tensor, "n 3"]
    lenses: Float64[Tensor, "n 4"]
    nearest: Int64[Tensor, "n k"]

    @staticmethod
    def of(cameras: Sequence[Camera], most: int) -> NeighbourCameras:
        """Build from at least one camera, with up to ``most`` neighbours each."""
        poses = torch.from_numpy(np.stack([camera.cam_from_world for camera in cameras]))
        lenses = [
            [camera.fx / camera.width, camera.fy / camera.height, camera.cx / camera.width, camera.cy / camera.height]
            for camera in cameras
        ]
        centres = np.array([camera.centre() for camera in cameras])
        nearest = []
        for row, centre in enumerate(centres):
            order = np.argsort(np.linalg.norm(centres - centre, axis=1), kind="stable")
            nearest.append(order[order != row][:most])
        return NeighbourCameras(
            poses[:, :3, :3].contiguous(),
            poses[:, :3, 3].contiguous(),
            torch.tensor(lenses, dtype=torch.float64),
            torch.from_numpy(np.array(nearest, np.int64).reshape(len(cameras), -1)),
        )

    def to(self, device: torch.device) -> NeighbourCameras:
        """The same on a device."""
        return NeighbourCameras(*(each.to(device) for each in (self.rotations, self.shifts, self.lenses, self.nearest)))

    def places(
        self, row: int, image_points: Float64[Tensor, "m 2"], depths: Float64[Tensor, " m"]
    ) -> Float64[Tensor, "m 3"]:
        """World points at image positions, in fractions of width and height, and depths along the viewing axis."""
        rays = (image_points - self.lenses[row, 2:]) / self.lenses[row, :2]
        in_camera = torch.cat((rays * depths[:, None], depths[:, None]), dim=1) - self.shifts[row]
        return in_camera @ self.rotations[row]

    def agree(
        self, row: int, places: Float64[Tensor, "m 3"], scores: Float[Tensor, "n g g"], limit: Float[Tensor, " 1"]
    ) -> Bool[Tensor, " m"]:
        """Whether most of the nearest photos that have a score at a place have one of at most ``limit``.

        Args:
            row: The photo whose neighbours are compared.
            places: World points; no photo shows a non-finite one.
            scores: Each photo's scores by cell; negative if unknown.
            limit: Largest score that agrees.
        """
        others, grid = self.nearest[row], scores.shape[1]
        in_camera = self.rotations[others] @ places.T + self.shifts[others][:, :, None]  # (k, 3, m)
        lenses = self.lenses[others][:, :, None]
        pixels = in_camera[:, :2] / in_camera[:, 2:] * lenses[:, :2] + lenses[:, 2:]
        visible = (in_camera[:, 2] > 0.0) & in_camera[:, 2].isfinite() & ((pixels >= 0.0) & (pixels < 1.0)).all(dim=1)
        cells = (torch.where(visible[:, None], pixels, 0.0) * grid).long().clamp(max=grid - 1)
        found = scores.flatten()[(others[:, None] * grid + cells[:, 1]) * grid + cells[:, 0]]
        seen = visible & (found >= 0.0)
        return 2 * (seen & (found <= limit)).sum(dim=0) > seen.sum(dim=0)
