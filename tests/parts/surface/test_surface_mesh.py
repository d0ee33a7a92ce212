"""The mesh: blocks, order, colours, files; and the complete mesh where open3d is installed."""

import json
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
import trimesh
from house_photos import GSD_M, Recorder, house_site, photos, run_surface, surface_distances
from house_site import ExactDepths, true_height, true_orthophoto
from PIL import Image

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.depths.sources import DepthSource
from splatpipe.pipeline.surface.shapes.blocks import SIDE, blocks_of, keys_of, surface_blocks
from splatpipe.pipeline.surface.shapes.decimation import decimate
from splatpipe.pipeline.surface.shapes.point_colours import photo_set
from splatpipe.pipeline.surface.shapes.surface_mesh import MeshTask, vertex_colours
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh, in_order, remove_small_components
from splatpipe.pipeline.surface.texture.charts import BORDER, make_charts
from splatpipe.pipeline.surface.texture.face_choice import same_label
from splatpipe.pipeline.surface.texture.face_graph import adjacent_faces, connected_parts
from splatpipe.pipeline.surface.texture.face_views import NONE, FaceViews, rate_faces, sample_faces
from splatpipe.pipeline.surface.texture.mesh_files import write_mesh
from splatpipe.pipeline.surface.texture.mesh_product import TexturedMeshTask, make_mesh
from splatpipe.pipeline.surface.texture.neighbour_photos import FaceNeighbours, NeighbourPhotos
from splatpipe.pipeline.surface.texture.texture import TextureTask, texture_mesh
from splatpipe.pipeline.surface.texture.textured_mesh import Atlas, TexturedMesh, load_textured_mesh, page_paths
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

FRAME = Frame("enu", Similarity.identity(), Origin(47.8412, 13.5127, 512.0), "ellipsoidal", crs="EPSG:32633")
BOX = house_site().box


@cache
def exact_photos() -> PhotoSet:
    return photo_set(photos(), GSD_M, 1)


def flat_mesh(east: float, cells: int, step: float = 0.25, height: float = 0.0) -> TriangleMesh:
    """A level square of the ground."""
    rows, columns = np.divmod(np.arange((cells + 1) ** 2), cells + 1)
    vertices = np.stack([east + columns * step, rows * step, np.full(len(rows), height)], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    one = np.stack([corner, corner + 1, corner + cells + 2], axis=1)
    other = np.stack([corner, corner + cells + 2, corner + cells + 1], axis=1)
    return TriangleMesh(vertices, np.concatenate([one, other]))


def with_page(folder: Path, coloured: ColouredMesh) -> TexturedMesh:
    """A square mesh with a page that is red, and blue in the north-east."""
    places = coloured.mesh.vertices - coloured.mesh.vertices.min(axis=0)
    at = places[:, :2] / places[:, :2].max() * 60.0 + 2.0
    at[:, 1] = 64.0 - at[:, 1]  # rows go down
    page = np.zeros((64, 64, 3), np.uint8)
    page[..., 0] = 255
    page[:32, 32:] = (0, 0, 255)
    pages = page_paths(folder, 1)
    Image.fromarray(page).save(pages[0], quality=95, subsampling=0)
    rects, count = np.array([[0, 0, 0, 64, 64]], np.int32), len(coloured.mesh.triangles)
    corners = at[coloured.mesh.triangles].astype(np.float32)
    atlas = Atlas(corners, np.zeros(count, np.int32), rects, np.array([[64, 64]], np.int32))
    return TexturedMesh(coloured, atlas, pages)


def assert_blue_in_the_north_east(visual: Any, mesh: TriangleMesh, faces: np.ndarray) -> None:
    """The colours at the middles of triangles, by another program's reading of texture coordinates and image."""
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or material.image
    colours = visual.uv[faces].mean(axis=1)
    shown = trimesh.visual.color.uv_to_color(colours, image)[:, :3]
    middle = mesh.vertices[mesh.triangles].mean(axis=1)[:, :2]
    blue = (middle > (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))[:2] / 2.0).all(axis=1)
    assert (shown[blue] @ [-1, 0, 1] > 200).all() and (shown[~blue] @ [1, 0, -1] > 200).all() and blue.sum() == 2


