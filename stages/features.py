"""features: a COLMAP database of cameras, keypoints and descriptors, and the keypoints' colours."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
import pycolmap

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.engine.machine import available_memory_bytes, resident_bytes, threads_within
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import JSON, Inputs, Machine, Reporter, Summary
from splatpipe.pipeline.photos.files.names import list_names
from splatpipe.pipeline.photos.files.photo_list import PhotoList, load_photo_list
from splatpipe.pipeline.sfm.matching.keypoints import Bytes, extract, extraction_bytes, single_threaded_opencv
from splatpipe.pipeline.sfm.options import FeaturesConfig
from splatpipe.pipeline.sfm.recovery.refusal import little_texture, texture_hint

MIN_KEYPOINTS = 16  # COLMAP needs 15 inliers per pair; a photo with fewer keypoints can never be placed


def run(config: FeaturesConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write ``database.db`` and ``colours.npy``; image ids are 1, 2, … in name order, camera ids 1, 2, … by group.

    Raises:
        SplatpipeError: if no photo has enough keypoints.
        MachineError: if memory is too small for a single photo.
    """
    photo_list = load_photo_list(inputs["ingest.photos"])
    cameras = read_json(inputs["ingest.cameras"])["cameras"]
    threads = _threads(config, photo_list, inputs.machine)
    counts: list[int] = []
    colours: list[Bytes] = []
    with (
        tempfile.TemporaryDirectory(prefix="scratch-", dir=out, ignore_cleanup_errors=True) as scratch,
        single_threaded_opencv(),
        pycolmap.Database.open(out / "database.db") as database,
    ):
        _write_cameras(database, cameras, photo_list)
        work = partial(
            extract,
            config=config,
            part=inputs["ingest.photos"],
            photos_dir=inputs.photos_dir,
            scratch=Path(scratch),
        )
        found = ordered_map(work, photo_list.photos, threads)
        for number, features in enumerate(found, start=1):
            database.write_keypoints(number, features.keypoints)
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, features.descriptors))
            counts.append(len(features.keypoints))
            colours.append(features.colours)
            report.progress(number, len(photo_list), "finding keypoints", "photos")
    with new_file(out / "colours.npy") as file:
        np.save(file, np.concatenate(colours))
    _check(photo_list, counts, report)
    return {
        "photos": len(photo_list),
        "keypoints": sum(counts),
        "keypoints_per_photo": round(sum(counts) / len(counts)),
        "cameras": len(cameras),
    }


def _threads(config: FeaturesConfig, photo_list: PhotoList, machine: Machine) -> int:
    """Number of photos in work at once, as memory allows.

    Raises:
        MachineError: if it is too small for the largest one.
    """
    sizes = [(photo.width * photo.height, max(photo.width, photo.height)) for photo in photo_list.photos]
    each = max(extraction_bytes(config, *size) for size in sizes)
    needed, limit = resident_bytes() + each, available_memory_bytes()
    if 0 < limit < needed:
        raise MachineError(
            f"Finding the keypoints of one photo takes {needed / 1e9:.2f} GB of memory, and this machine or container "
            f"has {limit / 1e9:.2f} GB.",
            hint="Give it more memory, or use smaller images, such as --set features.max_image_size=1000.",
        )
    return threads_within(machine.threads, each, machine.memory_bytes)


def _check(photo_list: PhotoList, counts: list[int], report: Reporter) -> None:
    poor = [photo.name for photo, count in zip(photo_list.photos, counts, strict=True) if count < MIN_KEYPOINTS]
    if len(counts) - len(poor) < 2:
        raise SplatpipeError(
            "The photos have too little texture: they have hardly any keypoints.",
            hint=texture_hint((photo.width, photo.height) for photo in photo_list.photos),
        )
    if little_texture(counts):
        report.warning(
            f"The photos have little texture: {median(counts):.0f} keypoints a photo (median); few will match.",
            hint=texture_hint((photo.width, photo.height) for photo in photo_list.photos),
        )
    if poor:
        verb, what = ("has", "It is") if len(poor) == 1 else ("have", "They are")
        report.warning(
            f"{len(poor)} of {len(counts)} photos {verb} hardly any keypoints and cannot be placed:"
            f" {list_names(poor)}.",
            hint=f"{what} probably blurred, blank or masked.",
        )


def _write_cameras(database: pycolmap.Database, cameras: list[JSON], photo_list: PhotoList) -> None:
    """A camera and a trivial rig for each group, an image and a frame for each photo."""
    for number, group in enumerate(cameras, start=1):
        camera = pycolmap.Camera(
            camera_id=number,
            model=group["model"],
            width=group["width"],
            height=group["height"],
            params=group["params"],
            has_prior_focal_length=group["has_prior"],
        )
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for number, photo in enumerate(photo_list.photos, start=1):
        image = pycolmap.Image(name=photo.name, camera_id=photo.camera + 1, image_id=number)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=number, rig_id=photo.camera + 1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
