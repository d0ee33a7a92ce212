"""Lens files: other programs' files are read as they mean them; broken or hostile ones are rejected."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.sfm.lenses.lens_file import fitted, read_lens_file
from splatpipe.pipeline.sfm.lenses.lens_model import StatedLens, apart_px

SIZE = (5472, 3648)
F, CX, CY = 3676.5, 2741.2, 1839.7
K1, K2, K3, P1, P2 = -0.0121, 0.0203, -0.0311, 0.00132, -0.00087
OPENCV = (F, F, CX, CY, K1, K2, P1, P2, K3, 0.0, 0.0, 0.0)

METASHAPE = f"""<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>5472</width><height>3648</height>
  <f>{F}</f><cx>{CX - 2736}</cx><cy>{CY - 1824}</cy>
  <k1>{K1}</k1><k2>{K2}</k2><k3>{K3}</k3><p1>{P2}</p1><p2>{P1}</p2>
  <date>2024-05-26T08:27:27Z</date>
</calibration>
"""
SENSOR = (13.1328, 8.7552)  # mm
CAM = f"""Pix4D camera calibration file 0
#Focal Length mm assuming a sensor width of {SENSOR[0]}x{SENSOR[1]}mm
F {F * SENSOR[0] / 5472}
#Principal Point mm
Px {CX * SENSOR[0] / 5472}
Py {CY * SENSOR[0] / 5472}
#Symmetrical Lens Distortion Coeffs
K1 {K1}
K2 {K2}
K3 {K3}
#Tangential Lens Distortion Coeffs
T1 {P1}
T2 {P2}
"""
BLOCK = f"""{{name}} 5472 3648
{F} 0 {CX}
0 {F} {CY}
0 0 1
{K1} {K2} {K3}
{P1} {P2}
-892.5 11.2 -4.0
-0.99 -0.01 -0.05
-0.006 0.99 -0.11
0.05 -0.08 -0.99
"""
PARAMETERS = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""
COLMAP = f"# Camera list\n1 FULL_OPENCV 5472 3648 {' '.join(map(str, OPENCV))}\n"


def written(folder: Path, text: str | bytes, name: str = "lens.txt") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def in_pixels(lens: StatedLens) -> pycolmap.Camera:
    found = fitted(lens, *SIZE, 0.005)
    assert found is not None
    return found.colmap()


@pytest.mark.parametrize(
    "text", [COLMAP, METASHAPE, CAM, PARAMETERS + BLOCK.format(name="DJI_1.JPG") + BLOCK.format(name="DJI 2.JPG")]
)
def test_every_format_means_the_same_lens(tmp_path: Path, text: str) -> None:
    (found,) = read_lens_file(written(tmp_path, text))
    true = StatedLens("FULL_OPENCV", *SIZE, OPENCV, "file").colmap()
    assert float(apart_px(in_pixels(found.lens), true).max()) < 1e-3


def test_formats_agree_with_their_programs_formulas(tmp_path: Path) -> None:
    """Metashape's and Pix4D's own formulas, by hand, against COLMAP's projection of what was read."""
    x, y = 0.31, -0.22
    r2 = x * x + y * y
    radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    p1, p2 = P2, P1  # as the XML has them
    metashape = (
        0.5 * SIZE[0] + CX - 2736 + F * (x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y),
        0.5 * SIZE[1] + CY - 1824 + F * (y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y),
    )
    pix4d = (
        CX + F * (x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x)),
        CY + F * (y * radial + 2 * P2 * x * y + P1 * (r2 + 2 * y * y)),
    )
    for text, wanted in ((METASHAPE, metashape), (CAM, pix4d)):
        (found,) = read_lens_file(written(tmp_path, text))
        seen = np.asarray(in_pixels(found.lens).img_from_cam(np.array([[x, y, 1.0]])))[0]
        assert seen == pytest.approx(wanted, abs=1e-6)


