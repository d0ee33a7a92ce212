"""What the CUDA kernels of features refuse, and what they leave alone, through the C interface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from exact_features import exact_features, feature_case
from feature_agreement import disagreements
from feature_frames import FeatureDevice, run_features
from frames import pointer
from on_cpu import library_on_cpu

from splatpipe.pipeline.raster.cuda.cuda_api import SplatFeaturePictures, SplatFeatures, SplatFrame

Change = Callable[[SplatFeatures, SplatFrame], None]


@pytest.mark.parametrize("channels", [1, 3, 4, 5, 16, 17, 32, 33, 50])
def test_nothing_is_read_before_it_is_written_nor_written_beside(channels: int) -> None:
    case = feature_case(11, 50, channels, (37, 21), compensate=True, magnitudes=True)
    assert list(disagreements(run_features(library_on_cpu(), case), exact_features(case))) == []


def test_no_gaussians_are_the_background() -> None:
    case = feature_case(1, 0, 6, (20, 9))
    made = run_features(library_on_cpu(), case)
    np.testing.assert_array_equal(made.pictures["features"], np.broadcast_to(case.background, (9, 20, 6)))
    assert not made.pictures["alpha"].any()


def blended(change: Change) -> None:
    """Blend a view of five channels whose arguments were changed."""
    library, case = library_on_cpu(), feature_case(1, 30, 5, (20, 9))
    device = FeatureDevice(library, case)
    device.project()
    given = device.given()
    size = library.size("splat_frame_bytes", device.shot, case.count, 100)
    memory = device.at.empty("frame", (size,), np.uint8)
    frame = SplatFrame(pointer(memory), size, None, 0, case.count, 100, 1)
    pictures = {"features": device.at.empty("features", (9, 20, 5)), "alpha": device.at.empty("alpha", (9, 20))}
    to = SplatFeaturePictures(**{name: pointer(picture) for name, picture in pictures.items()})
    change(given, frame)
    library.call("splat_blend_features", device.shot, given, frame, to, None)


def setting(**named: object) -> Change:
    """Change fields of the features, or else of the frame."""

    def change(given: SplatFeatures, frame: SplatFrame) -> None:
        for name, value in named.items():
            target = given if hasattr(given, name) else frame
            setattr(target, name, value(target) if callable(value) else value)

    return change


def test_the_same_call_unchanged_is_taken() -> None:
    blended(setting())


@pytest.mark.parametrize(
    "change",
    [
        setting(channels=0),
        setting(channels=65_537, stride=65_540),
        setting(stride=5),
        setting(stride=12),
        setting(alpha_max=0.0),
        setting(alpha_max=1.0),
        setting(alpha_max=float("nan")),
        setting(features=None),
        setting(features=lambda given: given.features + 4),
        setting(radii=None),
        setting(memory=lambda frame: frame.memory + 16),
        setting(capacity=29),
        setting(passes=0),
    ],
)
def test_arguments_that_make_no_sense_are_refused(change: Change) -> None:
    with pytest.raises(ValueError, match="makes no sense"):
        blended(change)


def test_too_little_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="less memory"):
        blended(setting(bytes=lambda frame: frame.bytes - 1))
