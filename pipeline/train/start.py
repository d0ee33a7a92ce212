"""What training starts with, as the cap allows: a start that fills it leaves density control nothing to place."""

from __future__ import annotations

from pathlib import Path

import torch

from splatpipe.pipeline.photos.dataset import load_points
from splatpipe.pipeline.splat.gaussians import Gaussians

START_SHARE = 0.5  # of the cap, that the start may fill with points of the sweep: the rest is for where detail is


def with_room(start: Gaussians, dataset: Path, cap: int) -> Gaussians:
    """The start with as many of the sweep's Gaussians as leave room to grow, taken evenly; all the sparse points' stay.

    Args:
        start: Those of the sparse points first, as `initialize` leaves them.
        dataset: The sparse points'.
        cap: Most Gaussians of the training.

    Raises:
        StageError: if the dataset is broken.
    """
    sparse = min(len(load_points(dataset)), len(start))
    dense = len(start) - sparse
    room = max(0, int(START_SHARE * cap) - sparse)
    if dense <= room:
        return start
    return start.select(torch.cat([torch.arange(sparse), sparse + torch.arange(room) * dense // max(room, 1)]))
