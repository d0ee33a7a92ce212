"""EXIF and XMP: drones' metadata is read, and hostile bytes do no harm."""

import io
import math
import struct
import warnings

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from splatpipe.pipeline.photos.metadata.exif import Exif, read_exif
from splatpipe.pipeline.photos.metadata.xmp import MAX_PACKET_BYTES, find_packet, parse_xmp, xmp_number

DJI = "http://www.dji.com/drone-dji/1.0/"
RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def packet(attributes: str = "", inside: str = "", before: str = "") -> bytes:
    text = (
        f'{before}<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{RDF}"><rdf:Description rdf:about="" '
        f'xmlns:drone-dji="{DJI}" {attributes}>{inside}</rdf:Description></rdf:RDF></x:xmpmeta>'
    )
    return text.encode()


def exif_of(exif_bytes: bytes) -> Exif:
    """Read EXIF back from a JPEG that carries it."""
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "JPEG", exif=exif_bytes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's, of broken tags; ingest does the same
        with Image.open(io.BytesIO(stream.getvalue())) as picture:
            return read_exif(picture)


def tagged(base: dict[int, object], detail: dict[int, object], gps: dict[int, object]) -> Exif:
    exif = Image.Exif()
    exif.update(base)
    exif.get_ifd(0x8769).update(detail)
    exif.get_ifd(0x8825).update(gps)
    return exif_of(exif.tobytes())


def test_exif_of_a_drone_is_read() -> None:
    exif = tagged(
        {271: "DJI\0\0\0\0", 272: "FC300S\0\0", 274: 6},
        {0x9003: "2016:06:23 16:31:59", 0x9291: "89", 0x920A: IFDRational(361, 100), 0xA405: 20}
        | {0xA002: 4000, 0xA003: 2250, 0xA20E: IFDRational(4000, 1), 0xA210: 3},
        {1: "S", 2: (46.0, 50.0, 33.3855), 3: "W", 4: (91.0, 59.0, 40.4156), 5: b"\x01", 6: IFDRational(198309, 1000)}
        | {31: IFDRational(25, 10)},
    )
    assert (exif.make, exif.model, exif.orientation) == ("DJI", "FC300S", 6)
    assert exif.time == "2016-06-23T16:31:59.89"
    assert (exif.focal_mm, exif.focal_35mm, exif.width, exif.height) == (3.61, 20.0, 4000, 2250)
    assert exif.focal_plane_px_per_mm == pytest.approx(400.0)
    assert exif.gps is not None
    assert exif.gps.latitude == pytest.approx(-46.8426071, abs=1e-7)
    assert exif.gps.longitude == pytest.approx(-91.9945599, abs=1e-7)
    assert exif.gps.altitude_m == pytest.approx(-198.309)
    assert exif.gps.horizontal_error_m == 2.5


def test_no_exif_is_all_defaults() -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "PNG")
    with Image.open(stream) as picture:
        assert read_exif(picture) == Exif()


def test_nonsensical_values_are_ignored() -> None:
    exif = tagged(
        {271: "\0\0\x07\n ", 272: "M" * 5000, 274: 42},
        {0x9003: "0000:00:00 00:00:00", 0x920A: IFDRational(0, 0), 0xA405: 0, 0xA002: 0, 0xA003: 4_000_000_000}
        | {0xA20E: IFDRational(1, 0)},
        {1: "N", 2: (IFDRational(0, 0), 0.0, 0.0), 3: "E", 4: (999999.0, 0.0, 0.0), 6: IFDRational(1, 0)},
    )
    assert exif.make == ""
    assert len(exif.model) == 64
    assert (exif.orientation, exif.time, exif.focal_mm, exif.focal_35mm) == (1, None, None, None)
    assert (exif.width, exif.height, exif.focal_plane_px_per_mm) == (None, None, None)
    assert exif.gps is not None
    assert math.isnan(exif.gps.latitude)
    assert exif.gps.altitude_m is None


@given(st.binary(max_size=400))
@settings(max_examples=150, deadline=None)
def test_any_bytes_as_exif_do_no_harm(data: bytes) -> None:
    exif = exif_of(b"Exif\0\0" + data)
    assert 1 <= exif.orientation <= 8


