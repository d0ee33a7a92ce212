"""Control without clicking: targets in photos, their IDs, scale bars."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from target_scenes import TargetAppearance, coded, quadrants, render

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.targets.coded_targets import find_coded_targets
from splatpipe.pipeline.photos.targets.quadrant_targets import find_quadrant_targets
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.pipeline.survey.files.control_file import read_control_file
from splatpipe.pipeline.survey.files.scale_bars import ScaleBar, read_scale_bars, scale_by
from splatpipe.pipeline.survey.targets.constellation import overlay
from splatpipe.pipeline.survey.targets.target_finds import WantedTargets
from splatpipe.pipeline.survey.targets.target_marks import number_of

FAMILIES = ("DICT_APRILTAG_36h11", "DICT_4X4_250", "DICT_6X6_250")


def demo_photo(number: int) -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(capture_path() / f"DJI_{number:04d}.JPG"))[:, :, ::-1])


def test_quadrants_from_12_px_are_found_to_a_tenth_of_a_pixel() -> None:
    rng = np.random.default_rng(3)
    found, errors = 0, []
    for number in (2, 24):
        drawn, placed = render(demo_photo(number), [("", quadrants)] * 12, TargetAppearance((12.0, 30.0)), rng, 90.0)
        finds = find_quadrant_targets(drawn)
        for target in placed:
            off = [(f.x - target.centre[0], f.y - target.centre[1]) for f in finds]
            near = min(off, key=lambda each: np.hypot(*each))
            if np.hypot(*near) < 1.0:
                found += 1
                errors.append(near)
    assert found >= 22  # 24 were drawn
    assert np.sqrt(np.square(errors).mean()) < 0.1


def test_coded_targets_from_20_px_are_read_and_found() -> None:
    rng = np.random.default_rng(4)
    kinds = []
    for name in FAMILIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        for number in (3, 17, 29):
            cells = dictionary.generateImageMarker(number, dictionary.markerSize + 2) > 127
            kinds.append((f"{name.removeprefix('DICT_').lower()}:{number}", coded(cells.astype(np.uint8))))
    drawn, placed = render(demo_photo(3), kinds, TargetAppearance((20.0, 40.0)), rng, 110.0)
    finds = {f"{f.dictionary}:{f.number}": f for f in find_coded_targets(drawn)}
    read = [target for target in placed if target.name in finds]
    assert len(finds) == len(read) >= 8  # 9 were drawn
    off = [(finds[t.name].x - t.centre[0], finds[t.name].y - t.centre[1]) for t in read]
    assert np.sqrt(np.square(off).mean()) < 0.3


def test_a_photo_without_targets_has_none() -> None:
    """Noise, a chessboard's rows, and a photo that is too small for a ring."""
    rng = np.random.default_rng(5)
    noise = rng.integers(0, 256, (400, 400, 3)).astype(np.uint8)
    assert find_quadrant_targets(noise) == [] and find_coded_targets(noise) == []
    board = np.kron(np.indices((20, 20)).sum(axis=0) % 2, np.ones((20, 20)))
    assert find_quadrant_targets((200 * board[..., None] * np.ones(3)).astype(np.uint8)) == []
    assert find_quadrant_targets(np.zeros((3, 3, 3), np.uint8)) == []


def test_numbers_are_read_from_names() -> None:
    numbers = [number_of(name) for name in ("GCP12", "P07", "tag 3", "corner", "A1-20", "9" * 9)]
    assert numbers == [12, 7, 3, None, 20, None]


def test_displaced_rotated_constellation_with_false_points_is_recognised() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform([-30, -30, 0], [30, 30, 8], (9, 3))
    points[4, 2] = np.nan
    turn = cv2.Rodrigues(np.array([0.004, -0.003, 0.01]))[0]
    seen = 1.004 * np.where(np.isnan(points), 3.0, points) @ turn.T + [3.0, -2.0, 47.0]
    strangers = rng.uniform([-40, -40, 40], [40, 40, 60], (6, 3))
    found = overlay(np.concatenate([strangers, seen[:7]]), points, {})
    assert found is not None
    assert {(int(a), int(b)) for a, b in found.pairs} == {(6 + k, k) for k in range(7)}
    assert overlay(strangers, points, {}) is None


