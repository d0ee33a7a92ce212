"""Textures of meshes: the graph of triangles, charts, pages, seams, and the file that other products read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.surface.shapes.decimation import split_long_edges
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh
from splatpipe.pipeline.surface.texture.charts import BORDER, Charts
from splatpipe.pipeline.surface.texture.face_choice import choose_photos
from splatpipe.pipeline.surface.texture.face_graph import (
    adjacent_faces,
    connected_parts,
    independent_groups,
    reachable_from_borders,
)
from splatpipe.pipeline.surface.texture.face_views import HIDDEN, NONE, FaceViews
from splatpipe.pipeline.surface.texture.glb_mesh import split_corners
from splatpipe.pipeline.surface.texture.packing import pack_charts
from splatpipe.pipeline.surface.texture.seams import blend_seams
from splatpipe.pipeline.surface.texture.texels import texels_of
from splatpipe.pipeline.surface.texture.textured_mesh import (
    PAGE_SIDE,
    Atlas,
    TexturedMesh,
    load_textured_mesh,
    page_paths,
    save_textured_mesh,
)


def square_mesh(cells: int) -> TriangleMesh:
    """A level square of cells of two triangles, 1 m a side; rows of the triangles: first all lower, then all upper."""
    rows, columns = np.divmod(np.arange((cells + 1) ** 2), cells + 1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    lower = np.stack([corner, corner + 1, corner + cells + 2], axis=1)
    upper = np.stack([corner, corner + cells + 2, corner + cells + 1], axis=1)
    return TriangleMesh(np.stack([columns, rows, 0 * rows], axis=1).astype(float), np.concatenate([lower, upper]))


def edges_of(mesh: TriangleMesh) -> np.ndarray:
    sides = np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    return np.sort(sides, axis=1)


def test_neighbours_share_the_edge_and_know_each_other() -> None:
    mesh = square_mesh(5)
    beyond = adjacent_faces(mesh.triangles)
    assert (beyond < 0).sum() == 20  # the outline
    for face, edge in zip(*np.nonzero(beyond >= 0), strict=True):
        other = beyond[face, edge]
        shared = {*mesh.triangles[face, [edge, (edge + 1) % 3]]}
        assert shared <= {*mesh.triangles[other]} and face in beyond[other]


def test_no_two_triangles_of_a_group_are_neighbours() -> None:
    beyond = adjacent_faces(square_mesh(20).triangles)
    groups = independent_groups(beyond)
    assert sorted(np.concatenate(groups)) == list(range(800))
    for group in groups:
        assert not np.isin(beyond[group], group).any()


def test_an_edge_of_three_triangles_has_two_neighbours() -> None:
    beyond = adjacent_faces(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert beyond[:, 0].tolist() == [1, 0, -1]


def test_parts_are_numbered_by_their_first_triangles() -> None:
    beyond = adjacent_faces(square_mesh(2).triangles)
    joined = np.zeros(beyond.shape, bool)
    joined[1] = True  # the second lower triangle with its upper one, and the third cell's beside it
    count, part = connected_parts(beyond, joined)
    assert count == 8 - (beyond[1] >= 0).sum() and part[0] == 0 and part[1] == 1
    assert (part[beyond[1][beyond[1] >= 0]] == 1).all()


def test_only_what_reaches_a_border_is_removed() -> None:
    beyond = adjacent_faces(square_mesh(7).triangles)
    open_to = np.zeros(98, bool)
    open_to[[0, 49, 24, 73]] = True  # both triangles of a corner's cell, and of the middle one
    assert np.flatnonzero(reachable_from_borders(beyond, open_to)).tolist() == [0, 49]


def test_splitting_keeps_the_surface_and_opens_no_cracks() -> None:
    mesh = square_mesh(3)
    mesh = TriangleMesh(mesh.vertices * [5.0, 1.0, 1.0], mesh.triangles)
    split = split_long_edges(mesh, 1.6)
    ends = split.vertices[edges_of(split)]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() <= 1.6
    assert split.areas().sum() == pytest.approx(45.0) and (split.crosses()[:, 2] > 0.0).all()
    _, count = np.unique(edges_of(split), axis=0, return_counts=True)
    outline = split.vertices[np.unique(edges_of(split), axis=0)[count == 1]]
    on_side = ((outline == 0.0) | (outline == [15.0, 3.0, -1.0])).all(axis=1).any(axis=1)
    assert on_side.all() and count.max() == 2


def views_of(photo: list[list[int]], cost: list[list[float]], grey: list[list[int]]) -> FaceViews:
    colour = np.repeat(np.array(grey, np.uint8)[..., None], 3, axis=2)
    return FaceViews(np.array(photo, np.int16), np.array(cost, np.float32), colour)


def test_the_cheapest_photo_is_chosen_unless_it_shows_something_else_than_the_others() -> None:
    beyond = adjacent_faces(square_mesh(4).triangles)
    photos = [[0, 1, 2, 3]] * 32
    alike = views_of(photos, [[100.0, 300.0, 350.0, 400.0]] * 32, [[90, 92, 88, 91]] * 32)
    assert (choose_photos(alike, beyond, np.ones(32), 0.0) == 0).all()
    moved = replace(alike, colour=views_of(photos, [[0.0] * 4] * 32, [[200, 92, 88, 91]] * 32).colour)
    assert (choose_photos(moved, beyond, np.ones(32), 0.0) == 1).all()


def test_unseen_triangles_have_no_photo_and_small_parts_give_way_where_others_see_them() -> None:
    mesh = square_mesh(12)
    beyond, east = adjacent_faces(mesh.triangles), mesh.vertices[mesh.triangles].mean(axis=1)[:, 0]
    photo = np.tile(np.array([[0, 1]], np.int16), (288, 1))
    cost = np.where((east < 3.0)[:, None], [[100.0, 900.0]], [[900.0, 100.0]]).astype(np.float32)
    photo[40], cost[40] = NONE, HIDDEN
    views = FaceViews(photo, cost, np.full((288, 2, 3), 80, np.uint8))
    label = choose_photos(views, beyond, mesh.areas(), 0.0)
    assert label[40] == NONE and {*label} == {NONE, 0, 1} and (label == 0).mean() < 0.4
    assert {*choose_photos(views, beyond, mesh.areas(), 60.0)} == {NONE, 1}


def charts_of(size: np.ndarray) -> Charts:
    count = len(size)
    corners = np.tile(np.array([[[0, 0], [4, 0], [0, 4]]], np.float32) + BORDER, (count, 1, 1))
    number = np.arange(count)
    origin, scale = np.zeros((count, 2)), np.ones(count)
    return Charts(number.astype(np.int32), corners, number.astype(np.int16), origin, scale, size.astype(np.int32))


def test_charts_are_packed_without_overlap() -> None:
    size = np.random.default_rng(5).integers(8, 90, (300, 2))
    atlas = pack_charts(charts_of(size))
    (width, height), taken = atlas.sizes[0], np.zeros(atlas.sizes[0][::-1], int)
    for page, left, top, across, down in atlas.rects:
        assert page == 0 and left + across <= width and top + down <= height
        taken[top : top + down, left : left + across] += 1
    assert taken.max() == 1 and taken.mean() > 0.75
    np.testing.assert_array_equal(atlas.corners[:, 0], atlas.rects[:, 1:3] + BORDER)


def test_many_charts_take_several_pages_of_the_largest_size() -> None:
    atlas = pack_charts(charts_of(np.full((150, 2), 1028)))
    assert len(atlas.sizes) > 1 and atlas.sizes.max() <= PAGE_SIDE
    assert (np.diff(atlas.rects[:, 0]) >= 0).all()  # consecutive photos lie together
    assert (atlas.rects[:, 2] + atlas.rects[:, 4] <= atlas.sizes[atlas.rects[:, 0], 1]).all()


def test_texels_have_the_triangle_that_they_lie_in() -> None:
    corners = np.array([[[2.0, 2.0], [12.0, 2.0], [2.0, 12.0]], [[12.0, 2.0], [12.0, 12.0], [2.0, 12.0]]])
    found = texels_of(corners, 20, 20)
    assert len(np.unique(found.place)) == len(found.place)
    column, row = found.place % 20 + 0.5, found.place // 20 + 0.5
    inside = (column > 2.0) & (column < 12.0) & (row > 2.0) & (row < 12.0)
    assert inside.sum() == 100
    clear = inside & (column + row != 14.0)  # off the diagonal
    np.testing.assert_array_equal(found.face[clear], (column + row > 14.0)[clear] * 1)
    at = np.einsum("nk,nkc->nc", found.weight, corners[found.face])
    np.testing.assert_allclose(at, np.stack([column, row], axis=1), atol=1e-4)


def test_photos_weigh_the_same_on_both_sides_of_a_seam() -> None:
    mesh = square_mesh(4)
    label = np.where(mesh.vertices[mesh.triangles].mean(axis=1)[:, 0] < 2.0, 0, 1).astype(np.int16)
    blends = blend_seams(mesh, label, np.tile(np.array([[0, 1]], np.int16), (32, 1)))
    weights: dict[tuple[int, int], set[float]] = {}
    for face, photo, weight in zip(blends.face, blends.photo, blends.weight, strict=True):
        for corner in range(3):
            weights.setdefault((mesh.triangles[face, corner], photo), set()).add(float(weight[corner]))
    assert all(len(found) == 1 for found in weights.values())
    total = np.zeros((32, 3))
    np.add.at(total, blends.face, blends.weight)
    assert np.isin(total.round(5), [0.0, 1.0]).all() and (total[blends.face] > 0.0).all()
    alone = blend_seams(mesh, label, label[:, None])  # no photo sees what the other one shows
    assert (alone.weight == 1.0).all() and (alone.photo == label[alone.face]).all()


def textured(folder: Path) -> TexturedMesh:
    mesh = square_mesh(2)
    corners = (mesh.vertices[mesh.triangles][..., :2] * 8.0 + BORDER).astype(np.float32)
    atlas = Atlas(
        corners, np.zeros(8, np.int32), np.array([[0, 0, 0, 20, 20]], np.int32), np.array([[20, 20]], np.int32)
    )
    pages = page_paths(folder / "mesh", 1)
    pages[0].parent.mkdir(parents=True)
    Image.new("RGB", (20, 20), (200, 30, 40)).save(pages[0])
    return TexturedMesh(ColouredMesh(mesh, np.full((9, 3), 7, np.uint8)), atlas, pages)


def test_a_textured_mesh_is_read_back(tmp_path: Path) -> None:
    made = textured(tmp_path)
    save_textured_mesh(tmp_path / "textured.npz", made)
    again = load_textured_mesh(tmp_path / "textured.npz", tmp_path)
    assert again is not None and again.pages == made.pages
    for name, array in vars(made.atlas).items():
        np.testing.assert_array_equal(array, getattr(again.atlas, name))
    np.testing.assert_array_equal(again.coloured.mesh.triangles, made.coloured.mesh.triangles)
    save_textured_mesh(tmp_path / "none.npz", None)
    assert load_textured_mesh(tmp_path / "none.npz", tmp_path) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("triangles", np.full((8, 3), 9)),
        ("triangles", np.full((8, 3), -1)),
        ("chart", np.full(8, 1, np.int32)),
        ("rects", np.array([[1, 0, 0, 20, 20]], np.int32)),
        ("sizes", np.array([[1 << 30, 20]], np.int32)),
        ("corners", np.full((8, 3, 2), np.nan, np.float32)),
        ("corners", np.zeros((7, 3, 2), np.float32)),
        ("colours", np.zeros((9, 3), object)),
        ("vertices", np.full((9, 3), np.inf)),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, name: str, value: np.ndarray) -> None:
    save_textured_mesh(tmp_path / "textured.npz", textured(tmp_path))
    with np.load(tmp_path / "textured.npz") as kept:
        arrays = dict(kept) | {name: value}
    np.savez(tmp_path / "textured.npz", **arrays)
    with pytest.raises(StageError, match="cannot be read"):
        load_textured_mesh(tmp_path / "textured.npz", tmp_path)


def test_a_missing_page_is_named(tmp_path: Path) -> None:
    save_textured_mesh(tmp_path / "textured.npz", textured(tmp_path))
    (tmp_path / "mesh" / "mesh_00.jpg").unlink()
    with pytest.raises(StageError, match=r"mesh_00\.jpg is missing"):
        load_textured_mesh(tmp_path / "textured.npz", tmp_path)


def test_vertices_are_split_only_between_charts(tmp_path: Path) -> None:
    made = textured(tmp_path)
    assert len(split_corners(made.coloured.mesh, made.atlas, 0).vertices) == 9
    corners = made.atlas.corners.copy()
    corners[4:] += 1.0
    part = split_corners(made.coloured.mesh, replace(made.atlas, corners=corners), 0)
    assert len(part.vertices) == 16  # all but two corners are in both charts
    np.testing.assert_array_equal(part.vertex[part.triangles], made.coloured.mesh.triangles[part.face])
    np.testing.assert_allclose(part.uv[part.triangles] * 20.0, corners[part.face], atol=1e-5)