def together(*meshes: TriangleMesh) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def shuffled(mesh: TriangleMesh) -> TriangleMesh:
    rng = np.random.default_rng(3)
    order = rng.permutation(len(mesh.vertices))
    rank = np.argsort(order)
    triangles = rank[mesh.triangles][rng.permutation(len(mesh.triangles))]
    turn = (rng.integers(0, 3, len(triangles))[:, None] + np.arange(3)) % 3
    return TriangleMesh(mesh.vertices[order], np.take_along_axis(triangles, turn, axis=1))


def test_the_same_mesh_has_one_order() -> None:
    mesh = in_order(flat_mesh(0.0, 6))
    again = in_order(shuffled(mesh))
    np.testing.assert_array_equal(mesh.vertices, again.vertices)
    np.testing.assert_array_equal(mesh.triangles, again.triangles)
    np.testing.assert_allclose(again.normals(), np.tile([0.0, 0.0, 1.0], (49, 1)))
    assert again.areas().sum() == pytest.approx(2.25)


def test_crumbs_are_removed_and_large_pieces_kept() -> None:
    mesh = together(flat_mesh(0.0, 8), flat_mesh(10.0, 2), flat_mesh(20.0, 4))
    assert remove_small_components(mesh, 0.9).areas().sum() == pytest.approx(4.0 + 1.0)
    kept = remove_small_components(mesh, 1.1)
    assert len(kept.vertices) == 81 and kept.vertices[:, 0].max() <= 2.0
    assert not len(remove_small_components(mesh, 10.0).triangles)


def test_blocks_have_numbers_of_their_own() -> None:
    blocks = np.random.default_rng(0).integers(-(1 << 19), 1 << 19, (3, 500))
    np.testing.assert_array_equal(blocks_of(keys_of(blocks)), blocks)


def test_blocks_cover_the_surface_and_little_else() -> None:
    blocks = surface_blocks(exact_photos(), BOX, 0.2, 10_000, 1)
    side = SIDE * blocks.voxel_m
    east, north = (axis.ravel() for axis in np.meshgrid(np.arange(-4.9, 5.0, 0.3), np.arange(-4.9, 5.0, 0.3)))
    off_walls = (np.abs(np.abs(east) - 4.25) > 0.3) & (np.abs(np.abs(north) - 3.25) > 0.3)  # below the eaves few see
    places = np.stack([east, north, true_height(east, north)])[:, off_walls]
    there = keys_of(np.floor((places - BOX[0][:, None]) / side).astype(np.int64))
    assert np.isin(there, keys_of(blocks.places)).all()
    east, north, up = blocks.centres()
    assert not ((np.abs(east) < 2.0) & (np.abs(north) < 1.5) & (up < 2.0)).any()  # within the house
    assert not (up > 5.0 + side).any()
    again = surface_blocks(exact_photos(), BOX, 0.2, 10_000, 3)
    np.testing.assert_array_equal(blocks.places, again.places)


def test_voxels_grow_where_blocks_would_be_too_many() -> None:
    blocks = surface_blocks(exact_photos(), BOX, 0.05, 200, 1)
    assert 100 < blocks.places.shape[1] <= 200 and blocks.voxel_m > 0.1


def test_a_box_without_a_size_has_no_blocks() -> None:
    assert not surface_blocks(exact_photos(), np.stack([BOX[0], BOX[0]]), 0.2, 10_000, 1).places.size


def test_vertices_have_the_photos_colours_and_hidden_ones_their_neighbours() -> None:
    lawn, below = flat_mesh(-4.9, 2, 0.2), flat_mesh(-4.9, 2, 0.2, height=-2.0)
    mesh = TriangleMesh(
        np.concatenate([lawn.vertices - [0.0, 4.9, 0.0], below.vertices]), together(lawn, below).triangles
    )
    colours = vertex_colours(exact_photos(), mesh, 1)
    assert (colours[:, 1] > 120).all() and (colours[:, 0] < 130).all()  # green, below too
    unseen = TriangleMesh(mesh.vertices + 1000.0, mesh.triangles)
    assert (vertex_colours(exact_photos(), unseen, 1) == 128).all()


