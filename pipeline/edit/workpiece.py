"""A splat being edited: its Gaussians are changed in place, in pieces, so that five million need no second copy.

Motions are accumulated as one similarity transform in float64 until something needs the moved Gaussians, so that a
rotation about a far point followed by a move back is rounded only once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64

from splatpipe.pipeline.delivery.delivery_frame import frame_of
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import NO_OFFSET, Scene, SceneFacts, turn_of
from splatpipe.pipeline.survey.crs.frames import Frame, Origin
from splatpipe.pipeline.survey.crs.world import open_world

ROWS = 1 << 18  # Gaussians at a time: their float64 coordinates, in a CRS and intermediate, take 50 MB
FAR_M = 10_000.0  # at this distance float32 coordinates have steps of a millimetre: the origin is moved nearer
MIDDLE_QUANTILES = (0.01, 0.99)  # quantiles along each axis that bound a splat's main extent, robust against floaters
MAX_STEP_SHARE = 1e-5  # largest float32 step as a share of the splat's size: a millimetre for a site of 100 m
SAMPLE = 200_000  # Gaussians from which a splat's extent is estimated
MIN_KEPT_SHARE = 0.5  # memory is released once fewer than this share of the Gaussians remains


class Workpiece:
    """A splat that edit steps modify.

    Args:
        scene: The splat; its tensors are changed in place.
    """

    def __init__(self, scene: Scene) -> None:
        self._gaussians, self.facts = scene.gaussians, scene.facts
        self._moved = Similarity.identity()  # pending motion, in the splat's frame rotated to z up
        self.travelled = Similarity.identity()  # from the frame as it was read to the present one
        self.merged = False
        self.notes: list[str] = []

    def __len__(self) -> int:
        return len(self._gaussians)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return self._gaussians.sh_degree

    @property
    def frame(self) -> Frame | None:
        """The georeferenced frame; None if the splat is not georeferenced."""
        return None if self.facts.place is None else frame_of(self.facts.place)

    def places(self) -> Iterator[tuple[slice, Float64[np.ndarray, "n 3"]]]:
        """Yield the rows and centres, in the frame, z up, of a bounded number of Gaussians at a time."""
        for start in range(0, len(self), ROWS):
            rows = slice(start, min(start + ROWS, len(self)))
            yield rows, self._placed(self._gaussians.means[rows])

    def sample(self) -> Float64[np.ndarray, "n 3"]:
        """Centres of an even sample of the Gaussians, in the frame."""
        step = max(1, -(-len(self) // SAMPLE))
        return self._placed(self._gaussians.means[::step])

    def middle(self) -> Float64[np.ndarray, " 3"]:
        """Centre, in the frame, of the box that excludes the outermost 1 % at either end of each axis."""
        low, high = np.quantile(self.sample(), MIDDLE_QUANTILES, axis=0)
        return np.asarray((low + high) / 2.0)

    def _placed(self, means: torch.Tensor) -> Float64[np.ndarray, "n 3"]:
        turned = means.double().numpy() @ turn_of("z up", self.facts.axes).numpy().T
        return self._moved.apply(turned)

    def keep(self, chosen: Bool[np.ndarray, " n"]) -> None:
        """Keep only the chosen Gaussians, in their order."""
        count = 0
        for start in range(0, len(self), ROWS):
            rows = slice(start, start + ROWS)
            mask = torch.from_numpy(chosen[rows])
            left = int(mask.sum())
            for tensor in self._gaussians.tensors().values():
                tensor[count : count + left] = tensor[rows][mask]
            count += left
        few = count < MIN_KEPT_SHARE * len(self)
        self._gaussians = self._gaussians.first(count)
        if few:
            self._gaussians = self._gaussians.clone()

    def move(self, similarity: Similarity) -> None:
        """Apply a similarity transform, given in the frame, to the whole splat."""
        self._moved = similarity.compose(self._moved)
        self.travelled = similarity.compose(self.travelled)

    def replace_gaussians(self, gaussians: Gaussians) -> None:
        """Replace the Gaussians by others, given in the splat's own axes."""
        self.with_motion_applied()
        self._gaussians = gaussians

    def with_motion_applied(self) -> Gaussians:
        """Apply the pending motion and return the Gaussians in the splat's own axes; not copied.

        Raises:
            SplatpipeError: if they are too far from the origin for float32.
        """
        if _is_identity(self._moved):
            return self._gaussians
        self._near_zero()
        turn = turn_of("z up", self.facts.axes)
        rotation = turn.T @ torch.from_numpy(np.ascontiguousarray(self._moved.rotation)) @ turn
        translation = turn.T @ torch.from_numpy(np.ascontiguousarray(self._moved.translation))
        for piece in self._gaussians.pieces():
            moved = piece.transformed(float(self._moved.scale), rotation, translation)
            for name, tensor in piece.tensors().items():
                tensor.copy_(getattr(moved, name))
        self._moved = Similarity.identity()
        return self._gaussians

    def scene(self) -> Scene:
        """The edited scene; not copied."""
        gaussians = self.with_motion_applied()
        return Scene(gaussians, self.facts)

    def _near_zero(self) -> None:
        """Make sure that float32 can hold the coordinates; a splat that knows its origin gets a nearer one if needed.

        Raises:
            SplatpipeError: if float32 would be too coarse.
        """
        sample = self.sample()
        low, high = np.quantile(sample, MIDDLE_QUANTILES, axis=0)
        middle = (low + high) / 2.0
        if self.facts.place is not None and float(np.linalg.norm(middle)) > FAR_M:
            self._take_zero(middle)
            sample = self.sample()
        elif self.facts.offset != NO_OFFSET and float(np.linalg.norm(middle)) > FAR_M:
            self._take_off(np.rint(middle))
            sample = self.sample()
        size = float(np.linalg.norm(high - low)) + self._moved.scale * _sigma(self._gaussians)
        before = self._moved.scale * _step(_largest(self._gaussians.means))  # the file was no finer before
        if not _step(float(np.abs(sample).max())) <= max(MAX_STEP_SHARE * size, before):
            raise SplatpipeError(
                "The splat would be too far from the origin for a file, whose coordinates are 32-bit numbers.",
                hint="Keep coordinates small; a georeferenced splat can be moved anywhere with --move-to.",
            )

    def _take_off(self, origin: Float64[np.ndarray, " 3"]) -> None:
        """Take an origin off the coordinates, beyond what is taken off already."""
        self.move(Similarity(1.0, np.eye(3), -origin))
        x, y, z = (turn_of(self.facts.axes, "z up").numpy() @ origin + self.facts.offset).tolist()
        self.facts = replace(self.facts, offset=(x, y, z))

    def _take_zero(self, middle: Float64[np.ndarray, " 3"]) -> None:
        place = self.facts.place
        assert place is not None
        old = Origin(place.latitude, place.longitude, place.height_m)
        latitude, longitude, height_m = old.geodetic_from_enu(middle[None])[0].tolist()
        new = Origin(latitude, longitude, height_m)
        self.move(between(old, new))
        placed = replace(place, latitude=latitude, longitude=longitude, height_m=height_m)
        try:
            open_world(frame_of(placed))
        except SplatpipeError:  # outside its CRS's area of use: fall back to the UTM zone
            placed = replace(placed, crs="")
        self.facts = replace(self.facts, place=placed)
        self.notes.append(
            f"Its origin is now at {latitude:.7f} {longitude:.7f}: at the old origin's distance, coordinates "
            "would be rounded."
        )


