"""Files of photo positions: geo.txt as ODM defines it, CSV in the forms that people write, and invalid files."""

import random
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.survey.files.position_file import PhotoPlace, PositionFile, read_position_file
from splatpipe.pipeline.survey.files.survey_text import MAX_LINE_CHARS


def read(tmp_path: Path, text: str | bytes) -> PositionFile:
    path = tmp_path / "geo.txt"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_position_file(path)


def test_fields_of_geo_txt_count_strictly_by_position(tmp_path: Path) -> None:
    file = read(
        tmp_path,
        "# made by hand\nEPSG:32633\n"
        "a.jpg 388710.5 5299705.2\n"
        "b.jpg 388710.5 5299705.2 512.0\n"
        "c.jpg 388710.5 5299705.2 512.0 0.02 0.03\n"
        "d.jpg 388710.5 5299705.2 512.0 90 -5 1\n"
        "# c.jpg in between\n"
        "e.jpg\t388710.5\t5299705.2\t512.0\t0\t0\t0\t0.02\t0.03\n",
    )
    place = (388710.5, 5299705.2)
    nothing = (None, None)
    assert file.crs == "EPSG:32633"
    assert file.photos == (
        PhotoPlace(3, "a.jpg", *place, None, None, nothing),
        PhotoPlace(4, "b.jpg", *place, 512.0, None, nothing),
        PhotoPlace(5, "c.jpg", *place, 512.0, None, nothing),
        PhotoPlace(6, "d.jpg", *place, 512.0, (90.0, -5.0, 1.0), nothing),
        PhotoPlace(8, "e.jpg", *place, 512.0, None, (0.02, 0.03)),
    )


@pytest.mark.parametrize(
    "text",
    [
        "name,lon,lat,alt\na b.jpg,13.5127,47.8412,512\n",
        "\ufeffImage;Longitude;Latitude;Altitude\r\na b.jpg;13,5127;47,8412;512\r\n",
        "EPSG:4326\nfilename\tx\ty\tz\na b.jpg\t13.5127\t47.8412\t512\n",
        "# CRS: EPSG:4326\nlabel,y,x,height\na b.jpg,47.8412,13.5127,512\n",
        'photo,x,y,z,epsg\n"a b.jpg",13.5127,47.8412,512,4326\n',
    ],
)
def test_a_csv_is_read_by_its_header(tmp_path: Path, text: str) -> None:
    file = read(tmp_path, text)
    assert file.crs == "EPSG:4326"
    (photo,) = file.photos
    assert (photo.name, photo.x, photo.y, photo.z) == ("a b.jpg", 13.5127, 47.8412, 512.0)


def test_angles_and_accuracies_of_a_csv(tmp_path: Path) -> None:
    header = "name,lon,lat,alt,yaw,pitch,roll,sigma_horizontal,sigma_vertical\n"
    file = read(tmp_path, header + "a.jpg,13.5,47.8,512,90,-88,0.5,0.02,0.04\nb.jpg,13.5,47.8,,,,,0,\n")
    assert file.photos[0].angles_deg == (90.0, -88.0, 0.5)
    assert file.photos[0].sigma_m == (0.02, 0.04)
    assert (file.photos[1].z, file.photos[1].angles_deg, file.photos[1].sigma_m) == (None, None, (None, None))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# nothing\n\n", "is empty"),
        ("EPSG:4326\n", "lists no photo"),
        ("a.jpg 13.5 47.8 512\n", "Line 1 .* the first line must state the CRS"),
        ("EPSG:4326\na.jpg 13.5\n", "Line 2 .* 2 fields separated by blanks, but at least 3 are needed: photo x y"),
        ("EPSG:4326\na.jpg 13.5 north\n", "Line 2 .* y is 'north'"),
        ("EPSG:4326\na.jpg 13.5 inf\n", "Line 2 .* y is 'inf'"),
        ("EPSG:4326\na.jpg 13.5 1e300\n", "Line 2 .* not a valid number"),
        ("EPSG:4326\na.jpg 13.5 -\n", "Line 2 .* no x or no y"),
        ("EPSG:4326\na.jpg 1 2\na.jpg 1 2\n", "Line 3 .* was in line 2 already"),
        ("EPSG:4326\na.jpg 1 2 3 0 0 0 -5 1\n", "Line 2 .* an accuracy of -5 m"),
        ("EPSG:4326\na.jpg 1 2 3 1e6 0 0\n", "Line 2 .* angles"),
        ("name,x,y\na.jpg,388710,5299705\n", "states no CRS"),
        ("name,x,y,epsg\na.jpg,1,2,4326\nb.jpg,1,2,32633\n", "Line 3 .* another CRS"),
        ("EPSG:4326\n" + "a" * (MAX_LINE_CHARS + 1), "no plain text in line 2"),
        ("EPSG:4326\na\x00.jpg 1 2\n", "no plain text in line 2"),
        (b"EPSG:4326\n\xff\xfe.jpg 1 2\n", "not UTF-8 text"),
    ],
)
def test_errors_are_reported_with_their_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    with pytest.raises(SplatpipeError, match=message) as caught:
        read(tmp_path, text)
    assert caught.value.hint


