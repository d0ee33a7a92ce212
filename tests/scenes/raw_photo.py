"""A camera's raw file (DNG): a mosaic of colours, with the tags that readers need."""

from __future__ import annotations

import struct

import numpy as np

WIDTH, HEIGHT = 640, 480
ORIENTATION = 3


def dng() -> bytes:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    mosaic = ((columns * 50 + rows * 20) % 16000 + 500).astype("<u2").tobytes()
    shorts = {258: [16], 259: [1], 262: [32803], 274: [ORIENTATION], 277: [1], 33421: [2, 2], 50714: [0], 50778: [21]}
    longs = {254: [0], 256: [WIDTH], 257: [HEIGHT], 273: [0], 278: [HEIGHT], 279: [len(mosaic)], 50717: [16383]}
    tags = {tag: (3, len(values), struct.pack(f"<{len(values)}H", *values)) for tag, values in shorts.items()}
    tags |= {tag: (4, len(values), struct.pack(f"<{len(values)}I", *values)) for tag, values in longs.items()}
    tags |= {tag: (2, len(text), text) for tag, text in ((271, b"DJI\0"), (272, b"FC9\0"), (50708, b"DJI FC9\0"))}
    tags |= {33422: (1, 4, bytes([0, 1, 1, 2])), 50706: (1, 4, bytes([1, 4, 0, 0]))}
    tags[50721] = 10, 9, struct.pack("<18i", *(value for k in range(9) for value in (int(k % 4 == 0), 1)))
    tags[50728] = 5, 3, struct.pack("<6I", 1, 2, 1, 1, 2, 3)
    after = 8 + 2 + 12 * len(tags) + 4
    start = after + sum(len(content) for _, _, content in tags.values() if len(content) > 4)
    entries, far = b"", b""
    for tag, (kind, count, content) in sorted(tags.items()):
        content = struct.pack("<I", start) if tag == 273 else content
        entries += struct.pack("<HHI", tag, kind, count)
        if len(content) <= 4:
            entries += content.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", after + len(far))
            far += content
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + far + mosaic
