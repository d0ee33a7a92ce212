"""Checkpoints from which a killed training resumes: tensors and counts after an iteration, tied to one plan."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.splat.containers.archives import read_archive

CHECKPOINT_FORMAT = 1
_FACTS = "facts"


class BrokenCheckpointError(Exception):
    """A checkpoint from which training cannot resume; the message says why."""


class HostArrays(Mapping[str, npt.NDArray[Any]]):
    """Tensors as NumPy arrays, not copied; device tensors are fetched on access, since the host may not hold them all.

    Args:
        tensors: Tensors by name.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self._tensors = tensors

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        array: npt.NDArray[Any] = self._tensors[name].cpu().numpy()
        return array

    def __contains__(self, name: object) -> bool:
        return name in self._tensors

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint.

    Attributes:
        arrays: Every tensor of the state, by name; accessed one after the other.
        facts: Counts and curves as JSON values.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    facts: Mapping[str, Any]


def save_checkpoint(path: Path, plan_digest: str, checkpoint: Checkpoint) -> None:
    """Atomically replace the checkpoint at ``path``.

    The file is an uncompressed NumPy archive, whose checksums reveal damage.

    Raises:
        OSError: if it cannot be written; the previous checkpoint is kept.
    """
    header = {"format": CHECKPOINT_FORMAT, "plan": plan_digest, "facts": dict(checkpoint.facts)}
    facts = np.frombuffer(json.dumps(header).encode(), np.uint8)
    if _FACTS in checkpoint.arrays:
        raise ValueError(f"an array may not be called {_FACTS}")

    def write(file: IO[bytes]) -> None:  # like np.savez, which needs all arrays at once
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            _add_array(archive, _FACTS, facts)
            for name in checkpoint.arrays:
                _add_array(archive, name, checkpoint.arrays[name])

    write_durably(path, write)


def _add_array(archive: zipfile.ZipFile, name: str, array: npt.NDArray[Any]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def load_checkpoint(path: Path, plan_digest: str) -> Checkpoint:
    """Read a checkpoint back.

    Args:
        path: Path of the checkpoint.
        plan_digest: Digest of the plan that it must belong to.

    Raises:
        FileNotFoundError: if there is none.
        BrokenCheckpointError: if it is damaged, from another version, or for another plan.
    """
    try:
        arrays = read_archive(path)
        header = json.loads(arrays.pop(_FACTS).tobytes())
        found = (header["format"], header["plan"])
        facts = header["facts"]
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BrokenCheckpointError(f"it is damaged ({error})") from error
    if found[0] != CHECKPOINT_FORMAT:
        raise BrokenCheckpointError("it was written by another version")
    if found[1] != plan_digest:
        raise BrokenCheckpointError("it belongs to another plan")
    return Checkpoint(arrays, facts)
