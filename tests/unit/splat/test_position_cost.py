"""What formats say that their steps cost: told, or refused where the splat would be destroyed."""

from pathlib import Path

import numpy as np
import pytest
import torch
from some_splats import some_gaussians

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS
from splatpipe.pipeline.splat.formats.files import read_scene, write_scene
from splatpipe.pipeline.splat.model.position_cost import PositionCost
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts

LOSSY = [kind for kind in SPLAT_FORMATS if kind.name in ("compressed-ply", "spz", "spz2", "sog")]


@pytest.mark.parametrize("kind", SPLAT_FORMATS, ids=lambda kind: kind.name)
def test_positions_read_back_within_the_stated_step(tmp_path: Path, kind):
    scene = Scene(some_gaussians(600, degree=0, spread=2.0), SceneFacts("z up"))
    cost = write_scene(tmp_path / kind.file, scene, kind)
    assert cost.count == 600
    assert cost.size == pytest.approx(
        float(scene.gaussians.log_scales.median(1).values.exp().double().median()), rel=0.01
    )
    read = read_scene(tmp_path / kind.file).turned("z up").gaussians.means.double()
    apart = torch.cdist(read, scene.gaussians.means.double()).amin(1).numpy()
    assert np.median(apart) <= 1.01 * cost.step  # half a step along each of three axes
    assert not cost.warnings()


@pytest.mark.parametrize("kind", LOSSY, ids=lambda kind: kind.name)
def test_a_format_that_would_destroy_the_splat_is_refused(tmp_path: Path, kind):
    gaussians = some_gaussians(600, degree=0, spread=100.0)
    gaussians.log_scales[:] = -14.0
    with pytest.raises(SplatpipeError, match="would destroy the splat") as refused:
        write_scene(tmp_path / kind.file, Scene(gaussians), kind)
    assert "PLY or GLB" in refused.value.hint
    assert list(tmp_path.iterdir()) == []
    write_scene(tmp_path / "a.ply", Scene(gaussians))
    write_scene(tmp_path / "a.glb", Scene(gaussians))


def test_steps_are_told_from_a_share_of_the_gaussians_on():
    sizes = np.full((1000, 2), 0.1)
    sizes[:40] = 0.01
    assert PositionCost.of(0.02, sizes).warnings() == ()
    sizes[:60] = 0.01
    (warning,) = PositionCost.of(0.02, sizes).warnings()
    assert "60 of 1,000 Gaussians are smaller" in warning
    assert not PositionCost.of(0.02, sizes).destroys
    assert PositionCost.of(0.5, sizes).destroys
    assert not PositionCost.of(0.5, sizes, rounded=False).destroys  # float32, as it was given


def test_spz_keeps_far_gaussians_as_far_as_the_fine_ones_allow(tmp_path: Path):
    gaussians = some_gaussians(5000, degree=0, spread=3.0)
    gaussians.means[:25] *= (
        400.0 / gaussians.means[:25].norm(dim=1, keepdim=True) * torch.linspace(2.0, 4.0, 25)[:, None]
    )
    cost = write_scene(tmp_path / "far.spz", Scene(gaussians, SceneFacts("y up")))
    assert cost.warnings() == () and cost.step == 2.0**-12
    far = read_scene(tmp_path / "far.spz").gaussians.means.norm(dim=1)
    assert int((far > 500.0).sum()) == 25
    assert float(far.max()) == pytest.approx(1600.0, abs=0.01)


def test_spz_counts_the_gaussians_that_it_moves_and_resizes(tmp_path: Path):
    gaussians = some_gaussians(5000, degree=0, spread=3.0)
    gaussians.log_scales -= 4.0
    gaussians.means[:3] *= 1e6
    gaussians.log_scales[3:13] = 7.0
    moved, resized = write_scene(tmp_path / "far.spz", Scene(gaussians, SceneFacts("y up"))).warnings()
    assert "3 of 5,000 Gaussians" in moved and "Moved in" in moved
    assert "10 of 5,000 Gaussians" in resized and "largest" in resized
