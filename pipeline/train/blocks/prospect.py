"""What a block looks at and what it draws around itself, worked out once and kept beside its checkpoint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import torch

from splatpipe.pipeline.engine.durable import write_durably
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.dataset import View, load_points_and_tracks
from splatpipe.pipeline.raster.device import Device
from splatpipe.pipeline.splat.archives import read_archive
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import read_splat, write_splat
from splatpipe.pipeline.train.blocks.outlook import Cut, Parts, each_sight, parts_of, seen_windows
from splatpipe.pipeline.train.blocks.partition import Partition
from splatpipe.pipeline.train.blocks.sight import Sight
from splatpipe.pipeline.train.blocks.sighted import Sighted, sighted
from splatpipe.pipeline.train.blocks.surroundings import surroundings
from splatpipe.pipeline.train.blocks.visibility import BlockPhoto, BlockViews

SEEN = "seen.npz"
FROZEN = "frozen.ply"
_LEVEL = "level_"
_COUNTED = "counted_"


@dataclass(frozen=True, eq=False)
class Surveyor:
    """Who works it out.

    Attributes:
        dataset: The photos and the sparse points.
        coarse: The folder that the coarse pass left.
        partition: The cells.
        number: Of the block.
        views: All photos trained on.
        cut: How they are cut into windows.
        most_frozen: Gaussians that are drawn around the block.
        device: Renders what photos see.
    """

    dataset: Path
    coarse: Path
    partition: Partition
    number: int
    views: Sequence[View]
    cut: Cut
    most_frozen: int
    device: Device

    def parts(self, out: Path, report: Reporter) -> Parts:
        """The windows that the block trains on; their rows are those of ``views``.

        They, what of their photos counts (``counted``) and the frozen Gaussians (``frozen``) are kept in files: a run
        that goes on takes them as they are.

        Args:
            out: The block's folder.
            report: Takes progress.

        Raises:
            StageError: if the dataset or the coarse pass is broken.
        """
        try:
            arrays = read_archive(out / SEEN)
            read_splat(out / FROZEN)
            return {int(number): array for number, array in _named(arrays, _LEVEL)}
        except (OSError, ValueError, SplatpipeError):
            return self._work_out(out, report)

    def frozen(self, out: Path) -> Gaussians:
        """What is drawn around the block."""
        return read_splat(out / FROZEN)

    def counted(self, out: Path) -> dict[int, Sighted]:
        """What counts of each photo that the windows are of, by its row."""
        return {int(row): grid for row, grid in _named(read_archive(out / SEEN), _COUNTED)}

    def start(self, most: int) -> Gaussians:
        """What the coarse model has in the cell and its margin; the most opaque where it is more than ``most``."""
        coarse = read_splat(self.coarse / "model.ply")
        inside = self.partition.trained_by(self.number, coarse.means.double().numpy())
        rows = torch.from_numpy(np.flatnonzero(inside))
        if len(rows) > most:
            order = torch.argsort(coarse.opacity_logits[rows], descending=True, stable=True)
            rows = rows[order[:most]].sort().values
        return coarse.select(rows)

    def _work_out(self, out: Path, report: Reporter) -> Parts:
        coarse = read_splat(self.coarse / "model.ply")
        points, tracks = load_points_and_tracks(self.dataset)
        observed = [tracks[view.camera.name] for view in self.views]
        shown, seen = [], {}
        for row, sight in enumerate(each_sight(self.coarse, coarse, self.views, observed, self.device)):
            by_level = seen_windows(self.partition, sight, points.xyz, self.cut)
            shown.append({level: cells[self.number : self.number + 1].copy() for level, cells in by_level.items()})
            if any(cells.any() for cells in shown[-1].values()):
                seen[row] = sight
            report.progress(row + 1, len(self.views), "looking for what shows the block", "photos")
        parts = parts_of(shown, 0)
        write_splat(out / FROZEN, self._surroundings(coarse, parts, seen))

        arrays = {f"{_LEVEL}{level}": pairs for level, pairs in parts.items()}
        for row, sight in seen.items():
            arrays[f"{_COUNTED}{row}"] = sighted(self.partition, self.number, sight, points.xyz)

        def write(file: IO[bytes]) -> None:
            np.savez_compressed(file, allow_pickle=False, **arrays)

        write_durably(out / SEEN, write)
        return parts

    def _surroundings(self, coarse: Gaussians, parts: Parts, seen: dict[int, Sight]) -> Gaussians:
        """What the block's windows, at any level, see of the coarse model besides."""
        rows, photos, windows = sorted(seen), [], []
        for place, row in enumerate(rows):
            each = [self.cut.windows(seen[row].camera, level) for level in parts]
            chosen = []
            for pairs, at_level in zip(parts.values(), each, strict=True):
                mask = np.zeros(len(at_level), np.bool_)
                mask[pairs[pairs[:, 0] == row, 1]] = True
                chosen.append(mask)
            photos.append(BlockPhoto(place, np.concatenate(chosen), 0, 0.0, 0.0))
            windows.append(np.concatenate(each))
        view = (BlockViews(tuple(photos)), [seen[row] for row in rows], windows)
        return surroundings(self.partition, self.number, coarse, view, self.most_frozen).frozen


def _named(arrays: dict[str, npt.NDArray[Any]], prefix: str) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """The arrays whose names begin so, with the rest of the name."""
    return ((name.removeprefix(prefix), array) for name, array in arrays.items() if name.startswith(prefix))
