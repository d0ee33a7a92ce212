"""A killed writer of a surface product leaves nothing under the product's name, and the next one cleans up."""

import subprocess
import sys
from pathlib import Path

import pytest
import rasterio

sys.path.insert(0, str(Path(__file__).parent / "scenes"))

from hills import hill_grid, write_hill

from splatpipe.pipeline.surface.whole_file import whole_file

RASTERS, OTHERS = ("dsm.tif", "ortho.tif", "confidence.tif"), ("cloud.laz", "contours.dxf", "contours.geojson")
PRODUCTS = dict.fromkeys(RASTERS, "MachineError") | dict.fromkeys(OTHERS, "OSError")


def test_kills_and_full_disks_leave_no_half_product(tmp_path: Path) -> None:
    program = Path(__file__).parent / "killed_surface.py"
    done = subprocess.run([sys.executable, str(program), str(tmp_path)], capture_output=True, text=True, check=True)
    said = done.stdout.splitlines()
    for name, error in PRODUCTS.items():
        assert f"{name} {error}" in said and f"{name} fill_the_disk 0 0" in said
        assert any(line.startswith(f"{name} die -9 ") for line in said)
        assert not (tmp_path / name).exists()
    left = [path.name for path in tmp_path.iterdir()]
    assert any(name.startswith(".dsm.tif.") for name in left)
    write_hill(tmp_path / "dsm.tif", hill_grid())
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".dsm.tif.")]
    with rasterio.open(tmp_path / "dsm.tif") as raster:
        assert raster.count == 1


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a[1].tif"  # a name that is no pattern
    path.write_text("old")
    (tmp_path / ".a[1].tif.999999.making").mkdir()
    with pytest.raises(OSError, match="No space"), whole_file(path) as aside:
        aside.write_text("half")
        (aside.parent / "overviews.tmp").write_text("of a library")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with whole_file(path) as aside:
        aside.write_text("new")
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileNotFoundError), whole_file(path):
        pass  # nothing was written: that is no file
    assert path.read_text() == "new"