def test_an_ambiguous_lattice_is_not_assigned() -> None:
    grid = np.stack(np.meshgrid(np.arange(4) * 10.0, np.arange(3) * 10.0), axis=-1).reshape(-1, 2)
    points = np.concatenate([grid, np.zeros((12, 1))], axis=1)
    assert overlay(points[:8] + np.array([4.0, 0.0, 0.0]), points, {}) is None


def test_scale_bars_give_metres_and_the_wrong_one_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "scale_bars.csv"
    path.write_text("name_a;name_b;metres;sigma\nA;B;10,00;0.002\nB;C;5.0;\nA;C;9.0;0.01\n# rest\nA;X;1;\n")
    bars = read_scale_bars(path)
    assert bars[0] == ScaleBar("A", "B", 10.0, 0.002) and len(bars) == 4
    places = {"A": np.zeros(3), "B": np.array([4.0, 0.0, 0.0]), "C": np.array([4.0, 2.0, 0.0])}
    scale = scale_by(bars, places)
    assert scale is not None and scale.used == (0, 1) and scale.metres_per_unit == pytest.approx(2.5)
    assert scale.errors_m[2] == pytest.approx(np.hypot(10, 5) - 9.0, abs=1e-6) and np.isnan(scale.errors_m[3])
    assert scale_by(bars[3:], places) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("name_a,name_b\nA,B\n", "Line 1.*without the columns metres"),
        ("name_a,name_b,metres\n", "no bars"),
        ("name_a,name_b,metres\nA,a,1\n", "Line 2.*to itself"),
        ("name_a,name_b,metres\nA,B,-1\n", "Line 2.*a distance of -1"),
        ("name_a,name_b,metres\nA,B,nan\n", "Line 2.*not a valid number"),
        ("name_a,name_b,metres\nA,B,1e99\n", "Line 2.*not a valid number"),
        ("name_a,name_b,metres,sigma\nA,B,1,0\n", "Line 2.*standard deviation"),
        ("name_a,name_b,metres\n,B,1\n", "Line 2.*name"),
        ("name_a,name_b,metres\n" + "A" * 300 + ",B,1\n", "Line 2.*name"),
        ("name_a,name_b,metres\n" + "A,B,1\n" * 1001, "more than 1,000 bars"),
        ("name_a,name_b,metres\nA,B,1\x00\n", "no plain text"),
        (b"\xff\xd8", "not UTF-8"),
        (b"x" * (1 << 20) + b"x", "too large"),
    ],
)
def test_broken_scale_bars_are_refused_with_their_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    path = tmp_path / "scale_bars.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SplatpipeError, match=message):
        read_scale_bars(path)


def test_control_file_with_points_only_accepts_marks_later(tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    path.write_text("EPSG:32633\nname,x,y,z\nP1,1,2,3\nP2,4,5,6\n")
    point = read_control_file(path).points[0]
    assert point.marks == () and point.z == 3.0
    ControlText.read(path, lambda name: name).with_mark(point, "A.JPG", (7.0, 8.0)).save()
    first, second = read_control_file(path).points
    assert [(m.photo, m.x, m.y) for m in first.marks] == [("A.JPG", 7.0, 8.0)] and second.marks == ()


def test_targets_are_wanted_for_points_and_for_scale_bars_alone() -> None:
    bars, points = (ScaleBar("A", "B", 10.0, 0.002),), (("A", 1.0, 2.0, None),)
    assert WantedTargets("", (), bars) and WantedTargets("", points, ()) and not WantedTargets("", (), ())
