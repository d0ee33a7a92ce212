"""Pages do not reveal folders of the machine that made them."""

from __future__ import annotations

from pathlib import Path

import pytest
from markupsafe import Markup

from splatpipe.pipeline.app.path_labels import PathLabels

OUT = Path("/srv/customers/Brown & Sons/out")
PHOTOS = Path("/home/jane doe/DCIM/100MEDIA")
GCP = "/mnt/nas share/jane/survey (2)/gcp list.csv"
PLACES = PathLabels.of(
    OUT, PHOTOS, {"georef": {"control": GCP, "crs": "EPSG:32633+5773", "grids": ["~/grids/a b.tif"]}}
)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (f"Cannot write to {OUT}: No space left on device.", "Cannot write to OUT: No space left on device."),
        (f"The log: {OUT}/splatpipe.log", "The log: OUT/splatpipe.log"),
        (f"Run again: splatpipe run {PHOTOS} {OUT}", "Run again: splatpipe run PHOTOS OUT"),
        (f"{PHOTOS}/a b/DJI_0001.JPG is broken.", "PHOTOS/a b/DJI_0001.JPG is broken."),
        (
            f"The file {GCP} of georef.control does not exist.",
            "The file gcp list.csv of georef.control does not exist.",
        ),
        ("~/grids/a b.tif", "a b.tif"),
        ("/mnt/nas share/jane/survey (2)/other.csv", "other.csv"),
        ("See /opt/cuda/lib64/libcudart.so.12, please.", "See libcudart.so.12, please."),
        ("[Errno 2] No such file: '/root/.cache/x/y.bin'", "[Errno 2] No such file: 'y.bin'"),
        ("~/secret/keys.txt and ../../jane/work/z.toml", "keys.txt and z.toml"),
        (f"{OUT.parent}/other job", "other job"),
        ("cannot open:/home/jane/grids/x.tif", "cannot open:x.tif"),
        ("file:///home/jane/grids/x.tif", "x.tif"),
        ("Cannot read /mnt/Brown & Sons/site (2)/plan [old]/gcp.csv: denied", "Cannot read gcp.csv: denied"),
        ("(in /mnt/a b/c.txt) or /home/jane doe/d.txt", "(in c.txt) or d.txt"),
        ("'/home/jane/O'Brien & Co/x.tif' is broken", "'x.tif' is broken"),
        (r"C:\Users\jane doe\Brown (Ltd)\gcp list.csv is broken", "gcp list.csv is broken"),
        (r"'C:\\Users\\jane\\x.tif' and D:/work/y.tif", "'x.tif' and y.tif"),
        (r"on \\nas\customers\Brown\x.tif.", "on x.tif."),
        ("smb://jane@nas.local/customers/Brown & Sons/x.tif", "x.tif"),
        ("copied from smb://nas to sftp://host:22/home/jane/x y.tif", "copied from  to x y.tif"),
    ],
)
def test_folders_are_left_out(said: str, expected: str) -> None:
    assert PLACES.plain(said) == expected


@pytest.mark.parametrize(
    "said",
    [
        "1/255 of 3/4, px/m, and/or, 2026/11/22, m/s",
        "https://docs.kernel.org/admin-guide/cgroup-v2.html",
        "EPSG:32633 / UTM zone 33N",
        "/dev/shm is small; /proc/sys/kernel/x",
        "stages/undistort-01/dataset/images",
        "data:,a",
        r"two\nlines.jpg and u\u2028v.jpg have line breaks",
        "",
        "a / b",
    ],
)
def test_texts_that_are_no_folders_are_kept(said: str) -> None:
    assert PLACES.plain(said) == said


def test_markup_of_our_own_is_left_alone() -> None:
    picture = Markup("data:image/jpeg;base64,a+/home/b/c=")
    assert PLACES.plain_value(picture) is picture
    assert PLACES.plain_value(7) == 7


def test_the_root_as_out_replaces_nothing_else() -> None:
    assert PathLabels.of(Path("/"), Path("/photos")).plain("a/b /photos/x.jpg") != "aOUTb"


@pytest.mark.parametrize(
    "hostile", ["/", "/a", "../", "~/", "/ ", " /a b c", "/(", "/a [", " C:\\\\a", "x://", "x://a b", "\\\\\\\\a", "a "]
)
def test_long_texts_take_no_time(hostile: str) -> None:
    assert isinstance(PLACES.plain(hostile * 20_000), str)
