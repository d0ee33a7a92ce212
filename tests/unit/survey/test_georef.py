"""Georeferencing of synthetic models: known cameras in a known place, with noisy and wrong positions."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.source import ABSENT, open_source
from splatpipe.pipeline.engine.stage import Inputs, Summary
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.photos.files.photo_list import Photo, PhotoList, save_photo_list
from splatpipe.pipeline.survey.crs.frames import Frame, load_frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.crs.georeference import georeference
from splatpipe.pipeline.survey.files.scale_bars import ScaleBar
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.targets.target_finds import TargetFind, WantedTargets, save_finds, save_wanted
from splatpipe.stages.georef import run

PLACE = Origin(46.84266, -91.994, 199.0)
TRUTH = Similarity(
    6.5, rotation_from_vector(np.array([1.9, -0.7, 0.4])), np.array([12.0, -7.0, 3.0])
)  # world from model
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # camera from world, its top to the north


@dataclass
class Notes:
    """A reporter that records."""

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


@dataclass
class Survey:
    """Cameras in the world, the positions that their photos state, and coded targets by number."""

    centres: np.ndarray
    cam_from_world: np.ndarray
    names: list[str]
    positions: list[dict[str, object]]
    targets: dict[int, np.ndarray] = field(default_factory=dict)
    bars: tuple[ScaleBar, ...] = ()
    control: str = ""

    def at(self, name: str) -> dict[str, object]:
        return next(record for record in self.positions if record["name"] == name)


def survey(centres: np.ndarray, sigma: tuple[float, float] = (1.5, 3.0), seed: int = 0, gimbal: bool = False) -> Survey:
    """Return nadir cameras with positions of the given accuracy."""
    rng = np.random.default_rng(seed)
    measured = centres + rng.normal(size=centres.shape) * [sigma[0], sigma[0], sigma[1]]
    names = [f"dji {i:03d} ä.jpg" for i in range(len(centres))]
    angles = (0.0, -90.0, 0.0) if gimbal else (None, None, None)
    positions: list[dict[str, object]] = []
    for name, (latitude, longitude, height) in zip(names, PLACE.geodetic_from_enu(measured), strict=True):
        record: dict[str, object] = {"name": name, "latitude": latitude, "longitude": longitude, "altitude_m": height}
        record |= {"sigma_horizontal_m": sigma[0], "sigma_vertical_m": sigma[1], "relative_altitude_m": None}
        positions.append(record | dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles, strict=True)))
    return Survey(centres, np.tile(DOWN, (len(centres), 1, 1)), names, positions)


def grid(columns: int = 6, rows: int = 5, step: float = 12.0, height: float = 40.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    z = height + 3.0 * np.sin(np.arange(x.size))
    return np.stack([x.ravel(), y.ravel(), z], axis=1)


def quaternion(rotation: np.ndarray) -> Sequence[float]:
    import pycolmap

    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    return w, x, y, z


def write_model(scene: Survey, folder: Path, points: np.ndarray | None = None) -> None:
    """The scene in its model frame, as COLMAP's text files."""
    folder.mkdir(parents=True)
    model_from_world = TRUTH.inverse()
    (folder / "cameras.txt").write_text("1 PINHOLE 4000 3000 2300 2300 2000 1500\n")
    lines = []
    for number, (name, pose) in enumerate(zip(scene.names, scene.cam_from_world, strict=True), 1):
        cam_from_model = pose @ TRUTH.rotation
        centre = model_from_world.apply(scene.centres[number - 1][None])[0]
        values = [*quaternion(cam_from_model), *(-cam_from_model @ centre)]
        lines.append(f"{number} {' '.join(map(repr, map(float, values)))} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines), encoding="utf-8")
    cloud = model_from_world.apply(GROUND if points is None else points)
    rows = [f"{i} {x!r} {y!r} {z!r} 9 9 9 0.5\n" for i, (x, y, z) in enumerate(cloud.tolist(), 1)]
    (folder / "points3D.txt").write_text("".join(rows))


GROUND = np.random.default_rng(1).uniform(-10, 70, (300, 3)) * [1.0, 1.0, 0.001]


def finds(scene: Survey) -> list[TargetFind]:
    """The targets in all photos that show them, accurate to a tenth of a pixel."""
    rng = np.random.default_rng(2)
    found = []
    for name, pose, centre in zip(scene.names, scene.cam_from_world, scene.centres, strict=True):
        for number, place in scene.targets.items():
            x, y, z = pose @ (place - centre)
            at = np.array([2300.0 * x / z + 2000.0, 2300.0 * y / z + 1500.0]) + rng.normal(size=2) * 0.1
            if z > 0.0 and (at > 0.0).all() and (at < [4000.0, 3000.0]).all():
                found.append(TargetFind(name, "4x4_50", number, *at.tolist(), 40.0, 0.1))
    return found


def ingested(folder: Path, positions: list[dict[str, object]], names: list[str]) -> dict[str, Path]:
    """The parts that ingest would write."""
    (folder / "positions.json").write_text(json.dumps({"positions": positions, "orientations": {}}))
    group = {"focal_px": 2300.0, "width": 4000, "has_prior": True, "focal_source": "35mm-equivalent"}
    (folder / "cameras.json").write_text(json.dumps({"cameras": [group]}))
    (folder / "lenses.json").write_text('{"lenses": [null]}')
    save_photo_list(PhotoList(tuple(Photo(name, "0" * 64, 4000, 3000, 0) for name in names)), folder)
    save_wanted(WantedTargets("", (), ()), folder / "points.json")
    save_finds((), folder / "targets.json")
    return {
        "ingest.positions": folder / "positions.json",
        "ingest.photos": folder,
        "ingest.cameras": folder / "cameras.json",
        "ingest.lenses": folder / "lenses.json",
        "source.control": ABSENT,
        "source.boundary": ABSENT,
        "control.points": folder / "points.json",
        "targets.found": folder / "targets.json",
    }


def georef(
    scene: Survey, tmp_path: Path, photos: list[str] | None = None, **options: object
) -> tuple[Frame, Summary, list[str]]:
    model, out = tmp_path / "model", tmp_path / "out"
    write_model(scene, model)
    out.mkdir()
    notes = Notes()
    parts = {"sparse.model": model} | ingested(tmp_path, scene.positions, scene.names if photos is None else photos)
    points = [line.split(",") for line in scene.control.splitlines()[2:]]
    wanted = [(name, float(x), float(y), float(z)) for name, x, y, z in points]
    save_wanted(WantedTargets(scene.control[:10], tuple(wanted), scene.bars), tmp_path / "points.json")
    save_finds(finds(scene), tmp_path / "targets.json")
    if scene.control:
        parts["source.control"] = tmp_path / "control.csv"
        parts["source.control"].write_text(scene.control)
    summary = run(GeorefConfig(**options), Inputs(parts, tmp_path / "photos"), out, notes)
    assert {path.name: path.read_bytes() for path in model.iterdir()} == {
        path.name: path.read_bytes() for path in (out / "sparse" / "0").iterdir()
    }
    return load_frame(out / "frame.json"), summary, notes.warnings


def errors_m(frame: Frame, scene: Survey) -> np.ndarray:
    """Distances between where the frame puts the cameras and where they are, on the earth."""
    assert frame.origin is not None
    placed = frame.world_from_model.apply(TRUTH.inverse().apply(scene.centres))
    return np.linalg.norm(PLACE.enu_from_geodetic(frame.origin.geodetic_from_enu(placed)) - scene.centres, axis=1)


@pytest.mark.parametrize(("sigma", "expected"), [((1.5, 3.0), 3.0), ((0.02, 0.03), 0.04)])
def test_positions_place_the_model(tmp_path: Path, sigma: tuple[float, float], expected: float) -> None:
    scene = survey(grid(), sigma)
    frame, summary, warnings = georef(scene, tmp_path)
    assert frame.kind == "enu"
    assert errors_m(frame, scene).max() < expected
    assert summary["positions_used"] == 30
    assert frame.residuals["rmse_horizontal_m"] == pytest.approx(sigma[0] * np.sqrt(2), rel=0.4)
    assert frame.residuals["rmse_vertical_m"] == pytest.approx(sigma[1], rel=0.4)
    assert set(frame.residuals["photos"]) == set(scene.names)
    assert frame.origin is not None
    assert (frame.origin.latitude, frame.origin.height_m) == (
        round(frame.origin.latitude, 5),
        round(frame.origin.height_m),
    )
    assert frame.vertical_datum == "unknown"
    assert warnings == []


def test_wrong_positions_are_named_and_left_out(tmp_path: Path) -> None:
    scene = survey(grid())
    wrong = [scene.names[i] for i in (3, 11, 20)]
    for name in wrong:
        scene.at(name)["latitude"] = float(str(scene.at(name)["latitude"])) + 0.001  # 111 m
    frame, summary, warnings = georef(scene, tmp_path)
    assert frame.left_out == tuple(wrong)
    assert summary["positions_left_out"] == 3
    assert errors_m(frame, scene).max() < 3.0
    assert any(all(name in warning for name in wrong) for warning in warnings)


def test_inaccurate_positions_are_reported_with_the_rms_of_the_table(tmp_path: Path) -> None:
    scene = survey(grid(), (15.0, 30.0))
    for record in scene.positions:
        record |= {"sigma_horizontal_m": 1.5, "sigma_vertical_m": 3.0}
    _, _, warnings = georef(scene, tmp_path)
    table = json.loads((tmp_path / "out" / "accuracy.json").read_text())["tables"]["gps"]
    expected = f"off by {table['rmse_horizontal_m']:.1f} m horizontally and {table['rmse_up_m']:.1f} m in height (RMS)"
    assert any(expected in warning for warning in warnings), warnings


def test_photos_without_position_and_positions_without_photo_do_no_harm(tmp_path: Path) -> None:
    scene = survey(grid())
    scene.positions = scene.positions[5:]
    scene.positions[0]["altitude_m"] = None
    scene.positions.append(scene.positions[1] | {"name": "not registered.jpg", "latitude": -3.0})
    frame, summary, _ = georef(scene, tmp_path)
    assert summary["positions_used"] == 24
    assert errors_m(frame, scene).max() < 3.5


def test_models_that_call_the_photos_otherwise_get_their_positions(tmp_path: Path) -> None:
    """A label without suffix, another case, a folder; but no position where several photos may be meant."""
    scene = survey(grid())
    photos = [str(record["name"]) for record in scene.positions]
    scene.names = [f"Camera/{name.upper()}" for name in photos[:10]] + [name.rpartition(".")[0] for name in photos[10:]]
    scene.names[29] = f"Camera/{scene.names[29]}"
    frame, summary, _ = georef(scene, tmp_path / "a", [*photos, "spare/dji 029 ä.jpg"])
    assert summary["positions_used"] == 29
    assert errors_m(frame, scene).max() < 3.5
    assert set(frame.residuals["photos"]) == set(photos[:29])


def test_line_of_cameras_is_levelled_by_the_cameras(tmp_path: Path) -> None:
    centres = np.stack([np.arange(12) * 9.0, np.arange(12) * 2.0, np.full(12, 40.0)], axis=1)
    scene = survey(centres[:, [1, 0, 2]], (0.5, 1.0))  # flown along the images' height, as drones do
    frame, _, warnings = georef(scene, tmp_path)
    assert frame.kind == "enu"
    assert "rotation" in frame.note
    assert any("along a line" in warning for warning in warnings)
    up = frame.world_from_model.rotation @ TRUTH.rotation.T @ [0.0, 0.0, 1.0]
    assert up[2] > np.cos(np.radians(4.0))
    assert errors_m(frame, scene).max() < 2.0


def test_line_of_cameras_is_levelled_by_the_gimbal(tmp_path: Path) -> None:
    centres = np.stack([np.arange(12) * 9.0, np.arange(12) * 2.0, np.full(12, 40.0)], axis=1)
    frame, _, _ = georef(survey(centres, (0.5, 1.0), gimbal=True), tmp_path)
    assert "gimbal" in frame.note
    turn = frame.world_from_model.rotation @ TRUTH.rotation.T
    assert np.degrees(np.arccos((np.trace(turn) - 1.0) / 2.0)) < 4.0


@pytest.mark.parametrize(
    ("centres", "sigma", "keep", "reason"),
    [
        (grid(), (1.5, 3.0), 0, "no photo of the model has a position"),
        (grid(), (1.5, 3.0), 1, "only 1 photo of the model has a position"),
        (grid(), (1.5, 3.0), 2, "only 2 photos of the model have a position"),
        (grid(step=0.05), (3.0, 5.0), 30, "too close together"),
        (np.stack([np.zeros(9), np.zeros(9), np.arange(9) * 9.0], axis=1), (0.5, 1.0), 9, "along a line"),
    ],
)
def test_uninformative_positions_leave_an_arbitrary_frame(
    tmp_path: Path, centres: np.ndarray, sigma: tuple[float, float], keep: int, reason: str
) -> None:
    """The last case: a vertical line of cameras looking down, whose heading is undetermined."""
    scene = survey(centres, sigma)
    scene.positions = scene.positions[:keep]
    frame, summary, warnings = georef(scene, tmp_path)
    assert (frame.kind, frame.origin, summary["kind"]) == ("arbitrary", None, "arbitrary")
    assert reason in frame.note
    assert any("Arbitrary scale" in warning and reason in warning for warning in warnings)
    up = frame.world_from_model.rotation @ TRUTH.rotation.T @ [0.0, 0.0, 1.0]
    assert up[2] > np.cos(np.radians(2.0))
    assert frame.world_from_model.scale == 1.0


def test_contradictory_positions_are_rejected(tmp_path: Path) -> None:
    scene = survey(grid())
    rng = np.random.default_rng(3)
    for record in scene.positions:
        record["latitude"] = 46.8 + rng.uniform(-0.01, 0.01)
        record["longitude"] = -92.0 + rng.uniform(-0.01, 0.01)
    frame, _, _ = georef(scene, tmp_path)
    assert frame.kind == "arbitrary"
    assert "agree with the model" in frame.note


def test_height_contradicted_by_the_drone_is_reported(tmp_path: Path) -> None:
    scene = survey(grid(), (0.02, 0.03), gimbal=True)
    for record in scene.positions:
        record["relative_altitude_m"] = 34.0
    _, _, warnings = georef(scene, tmp_path)
    assert any("34.0 m according to the drone" in warning for warning in warnings)


def test_invalid_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.bin").write_bytes(b"\xff" * 20)
    parts = {"sparse.model": tmp_path / "model"} | ingested(tmp_path, [], ["a.jpg"])
    with pytest.raises(SplatpipeError, match="model cannot be read"):
        run(GeorefConfig(), Inputs(parts, tmp_path), tmp_path / "out", Notes())


def test_models_of_the_user_are_copied_and_never_linked(tmp_path: Path) -> None:
    scene = survey(grid())
    write_model(scene, tmp_path / "project" / "sparse")
    (tmp_path / "out").mkdir()
    parts = {"sparse.model": tmp_path / "project" / "sparse"} | ingested(tmp_path, [], scene.names)
    run(GeorefConfig(), Inputs(parts, tmp_path / "project"), tmp_path / "out", Notes())
    assert all(path.stat().st_nlink == 1 for path in (tmp_path / "out" / "sparse" / "0").iterdir())


def test_photos_that_a_model_of_the_user_has_and_its_folder_lacks_are_named(tmp_path: Path) -> None:
    scene = survey(grid())
    write_model(scene, tmp_path / "project" / "sparse")
    (tmp_path / "out").mkdir()
    parts = {"sparse.model": tmp_path / "project" / "sparse"} | ingested(tmp_path, [], [*scene.names[5:], "new.jpg"])
    notes = Notes()
    run(GeorefConfig(), Inputs(parts, tmp_path / "project"), tmp_path / "out", notes)
    lost, new = (text for text in notes.warnings if "sparse/" in text)
    assert lost.startswith("5 of 30 photos of the model in sparse/ are missing in images/: ")
    assert all(name in lost for name in scene.names[:5])
    assert new == "1 of 26 photos in images/ is not in the model in sparse/: new.jpg."


TARGETS = {1: np.array([5.0, 5.0, 0.0]), 2: np.array([35.0, 5.0, 0.4]), 7: np.array([5.0, 40.0, 0.1])}


def bar(a: int, b: int, longer: float = 1.0) -> ScaleBar:
    return ScaleBar(f"T{a}", f"T{b}", longer * float(np.linalg.norm(TARGETS[a] - TARGETS[b])), 0.001)


def test_scale_bars_make_a_metric_frame_without_any_position(tmp_path: Path) -> None:
    scene = survey(grid())
    scene.positions, scene.targets = [], TARGETS
    scene.bars = (bar(1, 2), bar(1, 7), bar(2, 7, longer=1.2), ScaleBar("T1", "T9", 4.0, 0.001))
    frame, summary, warnings = georef(scene, tmp_path)
    assert frame.kind == "arbitrary" and frame.origin is None and frame.in_metres
    assert frame.world_from_model.scale == pytest.approx(TRUTH.scale, rel=2e-4)
    assert abs(frame.world_from_model.rotation @ TRUTH.rotation.T @ [0.0, 0.0, 1.0])[2] > np.cos(np.radians(3.0))
    assert "Metres by 2 scale bars" in frame.note and "place and heading are arbitrary" in frame.note
    facts = georeference(frame, np.zeros((2, 3)))
    assert facts["frame"] == "z up, metres, arbitrary place and heading" and facts["origin"] is None
    accuracy = json.loads((tmp_path / "out" / "accuracy.json").read_text())
    assert accuracy["scale"]["metric"] and not accuracy["scale"]["placed"]
    bars = accuracy["scale"]["bars"]
    assert [one["used"] for one in bars] == [True, True, False, False] and bars[3]["error_m"] is None
    assert abs(bars[0]["error_m"]) < 0.01 and bars[2]["error_m"] == pytest.approx(-bars[2]["metres"] / 6.0, abs=0.02)
    assert summary["scale_bars"] == 2
    assert any("contradict the others" in text and "T2 to T7" in text for text in warnings)
    assert any("was not detected: T1 to T9" in text for text in warnings)
    assert not any("Arbitrary scale" in text for text in warnings)


def test_scale_bars_that_contradict_each_other_give_no_metres(tmp_path: Path) -> None:
    scene = survey(grid())
    scene.positions, scene.targets, scene.bars = [], TARGETS, (bar(1, 2), bar(1, 7, longer=2.0))
    frame, summary, warnings = georef(scene, tmp_path)
    assert not frame.in_metres and "scale_bars" not in summary
    assert any("contradict each other" in text for text in warnings) and any("Arbitrary scale" in t for t in warnings)


def test_scale_bars_check_the_metres_of_positions(tmp_path: Path) -> None:
    scene = survey(grid(), (0.02, 0.03))
    scene.targets, scene.bars = TARGETS, (bar(1, 2, longer=1.1), bar(1, 7, longer=1.1))
    frame, _, warnings = georef(scene, tmp_path)
    assert frame.kind == "enu" and frame.world_from_model.scale == pytest.approx(TRUTH.scale, rel=1e-3)
    assert any("2 scale bars" in text and "-9.1" in text for text in warnings)  # 1 / 1.1
    scale = json.loads((tmp_path / "out" / "accuracy.json").read_text())["scale"]
    assert scale["placed"] and scale["bars"][0]["error_m"] == pytest.approx(-3.0, abs=0.05)


def test_points_without_marks_and_targets_leave_the_frame_to_the_positions(tmp_path: Path) -> None:
    scene = survey(grid(), (0.02, 0.03))
    scene.control = "EPSG:32615\nname,x,y,z\nG1,576870.0,5188000.0,199.0\nG2,576900.0,5188010.0,199.0\n"
    frame, summary, warnings = georef(scene, tmp_path)
    assert frame.kind == "enu" and errors_m(frame, scene).max() < 0.1 and "control_points" not in summary
    assert any("without marks in photos" in text and "no targets were detected" in text for text in warnings)


def test_of_several_models_the_one_that_is_used_is_said(tmp_path: Path) -> None:
    scene = survey(grid())
    project = tmp_path / "project"
    (project / "images").mkdir(parents=True)
    write_model(scene, project / "sparse/1")
    write_model(replace(scene, names=scene.names[:2], cam_from_world=scene.cam_from_world[:2]), project / "sparse/0")
    source = open_source(project, tmp_path / "out")
    (tmp_path / "out").mkdir()
    parts = {"sparse.model": source.part_path("sparse.model")} | ingested(tmp_path, scene.positions, scene.names)
    notes = Notes()
    run(GeorefConfig(), Inputs(parts, project), tmp_path / "out", notes)
    said = [note for note in notes.notes if "models in sparse/" in note]
    assert len(said) == 1 and "sparse/1 with 30 photos is used; sparse/0 has 2" in said[0]
    assert not any("not in the model" in warning for warning in notes.warnings)
