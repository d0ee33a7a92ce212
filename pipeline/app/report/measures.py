"""The report's tables of sections and volumes, with their uncertainties."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

from splatpipe.pipeline.app.measurements import SECTIONS, VOLUMES, outdated, read_measurements, title_of
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import length

MAX_ROWS = 200  # volumes in the table; the file has all of them
BASES = {"rim": "rim", "lowest": "lowest", "stated": "stated"}
SIGMA_DIGITS = 2  # significant digits of a standard deviation


def measures(inputs: ReportInputs) -> dict[str, Any]:
    """The measurements on the report's surface model.

    Returns:
        ``sections`` (``picture`` is the image's path), ``volumes``, the number of ``more`` volumes, ``volumes_file``,
        and whether the measurements in OUT are ``outdated``.
    """
    part = inputs.contents.parts.get("dsm.files")
    surface = "" if part is None else part.digest
    volumes = read_measurements(inputs.out, "volumes", surface)
    return {
        "sections": [_section(inputs.out, item) for item in read_measurements(inputs.out, "sections", surface)],
        "volumes": [_volume(item) for item in volumes[:MAX_ROWS]],
        "more": max(0, len(volumes) - MAX_ROWS),
        "volumes_file": VOLUMES,
        "outdated": outdated(inputs.out, surface),
    }


def _section(out: Path, item: dict[str, Any]) -> dict[str, Any]:
    files = [(kind, out / SECTIONS / Path(str(item.get(key))).name) for kind, key in (("DXF", "dxf"), ("CSV", "csv"))]
    picture = out / SECTIONS / Path(str(item.get("picture"))).name
    sigma_m = item.get("height_sigma_m")
    return {
        "name": title_of(item),
        "length": f"{item['length_m']:.2f} m",
        "known": f"{100.0 * item['share_with_height']:.0f} %",
        "sigma": f"± {length(sigma_m)}" if isinstance(sigma_m, float) else "not known",
        "picture": picture if picture.is_file() else None,
        "files": [(kind, quote(f"{SECTIONS}/{path.name}")) for kind, path in files if path.is_file()],
    }


def _volume(item: dict[str, Any]) -> dict[str, Any]:
    amounts = {kind: _with_sigma(item[f"{kind}_m3"], item[f"{kind}_sigma_m3"]) for kind in ("cut", "fill", "net")}
    height = item["base"].get("height_m")
    where = f", {height:.2f} m" if isinstance(height, float) else ""
    return {
        "name": title_of(item),
        "area": f"{item['area_m2']:.1f} m²",
        "unknown": f"{100.0 * item['share_without_height']:.1f} %",
        **amounts,
        "base": BASES.get(str(item["base"].get("kind")), "") + where,
    }


def _with_sigma(m3: float, sigma_m3: float) -> str:
    """A volume with its standard deviation, rounded to significant digits."""
    digits = 3
    while digits and sigma_m3 * 10.0 ** (digits - 1) >= 10.0 ** (SIGMA_DIGITS - 1):
        digits -= 1
    return f"{m3:,.{digits}f} ± {sigma_m3:,.{digits}f} m³"
