"""Files of calibrated lenses: COLMAP's ``cameras.txt``, Metashape's XML, Pix4D's ``.cam`` and camera parameters.

The files are untrusted: no document types, no entities, and limits on everything. Conventions, converted to COLMAP's:

* Metashape (user manual, "Camera models"): ``cx``, ``cy`` are relative to the image centre, fx = f + b1, and
  x' = x (1 + k1 r^2 + …) + p1 (r^2 + 2 x^2) + 2 p2 x y: its p1 is OpenCV's p2, and vice versa.
* Pix4D ("How are the internal and external camera parameters defined?"): x' = x (1 + K1 r^2 + …) + 2 T1 x y
  + T2 (r^2 + 2 x^2), as OpenCV. A ``.cam`` is in millimetres on a sensor whose size is given in a comment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.parsers import expat

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.files.text_lines import text_lines
from splatpipe.pipeline.sfm.lenses.lens_model import GRID, PARAMETERS, StatedLens, is_known

MAX_BYTES = 32 << 20  # Pix4D's parameters take half a kilobyte per photo
MAX_LENSES = 1000
MAX_LINES = 2_000_000
MAX_DEPTH = 16
MAX_ELEMENTS = 200_000  # Metashape's cameras.xml has about ten per photo
MAX_CHARS = 200  # longest text of a number, and characters of a name that are kept
HIGHEST_TERM_PX = 0.5  # maximum error from dropping lens terms that COLMAP's models lack
# central share of the sides over which lens terms are tested: calibrations have no targets in the corners
CALIBRATED_SIDE_SHARE = 0.95
MAX_COEFFICIENT = 100.0  # largest distortion coefficient; long lenses have large ones, since r is small
FORMATS = "COLMAP's cameras.txt, Metashape's calibration XML, or Pix4D's .cam or calibrated_camera_parameters.txt"
CAM_KEYS = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")
SENSOR = re.compile(r"sensor width of\s+([0-9.eE+-]{1,40})\s*x\s*([0-9.eE+-]{1,40})\s*mm")


@dataclass(frozen=True)
class FileLens:
    """A lens read from a file.

    Attributes:
        lens: The lens; its size and parameters may be in millimetres.
        photos: Names of the photos taken with it, according to the file; empty if it names none.
    """

    lens: StatedLens
    photos: frozenset[str] = frozenset()


class _RefusedError(Exception):
    """The file exceeds a limit, or is not what it seems to be."""


def _content(path: Path) -> bytes:
    try:
        return read_small(path, MAX_BYTES)
    except OSError as error:
        raise _RefusedError(error.strerror or str(error)) from error


def read_lens_file(path: Path) -> tuple[FileLens, ...]:
    """Read every lens of a file.

    Raises:
        SplatpipeError: If the format is not supported, the file is broken, or it contains no usable lens.
    """
    try:
        data = _content(path)
        if b"\0" in data[:4096]:
            raise _RefusedError("it is no text")
        start = data.lstrip(b"\xef\xbb\xbf \t\r\n")[:1]
        lenses = _metashape(data) if start == b"<" else _text(data.decode("utf-8", "replace"))
        if not lenses:
            raise _RefusedError("it has no lens")
        if len(lenses) > MAX_LENSES:
            raise _RefusedError(f"it has more than {MAX_LENSES} lenses")
        return tuple(lenses)
    except (_RefusedError, ValueError, OverflowError) as error:
        raise SplatpipeError(
            f"{path.name} cannot be used as a lens: {str(error)[:200]}.",
            hint=f"Supported are {FORMATS}. Give another with --set ingest.lens=PATH, or =none for no lens file.",
        ) from error


def fitted(lens: StatedLens, width: int, height: int, tolerance: float) -> StatedLens | None:
    """Rescale a lens to another image size; None if the aspect ratio differs by more than the tolerance."""
    by_x, by_y = width / lens.width, height / lens.height
    if abs(by_x / by_y - 1.0) > tolerance:
        return None
    named = dict(zip(PARAMETERS[lens.model], lens.params, strict=True))
    for name in ("f", "fx", "cx"):
        if name in named:
            named[name] *= by_x
    for name in ("fy", "cy"):
        if name in named:
            named[name] *= by_y
    return replace(lens, width=width, height=height, params=tuple(named.values()))


def checked_lens(lens: StatedLens) -> StatedLens:
    """Return the lens if it is plausible: finite, principal point in the image, invertible up to the corners.

    Raises:
        ValueError: With the reason, if it is not.
    """
    if not is_known(lens.model):
        raise ValueError(f"COLMAP's camera model {lens.model[:40]} is not supported")
    if not all(math.isfinite(value) for value in (*lens.params, lens.width, lens.height)):
        raise ValueError("a number is not finite")
    if not (0.0 < lens.width <= 1e6 and 0.0 < lens.height <= 1e6):
        raise ValueError("the size of its pictures is impossible")
    named = dict(zip(PARAMETERS[lens.model], lens.params, strict=True))
    larger = max(lens.width, lens.height)
    focals = [named[name] for name in ("f", "fx", "fy") if name in named]
    if not all(0.05 <= focal / larger <= 50.0 for focal in focals):
        raise ValueError("its focal length cannot be one of pictures of its size")
    if not (0.0 < named["cx"] < lens.width and 0.0 < named["cy"] < lens.height):
        raise ValueError("its principal point is outside the picture")
    if any(abs(value) > MAX_COEFFICIENT for name, value in named.items() if name[0] in "kp"):
        raise ValueError("a coefficient of distortion is impossible")
    pixels = fitted(
        lens, max(1, round(1000.0 * lens.width / larger)), max(1, round(1000.0 * lens.height / larger)), 1.0
    )
    assert pixels is not None
    camera = pixels.colmap()
    across, down = (
        np.linspace(0.5 - CALIBRATED_SIDE_SHARE / 2, 0.5 + CALIBRATED_SIDE_SHARE / 2, GRID) * side
        for side in (camera.width, camera.height)
    )
    x, y = np.meshgrid(across, down)
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = np.asarray(camera.cam_from_img(places), np.float64)
    back = np.asarray(camera.img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], axis=1)), np.float64)
    if not np.isfinite(rays).all() or not float(np.abs(back - places).max()) <= 0.1:
        raise ValueError("its distortion folds the picture over before the corners")
    return lens


def _number(text: str) -> float:
    if len(text) > MAX_CHARS:
        raise _RefusedError("a number is too long")
    value = float(text)
    if not math.isfinite(value):
        raise _RefusedError(f"{text[:20]} is no finite number")
    return value


def _text(text: str) -> list[FileLens]:
    lines = text_lines(text)
    if len(lines) > MAX_LINES:
        raise _RefusedError("it has too many lines")
    head = text[:4096]
    if ("calibration file" in head and "Pix4D" in head) or SENSOR.search(head):
        return [_pix4d_cam(lines)]
    if "fileName imageWidth imageHeight" in head:
        return _pix4d_parameters(lines)
    return _colmap(lines)


def _colmap(lines: Sequence[str]) -> list[FileLens]:
    """Parse ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`` per line; lines starting with # are comments."""
    found = []
    for line in lines:
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) < 5 or len(fields) > 40:
            raise _RefusedError("its format is not known")
        int(fields[0][:MAX_CHARS])
        model = fields[1]
        if not is_known(model):
            raise _RefusedError(f"COLMAP's camera model {model[:40]} is not supported")
        params = tuple(_number(field) for field in fields[4:])
        if len(params) != len(PARAMETERS[model]):
            raise _RefusedError(f"{model} has {len(PARAMETERS[model])} parameters, not {len(params)}")
        lens = StatedLens(
            model, int(_number(fields[2])), int(_number(fields[3])), params, "file", fields[0][:MAX_CHARS]
        )
        found.append(FileLens(checked_lens(lens)))
        if len(found) > MAX_LENSES:
            break
    return found


