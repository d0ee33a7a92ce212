"""The current model of a running training, and renders of it by our rasterizer."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from splatpipe.pipeline.delivery.delivery_frame import in_world
from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, StageError, card_fault
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.runs.run_folder import Contents
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_split, load_views
from splatpipe.pipeline.photos.pixels.images import Pixels, reduced_view
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.device import Device, choose_device, cpu
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.options import JUDGED_MEGAPIXELS
from splatpipe.pipeline.render.rendering import as_trained, placed, render_pixels
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians
from splatpipe.pipeline.splat.sky.panorama import Panorama, read_panorama
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.web.viewer import viewer_page
from splatpipe.pipeline.web.viewer_scene import SPLAT, viewer_rendering, viewer_scene, viewer_splat

CHECKPOINT, RENDERING = "checkpoint.npz", "rendering.json"  # in the folder of a running training
COARSE_SUMMARY = "coarse.json"  # in the folder of blocks not laid out yet: the coarse pass is done
FROZEN = "frozen.ply"  # beside a block's checkpoint: the fixed Gaussians rendered around it
COARSE_MODEL, COARSE_SKY = "model.ply", "sky.npz"  # files of the coarse pass of a scene in blocks
JPEG_QUALITY = 92
SKY = "sky.colours"  # array of a checkpoint
RENDER_BYTES = 1000  # GPU memory per Gaussian: 236 for parameters, 201 for a frame, 8 pairs of 64
LEFT_SHARE = 0.25  # GPU memory kept free for training, which permanently reduces its use if it ever runs short


@dataclass(frozen=True)
class ModelSource:
    """A model that can be shown.

    Attributes:
        path: Its file.
        kind: ``initial``, ``checkpoint``, ``coarse`` (whole scene, from which blocks start) or ``model`` (finished).
        stamp: Changes with its content.
        rendering: Its rendering settings; None before training has begun.
        sky: The finished sky beside a finished model, or that of a block.
        block: Number of the block whose checkpoint it is; 0 for the whole scene.
    """

    path: Path
    kind: str
    stamp: str
    rendering: Path | None
    sky: Path | None = None
    block: int = 0


@dataclass(frozen=True)
class LoadedModel:
    """A model loaded for rendering."""

    gaussians: Gaussians
    sky: Panorama | None
    options: rasterizer.RenderOptions
    megapixels: float | None
    iteration: int


def newest(contents: Contents) -> ModelSource | None:
    """The newest model of a training; None before it can begin."""
    if "train.model" in contents.parts:
        if "train.rendering" not in contents.parts:  # from an earlier version: its rendering settings are unknown
            return None
        part = contents.parts.get("clean.model", contents.parts["train.model"])
        rendering, sky = contents.parts["train.rendering"].path, contents.parts["train.sky"].path
        return ModelSource(part.path, "model", part.digest[:16], rendering, sky)
    folder = contents.working.get("train")
    for training, rendering, block in _trainings(contents):
        try:
            facts = (training / CHECKPOINT).stat()
            stamp = f"{facts.st_ino:x}-{facts.st_mtime_ns:x}"
            sky = rendering.with_name(COARSE_SKY)
            return ModelSource(
                training / CHECKPOINT, "checkpoint", stamp, rendering, sky if sky.is_file() else None, block
            )
        except OSError:
            continue
    coarse = _coarse(contents)
    if coarse is not None:
        done = {part.path: part.digest[:16] for name, part in contents.parts.items() if name == "blocks.coarse"}
        stamp = done.get(coarse) or f"{_mtime_ns(coarse / COARSE_MODEL):x}"
        return ModelSource(coarse / COARSE_MODEL, "coarse", stamp, coarse / RENDERING, coarse / COARSE_SKY)
    if "initialize.splat" in contents.parts:
        part = contents.parts["initialize.splat"]
        begun = folder is not None and (folder / RENDERING).is_file()
        return ModelSource(part.path, "initial", part.digest[:16], folder / RENDERING if folder and begun else None)
    return None


def _coarse(contents: Contents) -> Path | None:
    """The coarse pass's model of a scene in blocks; None without blocks, or before it is done."""
    part = contents.parts.get("blocks.coarse")
    if part is not None and (part.path / COARSE_MODEL).is_file():
        return part.path
    folder = contents.working.get("blocks")
    return folder / "coarse" if folder is not None and (folder / COARSE_SUMMARY).is_file() else None