def test_hostile_files_are_refused_or_read_and_nothing_else(tmp_path: Path) -> None:
    rng = random.Random(4)
    text = "EPSG:32633\nname,x,y\na.jpg 388710.5 5299705.2 512.0 90 -5 1 0.02 0.03\nb.jpg\t1\t2\t3\n"
    for _ in range(300):
        data = bytearray(text.encode())
        for _ in range(rng.randint(1, 12)):
            at = rng.randrange(len(data))
            data[at : at + rng.randint(0, 3)] = bytes(rng.choices(b' \t\n,;"#-.e19:\x00\xc3', k=rng.randint(0, 4)))
        try:
            read(tmp_path, bytes(data))
        except SplatpipeError as error:
            assert error.message and error.hint


PLACE = (13.5127, 47.8412, 512.0)


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:4326\n{name},13.5127,47.8412,512\n",
        "EPSG:4326;;;\n{name};13,5127;47,8412;512,0\n",
        "sep=;\nEPSG:4326\n{name};13.5127;47.8412;512\n",
        '"sep=,"\nname,lon,lat,alt\n"{name}",13.5127,47.8412,512\n',
        "EPSG:4326\n{name} 13.5127 47.8412 512\n",  # by blanks
        "EPSG:4326\n{name} 13,5127 47,8412 512\n",
        "# image_name x y z\nEPSG:4326\n{name}\t13.5127\t47.8412\t512\n",
        # Metashape: titles in a comment, the CRS in words
        "# Coordinate system: WGS 84 (EPSG::4326)\n#Label,Longitude,Latitude,Altitude,Yaw,Pitch,Roll,Error_(m)\n"
        "{name},13.5127,47.8412,512.0,,,,0.01\nlost.JPG,,,,,,,\n#Total Error,,,,,,,0.02\n",
        '# Cameras (1)\n# Coordinate system: GEOGCS["W",DATUM["W",AUTHORITY["EPSG","6326"]],AUTHORITY["EPSG","4326"]]\n'
        "#Label\tX/Longitude\tY/Latitude\tZ/Altitude\n{name}\t13.5127\t47.8412\t512\n",
        # Pix4D's titles
        "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [m],accuracy horizontal [m]\n"
        "{name},47.8412,13.5127,512,0.02\n",
        "imageName Longitude Latitude Altitude\n{name} 13.5127 47.8412 512\n",
        # Emlid: projected coordinates in a CRS that is named only, and degrees
        "Name,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height,CS name\n"
        "{name},388710.5,5299705.2,465,13.5127,47.8412,512,RDN2008 / Italy zone (N-E)\n",
        "\ufeffSourceFile,GPSLatitude,GPSLongitude,GPSAltitude\r\n{name},47.8412,13.5127,512\r\n",  # exiftool
    ],
)
@pytest.mark.parametrize("name", ["DJI_0001.JPG", "2026-09-26 15-24-47 left.JPG"])
def test_separator_and_columns_of_other_programs_are_found(tmp_path: Path, text: str, name: str) -> None:
    (photo,) = read(tmp_path, text.format(name=name)).photos
    assert (photo.name, photo.x, photo.y, photo.z) == (name, *PLACE)