def _pix4d_cam(lines: Sequence[str]) -> FileLens:
    size = next((match for line in lines[:100] if (match := SENSOR.search(line))), None)
    if size is None:
        raise _RefusedError("it does not say the sensor's size")
    values = {}
    for line in lines[:200]:
        fields = line.split()
        if len(fields) == 2 and fields[0] in CAM_KEYS:
            values[fields[0]] = _number(fields[1])
    missing = [key for key in CAM_KEYS if key not in values]
    if missing:
        raise _RefusedError(f"it lacks {', '.join(missing)}")
    focal, radial, tangential = values["F"], [values[f"K{n}"] for n in (1, 2, 3)], (values["T1"], values["T2"])
    params = _brown((focal, focal, values["Px"], values["Py"]), radial, tangential)
    lens = StatedLens("FULL_OPENCV", _number(size[1]), _number(size[2]), params, "file")
    return FileLens(checked_lens(lens))


def _pix4d_parameters(lines: Sequence[str]) -> list[FileLens]:
    """Parse ten lines per photo: name and size, three of K, radial, tangential, position, three of rotation."""
    rows = [line.split() for line in lines if line.strip()]
    start = next((k for k, row in enumerate(rows) if _is_size(row)), len(rows))
    photos: dict[StatedLens, set[str]] = {}
    for k in range(start, len(rows) - 5, 10):
        if not _is_size(rows[k]):
            raise _RefusedError("its blocks of ten lines are broken")
        matrix = [[_number(field) for field in row] for row in rows[k + 1 : k + 4]]
        radial, tangential = ([_number(field) for field in row] for row in rows[k + 4 : k + 6])
        if [len(row) for row in matrix] != [3, 3, 3] or (len(radial), len(tangential)) != (3, 2):
            raise _RefusedError("its blocks of ten lines are broken")
        inner = (matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2])
        params = _brown(inner, radial, (tangential[0], tangential[1]))
        lens = StatedLens("FULL_OPENCV", int(rows[k][-2]), int(rows[k][-1]), params, "file")
        photos.setdefault(lens, set()).add(" ".join(rows[k][:-2])[:MAX_CHARS])
        if len(photos) > MAX_LENSES:
            raise _RefusedError(f"it has more than {MAX_LENSES} lenses")
    return [FileLens(checked_lens(lens), frozenset(names)) for lens, names in photos.items()]


