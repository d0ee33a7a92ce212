"""The model folder that 3DGS trainers write: `point_cloud/iteration_N/point_cloud.ply`, cameras and settings.

Layout: the reference implementation of "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al.,
SIGGRAPH 2023). Viewers take the newest iteration.
"""

from __future__ import annotations

import re
from pathlib import Path

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.splat.containers.bounded import CheckValues, check_values
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.model.position_cost import PositionCost
from splatpipe.pipeline.splat.model.scene import Scene

POINT_CLOUD, PLY = "point_cloud", "point_cloud.ply"
ITERATION = 30_000  # iteration of the reference's trainings: some viewers look nowhere else
_ITERATION = re.compile(r"iteration_([0-9]{1,9})", re.ASCII)
_SETTINGS = (
    "Namespace(sh_degree={degree}, source_path='', model_path='', images='images', depths='', resolution=-1, "
    "white_background={white}, train_test_exp=False, data_device='cuda', eval=True)"
)


def write(path: Path, scene: Scene) -> PositionCost:
    """Write the folder: the splat as in ``plain_ply``, about its origin, and `cfg_args`.

    Args:
        path: The folder; created if missing.
        scene: The scene.

    Raises:
        ValueError: if a value is not finite.
        OSError: if it cannot be written.
    """
    folder = path / POINT_CLOUD / f"iteration_{ITERATION}"
    folder.mkdir(parents=True, exist_ok=True)
    cost = plain_ply.write_about_origin(folder / PLY, scene)
    settings = _SETTINGS.format(degree=scene.gaussians.sh_degree, white=False)
    write_file(path / "cfg_args", settings)
    return cost


def read(path: Path, check: CheckValues = check_values) -> Scene:
    """Read the newest iteration's splat.

    Raises:
        SplatpipeError: if there is none, or as ``plain_ply.read``.
    """
    found = [(int(match[1]), entry) for entry in _entries(path) if (match := _ITERATION.fullmatch(entry.name))]
    whole = [(number, entry / PLY) for number, entry in sorted(found) if (entry / PLY).is_file()]
    if not whole:
        raise SplatpipeError(f"{path} has no {POINT_CLOUD}/iteration_N/{PLY}.", hint="Name the folder of a 3DGS model.")
    return plain_ply.read(whole[-1][1], check)


def _entries(path: Path) -> list[Path]:
    try:
        return list((path / POINT_CLOUD).iterdir())
    except OSError:
        return []
