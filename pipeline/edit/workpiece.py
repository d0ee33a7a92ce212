"""A splat at work: its Gaussians are changed in place, piece by piece, so that five million fit where they lie.

Motions are kept as one similarity in float64 until something needs the Gaussians where they are: what is turned about
a far point and moved back is rounded once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.scene import Scene, SceneFacts, turn_of
from splatpipe.pipeline.survey.frames import Frame, Origin
from splatpipe.pipeline.survey.handover import frame_of
from splatpipe.pipeline.survey.world import open_world

ROWS = 1 << 18  # Gaussians at a time: places in float64, in a CRS and on the way there take 50 MB
FAR_M = 10_000.0  # from its zero a splat's float32 has steps of a millimetre: a nearer zero is taken
MIDDLE = (0.01, 0.99)  # shares along each axis between which a splat's middle is: a floater does not move it
COARSEST = 1e-5  # float32's step as a share of the splat: a millimetre of a site of 100 m
SAMPLE = 200_000  # Gaussians that tell where a splat is
FREED = 0.5  # share of the Gaussians that is given back to the machine when so many are gone


class Workpiece:
    """A splat that steps change.

    Args:
        scene: Taken over: its tensors are changed in place.
    """

    def __init__(self, scene: Scene) -> None:
        self._gaussians, self.facts = scene.gaussians, scene.facts
        self._moved = Similarity.identity()  # in the frame: the splat's, turned to z up
        self.travelled = Similarity.identity()  # from the frame as it was read to the present one
        self.merged = False
        self.notes: list[str] = []

    def __len__(self) -> int:
        return len(self._gaussians)

    @property
    def sh_degree(self) -> int:
        """Of the spherical harmonics."""
        return self._gaussians.sh_degree

    @property
    def frame(self) -> Frame | None:
        """The frame on the earth; None of a splat that lies nowhere."""
        return None if self.facts.place is None else frame_of(self.facts.place)

    def places(self) -> Iterator[tuple[slice, Float64[np.ndarray, "n 3"]]]:
        """Centres in the frame, z up, with the rows that they are of, a bounded number at a time."""
        for start in range(0, len(self), ROWS):
            rows = slice(start, min(start + ROWS, len(self)))
            yield rows, self._placed(self._gaussians.means[rows])

    def sample(self) -> Float64[np.ndarray, "n 3"]:
        """Centres of evenly chosen Gaussians in the frame."""
        step = max(1, -(-len(self) // SAMPLE))
        return self._placed(self._gaussians.means[::step])

    def middle(self) -> Float64[np.ndarray, " 3"]:
        """Middle of the box that holds all but the outermost hundredths along each axis, in the frame."""
        low, high = np.quantile(self.sample(), MIDDLE, axis=0)
        return np.asarray((low + high) / 2.0)

    def _placed(self, means: torch.Tensor) -> Float64[np.ndarray, "n 3"]:
        turned = means.double().numpy() @ turn_of("z up", self.facts.axes).numpy().T
        return self._moved.apply(turned)

    def keep(self, chosen: Bool[np.ndarray, " n"]) -> None:
        """Go on with the chosen Gaussians alone, in their order."""
        count = 0
        for start in range(0, len(self), ROWS):
            rows = slice(start, start + ROWS)
            mask = torch.from_numpy(chosen[rows])
            left = int(mask.sum())
            for tensor in self._gaussians.tensors().values():
                tensor[count : count + left] = tensor[rows][mask]
            count += left
        few = count < FREED * len(self)
        self._gaussians = self._gaussians.first(count)
        if few:
            self._gaussians = self._gaussians.clone()

    def move(self, similarity: Similarity) -> None:
        """Move all of it by a similarity of the frame."""
        self._moved = similarity.compose(self._moved)
        self.travelled = similarity.compose(self.travelled)

    def take(self, gaussians: Gaussians) -> None:
        """Go on with other Gaussians, in the splat's own axes."""
        self.settled()
        self._gaussians = gaussians

    def settled(self) -> Gaussians:
        """The Gaussians where they are now, in the splat's own axes; not copied.

        Raises:
            SplatpipeError: if they are too far from zero for float32.
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
        """What it has become; not copied."""
        gaussians = self.settled()
        return Scene(gaussians, self.facts)

    def _near_zero(self) -> None:
        """See to it that float32 holds its places: by another zero on the earth where it has one, or not at all."""
        sample = self.sample()
        low, high = np.quantile(sample, MIDDLE, axis=0)
        middle = (low + high) / 2.0
        if self.facts.place is not None and float(np.linalg.norm(middle)) > FAR_M:
            self._take_zero(middle)
            sample = self.sample()
        size = float(np.linalg.norm(high - low)) + self._moved.scale * _sigma(self._gaussians)
        before = self._moved.scale * _step(_largest(self._gaussians.means))  # what a file had already is no loss
        if not _step(float(np.abs(sample).max())) <= max(COARSEST * size, before):
            raise SplatpipeError(
                "The splat would be too far from the origin for a file, whose coordinates are 32-bit numbers.",
                hint="Keep coordinates small; a georeferenced splat can be moved anywhere with --move-to.",
            )

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
        except SplatpipeError:  # its CRS does not reach there: the UTM zone does
            placed = replace(placed, crs="")
        self.facts = replace(self.facts, place=placed)
        self.notes.append(
            f"Its origin is now at {latitude:.7f} {longitude:.7f}: at the old origin's distance, coordinates "
            "would be rounded."
        )


def between(source: Origin, target: Origin) -> Similarity:
    """From one local east-north-up frame to another's, exactly, through the earth-centred frame (EPSG:4978)."""
    if source == target:
        return Similarity.identity()
    from_source, from_target = source.ecef_from_enu(), target.ecef_from_enu()
    rotation = from_target[:3, :3].T @ from_source[:3, :3]
    return Similarity(1.0, rotation, from_target[:3, :3].T @ (from_source[:3, 3] - from_target[:3, 3]))


def _is_identity(similarity: Similarity) -> bool:
    return bool((similarity.matrix() == np.eye(4)).all())


def _step(size: float) -> float:
    """Between a float32 of this size and the next; infinite beyond the largest."""
    return float(np.spacing(np.float32(size))) if size <= np.finfo(np.float32).max else np.inf


def _largest(values: torch.Tensor) -> float:
    return max(float(values.max()), -float(values.min())) if len(values) else 0.0


def _sigma(gaussians: Gaussians) -> float:
    """Median of the standard deviations along the longest axes, world units: the size of a splat of one Gaussian."""
    step = max(1, -(-len(gaussians) // SAMPLE))
    return float(gaussians.log_scales[::step].amax(1).double().median().exp())


def facts_without_place(facts: SceneFacts) -> SceneFacts:
    """Of a splat whose lengths mean nothing any more."""
    return replace(facts, place=None, metres=False)
