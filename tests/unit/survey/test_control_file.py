"""Control point files: every form that surveyors deliver, and none that breaks the reader."""

from pathlib import Path

import pytest

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.survey.crs.crs import parse_crs
from splatpipe.pipeline.survey.files.control_file import ControlFile, Mark, read_control_file, read_points_file, titled


def read(folder: Path, text: str | bytes, name: str = "gcp_list.txt") -> ControlFile:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_control_file(path)


@pytest.mark.parametrize("crs", ["EPSG:32633", "+proj=utm +zone=11 +ellps=WGS84 +units=m +no_defs\t", "WGS84 UTM 33N"])
def test_odm_list_gives_points_with_their_marks(tmp_path: Path, crs: str) -> None:
    found = read(
        tmp_path,
        f"# surveyed by us\n{crs}\r\n10.5 20.25 512.0 100.5 200.25 A.JPG P1 extra 7\r\n\n# pause\n"
        "10.5\t20.25\t512.0\t7\t8\tmy photo.JPG\tP1\n11 21 513 1 2 A.JPG P2\n",
    )
    assert found.crs == parse_crs(crs)
    assert [point.name for point in found.points] == ["P1", "P2"]
    assert (found.points[0].x, found.points[0].y, found.points[0].z) == (10.5, 20.25, 512.0)
    assert found.points[0].marks == (Mark("A.JPG", 100.5, 200.25), Mark("my photo.JPG", 7.0, 8.0))
    assert found.points[0].role is None


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r\r\n", "\r"])  # also as a spreadsheet on a Mac saves it
def test_every_systems_line_ends_are_read(tmp_path: Path, end: str) -> None:
    found = read(tmp_path, end.join(["EPSG:32633", "1 2 3 10 20 A.JPG P1", "4 5 6 10 20 B.JPG P2", ""]))
    assert [(point.name, point.marks[0].photo) for point in found.points] == [("P1", "A.JPG"), ("P2", "B.JPG")]


@pytest.mark.parametrize("sign", ["\x85", "\u2028", "\u2029"])
def test_lines_end_at_line_feeds_only(tmp_path: Path, sign: str) -> None:
    found = read(tmp_path, f"EPSG:32633\n1\t2\t3\t10\t20\tA{sign}B.JPG\tP1\n4\t5\t6\t10\t20\tB.JPG\tP2\n")
    assert [(point.name, point.marks[0].photo) for point in found.points] == [("P1", f"A{sign}B.JPG"), ("P2", "B.JPG")]


def test_a_lone_carriage_return_within_a_line_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match="no plain text in line 2"):
        read(tmp_path, "EPSG:32633\n1 2 3 10 20 A.JPG P1\r4 5 6 10 20 B.JPG P2\n")


def test_lines_without_names_are_distinguished_by_their_coordinates(tmp_path: Path) -> None:
    found = read(tmp_path, "EPSG:32633\n1 2 3 10 20 A.JPG\n4 5 6 10 20 A.JPG\n1 2 3 11 21 B.JPG\n")
    assert [(point.name, len(point.marks)) for point in found.points] == [("point 1", 2), ("point 2", 1)]


def test_demo_capture_has_eighteen_points(tmp_path: Path) -> None:
    found = read_control_file(CAPTURE / "gcp_list.txt")
    assert found.crs.text == "EPSG:32633"
    assert len(found.points) == 18
    assert all(point.z is not None and len(point.marks) >= 2 for point in found.points)


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:25832\nname,x,y,z,photo,pixel_x,pixel_y,role,sigma_h,sigma_v\nP1,1.5,2.5,3.5,A.JPG,10,20,check,0.01,0.02\n",
        "# CRS: EPSG:25832\nName;Easting;Northing;Height;Image;px;py;Role;accuracy_xy;accuracy_z\n"
        "P1;1,5;2,5;3,5;A.JPG;10;20;check;0,01;0,02\n",
        "label\tcrs\teast\tnorth\taltitude\timage_name\tu\tv\ttype\tsigma_xy\tsigma_z\n"
        "P1\t25832\t1.5\t2.5\t3.5\tA.JPG\t10\t20\tcp\t.01\t.02\n",
    ],
)
def test_tables_are_read_by_their_header(tmp_path: Path, text: str) -> None:
    found = read(tmp_path, text, "control.csv")
    point = found.points[0]
    assert found.crs.text == "EPSG:25832"
    assert (point.name, point.x, point.y, point.z) == ("P1", 1.5, 2.5, 3.5)
    assert (point.role, point.sigma_m, point.marks) == ("check", (0.01, 0.02), (Mark("A.JPG", 10.0, 20.0),))


