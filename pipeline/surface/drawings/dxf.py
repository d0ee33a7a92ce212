"""ezdxf without the user's configuration and fonts, and with reproducible output.

When it is imported, ezdxf reads configuration files of the home folder and of the current folder, searches the system
for fonts and stores what it found in the home folder. Our files must depend on none of these, and an arbitrary user in
a container has no home folder, without which the import fails. Its environment variables are the only way to tell it,
so it is imported when the first drawing is made, and not before: nobody's environment changes by an import of ours.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal

from splatpipe.pipeline.engine.files.output_file import write_file

if TYPE_CHECKING:
    from ezdxf.document import Drawing as DxfDocument
    from ezdxf.enums import TextEntityAlignment

FOLDERS = ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")  # variables of where it reads and writes
NO_FONTS = '{"version": 2, "font-faces": []}'  # ezdxf's font cache: with another version, it would search for fonts


@contextmanager
def new_document(version: str, units: int) -> Iterator[DxfDocument]:
    """Yield a new document; what is made of it in the context has neither dates nor random numbers.

    Args:
        version: AutoCAD's, as ``R2000``.
        units: Value of ``$INSUNITS``.
    """
    ezdxf = _ezdxf()
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield ezdxf.new(version, units=units)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def alignment(name: Literal["LEFT", "CENTER", "RIGHT"]) -> TextEntityAlignment:
    """How a text lies at its place."""
    _ezdxf()
    from ezdxf.enums import TextEntityAlignment

    return TextEntityAlignment[name]


@cache
def _ezdxf() -> ModuleType:
    """The library, imported with an empty home folder and set back to its defaults."""
    with _empty_home():
        import ezdxf
    ezdxf.options.reset()  # type: ignore[attr-defined, no-untyped-call]  # drops what the folder says
    return ezdxf


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
