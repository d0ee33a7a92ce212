"""The viewer pages' names, and the placeholder in them for measurements that are made later."""

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
BEGIN, END = b'<script type="application/json" id="measurements">', b"</script>"  # as in the template, around null
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
    before, mark, after = page.partition(BEGIN)
    _, end, rest = after.partition(END)
    if not mark or not end:
        raise ValueError("the page has no place for measurements")
    content = NOTHING
    if measurements is not None:
        content = script_safe(json.dumps(measurements, ensure_ascii=False, allow_nan=False, sort_keys=True)).encode()
        content += b" " * (zlib.crc32(content) % SIZES)
    return b"".join((before, mark, content, end, rest))