def test_table_of_longitudes_and_latitudes_needs_no_crs(tmp_path: Path) -> None:
    found = read(tmp_path, "name,lat,lon,photo,px,py\nP1,47.8,13.5,A.JPG,1,2\n")
    assert (found.crs.text, found.points[0].x, found.points[0].y, found.points[0].z) == ("EPSG:4326", 13.5, 47.8, None)


def test_height_of_exactly_zero_is_unknown_unless_others_are_near_sea_level(tmp_path: Path) -> None:
    inland = read(tmp_path, "EPSG:32633\n1 2 0.0 1 1 A.JPG P1\n3 4 512 1 1 A.JPG P2\n5 6 NaN 1 1 A.JPG P3\n")
    assert [point.z for point in inland.points] == [None, 512.0, None]
    assert inland.zero_heights == ("P1",)
    coast = read(tmp_path, "EPSG:32633\n1 2 0.0 1 1 A.JPG P1\n3 4 1.25 1 1 A.JPG P2\n")
    assert [point.z for point in coast.points] == [0.0, 1.25]
    flat = read(tmp_path, "EPSG:32633\n1 2 0.0 1 1 A.JPG P1\n3 4 0 1 1 A.JPG P2\n")
    assert [point.z for point in flat.points] == [None, None]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("EPSG:32633\n", "no observations"),
        ("1 2 3 4 5 A.JPG P1\n", "must state the CRS"),
        ("EPSG:32633\n1 2 3 4 5\n", "Line 2.*5 fields"),
        ("EPSG:32633\n1 2 3 nan 5 A.JPG\n", "Line 2.*pixel x"),
        ("EPSG:32633\n1 1e300 3 4 5 A.JPG\n", "Line 2.*y is"),
        ("EPSG:32633\n1 inf 3 4 5 A.JPG\n", "Line 2.*y is"),
        ("EPSG:32633\n1 2 3 4 5 A.JPG P1\n9 2 3 4 5 B.JPG P1\n", "Line 3.*other coordinates than in line 2"),
        ("EPSG:32633\n1 2 3 4 5 A.JPG P1\n1 2 3 40 5 A.JPG P1\n", "Line 3.*second mark"),
        ("EPSG:32633\n1 2 3 4 5 " + "A" * 300 + " P1\n", "Line 2.*too long"),
        ("EPSG:32633\n" + "1" * 3000, "no plain text in line 2"),
        (b"EPSG:32633\n1 2 3 4 5 \x00.JPG", "no plain text in line 2"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "not UTF-8"),
        ("name,x,y,photo,px,py\nP1,1,2,A.JPG,3,4\n", "states no CRS"),
        ("name,x,y,z\nP1,1,2,3\n", "states no CRS"),
        ("EPSG:1\nname,x,y,photo\nP1,1,2,A.JPG\n", "Line 2.*header without the columns pixel_x, pixel_y"),
        ("EPSG:1\nname;x;y;z;photo\nP1;1;2;3;A.JPG\n", "Line 2.*header without the columns pixel_x, pixel_y"),
        ("EPSG:1\nname,x,y,photo,px,py,role\nP1,1,2,A.JPG,3,4,boss\n", "Line 3.*neither control nor check"),
        ("EPSG:1\nname,x,y,photo,px,py,sigma_h\nP1,1,2,A.JPG,3,4,0\n", "Line 3.*standard deviation"),
        ("name,x,y,photo,px,py,crs\nP1,1,2,A.JPG,3,4,1\nP2,1,2,A.JPG,3,4,2\n", "Line 3.*another CRS"),
    ],
)
def test_invalid_file_is_refused_with_its_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    with pytest.raises(SplatpipeError, match=message) as caught:
        read(tmp_path, text)
    assert caught.value.hint


