"""Field inputs: files of control, positions and boundaries."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from field_case import FieldInput, control_lines, copy_photos, edited, gps_of
from pyproj import Transformer

USED = (4, 17, 18, 19, 20)
STRIPPED = {2: None, 4: None, 6: None, 1: None, 3: None, 5: None}


def photos(folder: Path, indices: Sequence[int] = USED, *, positions: bool = True) -> None:
    """Write the photos that the files speak of, with or without positions of their own."""
    if positions:
        copy_photos(folder / "photos", indices)
        return
    (folder / "photos").mkdir()
    for i in indices:
        (folder / f"photos/DJI_{i + 1:04}.JPG").write_bytes(edited(i, gps=STRIPPED))


def marks(indices: Sequence[int] = USED) -> list[list[str]]:
    """Return the demo's marks in these photos: x, y, z, pixel x, pixel y, photo, name."""
    names = {f"DJI_{i + 1:04}.JPG" for i in indices}
    return [fields for line in control_lines()[1:] if (fields := line.split())[5] in names]


def write(folder: Path, name: str, text: str, encoding: str = "utf-8") -> None:
    """Write a file beside the photos, byte for byte."""
    (folder / "photos" / name).write_bytes(text.encode(encoding))


def german_excel(folder: Path) -> None:
    """A German Excel's CSV: sep=;, decimal commas, code page 1252, titles in German, trailing delimiters."""
    photos(folder)
    lines = ["sep=;", "EPSG:32633;;;;;;", "Punkt;Rechtswert;Hochwert;Höhe;Bild;Pixel X;Pixel Y;"]
    lines += [
        ";".join([f[6], f[0].replace(".", ","), f[1].replace(".", ","), f[2].replace(".", ","), f[5],
                  f[3].replace(".", ","), f[4].replace(".", ",")]) + ";"
        for f in marks()
    ]  # fmt: skip
    write(folder, "control.csv", "\r\n".join(lines) + "\r\n", "cp1252")


def utf16_tabs(folder: Path) -> None:
    """Excel's "Unicode text": UTF-16 with BOM, tabs, names in quotes."""
    photos(folder)
    lines = ["EPSG:32633", *("\t".join([*f[:5], f'"{f[5]}"', f[6]]) for f in marks())]
    write(folder, "gcp_list.txt", "\r\n".join(lines) + "\r\n", "utf-16")


def degrees_minutes_seconds(folder: Path) -> None:
    """Positions as degrees, minutes and seconds with their signs, as a GPS program exports them."""
    photos(folder, positions=False)

    def dms(value: float) -> str:
        degrees, rest = divmod(value, 1)
        minutes, rest = divmod(rest * 60, 1)
        return f"{degrees:.0f}°{minutes:02.0f}'{rest * 60:08.5f}\""

    lines = ["name,latitude,longitude,altitude"]
    for i in USED:
        latitude, longitude, altitude = gps_of(i)
        escaped = [dms(latitude).replace('"', '""') + "N", dms(longitude).replace('"', '""') + "E"]
        lines.append(f'DJI_{i + 1:04}.JPG,"{escaped[0]}","{escaped[1]}",{altitude}')
    write(folder, "positions.csv", "\n".join(lines) + "\n")


def names_as_paths(folder: Path) -> None:
    """geo.txt with Windows paths, lower case, no extension, quotes, comments and blank lines."""
    photos(folder, positions=False)
    lines = ["EPSG:4326", "# exported 2026-06-18", ""]
    for n, i in enumerate(USED):
        latitude, longitude, altitude = gps_of(i)
        stem = f"DJI_{i + 1:04}"
        name = (
            f"D:\\flight\\100MEDIA\\{stem}.JPG",
            f"./images/{stem}.JPG",
            f"{stem.lower()}.jpg",
            stem,
            f'"{stem}.JPG"',
        )[n % 5]
        lines.append(f"{name} {longitude:.8f} {latitude:.8f} {altitude}")
    write(folder, "geo.txt", "\n".join(lines) + "\n")


def latitude_first(folder: Path) -> None:
    """gcp_list.txt in EPSG:4326 with latitude first, as EPSG has it; the photos have positions."""
    photos(folder)
    back = Transformer.from_crs(32633, 4326, always_xy=True)
    lines = ["EPSG:4326"]
    for f in marks():
        longitude, latitude = back.transform(float(f[0]), float(f[1]))
        lines.append(f"{latitude:.9f} {longitude:.9f} {' '.join(f[2:])}")
    write(folder, "gcp_list.txt", "\n".join(lines) + "\n")


def wrong_zone(folder: Path) -> None:
    """Control in UTM 33 that says it is in UTM 32; the photos have positions."""
    photos(folder)
    write(folder, "gcp_list.txt", "\n".join(["EPSG:32632", *(" ".join(f) for f in marks())]) + "\n")


def repeated_names(folder: Path) -> None:
    """A point with two coordinates (a typing error of 10 m), and a mark given twice in one photo, 300 px apart."""
    photos(folder)
    rows = marks()
    rows[1][0] = f"{float(rows[1][0]) + 10:.4f}"
    again = [*rows[4][:3], f"{float(rows[4][3]) + 300:.2f}", *rows[4][4:]]
    write(folder, "gcp_list.txt", "\n".join(["EPSG:32633", *(" ".join(f) for f in [*rows, again])]) + "\n")


