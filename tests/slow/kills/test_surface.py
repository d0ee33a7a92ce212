"""A killed writer of a surface product leaves nothing under the product's name, and the next one cleans up."""

import subprocess
import sys
from pathlib import Path

import rasterio
from hills import hill_grid, write_hill
from repository import ROOT, SCENES, environment

RASTERS, OTHERS = (
    ("dsm.tif", "ortho.tif", "confidence.tif", "ortho.mbtiles", "cloud.copc.laz"),
    ("cloud.laz", "contours.dxf", "contours.geojson", "mesh-tiles"),
)


PRODUCTS = dict.fromkeys(RASTERS, "MachineError") | dict.fromkeys(OTHERS, "OSError")


def test_kills_and_full_disks_leave_no_half_product(tmp_path: Path) -> None:
    program = Path(__file__).parent / "killed_surface.py"
    command = [sys.executable, str(program), str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment(SCENES, ROOT / "benchmarks/formats")
    )
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