def test_point_may_be_listed_without_being_marked(tmp_path: Path) -> None:
    assert read(tmp_path, "EPSG:32633\nname,x,y,photo,px,py\nP1,1,2\n").points[0].marks == ()


def test_too_large_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match="more than 200,000 lines"):
        read(tmp_path, "EPSG:32633\n" + "\n" * 200_001)
    many = "EPSG:32633\n" + "".join(f"{i} 0 1 2 3 A.JPG P{i}\n" for i in range(10_001))
    with pytest.raises(SplatpipeError, match="10,000 points"):
        read(tmp_path, many)


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:32633\n1.5 2.5 3.5 10 20 {photo} P 1\n",
        "EPSG:32633\n1.5,2.5,3.5,10,20,{photo},P 1\n",
        "EPSG:32633;;;;;;\n1,5;2,5;3,5;10;20;{photo};P 1\n",
        "sep=;\nEPSG:32633\n1.5;2.5;3.5;10;20;{photo};P 1\n",
        "EPSG:32633\n1.5\t2.5\t3.5\t10\t20\t{photo}\tP 1\n",
        # Metashape, Pix4D, Trimble, Emlid: their titles, with the marks' columns
        "# Coordinate system: WGS 84 / UTM zone 33N (EPSG::32633)\n"
        "#Label,X/Easting,Y/Northing,Z/Altitude,Camera,X_px,Y_px\nP 1,1.5,2.5,3.5,{photo},10,20\n",
        "EPSG:32633\nGCP label;X [m];Y [m];Z [m];Filename;x pixel;y pixel\nP 1;1.5;2.5;3.5;{photo};10;20\n",
        "EPSG:32633\nPoint ID,Northing (m),Easting (m),Elev (m),Code,Photo,px,py\nP 1,2.5,1.5,3.5,GCP,{photo},10,20\n",
        "Name,Easting,Northing,Elevation,CS name,Image,px,py\nP 1,1.5,2.5,3.5,EPSG:32633,{photo},10,20\n",
    ],
)
@pytest.mark.parametrize("photo", ["A.JPG", "2026-09-26 15-24-47.JPG"])
def test_separator_and_columns_of_other_programs_are_found(tmp_path: Path, text: str, photo: str) -> None:
    found = read(tmp_path, text.format(photo=photo))
    (point,) = found.points
    assert found.crs.text == "EPSG:32633"
    assert (point.x, point.y, point.z, point.marks) == (1.5, 2.5, 3.5, (Mark(photo, 10.0, 20.0),))
    assert point.name.startswith("P")


