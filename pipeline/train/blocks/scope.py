"""The scope of each block (its windows and surroundings), computed once for all blocks from all photos' coverages.

It is stored in the artifact of the stage `blocks`, one file per block and one for the free space of all photos: no
block has to render depths again or read all sparse points with their tracks, whose memory grows with the photos.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.splat.containers.archives import read_archive
from splatpipe.pipeline.splat.containers.ply import read_splat, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import FreeSpace, PhotoBounds
from splatpipe.pipeline.train.blocks.block_windows import Parts, WindowScheme
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage
from splatpipe.pipeline.train.blocks.cells.sample_mask import SampleMask, counted_samples
from splatpipe.pipeline.train.blocks.cells.surroundings import BlockSurroundings, visible_around
from splatpipe.pipeline.train.blocks.cells.visibility import BlockPhoto, BlockViews

FROZEN = "frozen.ply"
FREE = "free_space.npz"
_LEVEL = "level_"
_SAMPLE_MASK = "counted_"


@dataclass(frozen=True, eq=False)
class BlockScope:
    """The scope of one block; photos are identified by their rows among the training photos.

    Attributes:
        windows: The windows that it trains on.
        sample_masks: The part of each photo that counts.
        around: What the windows see of the coarse model besides the block.
    """

    windows: Parts
    sample_masks: dict[int, SampleMask]
    around: BlockSurroundings

    @staticmethod
    def of(
        partition: Partition,
        block: int,
        windows: Parts,
        cut: WindowScheme,
        scene: tuple[Gaussians, Sequence[PhotoCoverage], Float64[np.ndarray, "p 3"]],
    ) -> BlockScope:
        """Compute a block's scope.

        Args:
            partition: The cells.
            block: The block's number.
            windows: The windows that it trains on.
            cut: How photos are cut into windows.
            scene: The coarse model, all photos' coverages and all sparse points.
        """
        coarse, seen, xyz = scene
        rows, photos, frames = rows_of(windows), [], []
        for place, row in enumerate(rows):
            each = [cut.windows(seen[row].camera, level) for level in windows]
            chosen = []
            for pairs, at_level in zip(windows.values(), each, strict=True):
                mask = np.zeros(len(at_level), np.bool_)
                mask[pairs[pairs[:, 0] == row, 1]] = True
                chosen.append(mask)
            photos.append(BlockPhoto(place, np.concatenate(chosen), 0, 0.0, 0.0))
            frames.append(np.concatenate(each))
        view = (BlockViews(tuple(photos)), [seen[row] for row in rows], frames)
        sample_masks = {row: counted_samples(partition, block, seen[row], xyz) for row in rows}
        return BlockScope(windows, sample_masks, visible_around(partition, block, coarse, view))

    def write(self, folder: Path, block: int) -> None:
        """Write the scope to a folder shared by all blocks."""
        arrays: dict[str, npt.NDArray[Any]] = {f"{_LEVEL}{level}": pairs for level, pairs in self.windows.items()}
        arrays |= {f"{_SAMPLE_MASK}{row}": grid for row, grid in self.sample_masks.items()}
        arrays |= {"rows": self.around.rows.astype(np.int32), "units": self.around.units}

        def write(file: IO[bytes]) -> None:
            np.savez_compressed(file, allow_pickle=False, **arrays)

        write_durably(_path(folder, block), write)

    @staticmethod
    def read(folder: Path, block: int) -> BlockScope:
        """The inverse of ``write``.

        Raises:
            StageError: if it is missing or broken.
        """
        path = _path(folder, block)
        try:
            arrays = read_archive(path)
            windows = {int(level): pairs for level, pairs in _named(arrays, _LEVEL)}
            sample_masks = {int(row): grid for row, grid in _named(arrays, _SAMPLE_MASK)}
            if sorted(sample_masks) != rows_of(windows):
                raise ValueError("other photos count than are looked at")
            return BlockScope(
                windows, sample_masks, BlockSurroundings(arrays["rows"].astype(np.int64), arrays["units"])
            )
        except (OSError, ValueError, KeyError, IndexError) as error:
            raise StageError(f"{path.name} cannot be read.", hint="Run again with --rerun-from blocks.") from error


@dataclass(frozen=True, eq=False)
class ScopeReader:
    """Reads the scope of a block that is being trained.

    Attributes:
        prospects: Folder of the scopes.
        coarse: Output folder of the coarse pass.
        partition: The cells.
        number: Number of the block.
        views: All training photos.
        cut: How they are cut into windows.
        most_frozen: Maximum number of frozen Gaussians rendered around the block.
    """

    prospects: Path
    coarse: Path
    partition: Partition
    number: int
    views: Sequence[View]
    cut: WindowScheme
    most_frozen: int

    def scope(self) -> BlockScope:
        """The block's scope.

        Raises:
            StageError: if it is missing or broken.
        """
        return BlockScope.read(self.prospects, self.number)

    def frozen(self, out: Path) -> Gaussians:
        """The frozen Gaussians around the block, also kept in its folder for inspecting its checkpoints.

        Args:
            out: The block's folder.
        """
        try:
            return read_splat(out / FROZEN)
        except (OSError, SplatpipeError):
            made = self.scope().around.within(read_splat(self.coarse / "model.ply"), self.most_frozen)
            write_splat(out / FROZEN, made)
            return read_splat(out / FROZEN)

    def start(self, most: int) -> Gaussians:
        """The coarse model's Gaussians in the cell and its margin; the most opaque if there are more than ``most``."""
        coarse = read_splat(self.coarse / "model.ply")
        inside = self.partition.trained_by(self.number, coarse.means.double().numpy())
        rows = torch.from_numpy(np.flatnonzero(inside))
        if len(rows) > most:
            order = torch.argsort(coarse.opacity_logits[rows], descending=True, stable=True)
            rows = rows[order[:most]].sort().values
        return coarse.select(rows)