def test_metashapes_fisheye_and_fourth_coefficient_and_sensors(tmp_path: Path) -> None:
    fisheye = METASHAPE.replace("frame", "fisheye").replace(str(P1), "0").replace(str(P2), "0")
    (found,) = read_lens_file(written(tmp_path, fisheye))
    ray = np.array([[math.tan(0.9), 0.0, 1.0]])
    t = 0.9
    wanted = CX + F * t * (1 + K1 * t**2 + K2 * t**4 + K3 * t**6)
    assert np.asarray(in_pixels(found.lens).img_from_cam(ray))[0, 0] == pytest.approx(wanted, abs=1e-6)
    (found,) = read_lens_file(written(tmp_path, METASHAPE.replace("<p1>", "<k4>0.002</k4><p1>")))
    r, x = 0.8, 0.8
    wanted = CX + F * (x * (1 + K1 * r**2 + K2 * r**4 + K3 * r**6 + 0.002 * r**8) + P2 * 3 * x * x)
    assert np.asarray(in_pixels(found.lens).img_from_cam(np.array([[x, 0.0, 1.0]])))[0, 0] == pytest.approx(
        wanted, abs=0.5
    )
    sensor = (
        '<document><chunk><sensors><sensor id="0" label="FC6310"><resolution width="5472" height="3648"/>'
        '<calibration type="frame" class="initial"><resolution width="5472" height="3648"/><f>3000</f></calibration>'
        '<calibration type="frame" class="adjusted"><resolution width="5472" height="3648"/><f>3676.5</f><k1>-0.01</k1>'
        "</calibration></sensor></sensors></chunk></document>"
    )
    (found,) = read_lens_file(written(tmp_path, sensor))
    assert (found.lens.params[0], found.lens.params[4], found.lens.camera) == (3676.5, -0.01, "FC6310")


def test_another_size_is_scaled_and_another_shape_is_refused() -> None:
    lens = StatedLens("SIMPLE_RADIAL", 4000, 3000, (3600.0, 2010.0, 1490.0, -0.1), "file")
    half = fitted(lens, 2000, 1500, 0.005)
    assert half is not None and half.params == (1800.0, 1005.0, 745.0, -0.1)
    assert fitted(lens, 3000, 4000, 0.005) is None
    assert fitted(lens, 4000, 2250, 0.005) is None


BOMB = '<!DOCTYPE c [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><calibration><f>&b;</f></calibration>'
HOSTILE = {
    "empty": "",
    "nothing": "# only a comment\n",
    "prose": "this is no lens at all, really\n",
    "binary": b"\x00\x01\x02",
    "entities": BOMB,
    "external": '<!DOCTYPE c SYSTEM "file:///etc/passwd"><calibration/>',
    "broken XML": METASHAPE[:-20],
    "deep XML": "<a>" * 100,
    "long XML": "<calibration>" + "<x/>" * 300_000 + "</calibration>",
    "another encoding": '<?xml version="1.0" encoding="utf-99"?><calibration/>',
    "NaN": METASHAPE.replace(str(K1), "nan"),
    "infinite": COLMAP.replace(str(F), "inf"),
    "a long number": COLMAP.replace(str(K2), "0." + "1" * 5000),
    "a large exponent": COLMAP.replace(str(K2), "1e400"),
    "too few parameters": "1 OPENCV 400 300 360 360 200 150\n",
    "another model": "1 THIN_PRISM_FISHEYE 400 300 360 360 200 150 0 0 0 0 0 0 0 0\n",
    "a negative size": "1 SIMPLE_RADIAL -400 300 360 200 150 0\n",
    "a huge size": "1 SIMPLE_RADIAL 40000000 300 360 200 150 0\n",
    "no focal length": METASHAPE.replace(f"<f>{F}</f>", ""),
    "an impossible focal length": "1 SIMPLE_RADIAL 400 300 0.001 200 150 0\n",
    "a centre outside": "1 SIMPLE_RADIAL 400 300 360 900 150 0\n",
    "a fold": "1 SIMPLE_RADIAL 400 300 360 200 150 -2.0\n",
    "a skew": METASHAPE.replace("<k1>", "<b2>55</b2><k1>"),
    "a spherical camera": METASHAPE.replace("frame", "spherical"),
    "an old PhotoScan's": METASHAPE.replace("<f>", "<fx>").replace("</f>", "</fx>"),
    "half a .cam": CAM[:150],
    "a .cam without a size": CAM.replace("sensor", "chip"),
    "torn blocks": PARAMETERS + BLOCK.format(name="a.jpg")[:-60] + BLOCK.format(name="b.jpg"),
    "blocks of words": PARAMETERS + "a b c\n" * 40,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_broken_or_hostile_file_is_refused_in_one_message(tmp_path: Path, name: str) -> None:
    with pytest.raises(SplatpipeError) as caught:
        read_lens_file(written(tmp_path, HOSTILE[name]))
    assert "lens.txt cannot be used as a lens" in caught.value.message and len(caught.value.message) < 300
    assert "ingest.lens" in caught.value.hint


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "lens.xml"
    with path.open("wb") as file:
        file.truncate(1 << 33)
    with pytest.raises(SplatpipeError, match="more than 32 MiB"):
        read_lens_file(path)