def test_points_of_a_receiver_without_marks_are_read_by_their_titles(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(
        "Name,Code,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height,Easting RMS,CS name\n"
        "P1,GCP,388710.5,5299705.2,465,13.5127,47.8412,512,0.01,ETRS89 / UTM 33N + height\n"
    )
    file = read_points_file(path)
    assert file.crs.text == "EPSG:4979"
    assert [(point.x, point.y, point.z) for point in file.points] == [(13.5127, 47.8412, 512.0)]


@pytest.mark.parametrize(
    "text", ["P1,5299705.2,388710.5,512,GCP\nP2,5299705.3,388711.5,513,GCP\n", "EPSG:32633\nP1;1;2;3\n"]
)
def test_points_without_titles_are_refused_with_what_is_wanted(tmp_path: Path, text: str) -> None:
    with pytest.raises(SplatpipeError, match=r"by .* without titles: their order") as caught:
        read(tmp_path, text)
    assert "name,north,east,height,code" in caught.value.hint


def test_a_line_that_cannot_be_read_names_the_separator_and_the_columns(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match="separated by blanks, but at least 6 are needed: x y z pixel_x") as caught:
        read(tmp_path, "EPSG:32633\n1|2|3|4|5|A.JPG\n")
    assert "112.1 514.1 DJI_0005.JPG P01" in caught.value.hint


@pytest.mark.parametrize(
    ("kind", "name", "said"),
    [
        ("", "point 12", "Point 12"),
        ("Control", "point 12", "Control point 12"),
        ("Check", "P1", "Check point P1"),
        ("", "point A", "Point point A"),  # its own name
    ],
)
def test_points_without_names_are_called_by_their_number(kind: str, name: str, said: str) -> None:
    assert titled(kind, name) == said


def test_a_german_spreadsheets_table_is_read(tmp_path: Path) -> None:
    lines = ["sep=;", "EPSG:25832;;;;;;", "Punkt;Rechtswert;Hochwert;Höhe;Bild;Pixel X;Pixel Y;"]
    lines += ["P1;388710,51;5299705,21;512,01;Münster_1.JPG;112,1;514,1;"]
    path = tmp_path / "control.csv"
    path.write_bytes("\r\n".join(lines).encode("cp1252"))
    [point] = read_control_file(path).points
    assert (point.name, point.x, point.y, point.z) == ("P1", 388710.51, 5299705.21, 512.01)
    assert [(mark.photo, mark.x, mark.y) for mark in point.marks] == [("Münster_1.JPG", 112.1, 514.1)]


TRIMBLE = (("P01", "5299705.214", "388710.512", "512.013", "GCP"), ("P02", "5299720.5", "388722.75", "512.44", "CHK"))


@pytest.mark.parametrize("decimals", [".", ","])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(
    "titles",
    [
        "Point ID,Northing,Easting,Elevation,Code",
        "Point ID,Northing (Meter),Easting (Meter),Elevation (Meter),Feature Code",
        "P,N,E,Z,D",
        "Point,North,East,Elev,Code",
        "Name,Grid Northing,Grid Easting,Elevation,Feature Code",
        "Punkt-Nr,Hochwert,Rechtswert,Höhe,Code",
    ],
)
def test_trimbles_tables_are_read(tmp_path: Path, titles: str, separator: str, decimals: str) -> None:
    rows = [[cell.replace(".", decimals) for cell in row] for row in TRIMBLE]
    lines = ["EPSG:32633", titles.replace(",", separator), *(separator.join(row) for row in rows)]
    path = tmp_path / "control.csv"
    path.write_text("\r\n".join(lines), encoding="utf-8")
    if (separator, decimals) == (",", ","):
        with pytest.raises(
            SplatpipeError, match=r"Line 3 .*commas separate both the columns and the decimals"
        ) as error:
            read_points_file(path)
        assert "semicolons" in error.value.hint
        return
    points = read_points_file(path).points
    assert [(point.name, point.x, point.y, point.z) for point in points] == [
        ("P01", 388710.512, 5299705.214, 512.013),
        ("P02", 388722.75, 5299720.5, 512.44),
    ]


def test_a_table_of_degrees_and_a_projected_crs_is_read_in_the_one_it_states(tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    table = "Point ID,Latitude,Longitude,Height,Northing,Easting,Elevation\nP1,47.84,13.51,558.1,5299705,388710,512.0\n"
    for crs, place in (("EPSG:32633", (388710.0, 5299705.0, 512.0)), ("EPSG:4326", (13.51, 47.84, 558.1))):
        path.write_text(f"{crs}\n{table}")
        (point,) = read_points_file(path).points
        assert (point.x, point.y, point.z) == place
    path.write_text(table)
    (point,) = read_points_file(path).points
    assert (point.x, point.y, point.z) == (13.51, 47.84, 558.1)


def test_a_header_without_a_photos_column_says_so(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match="a header without the columns photo, pixel_x, pixel_y"):
        read(tmp_path, "EPSG:32633\nnumber,x,y,z\n1,2,3,4\n")
