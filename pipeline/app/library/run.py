"""A run as an object: its cameras, points, figures and files, and renders from any view."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Float64, UInt8
from numpy.typing import NDArray

from splatpipe.pipeline.app.library.requests import check_machine
from splatpipe.pipeline.app.library.trained_scene import in_model_frame, in_world_frame, scene_parts
from splatpipe.pipeline.app.library.user_errors import user_errors
from splatpipe.pipeline.app.report import PDF_FILE, REPORT_FILE
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import require_replaceable, write_file
from splatpipe.pipeline.engine.machine import available_cores
from splatpipe.pipeline.engine.runs.run_folder import RunFolder, open_run_folder
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.stages.line import EXPORT, GEOREF, LINE, UNDISTORT

if TYPE_CHECKING:
    from splatpipe.pipeline.film.filming import TrainedScene

METRICS, GEOREFERENCE = "metrics.json", "georef.json"
Vector = Sequence[float] | NDArray[Any]
What = Literal["colour", "depth", "normals"]


@dataclass(frozen=True, eq=False)
class Render:
    """A rendered image; a notebook shows it.

    Attributes:
        pixels: Red, green, blue.
        values: Depths along the view axis, in the run's units, 0 without a surface; or unit normals (h, w, 3) in its
            frame, 0 without a surface; None for colours.
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    values: Float[np.ndarray, "h w *k"] | None = None

    def png(self) -> bytes:
        """The image as a PNG file."""
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(self.pixels)).save(file, "PNG")
        return file.getvalue()

    def save(self, path: Path | str) -> None:
        """Write the image as PNG.

        Raises:
            SplatpipeError: if it cannot be written.
        """
        with user_errors():
            require_replaceable(Path(path).expanduser())
            write_file(Path(path).expanduser(), self.png())

    def _repr_png_(self) -> bytes:
        return self.png()


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """The sparse points of a run.

    Attributes:
        xyz: Positions, in the run's frame.
        rgb: Colours.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


class Run:
    """A run in its OUT; everything is read when it is first used, and stays as it was read.

    All coordinates are in the frame of `splat.ply`: east, north, up in metres about the origin that ``georeference``
    states; without a georeference, up is +z, and scale and place are arbitrary.

    Attributes:
        out: Its folder, absolute.
    """

    out: Path

    def __init__(self, folder: RunFolder, device: str, threads: int) -> None:
        self.out = folder.out
        self._folder, self._device, self._threads = folder, device, threads

    def __repr__(self) -> str:
        return f"Run({str(self.out)!r})"

    @cached_property
    def cameras(self) -> list[Camera]:
        """The cameras of the photos that could be placed, undistorted, by name.

        Raises:
            SplatpipeError: if the run is not that far.
        """
        from splatpipe.pipeline.photos.pixels.dataset import load_views

        with user_errors():
            views = load_views(self._part("undistort.dataset"))
            return [in_world_frame(view.camera, self._world_from_model) for view in views]

    @cached_property
    def sparse_points(self) -> SparsePoints:
        """The points that photos were placed by.

        Raises:
            SplatpipeError: if the run is not that far.
        """
        from splatpipe.pipeline.photos.pixels.dataset import load_points

        with user_errors():
            points = load_points(self._part("undistort.dataset"))
            return SparsePoints(self._world_from_model.apply(points.xyz), points.rgb)

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The content of `metrics.json`: photos placed, errors, PSNR of held-out photos, accuracy; docs/products.md.

        Raises:
            SplatpipeError: if the run is not that far.
        """
        return self._json(METRICS)

    @cached_property
    def georeference(self) -> dict[str, Any]:
        """The content of `georef.json`: origin, CRS, the exact way to its coordinates; docs/coordinates.md.

        Raises:
            SplatpipeError: if the run is not that far.
        """
        return self._json(GEOREFERENCE)

    @property
    def products(self) -> dict[str, Path]:
        """The files for people in OUT, by their names there, e.g. ``splat.ply`` and ``report.html``."""
        names = [*self._folder.deliverables(), REPORT_FILE, PDF_FILE]
        return {name: self.out / name for name in names if (self.out / name).is_file()}

    def render(self, camera: Camera, what: What = "colour") -> Render:
        """Render the splat as it was trained, with its sky.

        Args:
            camera: One of ``cameras``, a changed copy of one, or that of ``look_at``.
            what: ``colour``, ``depth`` or ``normals``.

        Raises:
            SplatpipeError: if the run has no trained splat, or the camera cannot be rendered.
        """
        from splatpipe.pipeline.app.library.rendered import render_view, require_renderable

        require_renderable(camera, what)
        with user_errors():
            inside = in_model_frame(camera, self._world_from_model)
            return Render(*render_view(self._scene, self._world_from_model, inside, what, self._cores))

    @property
    def _cores(self) -> int:
        return self._threads or available_cores()

    @cached_property
    def _scene(self) -> TrainedScene:
        from splatpipe.pipeline.film.filming import open_scene
        from splatpipe.pipeline.raster.device import choose_device
        from splatpipe.pipeline.raster.threads import same_bits

        with same_bits(self._cores):
            return open_scene(scene_parts(self.out), self._cores, choose_device(self._device))

    @cached_property
    def _world_from_model(self) -> Similarity:
        from splatpipe.pipeline.survey.crs.frames import load_frame

        return load_frame(self._part("georef.frame")).world_from_model

    def _part(self, name: str) -> Path:
        part = self._folder.lineage(EXPORT, UNDISTORT, GEOREF).get(name)
        if part is None:
            raise UsageError(
                f"{self.out} has no {name} yet.", hint=f"Run the pipeline first: splatpipe run PHOTOS {self.out}"
            )
        return part.path

    def _json(self, name: str) -> dict[str, Any]:
        path = self.out / name
        try:
            found: dict[str, Any] = read_json(path)
        except (OSError, ValueError) as error:
            raise UsageError(
                f"{path} cannot be read: {error}.", hint=f"Run the pipeline first: splatpipe run PHOTOS {self.out}"
            ) from error
        return found