def _trainings(contents: Contents) -> list[tuple[Path, Path, int]]:
    """Running trainings: checkpoint, rendering settings, and block number (0 for the whole scene or a coarse pass).

    The block updated last comes first.
    """
    found = []
    if "train" in contents.working:
        found.append((contents.working["train"], contents.working["train"] / RENDERING, 0))
    if (coarse := _coarse(contents)) is not None:
        blocks = [(_mtime_ns(folder / CHECKPOINT), name, folder) for name, folder in contents.working.items()]
        blocks = [each for each in blocks if each[1].startswith("train.")]
        for _, name, folder in sorted(blocks, reverse=True):
            found.append((folder, coarse / RENDERING, int(name.removeprefix("train."))))
    if "blocks" in contents.working:
        folder = contents.working["blocks"] / "coarse"
        found.append((folder, folder / RENDERING, 0))
    return found


def _mtime_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def iteration_of(source: ModelSource) -> int | None:
    """A model's training iteration; None if its file does not record it."""
    if source.kind == "initial":
        return 0
    try:
        if source.kind == "checkpoint":
            return int(_facts(source.path)["iteration"])
        manifest = read_json(source.path.parent / "manifest.json")
        return int(manifest["summary"]["iterations"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def load(source: ModelSource, contents: Contents) -> LoadedModel:
    """Read a model for rendering.

    Raises:
        SplatpipeError: if it cannot be read, e.g. if a checkpoint was replaced meanwhile.
    """
    if source.kind == "checkpoint":
        gaussians, sky = _from_checkpoint(source.path, contents)
        if sky is None and source.sky is not None:
            sky = read_panorama(source.sky)
    else:
        gaussians = read_splat(source.path)
        sky = read_panorama(source.sky) if source.sky is not None else None
    if source.rendering is None:
        return LoadedModel(gaussians, sky, rasterizer.RenderOptions(sh_degree=gaussians.sh_degree), None, 0)
    options, megapixels = as_trained(source.rendering, gaussians)
    return LoadedModel(gaussians, sky, options, megapixels, iteration_of(source) or 0)


def views_of(contents: Contents) -> tuple[View, ...]:
    """The training and held-out views; empty before they are undistorted."""
    part = contents.parts.get("undistort.dataset")
    if part is None:
        return ()
    folder = part.path.resolve()  # an OUT from elsewhere may refer to images outside it
    return tuple(view for view in load_views(part.path) if view.image_path.resolve().is_relative_to(folder))


def held_out_of(contents: Contents) -> Sequence[str]:
    """Names of the held-out photos; empty before they are chosen."""
    part = contents.parts.get("split.views")
    try:
        return () if part is None else load_split(part.path).held_out
    except StageError:
        return ()


def device_of(contents: Contents, logged: str) -> str:
    """The device that training was given, or that of the run if training is not done.

    Args:
        contents: The run.
        logged: The device of its last run, from its log.
    """
    done = contents.artifacts.get("train")
    machine = None if done is None else done.manifest.get("machine")
    return str(machine.get("device", logged)) if isinstance(machine, Mapping) else logged


def pictures(loaded: LoadedModel, view: View, threads: int, device: str = "auto") -> tuple[bytes, bytes]:
    """JPEGs of a render and of its photo, both at training size, 2 megapixels at most.

    Args:
        loaded: The model.
        view: The photo.
        threads: CPU threads.
        device: The run's device: with ``cpu``, rendered on the CPU, else on the GPU if the training leaves enough
            memory there, which is released afterwards.

    Raises:
        SplatpipeError: if the photo cannot be read.
    """
    camera, photo, _ = reduced_view(view, min(JUDGED_MEGAPIXELS, loaded.megapixels or JUDGED_MEGAPIXELS))
    with same_bits(threads):
        render = None if device == "cpu" else _render_on_gpu(loaded, camera)
        if render is None:
            render = _render(loaded, camera, cpu())
    return _jpeg(render), _jpeg(photo)


def _render_on_gpu(loaded: LoadedModel, camera: Camera) -> Pixels | None:
    """A render by the GPU; None without a GPU or with too little free memory."""
    try:
        device = choose_device("auto")
        if device.name == "cpu":
            return None
        free, whole = torch.cuda.mem_get_info(device.tensors)
        if free - RENDER_BYTES * len(loaded.gaussians) < LEFT_SHARE * whole:
            return None
        return _render(loaded, camera, device)
    except (torch.OutOfMemoryError, MachineError):
        return None
    except RuntimeError as error:
        if card_fault(error) is None:
            raise
        return None
    finally:
        with suppress(RuntimeError):  # again, of a card that failed
            torch.cuda.empty_cache()  # does nothing if CUDA was not used


def _render(loaded: LoadedModel, camera: Camera, device: Device) -> Pixels:
    return render_pixels(placed((loaded.gaussians, loaded.sky), device), camera, loaded.options)


def viewer(loaded: LoadedModel, source: ModelSource, contents: Contents, name: str) -> tuple[str, bytes]:
    """The 3D viewer's page of a model, and the splat file ``SPLAT`` that it loads from beside it.

    Args:
        loaded: The model.
        source: Its source.
        contents: The run.
        name: The run's name.

    Raises:
        SplatpipeError: if the run is not georeferenced yet or cannot be read.
    """
    if source.rendering is None or not {"georef.frame", "undistort.dataset"} <= set(contents.parts):
        raise SplatpipeError("There is nothing to show in 3D yet.")
    frame = load_frame(contents.parts["georef.frame"].path)
    gaussians = in_world(loaded.gaussians, frame)
    rendering = viewer_rendering(loaded.options, loaded.sky)
    dataset, held_out = contents.parts["undistort.dataset"].path, set(held_out_of(contents))
    title = f"{name}, iteration {loaded.iteration:,}"
    scene = viewer_scene(dataset, frame, rendering, held_out, len(gaussians), title)
    return viewer_page(scene, SPLAT), viewer_splat(gaussians, scene.antialias)


def _from_checkpoint(path: Path, contents: Contents) -> tuple[Gaussians, Panorama | None]:
    """The Gaussians as rendered, and the sky; only the arrays needed for that are read from the file."""
    try:
        with open_archive(path) as archive:
            tensors = {name: torch.from_numpy(archive[name]) for name in PARAMETERS}
            colours = torch.from_numpy(archive[SKY]) if SKY in archive.files else None
        gaussians = Gaussians.from_tensors(tensors)
    except Exception as error:  # zip, header and array readers raise almost anything on broken files
        raise SplatpipeError(f"The checkpoint cannot be read: {' '.join(str(error).split())[:120]}") from error
    gaussians = gaussians.select(gaussians.finite())
    frozen = path.with_name(FROZEN)
    if frozen.is_file():
        gaussians = Gaussians.concat([gaussians, read_splat(frozen)])
    sky = None
    if colours is not None and "georef.frame" in contents.parts:
        # A checkpoint does not store the up direction; the frame's is within a cell of it.
        up = load_frame(contents.parts["georef.frame"].path).world_from_model.rotation[2]
        sky = Panorama(np.asarray(up, np.float64), colours)
    return gaussians, sky


def _facts(checkpoint: Path) -> Mapping[str, int]:
    with open_archive(checkpoint) as archive:
        facts: Mapping[str, int] = json.loads(archive["facts"].tobytes())["facts"]
    return facts


def _jpeg(pixels: np.ndarray) -> bytes:
    done, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(pixels[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    if not done:
        raise SplatpipeError("A picture could not be coded as JPEG.")
    return bytes(data.tobytes())