def test_files_are_read_by_other_programs_in_the_right_place(tmp_path: Path) -> None:
    mesh = flat_mesh(3.0, 2, height=7.0)
    colours = np.arange(27, dtype=np.uint8).reshape(9, 3) * 9
    uncertain = replace(FRAME, residuals={"uncertainty": {"horizontal_m": 0.02}})
    ring = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    facts = PlanArea.seen_from_above([(ring,)]).facts()
    degrees = [[[[13.5, 47.8], [13.6, 47.8], [13.6, 47.9], [13.5, 47.9]]]]
    (tmp_path / "boundary.json").write_text(json.dumps({"world": facts, "degrees": degrees}))
    made = with_page(tmp_path, ColouredMesh(mesh, colours))
    write_mesh(tmp_path, made, uncertain, tmp_path / "boundary.json")
    (tmp_path / "boundary.json").unlink()
    names = ["georef.json", "mesh.glb", "mesh.mtl", "mesh.obj", "mesh.ply", "mesh_00.jpg"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    glb = trimesh.load(tmp_path / "mesh.glb", force="mesh", process=False)
    np.testing.assert_allclose(glb.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0], mesh.vertices)  # y up
    np.testing.assert_array_equal(glb.faces, mesh.triangles)
    np.testing.assert_allclose(glb.face_normals, np.tile([0.0, 1.0, 0.0], (8, 1)))
    assert_blue_in_the_north_east(glb.visual, mesh, glb.faces)
    obj = trimesh.load(tmp_path / "mesh.obj", force="mesh", process=False)
    np.testing.assert_allclose(obj.vertices[obj.faces], mesh.vertices[mesh.triangles])  # z up
    assert_blue_in_the_north_east(obj.visual, TriangleMesh(obj.vertices, obj.faces), obj.faces)
    head = (tmp_path / "mesh.obj").read_text().split("mtllib")[0]
    assert "# offset: 388" in head and "crs: EPSG:32633" in head
    ply = plyfile.PlyData.read(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(np.stack([ply["vertex"][a] for a in "xyz"], axis=1), mesh.vertices)
    np.testing.assert_array_equal(np.stack([ply["vertex"][c] for c in ("red", "green", "blue")], axis=1), colours)
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), mesh.triangles)
    assert "frame: local east north up, metres" in ply.comments
    placed = json.loads((tmp_path / "georef.json").read_text())
    assert placed["origin"]["latitude"] == 47.8412 and placed["uncertainty"] == {"horizontal_m": 0.02}
    assert placed["crs_from_local_tangent"]["over_box_m"] == [[3.0, 0.0, 7.0], [3.5, 0.5, 7.0]]
    assert placed["boundary"]["area_m2"] == 100.0
    assert placed["boundary"]["wgs84"]["coordinates"] == [[[*degrees[0][0], degrees[0][0][0]]]]


