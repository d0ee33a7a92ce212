"""Captures of known cameras anywhere on earth: their metadata, and their sparse model in a frame of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.geometry.upright import display_from_stored, enu_from_gimbal
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import Exif, Gps
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.crs.world import in_crs
from splatpipe.pipeline.survey.placing.assumed_heights import with_assumed_heights
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import georeference
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.plausibility.last_look import Contradiction, Placed, report_contradictions
from splatpipe.pipeline.survey.plausibility.position_issues import find_position_issues
from splatpipe.pipeline.survey.positions.photo_positions import positions_json, read_positions

Array = NDArray[np.float64]
WORLD_FROM_MODEL = Similarity(6.5, rotation_from_vector(np.array([1.9, -0.7, 0.4])), np.array([12.0, -7.0, 3.0]))
ALPS = Origin(47.84, 13.51, 520.0)
NOISE_M = 0.4


@dataclass(frozen=True)
class Site:
    """A flight over a scene.

    Attributes:
        centres: Cameras: east, north, up of ``place``, in the order of time.
        yaw_deg: Of the camera.
        pitch_deg: Likewise; -90 looks down.
        ground: Points of the scene.
        place: Zero of both.
        nose_deg: Of the aircraft; None for the camera's yaw.
        step_s: Between photos; None where no time is known.
        takeoff_m: Height of the take-off point.
        orientation: EXIF's.
        tags: Which of XMP's tags there are: ``angles``, ``nose``, ``height``, ``place``.
        altitude: Whether EXIF states one.
        noise_m: Of the positions.
        compass_deg: By which stated headings are off.
    """

    centres: Array
    yaw_deg: Array
    pitch_deg: Array
    ground: Array
    place: Origin = ALPS
    nose_deg: Array | None = None
    step_s: float | None = 3.0
    takeoff_m: float = 0.0
    orientation: int = 1
    tags: Sequence[str] = ("angles", "nose", "height", "place")
    altitude: bool = True
    noise_m: float = NOISE_M
    compass_deg: float = 0.0

    def geodetic(self) -> Array:
        """Latitude, longitude, height of the cameras as measured."""
        noise = np.random.default_rng(0).normal(size=self.centres.shape) * self.noise_m
        return np.asarray(self.place.geodetic_from_enu(self.centres + noise))

    def names(self) -> list[str]:
        """The photos."""
        return [f"{k:03d}.jpg" for k in range(len(self.centres))]

    def model(self) -> SparseModel:
        """The true model in its own frame."""
        from_world = WORLD_FROM_MODEL.inverse()
        enu_from_upright = enu_from_gimbal(self.yaw_deg, self.pitch_deg, np.zeros(len(self.centres)))
        enu_from_camera = enu_from_upright @ display_from_stored(self.orientation)
        return SparseModel(
            self.names(),
            from_world.apply(self.centres),
            np.swapaxes(enu_from_camera, 1, 2) @ WORLD_FROM_MODEL.rotation,
            from_world.apply(self.ground),
            tuple(range(len(self.centres))),
            pycolmap.Reconstruction(),
        )

    def photos(self, geodetic: Array | None = None) -> list[CheckedPhoto]:
        """The photos with metadata; EXIF's position is another one if given."""
        true = self.geodetic()
        stated = true if geodetic is None else geodetic
        nose = self.yaw_deg if self.nose_deg is None else self.nose_deg
        found = []
        for k, name in enumerate(self.names()):
            tags: dict[str, float] = {}
            if "angles" in self.tags:
                tags |= {"GimbalYawDegree": self.yaw_deg[k] + self.compass_deg, "GimbalPitchDegree": self.pitch_deg[k]}
                tags |= {"GimbalRollDegree": 0.0}
            if "nose" in self.tags:
                tags |= {"FlightYawDegree": nose[k] + self.compass_deg}
            if "height" in self.tags:
                tags |= {"RelativeAltitude": self.centres[k, 2] - self.takeoff_m}
            if "place" in self.tags:
                tags |= {"GpsLatitude": stated[k, 0], "GpsLongitude": stated[k, 1]}
            gps = Gps(stated[k, 0], stated[k, 1], float(true[k, 2]) if self.altitude else None)
            seconds = 36_000.0 + k * (self.step_s or 0.0)
            clock = f"{int(seconds // 3600):02d}:{int(seconds // 60) % 60:02d}:{int(seconds) % 60:02d}"
            time = None if self.step_s is None else f"2026-05-01T{clock}"
            exif = Exif(make="DJI", model="M3E", gps=gps, time=time, orientation=self.orientation)
            xmp = {f"drone-dji:{key}": f"{value:.9f}" for key, value in tags.items()}
            found.append(CheckedPhoto(name, Path(name), "0" * 64, 400, 300, name, True, False, None, exif, xmp))
        return found


