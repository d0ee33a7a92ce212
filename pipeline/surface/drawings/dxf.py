"""ezdxf without the user's configuration and fonts, and with reproducible output.

When it is imported, ezdxf reads configuration files of the home folder and of the current folder, searches the system
for fonts and stores what it found in the home folder. Our files must depend on none of these, and an arbitrary user in
a container has no home folder, without which the import fails.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatpipe.pipeline.engine.files.output_file import write_file

FOLDERS = ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")  # variables of where it reads and writes
NO_FONTS = '{"version": 2, "font-faces": []}'  # ezdxf's font cache: with another version, it would search for fonts


@contextmanager
def _empty_home() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in FOLDERS}
    with tempfile.TemporaryDirectory() as folder:
        fonts = Path(folder) / "ezdxf" / "font_manager_cache.json"
        fonts.parent.mkdir()
        write_file(fonts, NO_FONTS)
        os.environ.update(dict.fromkeys(FOLDERS, folder))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


with _empty_home():
    from ezdxf._options import options
    from ezdxf.document import Drawing as DxfDocument
    from ezdxf.enums import TextEntityAlignment
    from ezdxf.filemanagement import new as new_document
options.reset()  # type: ignore[no-untyped-call]  # drops what the current folder's file says

__all__ = ["DxfDocument", "TextEntityAlignment", "new_document", "reproducible"]


@contextmanager
def reproducible() -> Iterator[None]:
    """Make ezdxf write neither dates nor random numbers, by its own options."""
    before = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        options.write_fixed_meta_data_for_testing = before
