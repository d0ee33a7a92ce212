"""Dense initialization: depths against a room with known walls, and which photos may contribute."""

import shutil
from pathlib import Path

import corner_photos
import cv2
import numpy as np
import pycolmap
import pytest
from corner_photos import FOCAL, HEIGHT, ROOM_M, WIDTH, Recorder
from tiny_scene import split_part, write_model

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.dense import NEAR_MARGIN, DensePoints, PointBudget, dense_points, thin_out
from splatpipe.pipeline.mvs.depth_search import confirm
from splatpipe.pipeline.mvs.neighbours import SparseVisibility, inverse_depths, neighbours
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.mvs.patch_match import find_depths
from splatpipe.pipeline.mvs.picture import Picture
from splatpipe.pipeline.photos.pixels.dataset import load_points, load_views
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.train.plan.start import read_start
from splatpipe.stages import initialize as stages_initialize
from splatpipe.stages.initialize import run

PHOTOS = 6
SPARSE_M = 1.2  # sparse points lie within this distance of the corner only


def room_cameras(count: int = PHOTOS) -> list[Camera]:
    """The arc's cameras, without the lens's distortion."""
    return [
        Camera(f"{number}.png", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)
        for number, pose in enumerate(corner_photos.poses(count))
    ]


def photograph(camera: Camera) -> np.ndarray:
    lens = pycolmap.Camera.create_from_model_name(1, "PINHOLE", FOCAL, WIDTH, HEIGHT)
    return corner_photos.render(camera.cam_from_world, 0, lens)


def walls(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True depth (h, w), inf beside the walls, the wall's axis (-1 beside them), and the place (h, w, 3)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2)
    rays, centre = rays @ camera.cam_from_world[:3, :3], camera.centre()
    depth, axes = np.full(x.shape, np.inf), np.full(x.shape, -1)
    for axis in range(3):
        along = -centre[axis] / rays[..., axis]
        hit = np.delete(centre + along[..., None] * rays, axis, axis=2)
        nearer = (along > 0) & (along < depth) & (hit >= 0).all(axis=2) & (hit < ROOM_M).all(axis=2)
        depth[nearer], axes[nearer] = along[nearer], axis
    return depth, axes, centre + np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays


def whitewashed(camera: Camera) -> np.ndarray:
    """(h, w), where a square on the wall x = 0 would be."""
    _, axes, places = walls(camera)
    return (axes == 0) & (np.abs(places[..., 1:] - 1.0) < 0.6).all(axis=2)


def sparse_points() -> np.ndarray:
    """Return points on the walls, near the corner."""
    rng = np.random.default_rng(2)
    points = rng.uniform(0.0, SPARSE_M, size=(300, 3))
    points[np.arange(300), np.arange(300) % 3] = 0.0
    return points


def write_room(folder: Path, cameras: list[Camera], masked_axis: int | None = None) -> Path:
    """Write a dataset of the room, with one wall masked in all photos if requested."""
    (folder / "images").mkdir(parents=True)
    for camera in cameras:
        cv2.imwrite(str(folder / "images" / camera.name), photograph(camera)[:, :, ::-1])
        if masked_axis is not None:
            (folder / "masks").mkdir(exist_ok=True)
            mask = np.where(walls(camera)[1] == masked_axis, 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / "masks" / f"{camera.name}.png"), mask)
    points = sparse_points()
    write_model(folder / "sparse/0", cameras, points, np.full(points.shape, 128, np.uint8))
    return folder


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("room") / "dataset", room_cameras())


def initialized(
    dataset: Path, out: Path, threads: int = 1, held_out: str = "", **options: object
) -> tuple[dict, bytes]:
    """Summary of the stage and its file."""
    out.mkdir(parents=True)
    inputs = Inputs(
        {"undistort.dataset": dataset} | split_part(dataset, names=held_out), out, machine=Machine(threads=threads)
    )
    summary = run(InitializeConfig(**options), inputs, out, Recorder())
    assert [path.name for path in out.iterdir()] == ["init.ply"]
    return dict(summary), (out / "init.ply").read_bytes()


def dense(dataset: Path, out: Path) -> DensePoints:
    return dense_points(dataset, load_views(dataset), PointBudget(50_000), out, 1, Recorder())


@pytest.fixture(scope="module")
def points(room: Path, tmp_path_factory: pytest.TempPathFactory) -> DensePoints:
    """The room's dense points."""
    return dense(room, tmp_path_factory.mktemp("points"))


@pytest.fixture(scope="module")
def started(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, bytes]:
    """Return the whole stage's output with one thread."""
    return initialized(room, tmp_path_factory.mktemp("started") / "out")