def write_free_space(folder: Path, space: FreeSpace) -> None:
    """Write the free space of all photos to a folder."""
    photos = space.photos
    arrays = {
        "support": space.support,
        "near": np.array([photo.near for photo in photos], np.float64),
        "shapes": np.array([photo.depth.shape for photo in photos], np.int64).reshape(-1, 2),
        "depths": np.concatenate([np.zeros(0), *(photo.depth.ravel() for photo in photos)]),
        "boxes": np.concatenate([np.zeros((4, 0)), *(photo.box.reshape(4, -1) for photo in photos)], axis=1),
    }

    def write(file: IO[bytes]) -> None:
        np.savez_compressed(file, allow_pickle=False, **arrays)

    write_durably(folder / FREE, write)


def read_free_space(folder: Path, cameras: Sequence[Camera]) -> FreeSpace:
    """The inverse of ``write_free_space``.

    Args:
        folder: The folder written to.
        cameras: Cameras of all training photos, in order.

    Raises:
        StageError: if it is missing or broken.
    """
    try:
        arrays = read_archive(folder / FREE)
        photos, start = [], 0
        for camera, near, (rows, columns) in zip(
            cameras, arrays["near"].tolist(), arrays["shapes"].tolist(), strict=True
        ):
            end = start + rows * columns
            depth, box = arrays["depths"][start:end], arrays["boxes"][:, start:end]
            photos.append(PhotoBounds(camera, depth.reshape(rows, columns), box.reshape(4, rows, columns), near))
            start = end
        return FreeSpace(tuple(photos), arrays["support"])
    except (OSError, ValueError, KeyError) as error:
        raise StageError(f"{FREE} cannot be read.", hint="Run again with --rerun-from blocks.") from error


def rows_of(windows: Parts) -> list[int]:
    """Rows of the windows' photos, ascending."""
    return sorted({row for pairs in windows.values() for row in pairs[:, 0].tolist()})


def _path(folder: Path, block: int) -> Path:
    return folder / f"block_{block + 1}.npz"


def _named(arrays: dict[str, npt.NDArray[Any]], prefix: str) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """The arrays whose names begin with a prefix, with the rest of the name."""
    return ((name.removeprefix(prefix), array) for name, array in arrays.items() if name.startswith(prefix))
