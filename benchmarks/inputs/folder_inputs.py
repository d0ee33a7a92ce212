"""Field inputs: whole folders, as cameras' cards and other programs leave them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from field_case import FieldInput, control_lines, copy_photos, demo_bytes
from model_inputs import write_model
from PIL import Image

FEW = range(5)


def card_dump(folder: Path) -> None:
    """A drone's card: photos, raw twins, a receiver's files, panorama parts, thumbnails, a Mac's and Windows' dirt."""
    media = folder / "DCIM/100MEDIA"
    for path in copy_photos(media, FEW):
        path.with_suffix(".DNG").write_bytes(b"II*\0\x08\0\0\0\0\0\0\0\0\0")
        (media / f"._{path.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
        thumbnails = folder / "DCIM/.thumbnails"
        thumbnails.mkdir(exist_ok=True)
        Image.open(path).resize((400, 300)).save(thumbnails / path.name)
    for name in ("Timestamp.MRK", "PPKRAW.bin", "Rinex.obs", "EVENTLOG.bin", "flight.nav"):
        (media / name).write_bytes(b"1\t123456.789\t[2162]\t0,N\t0,E\t0,V\t47.84,Lat\t13.51,Lon\t547.1,Ellh\n")
    (media / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0" + bytes(100))
    (media / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    copy_photos(folder / "DCIM/PANORAMA/100_0001", range(30, 34), lambda i: f"PANO_{i:04}.JPG")
    (folder / "MISC").mkdir()
    (folder / "MISC/IDX.db").write_bytes(bytes(50))
    (folder / "MISC/THM").mkdir()
    Image.open(media / "DJI_0001.JPG").resize((160, 120)).save(folder / "MISC/THM/DJI_0001.THM", "JPEG")


def odm_project(folder: Path) -> None:
    """A whole ODM project: images, control, and what ODM made of them."""
    project = folder / "project"
    photos = copy_photos(project / "images", FEW)
    shutil.copy(Path(__file__).resolve().parents[2] / "demo/capture/gcp_list.txt", project / "gcp_list.txt")
    for where in ("opensfm/undistorted/images", "odm_texturing"):
        (project / where).mkdir(parents=True)
    for path in photos:
        Image.open(path).save(project / f"opensfm/undistorted/images/{path.name}.tif")
    Image.open(photos[0]).resize((2048, 2048)).save(
        project / "odm_texturing/odm_textured_model_geo_material0000_map_Kd.png"
    )
    for name in ("odm_orthophoto/odm_orthophoto.tif", "odm_dem/dsm.tif"):
        (project / name).parent.mkdir()
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (900, 1200, 3), dtype=np.uint8)).save(project / name)
    assert control_lines()


def out_among_photos(folder: Path) -> None:
    """Photos in the current folder, and OUT in it: a second run and a check must not find the first one's pictures."""
    copy_photos(folder, FEW)


def earlier_run(folder: Path) -> None:
    """Photos, and among them the folder of an earlier run, with its dataset, moved there by hand."""
    photos = copy_photos(folder, FEW)
    dataset = folder / "first/stages/undistort-0123456789abcdef/dataset/images"
    dataset.mkdir(parents=True)
    for path in photos:
        with Image.open(path) as image:
            image.resize((800, 600)).save(dataset / path.name)
    (folder / "first/stages/format.json").write_text(json.dumps({"format": 1}))
    (folder / "first/splat.ply").write_bytes(b"ply\n")


def cloud_copies(folder: Path) -> None:
    """A synchronised folder: "(1)" copies, a conflicted copy, extensions in mixed case, a placeholder of iCloud."""
    photos = copy_photos(folder, FEW, lambda i: f"IMG_{i:04}.{('JPG', 'jpg', 'JpEg', 'JPEG', 'jpG')[i]}")
    for path, name in zip(
        photos, ("IMG_0000(1).JPG", "IMG_0001 (Anna's conflicted copy 2026-06-18).jpg"), strict=False
    ):
        (folder / name).write_bytes(path.read_bytes())
    (folder / ".IMG_0009.JPG.icloud").write_bytes(b"bplist00")


def webodm_assets(folder: Path) -> None:
    """WebODM's all.zip, unpacked: no photos, only products."""
    pixels = np.random.default_rng(0).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    for name in ("orthophoto_tiles/18/140908/90870.png", "odm_orthophoto/odm_orthophoto.tif", "dsm_tiles/1/2/3.png"):
        (folder / "all" / name).parent.mkdir(parents=True)
        Image.fromarray(pixels).save(folder / "all" / name)
    (folder / "all/cameras.json").write_text("{}")


def nerfstudio_folder(folder: Path) -> None:
    """nerfstudio's folder: images, images_2, images_4, transforms.json and colmap/sparse/0."""
    photos = copy_photos(folder / "data/images", range(0, 40, 4))
    for by in (2, 4):
        (folder / f"data/images_{by}").mkdir()
        for path in photos:
            Image.open(path).resize((1200 // by, 900 // by)).save(folder / f"data/images_{by}/{path.name}")
    write_model(folder / "data/colmap/sparse/0")
    frames = [{"file_path": f"images/{path.name}", "transform_matrix": np.eye(4).tolist()} for path in photos]
    (folder / "data/transforms.json").write_text(json.dumps({"fl_x": 851.3, "w": 1200, "h": 900, "frames": frames}))


def not_a_folder(folder: Path) -> None:
    """A ZIP of photos, a single photo, an empty folder, one that is not there, a list of names, OUT that is PHOTOS."""
    copy_photos(folder / "photos", FEW)
    shutil.make_archive(str(folder / "photos"), "zip", folder / "photos")
    (folder / "one.JPG").write_bytes(demo_bytes(0))
    (folder / "empty").mkdir()
    (folder / "list.txt").write_text("photos/DJI_0001.JPG\nphotos/DJI_0002.JPG\n")


FOLDER_INPUTS = (
    FieldInput("card_dump", card_dump, ("check .",), 0),
    FieldInput(
        "odm_project",
        odm_project,
        ("check project",),
        0,
        ("each is a folder of OpenDroneMap's products", "5 photos."),
        ("Duplicate",),
        mended="products counted as photos",
    ),
    FieldInput(
        "out_among_photos", out_among_photos, ("run . out --until features", "run . out --until ingest", "check ."), 0
    ),
    FieldInput("nerfstudio_folder", nerfstudio_folder, ("run data out --until ingest",), 0),
    FieldInput(
        "not_a_folder",
        not_a_folder,
        (
            "check photos.zip",
            "check one.JPG",
            "check empty",
            "check nowhere",
            "check list.txt",
            "run photos photos --until ingest",
        ),
        2,
        ("photos.zip is an archive", "one.JPG is a single picture", "The folder empty is empty"),
        mended='"is a file"',
    ),
    FieldInput(
        "earlier_run",
        earlier_run,
        ("check .",),
        0,
        ("first is a folder of splatpipe's products", "5 photos."),
        ("Duplicate",),
        mended="its pictures counted as photos",
    ),
    FieldInput(
        "cloud_copies",
        cloud_copies,
        ("check .",),
        0,
        ("IMG_0000(1).JPG is the same file as IMG_0000.JPG", "5 photos."),
        mended="the original was left out",
    ),
    FieldInput(
        "webodm_assets",
        webodm_assets,
        ("check all",),
        1,
        ("OpenDroneMap's products",),
        mended="tiles counted as photos",
    ),
)