def _is_size(row: Sequence[str]) -> bool:
    return len(row) >= 3 and all(field.isascii() and field.isdigit() and len(field) < 7 for field in row[-2:])


def _brown(
    inner: tuple[float, float, float, float], radial: Sequence[float], tangential: tuple[float, float]
) -> tuple[float, ...]:
    """Return FULL_OPENCV's parameters; ``tangential`` is in OpenCV's order."""
    return (*inner, radial[0], radial[1], *tangential, radial[2], 0.0, 0.0, 0.0)


class _Calibrations:
    """Collect Metashape's ``calibration`` elements, from a calibration file or from the sensors in ``cameras.xml``."""

    def __init__(self) -> None:
        self.found: list[dict[str, str]] = []
        self._path: list[str] = []
        self._texts: list[str] = []
        self._elements = 0
        self._label = ""

    def start(self, name: str, attributes: Mapping[str, str]) -> None:
        self._elements += 1
        if len(self._path) >= MAX_DEPTH or self._elements > MAX_ELEMENTS:
            raise _RefusedError("its XML is too deep or too long")
        if name == "sensor":
            self._label = attributes.get("label", "")[:MAX_CHARS]
        if name == "calibration":
            if len(self.found) >= MAX_LENSES:
                raise _RefusedError(f"it has more than {MAX_LENSES} lenses")
            kept = {"class": attributes.get("class", ""), "projection": attributes.get("type", "frame")}
            self.found.append({**kept, "label": self._label})
        elif name == "resolution" and "calibration" in self._path:
            self.found[-1] |= {key: attributes.get(key, "")[:MAX_CHARS] for key in ("width", "height")}
        self._path.append(name)
        self._texts = []

    def text(self, data: str) -> None:
        if sum(map(len, self._texts)) + len(data) <= MAX_CHARS:
            self._texts.append(data)

    def end(self, name: str) -> None:
        self._path.pop()
        if self._path and self._path[-1] == "calibration":
            self.found[-1][name] = "".join(self._texts).strip() or self.found[-1].get(name, "")
        self._texts = []

    def refuse(self, *_: object) -> None:
        raise _RefusedError("it declares a document type or an entity")


