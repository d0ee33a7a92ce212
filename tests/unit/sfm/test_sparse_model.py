"""Models on a disk that runs full: pycolmap writes what fits and reports nothing."""

import errno
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.sfm.model.sparse_model import write_model

FILES = ("cameras.bin", "images.bin", "points3D.bin")


def a_model() -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=40, height=30, params=[50.0, 50.0, 20.0, 15.0])
    model.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(("b.jpg", "ü 1.jpg"), start=1):
        image = pycolmap.Image(name, np.full((9, 2), 3.0), 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for index in range(7):
        track = pycolmap.Track([pycolmap.TrackElement(1, index), pycolmap.TrackElement(2, index)])
        model.add_point3D(np.array([0.1, 0.2, 3.0]), track, np.array([1, 2, 3], np.uint8))
    return model


def test_whole_model_is_written(tmp_path: Path) -> None:
    write_model(a_model(), tmp_path / "new" / "0")
    read = pycolmap.Reconstruction(tmp_path / "new" / "0")
    assert (read.num_reg_images(), read.num_points3D()) == (2, 7)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("lost", [1, 10**6])
def test_truncated_file_is_reported_as_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, lost: int
) -> None:
    whole = pycolmap.Reconstruction.write_binary

    def cut(model: pycolmap.Reconstruction, folder: Path) -> None:
        whole(model, folder)
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: max(0, len(data) - lost)])

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", cut)
    with pytest.raises(OSError, match=name) as error:
        write_model(a_model(), tmp_path / "0")
    assert error.value.errno == errno.ENOSPC
