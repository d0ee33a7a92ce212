"""Marks written into control files line by line: they read back unchanged, and nothing else changes."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.pipeline.survey.files.control_file import SurveyedPoint, read_control_file, read_points_file

PHOTOS = ("A.JPG", "sub/my photo.JPG", "Ö.jpg")
find = NameFinder(PHOTOS)


def point(name: str, x: float = 388710.5137, z: float | None = 512.012, **stated: object) -> SurveyedPoint:
    given = {"sigma_m": (None, None), "role": None, "marks": ()} | stated
    return SurveyedPoint(name, x, 5299705.2081, z, **given)  # type: ignore[arg-type]


def written(path: Path, text: str) -> ControlText:
    path.write_bytes(text.encode())
    return ControlText.read(path, find)


@pytest.mark.parametrize("as_csv", [False, True])
def test_marks_read_back(tmp_path: Path, as_csv: bool) -> None:
    path = tmp_path / "marks"
    named = [point("P1"), point('a point, named "so"', 1e-7, None), point("Ö 3", -12345678.123456789, 0.5)]
    text = ControlText.begin(path, "EPSG:32633", as_csv, find)
    for number, each in enumerate(named):
        for photo in PHOTOS[: number + 1]:
            text = text.with_mark(each, photo, (number + 0.125, 20.5))
    text = text.with_mark(named[0], "A.JPG", (7.5, 8.25))
    text.save()
    found = read_control_file(path)
    assert [(p.name, p.x, p.y, p.z) for p in found.points] == [(p.name, p.x, p.y, p.z) for p in named]
    marks = {(p.name, m.photo): (m.x, m.y) for p in found.points for m in p.marks}
    assert len(marks) == 6 and marks["P1", "A.JPG"] == (7.5, 8.25)
    assert ControlText.read(path, find).marks == text.marks


def test_roles_and_accuracies_stay_with_their_points(tmp_path: Path) -> None:
    text = ControlText.begin(tmp_path / "control.csv", "EPSG:32633", True, find)
    text = text.with_mark(point("P1", role="check", sigma_m=(0.01, 0.02)), "A.JPG", (1.0, 2.0))
    text.with_mark(point("P1", role="check", sigma_m=(0.01, 0.02)), PHOTOS[1], (3.0, 4.0)).save()
    found = read_control_file(tmp_path / "control.csv").points[0]
    assert (found.role, found.sigma_m, len(found.marks)) == ("check", (0.01, 0.02), 2)


ODM = (
    "\ufeff# by hand\r\nWGS84 UTM 33N\r\n\r\n"
    "388710.51370  5299705.20810 512.0120\t112.14 514.11 a.jpg P1 extra 7\r\n"
    "1\t2\t3\t4\t5\tmy photo.JPG\t\r\n"
    "388710.5137 5299705.2081 512.0120 9 9 ELSEWHERE.JPG P1\r\n# the end\r\n"
)


def test_only_the_marked_line_changes(tmp_path: Path) -> None:
    text = written(tmp_path / "gcp_list.txt", ODM)
    assert text.marks == {"P1": {"A.JPG": (112.14, 514.11)}, "point 2": {PHOTOS[1]: (4.0, 5.0)}}
    text.with_mark(point("P1"), "A.JPG", (1.0, 2.0)).save()
    before, after = ODM.split("\r\n"), (tmp_path / "gcp_list.txt").read_bytes().decode().split("\r\n")
    assert [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a != b] == [3]
    assert after[3].split() == before[3].replace("112.14", "1.00").replace("514.11", "2.00").split()


def test_a_new_mark_is_written_with_its_point_and_repeats_its_coordinates_as_written(tmp_path: Path) -> None:
    text = written(tmp_path / "gcp_list.txt", ODM).with_mark(point("P1"), "Ö.jpg", (1.0, 2.0))
    text = text.with_mark(point("point 2", 1.0, 3.0), "A.JPG", (5.0, 6.0))
    text.save()
    lines = (tmp_path / "gcp_list.txt").read_bytes().decode().split("\r\n")
    new = next(line for line in lines if "Ö.jpg" in line)
    assert new.split()[:6] == ["388710.5137", "5299705.2081", "512.0120", "1.00", "2.00", "Ö.jpg"]
    found = {p.name: p for p in read_control_file(tmp_path / "gcp_list.txt").points}
    assert len(found["P1"].marks) == 3 and len(found["point 2"].marks) == 2


def test_a_point_outlives_its_last_mark(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    text = ControlText.begin(path, "EPSG:32633", False, find).with_mark(point("P 1"), "A.JPG", (1.0, 2.0))
    text = text.without_mark(point("P 1"), "A.JPG")
    text.save()
    assert [p.name for p in ControlText.read(path, find).unmarked] == ["P 1"]
    assert ControlText.read(path, find).unmarked[0].x == 388710.5137
    with pytest.raises(SplatpipeError, match="no observations"):
        read_control_file(path)
    again = ControlText.read(path, find).with_mark(point("P 1"), "A.JPG", (1.0, 2.0))
    assert again.unmarked == [] and again.marks == {"P 1": {"A.JPG": (1.0, 2.0)}}
    table = ControlText.begin(path, "EPSG:32633", True, find).with_mark(point("P 1"), "A.JPG", (1.0, 2.0))
    table.without_mark(point("P 1"), "A.JPG").save()
    assert [(p.name, p.marks) for p in read_control_file(path).points] == [("P 1", ())]


UNNAMED = ("1 2 3 10 11 A.JPG", "4 5 6 20 21 A.JPG", "1 2 3 12 13 Ö.jpg", "7 8 9 30 31 A.JPG", "4 5 6 40 41 A.JPG P")


@pytest.mark.parametrize("as_csv", [False, True])
@pytest.mark.parametrize(("name", "photo"), [("point 1", "A.JPG"), ("point 2", "A.JPG"), ("P", "A.JPG")])
def test_points_without_names_keep_their_identity_when_a_mark_is_removed(
    tmp_path: Path, as_csv: bool, name: str, photo: str
) -> None:
    lines = ["EPSG:32633", *(["x,y,z,pixel_x,pixel_y,photo,name"] if as_csv else []), *UNNAMED]
    text = written(tmp_path / "marks", "\n".join(line.replace(" ", ",") if as_csv else line for line in lines) + "\n")
    expected = {
        "point 1": {"A.JPG": (10.0, 11.0), "Ö.jpg": (12.0, 13.0)},
        "point 2": {"A.JPG": (20.0, 21.0)},
        "point 3": {"A.JPG": (30.0, 31.0)},
        "P": {"A.JPG": (40.0, 41.0)},
    }
    assert text.marks == expected
    text.without_mark(point(name), photo).save()
    del expected[name][photo]
    found = ControlText.read(tmp_path / "marks", find)
    assert {each: seen for each, seen in found.marks.items() if seen} == {k: v for k, v in expected.items() if v}
    again = found.with_mark(point("point 3"), "Ö.jpg", (5.0, 6.0))
    assert again.marks["point 3"] == {"A.JPG": (30.0, 31.0), "Ö.jpg": (5.0, 6.0)}


def test_hidden_points_are_written_as_comments(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    text = ControlText.begin(path, "EPSG:32633", False, find).with_mark(point("P1"), "A.JPG", (1.0, 2.0))
    text = text.with_hidden("P1", PHOTOS[1], hidden=True).with_hidden("P1", PHOTOS[1], hidden=True)
    text.save()
    assert ControlText.read(path, find).hidden == {("P1", PHOTOS[1])}
    assert len(read_control_file(path).points[0].marks) == 1
    assert text.with_hidden("P1", PHOTOS[1], hidden=False).hidden == set()
    assert text.with_mark(point("P1"), PHOTOS[1], (3.0, 4.0)).hidden == set()


def test_third_party_tables_keep_their_columns(tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    first = "Label;Easting;Northing;Height;remark;Image;px;py"
    text = written(path, f'# CRS: EPSG:25832\n{first}\nP1;1,5;2,5;3,5;"a;b";A.JPG;10;20\nP2;4,5;2,5;3,5;c;;;\n')
    text = text.with_mark(point("P1"), "A.JPG", (11.0, 21.0)).with_mark(point("P2"), "A.JPG", (12.0, 22.0))
    text.with_mark(point("P3", 7.0, None), "Ö.jpg", (13.0, 23.0)).save()
    assert path.read_text().splitlines() == [
        "# CRS: EPSG:25832",
        first,
        'P1;1,5;2,5;3,5;"a;b";A.JPG;11.00;21.00',
        "P2;4,5;2,5;3,5;c;A.JPG;12.00;22.00",
        "P3;7.0;5299705.2081;NaN;;Ö.jpg;13.00;23.00",
    ]
    assert [p.marks[0].x for p in read_control_file(path).points] == [11.0, 12.0, 13.0]


def test_links_and_permissions_are_kept_and_a_read_only_file_is_reported(tmp_path: Path) -> None:
    real = tmp_path / "real.txt"
    link = tmp_path / "gcp_list.txt"
    real.write_text("EPSG:32633\n1 2 3 4 5 A.JPG P1\n")
    real.chmod(0o640)
    link.symlink_to(real)
    ControlText.read(link, find).with_mark(point("P1", 1.0, 3.0), "A.JPG", (6.0, 7.0)).save()
    assert link.is_symlink() and real.stat().st_mode & 0o777 == 0o640
    assert read_control_file(real).points[0].marks[0].x == 6.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gcp_list.txt", "real.txt"]
    with pytest.raises(MachineError, match="Cannot write"):
        ControlText.begin(tmp_path / "none" / "gcp_list.txt", "EPSG:32633", False, find).save()


change = st.tuples(
    st.sampled_from(["P1", "P 2", "point 1"]),
    st.sampled_from(PHOTOS),
    st.one_of(st.none(), st.just("hidden"), st.tuples(st.floats(0, 9999), st.floats(0, 9999))),
)


@settings(max_examples=60, deadline=None)
@given(st.booleans(), st.lists(change, max_size=12))
def test_any_changes_leave_a_file_that_reads_back_accordingly(as_csv: bool, changes: list) -> None:
    """Compared with the simplest model: a dictionary."""
    text = ControlText.begin(Path("marks"), "EPSG:32633", as_csv, find)
    wanted: dict[tuple[str, str], object] = {}
    places = {name: point(name, float(number + 1)) for number, name in enumerate(["P1", "P 2", "point 1"])}
    for name, photo, after in changes:
        text = text.with_hidden(name, photo, hidden=after == "hidden")
        if isinstance(after, tuple):
            text = text.with_mark(places[name], photo, after)
        else:
            text = text.without_mark(places[name], photo)
        wanted[name, photo] = after
    marks = {(name, photo): pixel for name, seen in text.marks.items() for photo, pixel in seen.items()}
    assert marks == {
        key: pytest.approx(after, abs=0.00501) for key, after in wanted.items() if isinstance(after, tuple)
    }
    assert text.hidden == {key for key, after in wanted.items() if after == "hidden"}


def test_points_without_marks_are_read_by_name(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("EPSG:25832\npoint;easting;northing;height;role\nP1;1,5;2,5;;check\nP2;3;4;5;\n")
    found = read_points_file(path)
    assert (found.crs.text, [(p.name, p.x, p.z, p.role) for p in found.points]) == (
        "EPSG:25832",
        [("P1", 1.5, None, "check"), ("P2", 3.0, 5.0, None)],
    )
    path.write_text("lon,lat,name\n13.5,47.8,P1\n")
    assert read_points_file(path).crs.text == "EPSG:4326"
    path.write_text("EPSG:32633\n1 2 3 4 5 A.JPG P1\n")  # a control file has points, too
    assert len(read_points_file(path).points[0].marks) == 1
    for text, wrong in (("EPSG:25832\nname,x\nP1,1\n", "points.csv"), ("", "empty"), ("name,x,y\nP1,1,2\n", "no CRS")):
        path.write_text(text)
        with pytest.raises(SplatpipeError, match=wrong):
            read_points_file(path)


@pytest.mark.parametrize("separator", [",", ";", " "])
def test_marks_are_written_with_the_files_own_separator(tmp_path: Path, separator: str) -> None:
    fields = ["388710.5137", "5299705.2081", "512.0120", "1", "2", "A.JPG", "P1"]
    text = written(tmp_path / "gcp_list.txt", f"EPSG:32633\n{separator.join(fields)}\n")
    text.with_mark(point("P1"), "sub/my photo.JPG", (3.0, 4.0)).with_mark(point("P1"), "A.JPG", (5.0, 6.0)).save()
    found = read_control_file(tmp_path / "gcp_list.txt").points[0]
    assert {mark.photo: (mark.x, mark.y) for mark in found.marks} == {"A.JPG": (5.0, 6.0), PHOTOS[1]: (3.0, 4.0)}
    assert (found.name, found.x, found.z) == ("P1", 388710.5137, 512.012)


def test_marks_are_added_to_points_whose_titles_are_a_comment(tmp_path: Path) -> None:
    text = written(
        tmp_path / "control.csv", "# CRS: EPSG:32633\n#Label,Easting,Northing,Altitude\nP1,388710.5,5299705.2,5\n"
    )
    text.with_mark(point("P1"), "A.JPG", (3.0, 4.0)).save()
    found = read_control_file(tmp_path / "control.csv").points[0]
    assert [(mark.photo, mark.x, mark.y) for mark in found.marks] == [("A.JPG", 3.0, 4.0)]