def test_utf_16_of_a_spreadsheet_is_read(tmp_path: Path) -> None:
    text = "Name\tLongitude\tLatitude\tAltitude\r\nä b.jpg\t13,5127\t47,8412\t512\r\n"
    (photo,) = read(tmp_path, text.encode("utf-16")).photos
    assert (photo.name, photo.x, photo.y, photo.z) == ("ä b.jpg", *PLACE)


@pytest.mark.parametrize(
    ("text", "crs"),
    [
        ("Name,Easting,Northing,Elevation,CS name\na.jpg,1,2,3,WGS 84 / UTM zone 33N\n", "WGS 84 / UTM zone 33N"),
        ("# CRS: 32633\nname,x,y\na.jpg,1,2\n", "EPSG:32633"),
        (
            '# CoordinateSystem: PROJCS["WGS 84 / UTM zone 33N",AUTHORITY["EPSG","32633"]]\nlabel,x,y\na.jpg,1,2\n',
            "EPSG:32633",
        ),
        ("EPSG:25832+7837,,,\na.jpg,1,2,3\n", "EPSG:25832+7837"),
        ("name,lon,lat,ellipsoidal height\na.jpg,13,47,3\n", "EPSG:4979"),
    ],
)
def test_the_crs_is_found_where_programs_state_it(tmp_path: Path, text: str, crs: str) -> None:
    assert read(tmp_path, text).crs == crs


def test_names_with_blanks_and_without_suffix_are_told_by_the_photos(tmp_path: Path) -> None:
    path = tmp_path / "geo.txt"
    path.write_text("EPSG:4326\nflight 1 12 13.5127 47.8412 512\nflight 1 13 13.5127 47.8413 512\n")
    file = read_position_file(path, ["flight 1 12.JPG", "flight 1 13.JPG"])
    assert [(photo.name, photo.y) for photo in file.photos] == [("flight 1 12", 47.8412), ("flight 1 13", 47.8413)]


def test_what_cannot_be_read_names_the_separator_the_columns_and_an_example(tmp_path: Path) -> None:
    with pytest.raises(
        SplatpipeError, match="1 field separated by blanks, but at least 3 are needed: photo x y"
    ) as caught:
        read(tmp_path, "EPSG:4326\na.jpg|13.5|47.8\n")
    assert "DJI_0001.JPG 13.5127 47.8412 512.3" in caught.value.hint


def test_names_in_quotes_between_blanks_and_a_photo_with_two_positions(tmp_path: Path) -> None:
    path = tmp_path / "geo.txt"
    path.write_text('EPSG:4326\n"DJI_0001.JPG" 13.5 47.8 512\n"DJI 0002.JPG" 13.6 47.9 513\n')
    assert [photo.name for photo in read_position_file(path).photos] == ["DJI_0001.JPG", "DJI 0002.JPG"]
    path.write_text("EPSG:4326\nDJI_0001.JPG 13.5 47.8 512\nDJI_0001.JPG 13.6 47.9 513\n")
    with pytest.raises(SplatpipeError, match=r"Line 3 of geo\.txt: DJI_0001\.JPG was in line 2 already") as caught:
        read_position_file(path)
    assert "one position" in caught.value.hint


@pytest.mark.parametrize(
    ("number", "way"),
    [("13°30'46.8\"E", "degrees with decimals"), ("13 30 46 E", "degrees with decimals"), ("388'710.51", "thousands")],
)
def test_a_number_in_another_notation_is_refused_with_the_right_one(tmp_path: Path, number: str, way: str) -> None:
    path = tmp_path / "positions.csv"
    path.write_text(f"name;longitude;latitude\nDJI_0001.JPG;{number};47.8\n")
    with pytest.raises(SplatpipeError, match="not a valid number") as caught:
        read_position_file(path)
    assert way in caught.value.hint
