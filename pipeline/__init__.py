"""splatpipe: the library in rooms, each on those below it, and the command line.

Here, before anything else is imported: what COLMAP's and Ceres' libraries do to a process that loads them.
"""

import contextlib
import ctypes
import importlib.abc
import importlib.machinery
import os
import signal
import sys
from collections.abc import Sequence
from types import ModuleType

LIBRARIES = ("pycolmap", "pyceres")
SIGACTION_BYTES = 256  # more than any system's struct sigaction

if sys.platform == "linux":
    # pycolmap exports a zlib of its own. Where it is the first to load libz.so.1, that library's inner calls bind to
    # pycolmap's, and the next PNG that anybody reads or writes ends the process ("free(): invalid pointer").
    with contextlib.suppress(OSError):
        ctypes.CDLL("libz.so.1")

# Their log goes to stderr alone, and so into a stage's log: glog would also leave a file in /tmp for every process,
# with photos' names and paths for everybody to read. It is read when they are loaded, here or in a child process.
os.environ.setdefault("GLOG_logtostderr", "1")


class _SignalKeeper(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads these libraries without log files, and puts back what SIGTERM does: they print a stack as after a crash.

    The C library is asked, as Python allows only its main thread to set a handler, and others import, too.
    """

    def __init__(self) -> None:
        self._loaders: dict[str, importlib.abc.Loader] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        extension = any(fullname == name or fullname.startswith(f"{name}.") for name in LIBRARIES)
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target) if extension else None
        if spec is not None and isinstance(spec.loader, importlib.machinery.ExtensionFileLoader):
            self._loaders[fullname], spec.loader = spec.loader, self
            return spec
        return None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        return self._loaders[spec.name].create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        before = ctypes.create_string_buffer(SIGACTION_BYTES)
        library = ctypes.CDLL(None)
        known = library.sigaction(signal.SIGTERM, None, before) == 0
        self._loaders[module.__name__].exec_module(module)
        if known:
            library.sigaction(signal.SIGTERM, before, None)
        _log_to_no_file(module)


def _log_to_no_file(module: ModuleType) -> None:
    """Take the log files' names from glog: pycolmap's bundle adjustment undoes ``GLOG_logtostderr``."""
    log = getattr(module, "logging", None)
    if log is not None and hasattr(log, "set_log_destination"):
        for level in ("INFO", "WARNING", "ERROR", "FATAL"):
            log.set_log_destination(getattr(log.Level, level), "")


sys.meta_path.insert(0, _SignalKeeper())
