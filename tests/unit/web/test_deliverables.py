"""Export formats of a run: read back by other programs in the run's frame and CRS; requested and rejected."""

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pytest
import tiny_scene
from plyfile import PlyData
from pydantic import ValidationError

from splatpipe.pipeline.delivery.delivery_frame import facts_of, in_world, pose_in_world
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.pixels.dataset import load_points, load_views
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.scene import Scene
from splatpipe.pipeline.survey.crs.frames import Frame, Origin
from splatpipe.pipeline.survey.crs.world import open_world
from splatpipe.pipeline.web.deliverables import RunSplat, write_deliverables
from splatpipe.pipeline.web.options import ExportConfig, parse_formats
from splatpipe.pipeline.web.viewer_scene import viewer_rendering, viewer_scene

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Frame(
    kind="enu",
    world_from_model=Similarity(4.0, TURN, np.array([10.0, -20.0, 5.0])),
    origin=Origin(52.2, 21.0, 113.0),
    vertical_datum="ellipsoidal",
    crs="EPSG:32634",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunSplat:
    dataset = tiny_scene.write_dataset(tmp_path_factory.mktemp("run") / "dataset")
    cameras = [view.camera for view in load_views(dataset)]
    scene = Scene(in_world(tiny_scene.true_model(), FRAME), facts_of(FRAME, antialias=False))
    viewer = viewer_scene(dataset, FRAME, viewer_rendering(RenderOptions(sh_degree=3), None))
    return RunSplat(
        scene, FRAME, dataset, cameras, load_points(dataset), frozenset({cameras[0].name}), {"format": 1}, viewer
    )


@pytest.fixture(scope="module")
def delivered(run: RunSplat, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("delivered")
    sizes = write_deliverables(
        ("tiles", "streamed-sog", "web", "model", "laz", "colmap", "transforms"), run, out, tiny_scene.Recorder()
    )
    assert all(size > 0 for size in sizes.values())
    return out / "export"


def test_colmap_reads_cameras_and_points_in_the_world_frame(run: RunSplat, delivered: Path) -> None:
    model = pycolmap.Reconstruction(delivered / "dataset/sparse/0")
    before = pycolmap.Reconstruction(run.dataset / "sparse/0")
    assert model.num_reg_images() == len(run.cameras)
    for camera in run.cameras:
        image = model.find_image_with_name(camera.name)
        rotation, centre = pose_in_world(camera, FRAME)
        np.testing.assert_allclose(image.projection_center(), centre, atol=1e-9)
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), rotation.T, atol=1e-9)
        assert (delivered / "dataset/images" / camera.name).is_file()
    for number, point in before.points3D.items():
        moved = FRAME.world_from_model.apply(point.xyz[None])[0]
        np.testing.assert_allclose(model.points3D[number].xyz, moved, atol=1e-9)
    model.update_point_3d_errors()
    before.update_point_3d_errors()
    assert abs(model.compute_mean_reprojection_error() - before.compute_mean_reprojection_error()) < 1e-6


def test_transforms_project_points_to_their_pixels(run: RunSplat, delivered: Path) -> None:
    table = json.loads((delivered / "dataset/transforms.json").read_text())
    assert table["test_filenames"] == [f"images/{run.cameras[0].name}"]
    assert len(table["train_filenames"]) == len(run.cameras) - 1
    points = run.points.xyz[:20]
    world = FRAME.world_from_model.apply(points)
    for frame, camera in zip(table["frames"], run.cameras, strict=True):
        assert (delivered / "dataset" / frame["file_path"]).is_file()
        pose = np.array(frame["transform_matrix"])  # OpenGL: x right, y up, looks along −z
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        pixels = np.stack(
            [
                frame["cx"] - frame["fl_x"] * local[:, 0] / local[:, 2],
                frame["cy"] + frame["fl_y"] * local[:, 1] / local[:, 2],
            ],
            axis=1,
        )
        rows, expected, _ = camera.in_view(points)
        assert len(rows)
        np.testing.assert_allclose(pixels[rows], expected, atol=1e-6)


def test_the_model_folder_is_the_splat_with_its_cameras(run: RunSplat, delivered: Path) -> None:
    read = read_scene(delivered / "model")
    assert read.facts == run.scene.facts
    assert (read.gaussians.means == run.scene.gaussians.means).all()
    cameras = json.loads((delivered / "model/cameras.json").read_text())
    assert [camera["img_name"] for camera in cameras] == [camera.name for camera in run.cameras]
    assert (delivered / "model/georef.json").is_file() and (delivered / "dataset/georef.json").is_file()
    cloud = PlyData.read(str(delivered / "model/input.ply"))["vertex"]
    np.testing.assert_allclose(cloud["x"], FRAME.world_from_model.apply(run.points.xyz)[:, 0], rtol=1e-5)
    np.testing.assert_array_equal(cloud["green"], run.points.rgb[:, 1])


def test_clouds_lie_in_the_crs_of_the_run(run: RunSplat, delivered: Path) -> None:
    world = open_world(FRAME)
    sparse, centres = laspy.read(delivered / "sparse.laz"), laspy.read(delivered / "centres.laz")
    assert sparse.header.parse_crs().to_epsg() == 32634 or "UTM zone 34N" in sparse.header.parse_crs().name
    expected = world.crs_from_local(FRAME.world_from_model.apply(run.points.xyz))
    assert np.abs(sparse.xyz - expected).max() < 6e-4
    expected = world.crs_from_local(run.scene.gaussians.means.double().numpy())
    assert np.abs(centres.xyz - expected).max() < 6e-4


def test_tiles_are_placed_on_the_globe_and_the_site_is_complete(delivered: Path) -> None:
    tileset = json.loads((delivered / "tiles/tileset.json").read_text())
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix, FRAME.origin.ecef_from_enu(), atol=1e-6)
    assert tileset["extensions"]["ESRI_crs"]["wkid"] == 32634
    assert (delivered / "tiles" / tileset["root"]["content"]["uri"]).is_file()
    assert (delivered / "streamed-sog/lod-meta.json").is_file()
    assert (delivered.parent / "web/index.html").is_file() and (delivered.parent / "web/levels.json").is_file()


def test_formats_that_need_a_scale_are_left_out_with_a_note(run: RunSplat, tmp_path: Path) -> None:
    recorder = tiny_scene.Recorder()
    nowhere = replace(run, frame=Frame("arbitrary", Similarity.identity()))
    assert list(write_deliverables(("laz", "model"), nowhere, tmp_path, recorder)) == ["model"]
    assert "laz is left out" in recorder.warnings[0]


def test_names_are_ordered_and_unknown_ones_refused() -> None:
    assert ExportConfig(formats=" laz, ply,model,laz ").formats == "model,laz"
    assert parse_formats("") == ()
    with pytest.raises(ValidationError, match="no format 'obj'"):
        ExportConfig(formats="obj")
