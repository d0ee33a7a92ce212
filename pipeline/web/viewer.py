"""`viewer.html`: a splat in a single page that opens anywhere, also from disk and offline."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from jinja2 import Environment
from markupsafe import Markup

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.sky.panorama import FULL_FROM_DEG, NOTHING_UP_TO_DEG
from splatpipe.pipeline.survey.crs.crs import UNKNOWN
from splatpipe.pipeline.survey.crs.local_crs import LocalCrs
from splatpipe.pipeline.web import asset, script_safe

TEMPLATE = Path(__file__).resolve().parent / "viewer.html"
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:;"
    " style-src 'unsafe-inline'; img-src data: blob:; connect-src 'self' data: blob:;"
    " base-uri 'none'; form-action 'none'"
)
MAX_POINTS = 150_000  # points in the page, 15 bytes each; more are thinned evenly
SIZE_QUANTILES = (0.05, 0.95)  # quantiles of the sparse points along each axis that bound the scene
NEARLY_MOST_SHARE = 0.9  # points in focus, over the most: a few on the far side need not push the view away
NEAR_PER_SIZE = 1e-3  # near plane as a share of the scene's size, if the caller gives none


@dataclass(frozen=True, eq=False)
class ViewerCamera:
    """A photo and where it was taken.

    Attributes:
        camera: The camera in the world frame, rotated upright; ``camera.name`` is shown.
        thumb: A small JPEG of the photo, rotated like the camera; None for none.
        held_out: Whether it is a held-out view.
    """

    camera: Camera
    thumb: bytes | None = None
    held_out: bool = False


@dataclass(frozen=True, eq=False)
class ViewerSky:
    """The background of the scene by direction.

    Attributes:
        colours: RGB at the cells' centres by elevation (rows, from straight down) and azimuth (columns, from west via
            south); twice as many columns as rows. Below the horizon the background colour is shown instead.
    """

    colours: UInt8[np.ndarray, "rows columns 3"]


@dataclass(frozen=True, eq=False)
class ViewerScene:
    """Everything a page shows besides the splat, in the world frame (z up).

    Attributes:
        title: The page's title.
        cameras: The photos; at least one.
        points: The sparse points.
        point_colours: The points' RGB colours.
        gaussians: The splat's number of Gaussians.
        metres: Whether a world unit is a metre; else the scale is arbitrary.
        crs: The CRS in which coordinates are shown; None for the world frame.
        antialias: Whether the splat was trained with opacities that compensate for the screen-space blur.
        background: RGB behind everything, 0..1.
        near: Distance of the near plane, world units; 0 for a share of the scene's size.
        sky: In front of the background; None for none.
        note: A sentence about the frame and its accuracy, for the help.
        focus: The sparse points that the initial view shows and rotates about; None for all.
        placed: If metric, whether heading and position are known too.
    """

    title: str
    cameras: tuple[ViewerCamera, ...]
    points: Float64[np.ndarray, "n 3"]
    point_colours: UInt8[np.ndarray, "n 3"]
    gaussians: int
    metres: bool
    crs: LocalCrs | None = None
    antialias: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near: float = 0.0
    sky: ViewerSky | None = None
    note: str = ""
    focus: Bool[np.ndarray, " n"] | None = None
    placed: bool = True


def viewer_page(scene: ViewerScene, splat: bytes | str) -> str:
    """The page as HTML, with no external reference other than the splat's URL, if that is given.

    Args:
        scene: What to show.
        splat: An SPZ file in its own frame (y up, see ``scene.spz``) to embed; or its URL relative to the page, from
            which the page loads it: this needs a server, or the user drops the file on the page.

    Raises:
        ValueError: if there is no camera.
        MachineError: if this installation was built without the page's script.
    """
    inlined = isinstance(splat, bytes)
    carried = f'<script type="text/plain" id="splat">{_base64(splat)}</script>' if isinstance(splat, bytes) else ""
    points, colours = page_points(scene)
    facts = scene_facts(scene, [None if each.thumb is None else _jpeg_address(each.thumb) for each in scene.cameras])
    facts["points"] = {"xyz": _base64(points.astype("<f4").tobytes()), "rgb": _base64(colours.tobytes())}
    facts["splat"] = {"inlined": inlined, "address": "" if inlined else splat}
    script = asset("viewer.js").replace("</script", "<\\/script").replace("<!--", "<\\!--")
    style, script = f"<style>{asset('viewer.css')}</style>", f"{carried}\n<script>{script}</script>"
    return render_page(scene, facts, PageParts(POLICY, style, script))


@dataclass(frozen=True)
class PageParts:
    """The page-specific parts of the HTML.

    Attributes:
        policy: The Content-Security-Policy.
        style: HTML for the head.
        script: HTML for the end of the body.
    """

    policy: str
    style: str
    script: str


def render_page(scene: ViewerScene, facts: Mapping[str, Any], parts: PageParts) -> str:
    """Render the page's HTML.

    Args:
        scene: What it shows.
        facts: The facts for its script.
        parts: Policy, styles and scripts.
    """
    environment = Environment(autoescape=True, keep_trailing_newline=True)
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(
        policy=parts.policy,
        title=scene.title,
        subtitle=_subtitle(scene),
        crs=_crs_line(scene),
        note=scene.note,
        north=scene.metres and scene.placed,
        style=Markup(parts.style),
        facts=Markup(script_safe(json.dumps(facts, ensure_ascii=False, allow_nan=False))),
        script=Markup(parts.script),
    )


def start_camera(scene: ViewerScene) -> int:
    """Index of the camera of the initial view: the first one that shows the most sparse points.

    With a focus, which many cameras may show completely: the nearest of those that show nearly the most of it.
    """
    if not len(scene.points):
        return 0
    if scene.focus is None or not scene.focus.any():
        return int(np.argmax([len(viewer_camera.camera.in_view(scene.points)[0]) for viewer_camera in scene.cameras]))
    seen = [viewer_camera.camera.in_view(scene.points[scene.focus])[2] for viewer_camera in scene.cameras]
    enough = NEARLY_MOST_SHARE * max(len(depths) for depths in seen)
    return int(np.argmin([np.median(depths) if len(depths) >= max(enough, 1.0) else np.inf for depths in seen]))


def scene_facts(scene: ViewerScene, thumbs: Sequence[str | None]) -> dict[str, Any]:
    """The facts about a scene for the page's script, without the splat and the sparse points.

    Args:
        scene: The scene.
        thumbs: URL of each camera's thumbnail, or None.

    Raises:
        ValueError: if there is no camera.
    """
    if not scene.cameras:
        raise ValueError("a viewer needs a camera to begin from")
    centres = np.array([each.camera.centre() for each in scene.cameras])
    visible_points = (
        page_points(scene)[0] if scene.focus is None or not scene.focus.any() else scene.points[scene.focus]
    )
    least, most = np.quantile(visible_points if len(visible_points) else centres, SIZE_QUANTILES, axis=0)
    size = float(np.linalg.norm(most - least)) or 1.0
    return {
        "title": scene.title,
        "metres": scene.metres,
        "antialias": scene.antialias,
        "background": list(scene.background),
        "near": scene.near if scene.near > 0.0 else NEAR_PER_SIZE * size,
        "size": size,
        "centre": ((least + most) / 2.0).tolist(),
        "start": start_camera(scene),
        "cameras": [_camera(each, thumb) for each, thumb in zip(scene.cameras, thumbs, strict=True)],
        "crs": None if scene.crs is None else scene.crs.facts(),
        "sky": None if scene.sky is None else _sky(scene.sky),
    }


def _camera(viewer_camera: ViewerCamera, thumb: str | None) -> dict[str, Any]:
    camera = viewer_camera.camera
    return {
        "name": camera.name,
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "rotation": camera.cam_from_world[:3, :3].T.ravel().tolist(),
        "centre": camera.centre().tolist(),
        "thumb": thumb,
        "held_out": viewer_camera.held_out,
    }


def _sky(sky: ViewerSky) -> dict[str, Any]:
    return {
        "rows": sky.colours.shape[0],
        "colours": _base64(np.ascontiguousarray(sky.colours).tobytes()),
        "nothing_up_to_deg": NOTHING_UP_TO_DEG,
        "full_from_deg": FULL_FROM_DEG,
    }


def page_points(scene: ViewerScene) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """The sparse points that a page shows, and their colours."""
    usable = np.flatnonzero(np.isfinite(scene.points).all(axis=1))
    step = max(1, -(-len(usable) // MAX_POINTS))
    return scene.points[usable[::step]], scene.point_colours[usable[::step]]


def _subtitle(scene: ViewerScene) -> str:
    photos = len(scene.cameras)
    return f"{scene.gaussians:,} Gaussians from {photos} photo{'' if photos == 1 else 's'}"


def _crs_line(scene: ViewerScene) -> str:
    if scene.crs is not None:
        datum = "datum not known" if scene.crs.heights == UNKNOWN else scene.crs.heights
        return f"{scene.crs.name} ({scene.crs.id}), heights: {datum}"
    if scene.metres and not scene.placed:
        return "metres by scale bars; place and heading are arbitrary"
    return "local east, north, up, metres" if scene.metres else "arbitrary units: the photos say nothing of the scale"


def _jpeg_address(picture: bytes) -> str:
    return f"data:image/jpeg;base64,{_base64(picture)}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
