"""Splats as arrays, and their files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from splatpipe.pipeline.app.library.user_errors import user_errors
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.similarity import Similarity

if TYPE_CHECKING:
    from splatpipe.pipeline.splat.model.scene import Scene, SplatOrigin

Axes = Literal["z up", "y up", "y down"]
ARRAYS = ("means", "log_scales", "quats", "opacity_logits", "sh")
NOWHERE = (0.0, 0.0, 0.0)
FAR = 10_000.0  # coordinates from which on an origin is taken off: float32 has steps of a millimetre there
ALMOST_ONE = float(np.nextafter(np.float32(1.0), np.float32(0.0)))  # the largest opacity with a logit


@dataclass(frozen=True, eq=False)
class Splat:
    """n Gaussians with the parameters that splat files hold, and where they lie.

    Arrays of other types, and tensors, are converted to float32; those of other shapes raise a ``SplatpipeError``. Far
    coordinates in float64 get an ``origin``.

    Attributes:
        means: Centres, less ``origin``.
        log_scales: Natural logarithms of the standard deviations along the Gaussian's own axes.
        quats: Rotations from these axes (w, x, y, z), not necessarily of unit length.
        opacity_logits: Logits of the opacities.
        sh: Spherical harmonics of red, green and blue, k = (degree + 1)², degree 0 to 3, signs and order of 3D Gaussian
            splatting; a colour is 0.5 plus their sum.
        origin: What was taken off far coordinates, along the axes, so that float32 can hold them: coordinates are
            ``means + origin``. Zero if the splat has a place.
        place: Where a georeferenced splat's zero lies on the earth, and its CRS; its axes, turned to z up, are east,
            north, up there. None if it is not georeferenced.
        axes: Which way is up: ``z up`` (surveying), ``y up`` (glTF) or ``y down`` (viewers of PLY).
        metres: Whether a unit is a metre.
        antialias: Whether opacities account for the screen-space blur (Mip-Splatting).
        notes: What its reader has to tell about it, a sentence each.
    """

    means: Float[np.ndarray, "n 3"]
    log_scales: Float[np.ndarray, "n 3"]
    quats: Float[np.ndarray, "n 4"]
    opacity_logits: Float[np.ndarray, " n"]
    sh: Float[np.ndarray, "n k 3"]
    origin: tuple[float, float, float] = NOWHERE
    place: SplatOrigin | None = None
    axes: Axes = "z up"
    metres: bool = False
    antialias: bool = False
    notes: tuple[str, ...] = ()
    _edits: tuple[Mapping[str, Any], ...] = ()

    def __post_init__(self) -> None:
        centres = _array(self.means, "means")
        object.__setattr__(self, "means", np.ascontiguousarray(centres, np.float32))
        for name in ARRAYS[1:]:
            object.__setattr__(self, name, np.ascontiguousarray(_array(getattr(self, name), name), np.float32))
        n = self.means.shape[0] if self.means.ndim else 0
        expected = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logits": (n,)}
        shapes = {name: getattr(self, name).shape for name in expected}
        if shapes != expected or self.sh.shape not in [(n, (degree + 1) ** 2, 3) for degree in range(4)]:
            listed = ", ".join(f"{name} {getattr(self, name).shape}" for name in ARRAYS)
            raise UsageError(f"The arrays have shapes that do not fit: {listed}.", hint="See splatpipe.Splat.")
        object.__setattr__(self, "origin", tuple(float(number) for number in self.origin))
        if centres.dtype != np.float32:
            self._take_off_origin(centres)

    def _take_off_origin(self, centres: NDArray[Any]) -> None:
        """Keep the accuracy of far coordinates.

        Raises:
            UsageError: if the splat has a place, about which its coordinates are.
        """
        middle = np.median(centres, axis=0) if len(centres) else np.zeros(3)
        taken = _origin_at(middle)
        if not taken.any():
            return
        if self.place is not None:
            raise UsageError(
                f"The splat lies {np.abs(middle).max():.0f} from its place.",
                hint="Give means about its place; or coordinates in a CRS without a place, and call georeferenced.",
            )
        object.__setattr__(self, "means", np.ascontiguousarray(centres - taken, np.float32))
        object.__setattr__(self, "origin", tuple((np.array(self.origin) + taken).tolist()))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Float[np.ndarray, "n 3"]:
        """Standard deviations along the Gaussian's own axes."""
        return np.asarray(np.exp(self.log_scales))

    @property
    def opacities(self) -> Float[np.ndarray, " n"]:
        """Opacities, 0 to 1."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.opacity_logits.astype(np.float64))), np.float32)

    @property
    def crs(self) -> str:
        """The CRS of a georeferenced splat; empty otherwise."""
        return "" if self.place is None else self.place.crs

    @classmethod
    def of_activated(
        cls,
        means: Float[np.ndarray, "n 3"],
        scales: Float[np.ndarray, "n 3"],
        quats: Float[np.ndarray, "n 4"],
        opacities: Float[np.ndarray, " n"],
        sh: Float[np.ndarray, "n k 3"],
        **where: Any,
    ) -> Splat:
        """A splat from scales and opacities in place of their logarithms and logits, as ``rasterization`` takes them.

        Args:
            means: As the attribute.
            scales: Positive.
            quats: As the attribute.
            opacities: 0 to 1.
            sh: As the attribute.
            where: Other attributes.

        Raises:
            SplatpipeError: if a scale is not positive, or an opacity not in its range.
        """
        sizes = _array(scales, "scales").astype(np.float64)
        shares = _array(opacities, "opacities").astype(np.float64)
        if not (sizes > 0.0).all() or not ((shares >= 0.0) & (shares <= 1.0)).all():
            raise UsageError("Scales must be positive, and opacities between 0 and 1.", hint="Activate them first.")
        kept = np.clip(shares, 1.0 - ALMOST_ONE, ALMOST_ONE)
        return cls(means, np.log(sizes), quats, np.log(kept / (1.0 - kept)), sh, **where)

    def turned(self, axes: Axes) -> Splat:
        """The same splat with other axes, harmonics included.

        Raises:
            SplatpipeError: if there are no such axes.
        """
        _check_axes(axes)
        return _splat(_scene(self).turned(axes))

    def transformed(self, similarity: Similarity) -> Splat:
        """The splat in another frame, z up, harmonics included; its place is lost, and far coordinates get an origin.

        Args:
            similarity: From its coordinates, ``means + origin`` along its own axes, to new ones, z up: as that of
                ``fit_similarity``.

        Raises:
            SplatpipeError: if the similarity is none.
        """
        import torch

        origin = np.array(self.origin)
        centre = np.median(self.means, axis=0) if len(self) else np.zeros(3)
        middle = similarity.apply((origin + centre)[None])[0]
        new = _origin_at(middle)
        shift = similarity.apply(origin[None])[0] - new
        rotation = torch.from_numpy(np.ascontiguousarray(similarity.rotation, np.float64))
        scene = _scene(replace(self, place=None, metres=False, axes="z up"))
        try:
            moved = scene.gaussians.transformed(float(similarity.scale), rotation, torch.from_numpy(shift))
        except ValueError as error:
            raise UsageError(f"The splat cannot be transformed: {error}.", hint="Check the similarity.") from error
        x, y, z = new.tolist()
        return _splat(replace(scene, gaussians=moved, facts=replace(scene.facts, offset=(x, y, z))))

    def georeferenced(self, crs: str, *, approximate: bool = False) -> Splat:
        """The splat placed on the earth: its coordinates, ``means + origin`` turned to z up, are read in a CRS.

        Args:
            crs: ``EPSG:25832``, with heights ``EPSG:25832+7837``, ``+proj=…`` or ``WGS84 UTM 32N``.
            approximate: Accept a less accurate transformation where a grid is missing.

        Returns:
            Local east, north, up in metres about the splat's middle, with ``place``.

        Raises:
            SplatpipeError: if it has a place already, or the CRS cannot be used there.
        """
        from splatpipe.pipeline.delivery.placed_scene import placed_in_crs

        with user_errors():
            return _splat(placed_in_crs(_scene(self), crs, approximate))


def read_splat(path: Path | str, *, axes: Axes | None = None) -> Splat:
    """Read a splat: PLY, compressed PLY, SPZ, SOG, GLB, or a trainer's model folder, recognised by content.

    Coordinates far from zero, also those in float64, keep their accuracy: see ``Splat.origin``. Files may come from
    anybody: sizes are limited, and broken ones are refused.

    Args:
        path: The file or folder.
        axes: Which way is up, where the file does not say it and its format's convention is wrong.

    Raises:
        SplatpipeError: if it is missing, of an unknown format, or broken.
    """
    from splatpipe.pipeline.splat.formats.files import read_scene

    if axes is not None:
        _check_axes(axes)
    with user_errors():
        splat = _splat(read_scene(Path(path).expanduser()))
    return splat if axes is None else replace(splat, axes=axes)


def write_splat(path: Path | str, splat: Splat, *, format: str | None = None) -> tuple[str, ...]:  # noqa: A002
    """Write a splat, with its place, CRS and origin; an existing file is replaced.

    Args:
        path: The file or folder; its suffix sets the format: ``.ply``, ``.viewer.ply``, ``.compressed.ply``, ``.spz``,
            ``.sog``, ``.glb``, none for a model folder.
        splat: The splat.
        format: The format, if the suffix does not set it: ``spz2``, ``model``, and the folders ``tiles`` (3D Tiles, for
            a georeferenced splat) and ``streamed-sog``. See docs/formats.md.

    Returns:
        What should be known about the file, a sentence each: what its positions lose, how well its place is known.

    Raises:
        SplatpipeError: if the splat is not valid, the format cannot hold it, or the file cannot be written.
    """
    from splatpipe.pipeline.app.library.splat_folders import FOLDERS
    from splatpipe.pipeline.splat.formats.files import format_of_name, write_scene

    path = Path(path).expanduser()
    with user_errors():
        scene = _scene(splat)
        if not len(splat) or not bool(scene.gaussians.finite().all()):
            raise SplatpipeError("The splat is empty, or has numbers that are not finite.", hint="Check its arrays.")
        if format in FOLDERS:
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise UsageError(f"{path} exists already.", hint="Name a new folder, or an empty one.")
            return FOLDERS[format](path, scene)
        return write_scene(path, scene, format_of_name(path, format)).warnings()


def _array(values: Any, name: str) -> NDArray[Any]:
    """Numbers as an array, without the gradients of a tensor.

    Raises:
        UsageError: if they are none.
    """
    try:
        found = np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)
        return found if found.dtype == np.float32 else found.astype(np.float64)
    except (ValueError, TypeError, RuntimeError) as error:
        raise UsageError(f"{name} is not an array of numbers.", hint="See splatpipe.Splat.") from error


def _origin_at(middle: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """What to take off the coordinates of a splat with this middle: whole units, zeros if it is near."""
    return np.rint(middle) if FAR < np.abs(middle).max() < np.inf else np.zeros(3)


def _check_axes(axes: str) -> None:
    if axes not in get_args(Axes):
        raise UsageError(f'There are no axes "{axes}".', hint=f"Choose from {', '.join(get_args(Axes))}.")


def _scene(splat: Splat) -> Scene:
    """The internal form.

    Raises:
        UsageError: if its axes, place or origin are not valid.
    """
    import torch

    from splatpipe.pipeline.splat.model.gaussians import Gaussians
    from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, facts_of_record

    try:
        gaussians = Gaussians(*(torch.from_numpy(getattr(splat, name).copy()) for name in ARRAYS))
        facts = SceneFacts(splat.axes, splat.antialias, splat.metres, splat.place, splat._edits, splat.origin)
        if facts_of_record(facts.record(), SceneFacts()) != facts:
            raise ValueError("its axes, place or origin are not valid")
    except (ValueError, TypeError) as error:
        raise UsageError(f"The splat is not valid: {error}.", hint="See docs/library.md for its arrays.") from error
    return Scene(gaussians, facts, splat.notes)


def _splat(scene: Scene) -> Splat:
    facts = scene.facts
    arrays = {name: tensor.detach().numpy() for name, tensor in scene.gaussians.tensors().items()}
    return Splat(
        **arrays,
        origin=facts.offset,
        place=facts.place,
        axes=facts.axes,
        metres=facts.metres,
        antialias=facts.antialias,
        notes=scene.notes,
        _edits=facts.edits,
    )
