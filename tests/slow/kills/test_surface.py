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


def run_program(name: str, folder: Path) -> list[str]:
    """Run a program beside this file, and return its lines."""
    command = [sys.executable, str(Path(__file__).with_name(name)), str(folder)]
    paths = environment(SCENES, ROOT / "benchmarks/formats")
    return subprocess.run(command, capture_output=True, text=True, check=True, env=paths).stdout.splitlines()


def test_products_killed_again_and_again_go_on_to_the_same_bits(tmp_path: Path) -> None:
    said = run_program("killed_products.py", tmp_path)
    for name, kills in {"terrain": 3, "textures": 3, "publication": 5}.items():
        ended = [line for line in said if line.startswith(f"{name} ended")]
        assert ended == [*[f"{name} ended -9"] * kills, f"{name} ended 0"]
        (told,) = (line.split() for line in said if line.startswith(f"{name} kept"))
        assert int(told[2]) > 0 and told[3] == "same", told


def test_kills_and_full_disks_leave_no_half_product(tmp_path: Path) -> None:
    said = run_program("killed_surface.py", tmp_path)
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
