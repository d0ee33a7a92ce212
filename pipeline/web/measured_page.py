"""The viewer pages' names, and the placeholders in them for what is made later: measurements, the mesh and points."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

from splatpipe.pipeline.web import script_safe

PAGE = "viewer.html"
SITE = "web/"
"""Folder in OUT of the viewer for web hosts."""
SITE_PAGE = f"{SITE}index.html"
SURFACES = "surfaces.json"
"""What viewers show besides the splat: ``mesh`` and ``points``, each missing if the run made none."""
BEGIN, END = b'<script type="application/json" id="measurements">', b"</script>"  # as in the template, around null
SURFACES_BEGIN = b'<script type="application/json" id="surfaces">'
NOTHING = b"null"
SIZES = 4096  # bytes of padding, so that different pages differ in size, for programs that compare only size and time


def with_measurements(page: bytes, measurements: Mapping[str, Any] | None) -> bytes:
    """Return a page with its measurements on the surface model replaced.

    Args:
        page: A page made by ``viewer_page`` or this function.
        measurements: ``sections`` and ``volumes`` as `src/viewer/results.js` expects them; None for none.

    Raises:
        ValueError: if the page has no placeholder for them, like those of earlier versions.
    """
    content = NOTHING
    if measurements is not None:
        content = script_safe(json.dumps(measurements, ensure_ascii=False, allow_nan=False, sort_keys=True)).encode()
    return _with(page, BEGIN, content)


def with_surfaces(page: bytes, surfaces: bytes | None) -> bytes:
    """Return a page with what it shows besides the splat replaced.

    Args:
        page: A page made by ``viewer_page`` or this function.
        surfaces: JSON for `src/viewer/surfaces.js`, of ASCII without "<"; None for nothing.

    Raises:
        ValueError: if the page has no placeholder for it, like those of earlier versions.
    """
    return _with(page, SURFACES_BEGIN, NOTHING if surfaces is None else surfaces)


def _with(page: bytes, begin: bytes, content: bytes) -> bytes:
    if content != NOTHING:
        content += b" " * (zlib.crc32(content) % SIZES)
    before, mark, after = page.partition(begin)
    _, end, rest = after.partition(END)
    if not mark or not end:
        raise ValueError(f"the page has no place for {begin.decode()}")
    return b"".join((before, mark, content, end, rest))
