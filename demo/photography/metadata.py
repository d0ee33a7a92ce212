"""Write EXIF and XMP like a DJI camera's into JPEG files, without touching the pixels."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from splatpipe.demo import CAPTURE, capture_path

MAKE, MODEL = "DJI", "M3E"
FOCAL_LENGTH_MM, FOCAL_LENGTH_35_MM = 12.29, 24
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
APP0, APP1, START_OF_SCAN = 0xE0, 0xE1, 0xDA
XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
DJI_ATTRIBUTE = re.compile(r'drone-dji:(\w+)="([^"]*)"')


@dataclass(frozen=True)
class GpsPosition:
    """A GNSS receiver's position: WGS84 degrees, altitude in metres (here: above the ellipsoid)."""

    latitude: float
    longitude: float
    altitude_m: float


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes, seconds to a millionth of a second (0.03 mm)."""
    micro_seconds = round(abs(degrees) * 3600e6)
    minutes, seconds = divmod(micro_seconds, 60_000_000)
    return IFDRational(minutes // 60), IFDRational(minutes % 60), IFDRational(seconds, 1_000_000)


def gps_tags(position: GpsPosition) -> dict[int, object]:
    """The GPS directory of EXIF."""
    return {
        0: b"\x02\x03\x00\x00",
        1: "N" if position.latitude >= 0 else "S",
        2: _sexagesimal(position.latitude),
        3: "E" if position.longitude >= 0 else "W",
        4: _sexagesimal(position.longitude),
        5: b"\x00",
        6: IFDRational(round(position.altitude_m * 1000), 1000),
        18: "WGS-84",
    }


def build_exif(size: tuple[int, int], taken: str, exposure_s: float, position: GpsPosition) -> bytes:
    """Build an EXIF block.

    Args:
        size: Width and height, pixels.
        taken: ``YYYY:MM:DD HH:MM:SS``.
        exposure_s: Exposure time.
        position: Position from the receiver.
    """
    exif = Image.Exif()
    exif.update(
        {
            0x010E: "rendered by splatpipe's demo generator",
            0x010F: MAKE,
            0x0110: MODEL,
            0x0112: 1,
            0x011A: IFDRational(72),
            0x011B: IFDRational(72),
            0x0128: 2,
            0x0131: "10.13.02.14",
            0x0132: taken,
        }
    )
    exif.get_ifd(EXIF_IFD).update(
        {
            0x829A: IFDRational(round(exposure_s * 1e7), 10_000_000),
            0x829D: IFDRational(28, 10),
            0x8822: 2,
            0x8827: 100,
            0x9000: b"0230",
            0x9003: taken,
            0x9004: taken,
            0x9204: IFDRational(0, 100),
            0x920A: IFDRational(round(FOCAL_LENGTH_MM * 100), 100),
            0xA001: 1,
            0xA002: size[0],
            0xA003: size[1],
            0xA405: FOCAL_LENGTH_35_MM,
        }
    )
    exif.get_ifd(GPS_IFD).update(gps_tags(position))
    return exif.tobytes()


def position_attributes(position: GpsPosition) -> dict[str, str]:
    """The position attributes of DJI's XMP."""
    return {
        "GpsLatitude": f"{position.latitude:+.9f}",
        "GpsLongitude": f"{position.longitude:+.9f}",
        "AbsoluteAltitude": f"{position.altitude_m:+.3f}",
    }


def build_xmp(taken: str, dji: Mapping[str, str]) -> bytes:
    """Build an XMP packet with DJI's attributes."""
    date = taken.replace(":", "-", 2).replace(" ", "T")
    lines = "".join(f'\n   drone-dji:{key}="{value}"' for key, value in dji.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="DJI Meta Data"\n   xmlns:tiff="http://ns.adobe.com/tiff/1.0/"\n'
        '   xmlns:xmp="http://ns.adobe.com/xap/1.0/"\n   xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"\n'
        f'   xmp:CreateDate="{date}"\n   tiff:Make="{MAKE}"\n   tiff:Model="{MODEL}"{lines}>\n'
        '  </rdf:Description>\n </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    ).encode()


def read_dji(jpeg: bytes) -> dict[str, str]:
    """Read DJI's XMP attributes from a photo of this capture."""
    start, end = jpeg.find(b"<x:xmpmeta"), jpeg.find(b"</x:xmpmeta>")
    return dict(DJI_ATTRIBUTE.findall(jpeg[start:end].decode()))


def with_metadata(jpeg: bytes, exif: bytes, xmp: bytes) -> bytes:
    """Replace a JPEG's APP0 and APP1 segments with this EXIF and XMP; the coded pixels are unchanged.

    Args:
        jpeg: A baseline or progressive JPEG file.
        exif: From ``Image.Exif.tobytes``, with its ``Exif`` header.
        xmp: The packet.
    """
    kept, at = [], 2
    while jpeg[at + 1] != START_OF_SCAN:
        length = 2 + struct.unpack(">H", jpeg[at + 2 : at + 4])[0]
        if jpeg[at + 1] not in (APP0, APP1):
            kept.append(jpeg[at : at + length])
        at += length
    return b"\xff\xd8" + _segment(exif) + _segment(XMP_HEADER + xmp) + b"".join(kept) + jpeg[at:]


def _segment(payload: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def write_rtk_variant(folder: Path) -> Path:
    """Write the demo photos as an RTK drone's: the same pixels, positions accurate to 2 and 3 cm, RTK tags.

    Args:
        folder: The target; created if missing.

    Returns:
        ``folder``.
    """
    rtk = json.loads((CAPTURE / "rtk.json").read_text("utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    for name, (latitude, longitude, altitude_m) in rtk["positions"].items():
        position = GpsPosition(latitude, longitude, altitude_m)
        source = capture_path() / name
        jpeg = source.read_bytes()
        with Image.open(source) as photo:
            exif = photo.getexif()
        taken = str(exif[0x0132])
        exif.get_ifd(GPS_IFD).update(gps_tags(position))
        xmp = build_xmp(taken, {**read_dji(jpeg), **position_attributes(position), **rtk["xmp"]})
        (folder / name).write_bytes(with_metadata(jpeg, exif.tobytes(), xmp))
    return folder