ENTRY = st.tuples(
    st.sampled_from([271, 272, 274, 306, 0x8769, 0x8825, 0x9003, 0x920A, 0xA002, 0xA20E, 0xA405, 1, 2, 3, 4, 5, 6]),
    st.integers(0, 14),
    st.sampled_from([0, 1, 2, 3, 65535, 2**31, 2**32 - 1]),
    st.sampled_from([0, 1, 8, 26, 38, 100, 2**31, 2**32 - 1]),
)


@given(st.lists(ENTRY, max_size=12), st.binary(max_size=64), st.sampled_from(["<", ">"]))
@settings(max_examples=150, deadline=None)
def test_any_directory_of_tags_does_no_harm(entries: list[tuple[int, int, int, int]], tail: bytes, order: str) -> None:
    """Real tags with wrong types, huge counts and offsets that lead outside or in circles."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(entries))
    body = b"".join(struct.pack(order + "HHII", *entry) for entry in sorted(entries))
    exif = exif_of(b"Exif\0\0" + head + body + struct.pack(order + "I", 8) + tail)
    assert exif.focal_mm is None or 0.1 <= exif.focal_mm <= 10_000


def test_xmp_is_read_as_attributes_and_as_elements() -> None:
    for found in (
        parse_xmp(packet('drone-dji:RelativeAltitude="+39.80"')),
        parse_xmp(packet(inside="<drone-dji:RelativeAltitude> +39.80 </drone-dji:RelativeAltitude>")),
    ):
        assert xmp_number(found, "drone-dji:RelativeAltitude", -1000, 1000) == 39.8


def test_xmp_prefixes_are_resolved_or_taken_as_they_are() -> None:
    other = packet('d:GimbalYawDegree="12"').replace(b"xmlns:drone-dji", b"xmlns:d")
    assert parse_xmp(other)["drone-dji:GimbalYawDegree"] == "12"
    undeclared = b'<x:xmpmeta><a drone-dji:GimbalYawDegree="12"/></x:xmpmeta>'
    assert parse_xmp(undeclared)["drone-dji:GimbalYawDegree"] == "12"


def test_xmp_packet_is_cut_out_of_a_file() -> None:
    data = b"\xff\xd8junk" + packet('drone-dji:A="1"') + b"more" + packet('drone-dji:A="2"')
    assert parse_xmp(find_packet(data))["drone-dji:A"] == "1"
    assert find_packet(b"<x:xmpmeta" + b" " * (MAX_PACKET_BYTES + 10) + b"</x:xmpmeta>") == b""
    assert find_packet(b"<x:xmpmeta without an end") == b""


def test_entities_and_document_types_are_refused() -> None:
    lol = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    bomb = packet('drone-dji:A="1"', "&l9;", before=f'<!DOCTYPE x [<!ENTITY l0 "lol">{lol}]>')
    outside = packet('drone-dji:A="1"', "&e;", before='<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>')
    assert parse_xmp(bomb) == {}
    assert parse_xmp(outside) == {}
    assert parse_xmp(packet('drone-dji:A="&undeclared;"')) == {}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"<x:xmpmeta>",
        b"<x:xmpmeta></y></x:xmpmeta>",
        b"<a>" * 1000 + b"</a>" * 1000,
        packet(" ".join(f'a:p{i}="1"' for i in range(5000))),
        b" " * (MAX_PACKET_BYTES + 1),
        b'<?xml version="1.0" encoding="no-such"?><x:xmpmeta/>',
    ],
)
def test_broken_deep_and_endless_packets_give_nothing(data: bytes) -> None:
    assert parse_xmp(data) == {}


@given(st.binary(max_size=300))
@settings(max_examples=150, deadline=None)
def test_any_bytes_as_xmp_do_no_harm(data: bytes) -> None:
    assert isinstance(parse_xmp(b"<x:xmpmeta>" + data + b"</x:xmpmeta>"), dict)
    assert isinstance(parse_xmp(data), dict)


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e999", "", "12 m", "1/0", "0x10", "2000"])
def test_xmp_numbers_are_finite_and_bounded(text: str) -> None:
    assert xmp_number({"a:b": text}, "a:b", -1000.0, 1000.0) is None


def test_xmp_rationals_are_numbers() -> None:
    assert xmp_number({"a:b": "398/10"}, "a:b", -1000.0, 1000.0) == 39.8
