"""The report's chapter on surface products: images, sizes, height accuracy, sections and volumes."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

from splatpipe.pipeline.app.measurements import SECTIONS, VOLUMES, outdated, read_measurements, title_of
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import count, length

PICTURE_SIDE = 960  # pixels
FACADE_SIDE = 480
MAX_FACADES = 12  # with an image; the list has all
SECTION_SIDE = 720
MAX_SECTIONS = 12  # with a drawing; the list has all
QUALITY = 85
MAX_ROWS = 200  # volumes in the table; the file has all of them
BASES = {"rim": "rim", "lowest": "lowest", "stated": "stated", "ground": "ground"}
SIGMA_DIGITS = 2  # significant digits of a standard deviation

Chapter = dict[str, Any]


def surfaces_chapter(inputs: ReportInputs, *, drawn: bool) -> Chapter | None:
    """The chapter on the surface model and the orthophoto; None if there are none.

    Args:
        inputs: The report's inputs.
        drawn: Whether to include images.
    """
    dsm, ortho = inputs.summary("dsm"), inputs.summary("ortho")
    if not dsm.get("cells"):
        return None
    facts = [
        ("cell of the surface model", length(dsm["cell_m"])),
        ("area with heights", f"{count(round(dsm['area_m2']))} m²"),
        ("expected deviation of a height", f"{length(dsm['expected_deviation_m'])} (median)"),
        ("ground sample distance of the photos", length(dsm["gsd_m"])),
        ("heights", str(dsm["heights"])),
        ("CRS", str(dsm["crs"])),
    ]
    if ortho.get("pixels"):
        facts.insert(0, ("pixel of the orthophoto", length(ortho["pixel_m"])))
        facts.append(("exposures balanced over", f"{ortho['exposures_stops']:.1f} stops"))
    dtm = inputs.summary("dtm")
    if dtm.get("cells"):
        shares = f"{dtm['ground_share']:.0%} seen, {dtm['building_share']:.0%} under buildings"
        facts.append(("ground in the terrain model", f"{shares}; contours of the {dtm['contours']}"))
    cloud, mesh = inputs.summary("cloud"), inputs.summary("mesh")
    if cloud.get("points"):
        facts.append(("points of the cloud", f"{count(cloud['points'])}, {length(cloud['spacing_m'])} apart"))
    if mesh.get("triangles"):
        facts.append(("triangles of the mesh", f"{count(mesh['triangles'])}, of voxels of {length(mesh['voxel_m'])}"))
    if mesh.get("pages"):
        pages = f"{count(mesh['pages'])} image{'s' if mesh['pages'] > 1 else ''}"
        facts.append(("textures of the mesh", f"{pages}, {mesh['texture_pixels'] / 1e6:.0f} megapixels"))
    facades = _facades(inputs, drawn=drawn)
    chapter = {"facts": facts, "pictures": _pictures(inputs) if drawn else [], "facades": facades}
    return {**chapter, "measured": _measurement_tables(inputs, drawn=drawn)}


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


def _measurement_tables(inputs: ReportInputs, *, drawn: bool) -> dict[str, Any]:
    """Sections and volumes, with thumbnails of the first sections."""
    tables = measures(inputs)
    for number, row in enumerate(tables["sections"]):
        path = row.pop("picture")
        row |= _small_picture(path, SECTION_SIDE) if drawn and path is not None and number < MAX_SECTIONS else {}
    return tables


def _facades(inputs: ReportInputs, *, drawn: bool) -> list[dict[str, Any]]:
    """Façades, largest first, with thumbnails of the first ones."""
    if not inputs.summary("facades").get("facades"):
        return []
    facades = inputs.read_in_part("facades.files", "facades/facades.json")["facades"]
    facades = sorted(facades, key=lambda each: -float(each["area_m2"]))
    rows = []
    for number, each in enumerate(facades):
        row = {"name": str(each["name"]), "area": f"{float(each['area_m2']):.1f} m²"}
        row["known"] = f"{100.0 * float(each['share_with_depth']):.0f} %"
        path = _file(inputs, "facades.files", f"facades/{each['picture']}")
        rows.append(
            row | (_small_picture(path, FACADE_SIDE) if drawn and path is not None and number < MAX_FACADES else {})
        )
    return rows


def _small_picture(path: Path, side: int) -> dict[str, Any]:
    import cv2
    import numpy as np

    from splatpipe.pipeline.app.report.charts.pictures import jpeg, shrunk

    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        return {}
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        pixels = np.where(pixels[..., 3:] > 0, pixels[..., :3], 255).astype(np.uint8)
    small = shrunk(np.asarray(pixels, np.uint8), side)
    return {"source": jpeg(small, QUALITY), "width": small.shape[1], "height": small.shape[0]}


def _pictures(inputs: ReportInputs) -> list[dict[str, Any]]:
    from splatpipe.pipeline.app.report.charts.pictures import jpeg
    from splatpipe.pipeline.surface.rasters.pictures import ortho_picture, relief_picture

    found = []
    path = _file(inputs, "ortho.files", "ortho.tif")
    if path is not None:
        pixels = ortho_picture(path, PICTURE_SIDE)
        found.append(
            (
                "orthophoto",
                "ortho.tif: a true orthophoto, so walls do not lean; white where too few photos see the surface",
                pixels,
            )
        )
    models = ("surface model", "dsm.files", "dsm.tif"), ("terrain model", "dtm.files", "dtm.tif")
    for name, part, file in models:
        path = _file(inputs, part, file)
        relief = None if path is None else relief_picture(path, PICTURE_SIDE)
        if relief is not None:
            text = f"{file}: from {relief.low:.1f} (violet) to {relief.high:.1f} (yellow), lit from the north-west"
            found.append((name, text, relief.pixels))
    return [
        {"name": name, "text": text, "source": jpeg(pixels[..., ::-1].copy(), QUALITY)}
        | {"width": pixels.shape[1], "height": pixels.shape[0]}
        for name, text, pixels in found
    ]


def _file(inputs: ReportInputs, part: str, name: str) -> Path | None:
    folder = inputs.part(part)
    return folder / name if folder is not None and (folder / name).is_file() else None


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
    where += "; heights of the ground" if item.get("model") == "dtm" else ""
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
