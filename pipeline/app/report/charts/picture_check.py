"""Whether a picture read from a file may stand in a page unescaped, as those that the report draws itself do.

An OUT may come from somebody else, so a kept picture is accepted only if it says nothing but what our charts say: a
JPEG or PNG as a data URL, or an SVG of plain shapes and texts. Its grammar is so narrow that an HTML parser cannot read
it otherwise than it is read here: no comments, no CDATA, no entities but the five of XML, no element that ends an SVG.
"""

from __future__ import annotations

import re

PICTURE = re.compile(r"data:image/(?:jpeg|png);base64,[A-Za-z0-9+/]*={0,2}\Z")
TOKEN = re.compile(r"<(/?)([A-Za-z]+)((?:\s+[A-Za-z][A-Za-z:-]*=\"[^\"<>]*\")*)\s*(/?)>|([^<>]+)")
ATTRIBUTE = re.compile(r"([A-Za-z][A-Za-z:-]*)=\"([^\"]*)\"")
ENTITY = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#34|#39);)")
LINK = re.compile(r"#[\w.-]+\Z|data:image/png;base64,[A-Za-z0-9+/=\s]*\Z")  # a part of the same chart, or pixels in it
CLIP = re.compile(r"url\(#[\w.-]+\)\Z")
STYLE = re.compile(r"(?:\s*[a-z-]+\s*:\s*[^:;{}()\\@]*(?:;|\Z))*\s*\Z")
PROPERTY = re.compile(r"([a-z-]+)\s*:")
STYLE_SHEET = "*{stroke-linejoin: round; stroke-linecap: butt}"  # of every chart by matplotlib
ELEMENTS = frozenset(("svg", "defs", "style", "g", "path", "use", "text", "tspan", "image", "clipPath", "rect"))
ATTRIBUTES = frozenset(
    (
        "role",
        "aria-label",
        "xmlns",
        "xmlns:xlink",
        "viewBox",
        "version",
        "type",
        "id",
        "d",
        "x",
        "y",
        "width",
        "height",
        "transform",
        "style",
        "clip-path",
        "xlink:href",
        "preserveAspectRatio",
        "fill",
        "stroke",
        "stroke-width",
        "font-family",
        "font-size",
        "text-anchor",
    )
)
PROPERTIES = frozenset(
    (
        "fill",
        "fill-opacity",
        "fill-rule",
        "stroke",
        "stroke-width",
        "stroke-opacity",
        "stroke-linecap",
        "stroke-linejoin",
        "stroke-miterlimit",
        "stroke-dasharray",
        "stroke-dashoffset",
        "opacity",
        "font",
        "font-size",
        "font-family",
        "font-style",
        "font-weight",
        "font-stretch",
        "font-variant",
        "text-anchor",
        "image-rendering",
    )
)


def is_plain_picture(markup: str) -> bool:
    """Whether a text is a picture, and nothing but a picture.

    Args:
        markup: The data URL, or the SVG element.
    """
    return PICTURE.match(markup) is not None if markup.startswith("data:") else _is_plain_svg(markup)


def _is_plain_svg(markup: str) -> bool:
    opened: list[str] = []
    at, count = 0, len(markup.rstrip())
    while at < count:
        token = TOKEN.match(markup, at)
        if token is None or (at > 0 and not opened):  # something after the element
            return False
        at = token.end()
        closing, name, attributes, empty, text = token.groups()
        if text is not None:
            if not opened or ENTITY.search(text) or (opened[-1] == "style" and text != STYLE_SHEET):
                return False
        elif closing:
            if attributes or empty or opened.pop() != name:
                return False
        else:
            if name not in ELEMENTS or (name == "svg") == bool(opened) or "style" in opened:
                return False
            if not all(_is_plain(key, value) for key, value in ATTRIBUTE.findall(attributes)):
                return False
            if not empty:
                opened.append(name)
            elif not opened:
                return False
    return count > 0 and not opened


def _is_plain(name: str, value: str) -> bool:
    if name not in ATTRIBUTES or ENTITY.search(value):
        return False
    if name == "xlink:href":
        return LINK.match(value) is not None
    if name == "clip-path":
        return CLIP.match(value) is not None
    if name == "style":
        return STYLE.match(value) is not None and PROPERTIES.issuperset(PROPERTY.findall(value))
    return "url" not in value or name in ("aria-label", "id")