@dataclass(frozen=True)
class Outcome:
    """What is told of a capture.

    Attributes:
        issues: What the metadata shows, by code.
        stopped: Why the positions do not place the model; empty if they do.
        contradictions: What the result contradicts.
        placed: The result.
        warnings: Reported contradictions.
    """

    issues: Mapping[str, str]
    stopped: str
    contradictions: tuple[Contradiction, ...] = ()
    placed: Placed | None = None
    warnings: list[str] = field(default_factory=list)

    @property
    def says(self) -> str:
        """All contradictions."""
        return " ".join(f"{each.text} {each.hint}" for each in self.contradictions)


class Warnings(list[str]):
    """A reporter that records warnings."""

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None: ...

    def warning(self, message: str, hint: str = "") -> None:
        self.append(message)


def place(site: Site, photos: Sequence[CheckedPhoto] | None = None, crs: str = "auto") -> Outcome:
    """Georeference a capture by its positions as the stages ingest and georef do."""
    checked = list(site.photos() if photos is None else photos)
    read = read_positions(checked)
    issues = {issue.code: issue.message for issue in find_position_issues(checked, read)}
    value, model = positions_json(read), site.model()
    records = {record["name"]: record for record in value["positions"]}
    stated = Positions(records, value["orientations"], value.get("wrong", {}), value.get("elsewhere", {}))
    positions = with_assumed_heights(model, stated)
    listed = {
        photo.name: Photo(photo.name, photo.sha256, photo.width, photo.height, 0, photo.exif.time) for photo in checked
    }
    try:
        frame, _ = georeference(model, positions, "auto", listed)
    except FrameUndeterminedError as error:
        return Outcome(issues, str(error))
    placed, warnings = Placed(in_crs(frame, crs), model, positions, listed), Warnings()
    return Outcome(issues, "", tuple(report_contradictions(placed, warnings)), placed, warnings)


def flat(extent: float = 80.0, relief: float = 0.5, seed: int = 1) -> Array:
    """Ground about zero."""
    return np.random.default_rng(seed).uniform(-extent, extent, (200, 3)) * [1.0, 1.0, relief / extent]


def strips(
    heading_deg: float = 90.0, count: int = 4, each: int = 8, height: float = 50.0, pitch: float = -90.0
) -> Site:
    """A survey to and fro."""
    along, across = np.meshgrid(np.arange(each) * 12.0, np.arange(count) * 18.0)
    along, back = along.copy(), np.arange(count) % 2 == 1
    along[back] = along[back, ::-1]
    yaw = np.where(back, heading_deg + 180.0, heading_deg)[:, None].repeat(each, 1).ravel()
    turn = np.radians(heading_deg)
    a, b = along.ravel() - along.mean(), across.ravel() - across.mean()
    east, north = a * np.sin(turn) + b * np.cos(turn), a * np.cos(turn) - b * np.sin(turn)
    centres = np.stack([east, north, np.full(len(east), height)], axis=1)
    return Site(centres, (yaw + 180.0) % 360.0 - 180.0, np.full(len(yaw), pitch), flat())


def orbit(count: int = 20, radius: float = 30.0, height: float = 30.0, pitch: float = -35.0) -> Site:
    """Around a scene, looking inwards, flying sideways."""
    turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    centres = np.stack([radius * np.sin(turns), radius * np.cos(turns), np.full(count, height)], axis=1)
    yaw = (np.degrees(turns) + 360.0) % 360.0 - 180.0
    return Site(centres, yaw, np.full(count, pitch), flat(25.0))


def joined(*sites: Site) -> Site:
    """Several flights' photos in one site, one after the other."""
    parts = [(each.centres, each.yaw_deg, each.pitch_deg, each.ground) for each in sites]
    centres, yaw, pitch, ground = (np.concatenate(side) for side in zip(*parts, strict=True))
    return replace(sites[0], centres=centres, yaw_deg=yaw, pitch_deg=pitch, ground=ground)