def _metashape(data: bytes) -> list[FileLens]:
    collected = _Calibrations()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    parser.StartElementHandler = collected.start
    parser.EndElementHandler = collected.end
    parser.CharacterDataHandler = collected.text
    parser.StartDoctypeDeclHandler = collected.refuse
    parser.EntityDeclHandler = collected.refuse
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError) as error:
        raise _RefusedError(f"its XML is broken ({str(error)[:80]})") from error
    # Prefer a sensor's adjusted calibration to its initial one; in a calibration file it has no class.
    adjusted = {entry["label"] for entry in collected.found if entry["class"] == "adjusted"}
    wanted = [e for e in collected.found if e["class"] != "initial" or e["label"] not in adjusted]
    return [FileLens(checked_lens(_metashape_lens(entry))) for entry in wanted]


def _metashape_lens(entry: Mapping[str, str]) -> StatedLens:
    def value(name: str) -> float:
        return _number(entry[name]) if entry.get(name) else 0.0

    if "fx" in entry and "f" not in entry:
        raise _RefusedError("it is an old PhotoScan's; export it again from Metashape")
    projection = entry["projection"]
    if projection not in ("frame", "fisheye", "equidistant_fisheye"):
        raise _RefusedError(f"Metashape's projection {projection[:30]} is not supported")
    width, height, focal = value("width"), value("height"), value("f")
    if min(width, height, focal) <= 0.0:
        raise _RefusedError("it lacks f, width or height")
    if abs(value("b2")) * 0.5 * height / focal > HIGHEST_TERM_PX:
        raise _RefusedError("its pixels are skewed (b2), which COLMAP's models do not support")
    inner = (focal + value("b1"), focal, width / 2 + value("cx"), height / 2 + value("cy"))
    radial = [value(f"k{n}") for n in (1, 2, 3, 4)]
    tangential = (value("p2"), value("p1"))
    size = (int(width), int(height))
    if projection == "frame":
        three = _three_of_four(radial, focal, math.hypot(width, height) / 2)
        return StatedLens("FULL_OPENCV", *size, _brown(inner, three, tangential), "file", entry["label"])
    if max(map(abs, tangential)) * focal > HIGHEST_TERM_PX:
        raise _RefusedError("it is a fisheye with tangential distortion, which COLMAP's model does not support")
    return StatedLens("OPENCV_FISHEYE", *size, (*inner, *radial), "file", entry["label"])


def _three_of_four(radial: Sequence[float], focal: float, corner_px: float) -> list[float]:
    """Approximate four radial coefficients by three up to the corner, by least squares in pixels."""
    if radial[3] == 0.0:
        return list(radial[:3])
    r = np.linspace(0.0, 1.05 * corner_px / focal, 200)
    powers = np.stack([r ** (2 * n + 1) for n in (1, 2, 3, 4)], axis=1)
    wanted = powers @ np.asarray(radial)
    found, *_ = np.linalg.lstsq(powers[:, :3], wanted, rcond=None)
    if float(np.abs(powers[:, :3] @ found - wanted).max()) * focal > HIGHEST_TERM_PX:
        raise _RefusedError("its fourth radial coefficient is too large for COLMAP's models")
    return [float(value) for value in found]