def test_glb_has_a_jpeg_per_page_and_is_unlit(tmp_path: Path) -> None:
    made = with_page(tmp_path, ColouredMesh(flat_mesh(0.0, 2), np.zeros((9, 3), np.uint8)))
    write_mesh(tmp_path, made, FRAME, None)
    data = (tmp_path / "mesh.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    scene, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert int.from_bytes(data[8:12], "little") == len(data) and scene["buffers"][0]["byteLength"] == len(binary)
    view = scene["bufferViews"][scene["images"][0]["bufferView"]]
    image = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    assert image == made.pages[0].read_bytes() and scene["images"][0]["mimeType"] == "image/jpeg"
    assert all(view["byteOffset"] % 4 == 0 for view in scene["bufferViews"])
    assert "KHR_materials_unlit" in scene["materials"][0]["extensions"]


def test_textures_show_the_photos_where_they_see_the_mesh_and_nothing_else(tmp_path: Path) -> None:
    """Lawn, path and roof from above; a part below the ground, which no photo sees, is removed."""
    lawn, below = flat_mesh(-4.9, 4, 0.2), flat_mesh(-4.9, 2, 0.2, height=-2.0)
    mesh = together(TriangleMesh(lawn.vertices - [0.0, 4.9, 0.0], lawn.triangles), below)
    coloured = ColouredMesh(mesh, vertex_colours(exact_photos(), mesh, 1))
    task = TextureTask(exact_photos(), GSD_M, 1e6, 1)
    made = texture_mesh(task, coloured, tmp_path, tmp_path, Recorder())
    shape, atlas = made.coloured.mesh, made.atlas
    assert len(shape.triangles) == 32 and shape.vertices[:, 2].min() == 0.0
    page = np.asarray(Image.open(made.pages[0]), np.float64)
    middle = atlas.corners.mean(axis=1)
    shown = page[middle[:, 1].astype(int), middle[:, 0].astype(int)]
    east, north, _ = shape.vertices[shape.triangles].mean(axis=1).T
    assert np.abs(shown - true_orthophoto(east, north)).mean() < 12.0
    size = np.linalg.norm(atlas.corners[:, 1] - atlas.corners[:, 0], axis=1)  # 0.2 m, or its diagonal
    assert (size > 0.2 / GSD_M * 0.5).all()  # at the photos' resolution
    before = made.pages[0].read_bytes()
    made.pages[0].unlink()
    again = texture_mesh(replace(task, threads=3), coloured, tmp_path, tmp_path, Recorder())  # the choice is kept
    assert again.pages[0].read_bytes() == before
    (tmp_path / "choice.npz").unlink()
    small = texture_mesh(replace(task, most_texels=120.0), coloured, tmp_path, tmp_path, Recorder())
    assert small.atlas.rects[:, 3:].prod(axis=1).sum() <= 120 < atlas.rects[:, 3:].prod(axis=1).sum()


def lonely_triangle() -> tuple[TriangleMesh, FaceViews, np.ndarray, int]:
    """Lawn that shows one photo, but for a triangle that shows another and knows no other; and that triangle's row."""
    lawn = flat_mesh(-4.9, 6, 0.2)
    mesh = TriangleMesh(lawn.vertices - [0.0, 4.9, 0.0], lawn.triangles)
    views = rate_faces(exact_photos(), sample_faces(mesh), GSD_M, 1, Recorder())
    everywhere = [number for number in range(len(photos())) if (views.photo == number).any(axis=1).all()]
    label, lonely = np.full(len(mesh.triangles), everywhere[0], np.int16), 20
    label[lonely] = everywhere[1]
    at = int(np.flatnonzero(views.photo[lonely] == everywhere[1])[0])
    views.photo[lonely, 0], views.photo[lonely, 1:] = everywhere[1], NONE
    views.cost[lonely, 0], views.colour[lonely, 0] = views.cost[lonely, at], views.colour[lonely, at]
    return mesh, views, label, lonely


@pytest.mark.parametrize(("hole", "odd", "joined"), [(False, 90, True), (True, 0, True), (True, 90, False)])
def test_a_lonely_triangle_takes_its_neighbours_photo_if_that_shows_it(hole: bool, odd: int, joined: bool) -> None:
    """Where the photo's depths have a hole it is believed only if it shows the same colour."""
    mesh, views, label, lonely = lonely_triangle()
    common = int(label[0])
    sources = photos()
    if hole:
        found = sources[common].depths.load()
        depth = np.zeros_like(found.depth)
        camera = replace(found.camera)
        source = DepthSource(camera, lambda: ExactDepths(camera, depth, found.confidence))
        sources[common] = replace(sources[common], depths=source)
    views.colour[lonely, 0] = np.minimum(views.colour[lonely, 0].astype(int) + odd, 255)
    asked = NeighbourPhotos(photo_set(sources, GSD_M, 1), sample_faces(mesh), views, GSD_M, 1)
    asked.join(label, FaceNeighbours(adjacent_faces(mesh.triangles), mesh.areas(), 1.0))
    assert (label[lonely] == common) == joined and (np.delete(label, lonely) == common).all()
    assert (common in views.photo[lonely]) == joined  # seams may mix it


def test_triangles_without_a_photo_go_on_from_those_beside_unless_something_else_is_there() -> None:
    mesh, views, label, lonely = lonely_triangle()
    label[:] = label[0]
    hidden = together(mesh, TriangleMesh(mesh.vertices - np.array([0.0, 0.0, 3.0]), mesh.triangles))  # below the lawn
    beyond = adjacent_faces(hidden.triangles)
    beyond[lonely, 0], beyond[lonely + 72, 0] = lonely + 72, lonely
    every = np.concatenate([label, np.full(72, NONE, np.int16)])
    every[lonely] = NONE
    both = FaceViews(
        *(
            np.concatenate([each, np.full_like(each, NONE if k == 0 else 0)])
            for k, each in enumerate(vars(views).values())
        )
    )
    both.photo[lonely] = NONE
    asked = NeighbourPhotos(exact_photos(), sample_faces(hidden), both, GSD_M, 1)
    asked.join(every, FaceNeighbours(beyond, hidden.areas(), 1.0))
    assert (every[:72] == label[0]).all() and (every[72:] == NONE).all()


def test_small_charts_near_each_other_share_a_rectangle_if_that_needs_less_room() -> None:
    lawn = flat_mesh(-4.9, 12, 0.2)
    mesh = TriangleMesh(lawn.vertices - [0.0, 4.9, 0.0], lawn.triangles)
    beyond = adjacent_faces(mesh.triangles)
    label = (np.arange(len(mesh.triangles)) % 2).astype(np.int16)  # no two neighbours along a row show the same photo
    charts = make_charts(mesh, label, beyond, photos(), 1e6)
    alone, _ = connected_parts(beyond, same_label(label, beyond))
    assert len(charts.photo) < alone / 4
    assert (charts.photo[charts.chart] == label).all()
    inside = (charts.corners >= BORDER - 1e-3) & (charts.corners <= charts.size[charts.chart, None] - BORDER)
    assert inside.all()


def test_few_triangles_are_unchanged() -> None:
    mesh = flat_mesh(0.0, 3)
    assert decimate(mesh, 18) is mesh


def test_the_complete_mesh_or_how_to_install_open3d(tmp_path: Path) -> None:
    """open3d is an extra: if it is missing, the error says how to install it; no other test here needs it."""
    shape = MeshTask(run_surface(FRAME, photos(noise_px=0.1, wild=0.03)), house_site(), 2.0 * GSD_M, 4000, 1)
    task, files = TexturedMeshTask(shape, GSD_M, 2e6), tmp_path / "files" / "mesh"
    if find_spec("open3d") is None:
        with pytest.raises(MachineError) as refused:
            make_mesh(task, tmp_path / "work", tmp_path, Recorder())
        assert "open3d" in refused.value.message and "splatpipe[mesh]" in refused.value.hint
        assert not list(tmp_path.iterdir())
        return
    summary = make_mesh(task, tmp_path / "work", tmp_path, Recorder())
    mesh = trimesh.load(files / "mesh.ply", process=False)
    assert 2500 < summary["triangles"] == len(mesh.faces) <= 4000
    places, _ = trimesh.sample.sample_surface(mesh, 20_000, seed=1)
    off = surface_distances(np.asarray(places))
    assert np.quantile(off, 0.5) < 0.3 * GSD_M
    # The eaves have no thickness, but voxels of 2 GSD always do: the errors are there, and little larger than that.
    eaves = ((np.abs(places[:, :2]) >= [3.8, 2.8]).any(axis=1)) & (places[:, 2] > 2.0)
    assert (off < 2.0 * GSD_M)[~eaves].mean() > 0.999 and (off < 4.0 * GSD_M).mean() > 0.99
    assert summary["area_m2"] > 0.95 * (100.0 + 2.0 * 9.0 * 4.03 + 28.0 * 3.0 - 56.0)
    made = (files / "mesh.glb").read_bytes()
    made_textured = load_textured_mesh(tmp_path / "textured.npz", tmp_path / "files")
    assert made_textured is not None and len(made_textured.coloured.mesh.triangles) == summary["triangles"]
    other = tmp_path / "other"
    make_mesh(replace(task, shape=replace(shape, threads=2)), other / "work", other, Recorder())
    assert (other / "files" / "mesh" / "mesh.glb").read_bytes() == made
    (files / "mesh.glb").unlink()
    again = Recorder()
    make_mesh(task, tmp_path / "work", tmp_path, again)  # as after a kill while it was decimated
    assert (files / "mesh.glb").read_bytes() == made and again.steps == [(1, 1)]
    empty = replace(task, shape=replace(shape, site=replace(house_site(), reach=(500.0, 500.0, 510.0, 510.0))))
    with pytest.raises(SplatpipeError, match="No surface"):
        make_mesh(empty, tmp_path / "empty", tmp_path, Recorder())
