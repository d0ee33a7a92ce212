"""Parse a photo's XMP to flat text properties, from untrusted bytes.

Drones write their altitudes, angles and accuracies there (``drone-dji:``, ``Camera:``), as attributes or as elements.
The packet is parsed without DTDs (so that no entity can be declared, expanded or fetched) and within limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from xml.parsers import expat

PACKET_START = b"<x:xmpmeta"
PACKET_END = b"</x:xmpmeta>"
MAX_PACKET_BYTES = 1 << 20  # a drone's packet has 2 to 8 kB; editors' histories reach some hundred kB
MAX_PROPERTIES = 2000
MAX_DEPTH = 32
MAX_VALUE_CHARS = 1000
MAX_NAME_CHARS = 200
SEPARATOR = ", "  # joins the items of an XMP list
PREFIX_OF_NAMESPACE = {
    "http://www.dji.com/drone-dji/1.0/": "drone-dji",
    "http://pix4d.com/camera/1.0": "Camera",
    "http://pix4d.com/camera/1.0/": "Camera",
    "http://ns.adobe.com/tiff/1.0/": "tiff",
    "http://ns.adobe.com/exif/1.0/": "exif",
}


class _RefusedError(Exception):
    """The packet exceeds a limit or declares a document type."""


class _Properties:
    """Collector of attributes and leaf elements as ``prefix:name`` -> text; the first of a name wins."""

    def __init__(self) -> None:
        self.values: dict[str, str] = {}
        self._prefixes: dict[str, str] = {}
        self._open: list[tuple[str, list[str], list[str]]] = []  # element, its text, the items of a list in it

    def start(self, name: str, attributes: dict[str, str]) -> None:
        for key, value in attributes.items():
            if key.startswith("xmlns:") and value in PREFIX_OF_NAMESPACE:
                self._prefixes[key.removeprefix("xmlns:")] = PREFIX_OF_NAMESPACE[value]
        for key, value in attributes.items():
            if not key.startswith("xmlns"):
                self._add(key, value)
        if len(self._open) >= MAX_DEPTH:
            raise _RefusedError
        self._open.append((name, [], []))

    def text(self, data: str) -> None:
        if self._open:
            self._open[-1][1].append(data)

    def end(self, name: str) -> None:
        opened, texts, items = self._open.pop()
        text = "".join(texts).strip() or SEPARATOR.join(items)
        if not text or opened != name:
            return
        self._add(name, text)
        if name == "rdf:li":
            around = (items for element, _, items in reversed(self._open) if not element.startswith("rdf:"))
            next(around, []).append(text)

    def refuse(self, *_: object) -> None:
        raise _RefusedError

    def _add(self, name: str, value: str) -> None:
        prefix, colon, local = name.partition(":")
        if len(self.values) >= MAX_PROPERTIES:
            raise _RefusedError
        if colon and len(name) <= MAX_NAME_CHARS and len(value) <= MAX_VALUE_CHARS:
            self.values.setdefault(f"{self._prefixes.get(prefix, prefix)}:{local}", value.strip())


def find_packet(data: bytes) -> bytes:
    """Extract the first XMP packet from a file's or a segment's bytes; empty if there is none."""
    start = data.find(PACKET_START)
    if start < 0:
        return b""
    end = data.find(PACKET_END, start, start + MAX_PACKET_BYTES)
    return b"" if end < 0 else data[start : end + len(PACKET_END)]


def parse_xmp(packet: bytes) -> Mapping[str, str]:
    """Read a packet's properties.

    Args:
        packet: From ``<x:xmpmeta`` to ``</x:xmpmeta>``; untrusted.

    Returns:
        ``{"drone-dji:RelativeAltitude": "+39.80", …}``: known namespaces under the prefix used here, others under the
        file's own; the items of a list are joined by commas. Empty if the packet is broken, declares a document type or
        exceeds a limit.
    """
    if not packet or len(packet) > MAX_PACKET_BYTES:
        return {}
    properties = _Properties()
    # Without namespace processing: packets with undeclared prefixes are common, and can be read this way.
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    parser.StartElementHandler = properties.start
    parser.EndElementHandler = properties.end
    parser.CharacterDataHandler = properties.text
    parser.StartDoctypeDeclHandler = properties.refuse
    parser.EntityDeclHandler = properties.refuse
    try:
        parser.Parse(packet, True)
    except (expat.ExpatError, _RefusedError, ValueError, LookupError):  # LookupError: an encoding Python does not know
        return {}
    return properties.values


def xmp_number(properties: Mapping[str, str], name: str, low: int | float, high: int | float) -> float | None:
    """A property as a finite number within ``[low, high]``, else None. ``+39.80`` and ``398/10`` are numbers."""
    text = properties.get(name, "")
    numerator, slash, denominator = text.partition("/")
    try:
        value = float(numerator) / float(denominator) if slash else float(text)
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if math.isfinite(value) and low <= value <= high else None
