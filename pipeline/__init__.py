"""splatpipe: the library in rooms, each on those below it, and the command line."""

import contextlib
import ctypes
import sys

if sys.platform == "linux":
    # pycolmap exports a zlib of its own. Where it is the first to load libz.so.1, that library's inner calls bind to
    # pycolmap's, and the next PNG that anybody reads or writes ends the process ("free(): invalid pointer").
    with contextlib.suppress(OSError):
        ctypes.CDLL("libz.so.1")