def between(source: Origin, target: Origin) -> Similarity:
    """The exact transform between two local east-north-up frames, through the earth-centred frame (EPSG:4978)."""
    if source == target:
        return Similarity.identity()
    from_source, from_target = source.ecef_from_enu(), target.ecef_from_enu()
    rotation = from_target[:3, :3].T @ from_source[:3, :3]
    return Similarity(1.0, rotation, from_target[:3, :3].T @ (from_source[:3, 3] - from_target[:3, 3]))


def _is_identity(similarity: Similarity) -> bool:
    return bool((similarity.matrix() == np.eye(4)).all())


def _step(size: float) -> float:
    """Spacing of float32 numbers at this magnitude; infinite beyond the largest."""
    return float(np.spacing(np.float32(size))) if size <= np.finfo(np.float32).max else np.inf


def _largest(values: torch.Tensor) -> float:
    return max(float(values.max()), -float(values.min())) if len(values) else 0.0


def _sigma(gaussians: Gaussians) -> float:
    """Median standard deviation along the longest axes, world units: a size even for a splat of one Gaussian."""
    step = max(1, -(-len(gaussians) // SAMPLE))
    return float(gaussians.log_scales[::step].amax(1).double().median().exp())


def facts_without_place(facts: SceneFacts) -> SceneFacts:
    """The facts without place and metres, for a splat whose scale is no longer known."""
    return replace(facts, place=None, metres=False)
