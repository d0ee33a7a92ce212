"""Depth maps in their files."""

import io
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_maps import DepthMap, DepthMapFile, save_depth_maps

CAMERA = Camera("a.png", 4, 3, 5.0, 5.0, 2.0, 1.5, np.eye(4))


def arrays(**named: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **named)
    return file.getvalue()


def one_array() -> bytes:
    file = io.BytesIO()
    np.save(file, np.ones((3, 4)))
    return file.getvalue()


def test_a_map_reads_back_as_written(tmp_path: Path) -> None:
    kept = DepthMap(np.full((3, 4), 2.5, np.float32), np.full((3, 4), 3, np.uint8))
    summary = save_depth_maps(tmp_path / "maps", [(CAMERA, kept)])
    assert summary == {"maps": 1, "megapixels": 12e-6, "found": 1.0}
    read = DepthMapFile(CAMERA, tmp_path / "maps/00000.npz").load()
    np.testing.assert_array_equal(read.depth, kept.depth)
    np.testing.assert_array_equal(read.confidence, kept.confidence)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no arrays",
        arrays(depth=np.ones((3, 4)), confidence=np.ones((3, 4)))[:-30],
        arrays(depth=np.ones((3, 4))),
        arrays(depth=np.ones((4, 3)), confidence=np.ones((4, 3))),
        arrays(depth=np.array([{}]), confidence=np.ones((3, 4))),
        one_array(),
    ],
)
def test_an_invalid_map_is_refused_by_its_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "00000.npz").write_bytes(content)
    with pytest.raises(StageError, match=r"00000\.npz"):
        DepthMapFile(CAMERA, tmp_path / "00000.npz").load()
