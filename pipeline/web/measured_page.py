"""The viewers' pages: what they are called, and the place in them for what is measured when they are there already."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

from splatpipe.pipeline.web import script_safe

PAGE = "viewer.html"
SITE = "web/"
"""Of the viewer as a folder for web hosts, in OUT."""
SITE_PAGE = f"{SITE}index.html"
BEGIN, END = b'<script type="application/json" id="measurements">', b"</script>"  # as in the template, with null
NOTHING = b"null"
SIZES = 4096  # pages that differ differ in their sizes as well, for programs that compare no more than size and time


def with_measurements(page: bytes, measurements: Mapping[str, Any] | None) -> bytes:
    """A page that shows what was measured on the surface model, in place of what it showed of that before.

    Args:
        page: As ``viewer_page`` or this function made it.
        measurements: ``sections`` and ``volumes``, as `src/viewer/results.js` takes them; None for none.

    Raises:
        ValueError: if the page has no place for them, as those of earlier versions.
    """
    before, mark, after = page.partition(BEGIN)
    _, end, rest = after.partition(END)
    if not mark or not end:
        raise ValueError("the page has no place for measurements")
    told = NOTHING
    if measurements is not None:
        told = script_safe(json.dumps(measurements, ensure_ascii=False, allow_nan=False, sort_keys=True)).encode()
        told += b" " * (zlib.crc32(told) % SIZES)
    return b"".join((before, mark, told, end, rest))