def open_run(out: Path | str, *, device: str = "auto", threads: int = 0) -> Run:
    """Open an existing run.

    Args:
        out: Its folder.
        device: Where to render: ``auto``, ``cpu`` or ``cuda``.
        threads: Threads for rendering; 0 for all cores. Does not change the image.

    Raises:
        SplatpipeError: if there is no run in it, or no such device or number of threads.
    """
    with user_errors():
        check_machine(device, threads)
        return Run(open_run_folder(Path(out), LINE), device, threads)


def look_at(
    eye: Vector,
    target: Vector,
    *,
    width: int = 1280,
    height: int = 720,
    angle_deg: float = 60.0,
    up: Vector = (0.0, 0.0, 1.0),
) -> Camera:
    """A camera at one place that looks at another.

    Args:
        eye: Its place: x, y, z.
        target: What is in the middle of its image: x, y, z.
        width: Pixels.
        height: Pixels.
        angle_deg: Field of view along the longer side.
        up: What is up in the image; where the camera looks along it, y is, or z along y.

    Raises:
        SplatpipeError: if both places are the same, or a number is not finite or not in its range.
    """
    from splatpipe.pipeline.film.camera_path import FilmCamera

    place, aim, above = (np.asarray(vector, np.float64) for vector in (eye, target, up))
    if not all(vector.shape == (3,) and np.isfinite(vector).all() for vector in (place, aim, above)) or not above.any():
        raise UsageError("Eye, target and up are three finite numbers each, and up is not zero.", hint="Give x, y, z.")
    if not all(isinstance(side, int | np.integer) and side > 0 for side in (width, height)):
        raise UsageError(f"An image of {width} × {height} pixels cannot be drawn.", hint="Give whole numbers.")
    ahead = aim - place
    if not 0.0 < float(np.linalg.norm(ahead)) < np.inf or not 0.0 < angle_deg < 180.0:
        raise UsageError(
            f"A camera at {place.tolist()} cannot look at {aim.tolist()} with an angle of {angle_deg} degrees.",
            hint="Give two different places, and an angle between 0 and 180 degrees.",
        )
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, above)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(above):
        right = np.cross(ahead, [0.0, 1.0, 0.0] if abs(ahead[1]) < 0.9 else [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = -pose[:3, :3] @ place
    lens = FilmCamera.of_angle(width, height, angle_deg)
    return Camera("view", int(width), int(height), lens.focal_px, lens.focal_px, width / 2.0, height / 2.0, pose)
