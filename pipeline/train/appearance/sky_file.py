"""The photos' sky masks in a file, so that they do not have to be detected again for every block."""

from __future__ import annotations

from collections.abc import Container, Mapping
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.splat.containers.archives import read_archive
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask


def write_skies(path: Path, masks: Mapping[str, SkyMask]) -> None:
    """Write sky masks by photo name; an empty set also gives a file."""
    names = sorted(masks)
    bits = [masks[name].bits for name in names]
    with new_file(path) as file:
        np.savez(
            file,
            allow_pickle=False,
            names=np.array(names, np.str_),
            shapes=np.array([masks[name].shape for name in names], np.int64).reshape(-1, 2),
            bits=np.concatenate([np.zeros(0, np.uint8), *bits]),
        )


def read_skies(path: Path, names: Container[str]) -> dict[str, SkyMask]:
    """Read the masks of some photos back; photos without sky are not in the result.

    Raises:
        StageError: if it is not such a file.
    """
    try:
        arrays = read_archive(path)
        shapes, bits = arrays["shapes"].astype(np.int64), arrays["bits"]
        sizes = -(-shapes.prod(axis=1) // 8)
        if bits.dtype != np.uint8 or len(bits) != int(sizes.sum()) or len(shapes) != len(arrays["names"]):
            raise ValueError("its masks are not of their sizes")
        found = {}
        for name, shape, end, size in zip(arrays["names"], shapes, np.cumsum(sizes), sizes, strict=True):
            if str(name) in names:
                found[str(name)] = SkyMask(bits[end - size : end].copy(), (int(shape[0]), int(shape[1])))
        return found
    except (OSError, ValueError, KeyError) as error:
        raise StageError(
            f"The skies of the coarse pass cannot be read: {error}.", hint="Run again with --rerun-from blocks."
        ) from error