def thousands_separators(folder: Path) -> None:
    """Swiss and English thousands separators in quotes: 388'710.51 and 5,299,705.21."""
    photos(folder)
    lines = ["EPSG:32633", "name,x,y,z,photo,pixel_x,pixel_y"]
    for f in marks():
        x, y = f"{float(f[0]):,.4f}".replace(",", "'"), f'"{float(f[1]):,.4f}"'
        lines.append(",".join([f[6], x, y, f[2], f[5], f[3], f[4]]))
    write(folder, "control.csv", "\n".join(lines) + "\n")


def feet(folder: Path) -> None:
    """Positions in US survey feet, heights too, as the CRS says."""
    photos(folder, positions=False)
    forth = Transformer.from_crs(4326, 32633, always_xy=True)
    lines = ["+proj=utm +zone=33 +datum=WGS84 +units=us-ft +no_defs"]
    for i in USED:
        latitude, longitude, altitude = gps_of(i)
        x, y = forth.transform(longitude, latitude)
        foot = 1200 / 3937
        lines.append(f"DJI_{i + 1:04}.JPG {x / foot:.3f} {y / foot:.3f} {altitude / foot:.3f}")
    write(folder, "geo.txt", "\n".join(lines) + "\n")


def holes_in_tables(folder: Path) -> None:
    """Positions with "-", "n/a", "NaN" and nothing for numbers, a photo twice, and photos that do not exist."""
    photos(folder)
    lines = ["name;latitude;longitude;altitude;accuracy"]
    for n, i in enumerate(USED):
        latitude, longitude, altitude = gps_of(i)
        height = ("-", "n/a", "NaN", "", f"{altitude}")[n % 5]
        lines.append(f"DJI_{i + 1:04}.JPG;{latitude:.8f};{longitude:.8f};{height};0.03")
    latitude, longitude, altitude = gps_of(USED[0])
    lines += [f"DJI_{USED[0] + 1:04}.JPG;{latitude + 0.001:.8f};{longitude:.8f};{altitude};0.03"]
    lines += [f"DJI_07{n:02}.JPG;{latitude:.8f};{longitude:.8f};{altitude};0.03" for n in range(20)]
    write(folder, "positions.csv", "\n".join(lines) + "\n")


def kml_boundary(folder: Path) -> None:
    """A boundary drawn in Google Earth: KML."""
    photos(folder)
    ring = "13.5120,47.8408,0 13.5134,47.8408,0 13.5134,47.8416,0 13.5120,47.8416,0 13.5120,47.8408,0"
    (folder / "site.kml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<Polygon><outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
        "</Polygon></Placemark></Document></kml>"
    )


def boundaries(folder: Path) -> None:
    """GeoJSON with latitude first; a line; points; and a right one of two parts, one with a hole, in 3D with BOM."""
    photos(folder)
    ring = [[13.5120, 47.8408], [13.5134, 47.8408], [13.5134, 47.8416], [13.5120, 47.8416], [13.5120, 47.8408]]
    hole = [[13.5125, 47.8411], [13.5126, 47.8411], [13.5126, 47.8412], [13.5125, 47.8411]]
    far = [[x + 0.003, y] for x, y in ring]
    two = [[[[x, y, 500.0] for x, y in part] for part in parts] for parts in ([ring, hole], [far])]
    shapes = {
        "swapped": {"type": "Polygon", "coordinates": [[[y, x] for x, y in ring]]},
        "line": {"type": "LineString", "coordinates": ring},
        "points": {"type": "MultiPoint", "coordinates": ring},
        "two_parts": {"type": "MultiPolygon", "coordinates": two},
    }
    for name, geometry in shapes.items():
        text = json.dumps(
            {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": geometry}]}
        )
        (folder / f"{name}.geojson").write_bytes(text.encode("utf-8-sig" if name == "two_parts" else "utf-8"))


TABLE_INPUTS = (
    FieldInput(
        "german_excel", german_excel, ("check photos",), 0, ("No problems found",), mended="code page, titles: not read"
    ),
    FieldInput(
        "utf16_tabs", utf16_tabs, ("check photos",), 0, ("No problems found",), mended="names in quotes: not found"
    ),
    FieldInput(
        "degrees_minutes_seconds",
        degrees_minutes_seconds,
        ("check photos",),
        1,
        ("Write degrees with decimals",),
        mended="the notation was not named",
    ),
    FieldInput(
        "names_as_paths",
        names_as_paths,
        ("check photos",),
        0,
        ("No problems found",),
        mended="names in quotes: not found",
    ),
    FieldInput(
        "latitude_first", latitude_first, ("check photos",), 1, ("Read with its first two coordinates swapped",)
    ),
    FieldInput("wrong_zone", wrong_zone, ("check photos",), 1, ("Read as EPSG:32633, they match",)),
    FieldInput("repeated_names", repeated_names, ("check photos",), 1, ("P01 has other coordinates than in line 2",)),
    FieldInput(
        "thousands_separators",
        thousands_separators,
        ("check photos",),
        1,
        ("without signs between thousands",),
        mended="the notation was not named",
    ),
    FieldInput("feet", feet, ("check photos",), 0, ("No problems found",)),
    FieldInput("holes_in_tables", holes_in_tables, ("check photos",), 1, ("was in line 2 already",)),
    FieldInput(
        "kml_boundary", kml_boundary, ("run photos out --boundary site.kml --until ingest",), 1, ("save it as GeoJSON",)
    ),
    FieldInput(
        "boundaries",
        boundaries,
        tuple(
            f"run photos out --boundary {name}.geojson --until ingest"
            for name in ("swapped", "line", "points", "two_parts")
        ),
        0,
    ),
)