def test_depths_are_within_a_hundredth_and_nothing_is_found_without_texture() -> None:
    cameras = room_cameras()
    pictures = []
    for camera in cameras:
        grey = cv2.cvtColor(photograph(camera), cv2.COLOR_RGB2GRAY)
        grey[whitewashed(camera)] = 128
        pictures.append(Picture(camera, grey, np.ones((HEIGHT, WIDTH), np.bool_)))
    found = find_depths(pictures[2], [pictures[number] for number in (1, 3, 0, 4)], (0.02, 0.5), 0)
    true, white = walls(cameras[2])[0], whitewashed(cameras[2])
    textured = np.isfinite(true) & ~white
    seen = found.inverse > 0
    errors = np.abs(1.0 / found.inverse[seen & textured] / true[seen & textured] - 1.0)
    assert np.median(errors) < 0.003
    assert np.percentile(errors, 95) < 0.01
    assert seen[textured].mean() > 0.9
    inner = cv2.erode(white.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0  # no edge within the window
    assert inner.mean() > 0.02
    assert not seen[inner].any()


def test_points_are_added_on_the_walls_where_there_were_none(room: Path, points: DensePoints) -> None:
    off_wall = np.abs(points.xyz).min(axis=1)
    assert len(points) > 500
    assert np.median(off_wall) < 0.01  # metres, with cameras at 3 to 4 m
    assert np.percentile(off_wall, 99) < 0.04
    assert points.xyz.min() > -0.05 and points.xyz.max() < ROOM_M + 0.05
    assert (points.xyz.max(axis=1) > SPARSE_M).mean() > 0.6
    gap = np.linalg.norm(points.xyz[:, None] - load_points(room).xyz[None], axis=2).min(axis=1)
    assert np.median(gap) > np.median(points.spacing)


def test_added_points_have_the_colour_of_the_wall(points: DensePoints) -> None:
    for axis in range(3):
        on_wall = np.flatnonzero((np.abs(points.xyz[:, axis]) < 0.02) & (np.sort(points.xyz, axis=1)[:, 1] > 0.3))
        place = np.delete(points.xyz[on_wall], axis, axis=1) / ROOM_M * (corner_photos.TEXTURE - 1)
        x, y = (np.ascontiguousarray(column, np.float32)[:, None] for column in place.T)
        blurred = cv2.blur(corner_photos.texture(axis), (5, 5))  # a pixel of the small photo; the texture is as fine
        expected = cv2.remap(blurred, x, y, cv2.INTER_LINEAR)[:, 0]
        for channel in range(3):
            assert np.corrcoef(points.rgb[on_wall, channel], expected[:, channel])[0, 1] > 0.6


def test_threads_do_not_change_a_bit(room: Path, started: tuple[dict, bytes], tmp_path: Path) -> None:
    assert initialized(room, tmp_path / "two", threads=2) == started


def test_sparse_gaussians_are_kept_and_the_summary_counts_both(
    room: Path, started: tuple[dict, bytes], tmp_path: Path
) -> None:
    off, _ = initialized(room, tmp_path / "off", dense=False)
    summary, written = started
    (tmp_path / "dense.ply").write_bytes(written)
    before, after = read_splat(tmp_path / "off/init.ply"), read_splat(tmp_path / "dense.ply")
    assert "dense_points" not in off
    assert off["gaussians"] == summary["points"] == 300
    assert summary["gaussians"] == len(after) == 300 + summary["dense_points"]
    assert (after.means[:300] == before.means).all()
    assert [read_start(path).sparse for path in (tmp_path / "off/init.ply", tmp_path / "dense.ply")] == [300, 300]


def test_only_photos_that_cover_the_scene_are_read(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages_initialize, "covering_views", lambda _, views: views[1:])
    dataset = tmp_path / "dataset"
    shutil.copytree(room, dataset)
    (dataset / "images/0.png").write_bytes(b"not a photo")
    summary, _ = initialized(dataset, tmp_path / "out", photos="covering", max_megapixels=0.02)
    assert summary["dense_points"] > 0


def test_off_reads_no_photo_and_no_setting(room: Path, started: tuple[dict, bytes], tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    shutil.copytree(room / "sparse", dataset / "sparse")
    (tmp_path / "bare").mkdir()
    run(InitializeConfig(dense=False), Inputs({"undistort.dataset": dataset}, tmp_path), tmp_path / "bare", Recorder())
    _, written = initialized(room, tmp_path / "off", dense=False)
    assert (tmp_path / "bare/init.ply").read_bytes() == written != started[1]


def test_cap_spreads_the_points_evenly(room: Path, points: DensePoints) -> None:
    few = thin_out(points, load_points(room).xyz, 60)
    assert 20 <= len(few) <= 60
    to_few = np.linalg.norm(points.xyz[:, None] - few.xyz[None], axis=2).min(axis=1)
    between = np.linalg.norm(few.xyz[:, None] - few.xyz[None], axis=2) + 9.0 * np.eye(len(few))
    assert np.percentile(to_few, 90) < 6.0 * np.median(between.min(axis=1))


def test_masked_surfaces_get_no_points(tmp_path: Path) -> None:
    points = dense(write_room(tmp_path / "dataset", room_cameras(), masked_axis=1), tmp_path)
    on_masked_wall = (np.abs(points.xyz[:, 1]) < 0.05) & (np.delete(points.xyz, 1, axis=1).min(axis=1) > 0.1)
    assert len(points) > 200
    assert not on_masked_wall.any()


def test_held_out_photos_have_no_influence(tmp_path: Path) -> None:
    dataset = write_room(tmp_path / "dataset", room_cameras(4))
    counts, before = initialized(dataset, tmp_path / "before", held_out="3.png")
    assert counts["dense_points"] > 0
    cv2.imwrite(str(dataset / "images/3.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    _, after = initialized(dataset, tmp_path / "after", held_out="3.png")
    assert before == after


def test_two_photos_or_none_in_common_add_nothing(tmp_path: Path) -> None:
    two = write_room(tmp_path / "two", room_cameras(2))
    apart = write_room(tmp_path / "apart", room_cameras(4))
    model = pycolmap.Reconstruction(apart / "sparse/0")
    bare = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        bare.add_camera_with_trivial_rig(camera)
    for image in model.images.values():
        fresh = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        bare.add_image_with_trivial_frame(fresh, image.cam_from_world())
    for point in model.points3D.values():
        bare.add_point3D(point.xyz, pycolmap.Track(), point.color)
    bare.write(apart / "sparse/0")
    for dataset in (two, apart):
        summary, _ = initialized(dataset, tmp_path / f"{dataset.name}-out")
        assert (summary["points"], summary["dense_points"]) == (300, 0)


def test_neighbours_prefer_ten_degrees_and_skip_views_that_share_nothing() -> None:
    points = np.random.default_rng(4).normal(scale=0.1, size=(40, 3))
    cameras = []
    for number, degrees in enumerate((0.0, 1.0, 10.0, 40.0, 10.0)):
        angle = np.radians(degrees)
        pose = np.eye(4)
        pose[:3, 3] = [-10.0 * np.sin(angle), 0.0, 10.0 * np.cos(angle)]
        cameras.append(Camera(str(number), 64, 48, 50.0, 50.0, 32.0, 24.0, pose))
    rows = np.arange(40)
    tracks = SparseVisibility(points, (rows, rows, rows, rows, rows[:0]))
    near = neighbours(tracks, cameras, 8)
    assert near[0] == [2, 1, 3]
    assert near[4] == []
    smallest, largest = inverse_depths(tracks, 0, cameras[0], NEAR_MARGIN) or (0.0, 0.0)
    assert 0.005 < smallest < 0.02 and 0.1 < largest < 0.2
    assert inverse_depths(tracks, 4, cameras[4], NEAR_MARGIN) is None


def test_a_voxel_without_a_sparse_point_keeps_its_most_certain_point() -> None:
    xyz = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [5.1, 0.0, 0.0], [9.0, 9.0, 9.0]])
    points = DensePoints(xyz, np.zeros((4, 3), np.uint8), np.array([1.0, 2.0, 1.0, 3.0]), np.full(4, 1.0))
    kept = thin_out(points, np.array([[5.2, 0.1, 0.1]]), 10)
    np.testing.assert_array_equal(kept.xyz, xyz[[1, 3]])


def test_voxels_have_the_photos_resolution() -> None:
    xyz = np.array(
        [[0.1, 0.1, 0.1], [1.1, 0.1, 0.1], [60.1, 0.1, 0.1], [61.1, 0.1, 0.1], [8.2, 0.1, 0.1], [8.9, 0.1, 0.1]]
    )
    spacing = np.array([0.5, 0.5, 4.0, 4.0, 0.5, 4.0])
    points = DensePoints(xyz, np.zeros((6, 3), np.uint8), np.arange(6.0), spacing)
    kept = thin_out(points, np.zeros((0, 3)), 10)
    np.testing.assert_array_equal(kept.xyz, xyz[[0, 1, 3, 4]])  # the last has a finer one in its voxel


@pytest.mark.parametrize(("depth", "agrees"), [(3.0, False), (60.0, True)])
def test_photos_agree_within_half_a_pixel_far_away(depth: float, agrees: bool) -> None:
    photo, camera = (Camera(name, 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)) for name in "ab")
    camera.cam_from_world[0, 3] = -1.0
    points = np.array([[0.5, 0.0, depth]])
    inverse = np.full((48, 64), 1.03 / depth, np.float32)
    moved, votes = np.zeros((1, 3)), np.zeros(1, np.uint8)
    confirm((points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()), photo, camera, inverse, (moved, votes))
    assert votes.tolist() == [agrees]
    expected = camera.centre() + (points - camera.centre()) / 1.03 if agrees else np.zeros((1, 3))
    np.testing.assert_allclose(moved, expected, rtol=1e-6)


def test_a_cap_of_one_leaves_one_point_on_all_sides_of_the_origin() -> None:
    xyz = np.random.default_rng(6).normal(size=(100, 3))
    points = DensePoints(xyz, np.zeros((100, 3), np.uint8), np.arange(100.0), np.full(100, 0.1))
    kept = thin_out(points, np.zeros((0, 3)), 1)
    np.testing.assert_array_equal(kept.xyz, xyz[99:])
