"""Levels of detail: every Gaussian in one leaf, errors that decrease towards the leaves, boxes around contents."""

import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.levels.levels import LevelNode, box_distance, build_levels, select_nodes
from splatpipe.pipeline.splat.model.gaussians import Gaussians


def a_wall(count: int = 1500, degree: int = 1, seed: int = 3) -> Gaussians:
    """Flat, overlapping Gaussians of changing colour on a wall of 10 by 10, and what is behind it."""
    generator = torch.Generator().manual_seed(seed)
    made = Gaussians.empty(count, degree)
    made.means = 10.0 * torch.rand(count, 3, generator=generator) * torch.tensor([1.0, 0.02, 1.0])
    made.log_scales = torch.log(torch.tensor([0.15, 0.01, 0.15])) + 0.2 * torch.randn(count, 3, generator=generator)
    made.opacity_logits = 1.0 + torch.randn(count, generator=generator)
    made.sh = 0.2 * torch.randn(made.sh.shape, generator=generator)
    made.sh[:, 0] += torch.sin(made.means)
    return made


def leaves(root: LevelNode) -> list[LevelNode]:
    return [node for node in root.nodes() if not node.children]


def rows(gaussians: Gaussians) -> np.ndarray:
    flat = torch.cat([tensor.reshape(len(gaussians), -1) for tensor in gaussians.tensors().values()], dim=1)
    return flat.numpy()[np.lexsort(flat.numpy().T)]


@pytest.mark.parametrize("count", [1, 300, 301, 1500])
def test_every_gaussian_is_in_one_leaf_to_the_bit(count: int) -> None:
    wall = a_wall(count)
    root = build_levels(wall, most_per_node=300)
    held = Gaussians.concat([leaf.gaussians for leaf in leaves(root)])
    assert np.array_equal(rows(held), rows(wall))
    assert all(leaf.error == 0.0 for leaf in leaves(root))
    assert all(len(node.gaussians) <= 300 for node in root.nodes())


def test_errors_rise_and_boxes_hold_their_children_towards_the_root() -> None:
    for node in build_levels(a_wall(), most_per_node=100).nodes():
        for child in node.children:
            assert node.error > child.error
            assert (node.box[0] <= child.box[0]).all() and (child.box[1] <= node.box[1]).all()
        if node.children:
            assert np.isfinite(node.error) and node.error > 0.0


def test_all_nodes_together_are_less_than_twice_the_model() -> None:
    wall = a_wall(1500, degree=0)
    for most in (75, 180, 260):
        assert sum(len(node.gaussians) for node in build_levels(wall, most).nodes()) <= 2 * len(wall)


def test_the_same_gaussians_give_the_same_bits() -> None:
    first, second = (list(build_levels(a_wall(700), most_per_node=200).nodes()) for _ in range(2))
    assert [node.error for node in first] == [node.error for node in second]
    for one, other in zip(first, second, strict=True):
        assert all(
            torch.equal(tensor, other.gaussians.tensors()[name]) for name, tensor in one.gaussians.tensors().items()
        )


def test_a_distant_sky_does_not_enlarge_the_walls_boxes() -> None:
    wall, sky = a_wall(1000), a_wall(200)
    generator = torch.Generator().manual_seed(4)
    sky.means = 1000.0 * torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1)
    root = build_levels(Gaussians.concat([wall, sky]), most_per_node=150)
    near = [leaf for leaf in leaves(root) if leaf.gaussians.means.abs().max() < 100.0]
    assert sum(len(leaf.gaussians) for leaf in near) == 1000
    assert all((leaf.box[1] - leaf.box[0]).max() < 12.0 for leaf in near)


def test_the_full_model_is_chosen_nearby_and_the_root_far_away_and_every_part_is_shown_once() -> None:
    root = build_levels(a_wall(), most_per_node=100)
    assert select_nodes(root, np.array([5.0, 0.1, 5.0]), 1e9) == leaves(root)
    assert select_nodes(root, np.array([0.0, 1e9, 0.0]), 1000.0) == [root]
    eye = np.array([-8.0, -4.0, 1.0])
    focal = float(np.median([16.0 * box_distance(child.box, eye) / child.error for child in root.children]))
    chosen = select_nodes(root, eye, focal)
    assert 1 < len(chosen) < len(leaves(root))
    under = [leaf for node in chosen for leaf in leaves(node)]
    assert under == leaves(root)
    assert all(not node.children or node.error * focal <= 16.0 * box_distance(node.box, eye) for node in chosen)


def test_levels_of_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="levels of 0"):
        build_levels(Gaussians.empty(0, 0))


def test_huge_gaussians_have_levels_too() -> None:
    gaussians = a_wall(100)
    gaussians.log_scales[:] = 3.0
    root = build_levels(gaussians, 10)
    assert sum(len(node.gaussians) for node in root.nodes() if not node.children) == 100
    assert len(root.gaussians) <= 10
