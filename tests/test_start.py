"""What training starts with, where the cap leaves no room for all of it."""

import sys
from pathlib import Path

import torch

from splatpipe.pipeline.photos.dataset import load_points
from splatpipe.pipeline.train.start import with_room

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import tiny_scene


def test_points_of_the_sweep_fill_half_of_the_cap_evenly_and_the_sparse_ones_stay(tmp_path: Path) -> None:
    dataset = tiny_scene.write_dataset(tmp_path / "dataset")
    sparse = len(load_points(dataset))
    start = tiny_scene.true_model(sparse + 100)
    start.means = torch.arange(3.0 * len(start)).view(-1, 3)  # tells the rows
    assert with_room(start, dataset, 2 * len(start)) is start
    half = with_room(start, dataset, 2 * sparse + 100)
    rows = half.means[:, 0].to(torch.int64) // 3
    assert rows[:sparse].tolist() == list(range(sparse))
    assert rows[sparse:].tolist() == list(range(sparse, sparse + 100, 2))
    assert len(with_room(start, dataset, sparse)) == sparse
