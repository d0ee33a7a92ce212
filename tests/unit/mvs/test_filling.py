"""Depths of two sources in one map: the photos' are kept, gaps are filled by the splat's, shifted to the photos'."""

import numpy as np
import pytest

from splatpipe.pipeline.mvs.depth_maps import DepthMap
from splatpipe.pipeline.mvs.filling import MIN_CONFIDENCE, fill_gaps, median_offset


def both(off: float, size: tuple[int, int] = (60, 80)) -> tuple[DepthMap, DepthMap]:
    """Depths of a slanted wall: the photo's with a hole, and the splat's, farther by a share, with outliers."""
    true = np.broadcast_to(np.linspace(8.0, 12.0, size[1], dtype=np.float32), size)
    known = np.ones(size, bool)
    known[10:20, 10:30] = False
    splat = (true * np.float32(1.0 + off)).astype(np.float32)
    splat[40:50] *= 1.5
    confidence = np.full(size, 9, np.uint8)
    confidence[10:20, 25:] = MIN_CONFIDENCE - 1
    found = DepthMap(np.where(known, true, np.float32(0.0)), np.where(known, 3, 0).astype(np.uint8))
    return found, DepthMap(splat, confidence)


def test_holes_are_filled_with_confirmed_depths_at_the_surface() -> None:
    found, rendered = both(0.001)
    assert median_offset(found, rendered) == pytest.approx(0.001, rel=1e-2)
    result = fill_gaps(found, rendered)
    known = found.confidence > 0
    assert np.array_equal(result.depth[known], found.depth[known])
    assert np.array_equal(result.confidence[known], found.confidence[known])
    true = np.broadcast_to(np.linspace(8.0, 12.0, 80, dtype=np.float32), (60, 80))
    np.testing.assert_allclose(result.depth[10:20, 10:25], true[10:20, 10:25], rtol=2e-5)
    assert (result.confidence[10:20, 10:25] == 9).all() and result.depth.dtype == np.float32
    assert not result.depth[10:20, 25:30].any() and not result.confidence[10:20, 25:30].any()


def test_with_little_overlap_or_another_surface_nothing_is_shifted() -> None:
    assert median_offset(*both(0.001, (30, 30))) == 0.0
    assert median_offset(*both(0.1)) == 0.0


def test_other_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="different grids"):
        fill_gaps(both(0.0)[0], both(0.0, (30, 80))[1])
