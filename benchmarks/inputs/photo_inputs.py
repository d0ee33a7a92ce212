"""Field inputs: photos."""

from __future__ import annotations

import os
import unicodedata
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from field_case import (
    EXIF_IFD,
    FieldInput,
    control_lines,
    copy_photos,
    demo_bytes,
    edited,
    exif_of,
    gps_of,
    with_metadata,
)
from PIL import Image, ImageCms, ImageFilter

FEW = range(10)


def picture(index: int) -> Image.Image:
    """Return a photo's pixels."""
    return Image.open(BytesIO(demo_bytes(index))).convert("RGB")


def orientations(folder: Path) -> None:
    """Orientation 5, 6, 7, 8 in turn, as of cameras whose sensor of gravity is confused when they look down."""
    for i in FEW:
        (folder / f"DJI_{i:04}.JPG").write_bytes(edited(i, main={0x112: (1, 6, 8, 3, 5, 7)[i % 6]}, xmp=True))


def no_references(folder: Path) -> None:
    """Positions without N, S, E, W and without XMP."""
    for i in FEW:
        (folder / f"2022_0221_{i:03}.JPG").write_bytes(edited(i, gps={1: None, 3: None, 5: None}))


def zero_positions(folder: Path) -> None:
    """Three of ten photos at 0/1 0/1 0/1, before the first fix, and altitude 0."""
    for i in FEW:
        zero = {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0), 6: 0.0}
        (folder / f"DJI_{i:04}.JPG").write_bytes(edited(i, gps=zero if i < 3 else {}))


def below_the_sea(folder: Path) -> None:
    """At the Dead Sea: altitude 385 m, AltitudeRef 1 (below the sea), no XMP."""
    for i in FEW:
        altitude = 905.0 - gps_of(i)[2]
        where = {2: (31.0, 30.0, 29.0 + 0.05 * i), 4: (35.0, 28.0, 45.0 + 0.1 * (i % 3)), 6: altitude, 5: b"\x01"}
        (folder / f"DJI_{i:04}.JPG").write_bytes(edited(i, gps=where))


def odd_times(folder: Path) -> None:
    """Times without seconds, as ISO, as zeros, as blanks, with a zone, with a 60th second."""
    odd = ["2026:06:18 13:42", "2026-06-18T13:42:17+02:00", "0000:00:00 00:00:00", "    :  :     :  :  ", "18/06/2026"]
    for i in FEW:
        exif = exif_of(demo_bytes(i))
        for tag in (36867, 36868):
            exif.get_ifd(EXIF_IFD)[tag] = odd[i % len(odd)]
        exif[306] = odd[i % len(odd)]
        (folder / f"IMG_{i:04}.JPG").write_bytes(with_metadata(demo_bytes(i), exif))


def colour_encodings(folder: Path) -> None:
    """An editor's export: CMYK, progressive, grey, Adobe RGB with its profile, 16-bit PNG, palette PNG, WebP."""
    srgb = ImageCms.createProfile("sRGB")
    for i in FEW:
        image, exif = picture(i), exif_of(demo_bytes(i))
        stem = folder / f"DJI_{i:04}"
        if i % 7 == 0:
            ImageCms.profileToProfile(image, srgb, srgb).convert("CMYK").save(f"{stem}.jpg", quality=95, exif=exif)
        elif i % 7 == 1:
            image.save(f"{stem}.jpg", quality=95, progressive=True, exif=exif)
        elif i % 7 == 2:
            image.convert("L").save(f"{stem}.jpg", quality=95, exif=exif)
        elif i % 7 == 3:
            profile = ImageCms.ImageCmsProfile(srgb).tobytes()
            image.save(f"{stem}.jpg", quality=95, exif=exif, icc_profile=profile)
        elif i % 7 == 4:
            cv2.imwrite(f"{stem}.png", np.asarray(image)[..., ::-1].astype(np.uint16) * 257)
        elif i % 7 == 5:
            image.quantize(256).save(f"{stem}.png")
        else:
            image.save(f"{stem}.webp", quality=95, exif=exif)


def twelve_bits(folder: Path) -> None:
    """16-bit TIFFs that use 12 bits, as scientific cameras write them: nearly black if read as 16."""
    for i in FEW:
        grey = np.asarray(picture(i).convert("L")).astype(np.uint16) * 16
        cv2.imwrite(str(folder / f"frame_{i:04}.tif"), grey)


def float_tiffs(folder: Path) -> None:
    """Reflectance as float TIFFs (0 to 1), and an elevation model that was left in the folder."""
    for i in FEW:
        values = np.asarray(picture(i)).astype(np.float32)[..., ::-1] / 255.0
        cv2.imwrite(str(folder / f"IMG_{i:04}_reflectance.tif"), values)
    cv2.imwrite(str(folder / "dsm.tif"), 500.0 + 10.0 * np.random.default_rng(0).random((700, 900)).astype(np.float32))


def odd_names(folder: Path) -> None:
    """Names as they come from a Mac, a phone and a joker; the control file has them composed (NFC)."""
    names = [
        unicodedata.normalize("NFD", "Münster Süd é.JPG"),
        "-rf.JPG",
        "DJI 0003 (copy) (1).JPG",
        "a.b..c.JPG",
        "x" * 240 + ".JPG",
        "50%_#1&2;3.JPG",
        "\N{HELICOPTER} flight.jpeg",
        "line\nbreak.JPG",
        " leading and trailing .JPG",
        "photo.jfif",
    ]
    copy_photos(
        folder / "photos",
        [4, 17, 18, 19, 20, 21, 22, 23, 24, 25],
        lambda i: names[[4, 17, 18, 19, 20, 21, 22, 23, 24, 25].index(i)],
    )
    lines = [control_lines()[0]]
    renamed = {
        "DJI_0005.JPG": unicodedata.normalize("NFC", names[0]),
        "DJI_0018.JPG": names[1],
        "DJI_0019.JPG": names[2],
    }
    for line in control_lines()[1:]:
        fields = line.split()
        if fields[5] in renamed:
            lines.append("\t".join([*fields[:5], renamed[fields[5]], fields[6]]))
    (folder / "photos/gcp_list.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def case_twins(folder: Path) -> None:
    """IMG.JPG and img.jpg of different shots, 100MEDIA and 101MEDIA with the same names; control with bare names."""
    copy_photos(folder / "photos", [0, 1], lambda i: ("IMG.JPG", "img.jpg")[i])
    copy_photos(folder / "photos/100MEDIA", range(4, 10))
    copy_photos(folder / "photos/101MEDIA", range(16, 22), lambda i: f"DJI_{i - 11:04}.JPG")
    lines = [line for line in control_lines() if any(f"DJI_{n:04}.JPG" in line for n in range(5, 11))]
    (folder / "photos/gcp_list.txt").write_text("\n".join([control_lines()[0], *lines]) + "\n", encoding="utf-8")


def no_photos_at_all(folder: Path) -> None:
    """No photos, by a photo's name: an empty file, a web page, half a download, a folder, a link to nowhere, a pipe."""
    copy_photos(folder / "photos", range(8))
    bad = folder / "photos"
    (bad / "EMPTY.JPG").touch()
    (bad / "LOGIN.JPG").write_text("<!DOCTYPE html><html><body>Sign in to your cloud</body></html>")
    (bad / "HALF.JPG").write_bytes(demo_bytes(9)[:70_000])
    (bad / "PADDED.JPG").write_bytes(demo_bytes(10)[:90_000] + b"\0" * 70_000)
    (bad / "FOLDER.JPG").mkdir()
    (bad / "LINK.JPG").symlink_to("/nowhere/DJI_0001.JPG")
    os.mkfifo(bad / "PIPE.JPG")


def payload_twins(folder: Path) -> None:
    """A DJI H20T: wide, zoom and thermal photos of each shot, and a 360-degree panorama beside them."""
    for i in FEW:
        stem = f"DJI_20260618134{i:03}_{i + 1:04}"
        wide = picture(i)
        exif = exif_of(demo_bytes(i))
        xmp = Image.open(BytesIO(demo_bytes(i))).info["xmp"]
        (folder / f"{stem}_W.JPG").write_bytes(demo_bytes(i))
        zoom = wide.crop((450, 340, 750, 565)).resize((1200, 900), Image.Resampling.LANCZOS)
        buffer = BytesIO()
        zoom.save(buffer, "JPEG", quality=92)
        exif.get_ifd(EXIF_IFD)[41989] = 96
        (folder / f"{stem}_Z.JPG").write_bytes(
            with_metadata(buffer.getvalue(), exif, xmp=xmp.replace(b"WideCamera", b"ZoomCamera"))
        )
        heat = wide.convert("L").resize((640, 512)).filter(ImageFilter.GaussianBlur(6)).convert("RGB")
        buffer = BytesIO()
        heat.save(buffer, "JPEG", quality=92)
        exif.get_ifd(EXIF_IFD)[41989] = 58
        (folder / f"{stem}_T.JPG").write_bytes(
            with_metadata(buffer.getvalue(), exif, xmp=xmp.replace(b"WideCamera", b"InfraredCamera"))
        )
    pano = picture(0).resize((4000, 2000))
    buffer = BytesIO()
    pano.save(buffer, "JPEG", quality=80)
    gpano = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        b'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        b'GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True" GPano:FullPanoWidthPixels="4000" '
        b'GPano:FullPanoHeightPixels="2000"/></rdf:RDF></x:xmpmeta>'
    )
    (folder / "DJI_0100_PANO.JPG").write_bytes(with_metadata(buffer.getvalue(), exif_of(demo_bytes(0)), xmp=gpano))


def sent_by_messenger(folder: Path) -> None:
    """Half of the photos at half size without metadata, as a messenger leaves them; two are there twice."""
    copy_photos(folder, range(5))
    for i in range(5, 10):
        picture(i).resize((600, 450)).save(folder / f"IMG-20260618-WA{i:04}.jpg", quality=70)
    for i in (0, 1):
        picture(i).resize((600, 450)).save(folder / f"IMG-20260618-WA{i:04}.jpg", quality=70)


def broken_rationals(folder: Path) -> None:
    """GPS with 0/0 seconds, altitude 0/0, and a latitude of 91 degrees in single photos."""
    from PIL.TiffImagePlugin import IFDRational

    none = IFDRational(0, 0)
    for i in FEW:
        odd = {0: {2: (47.0, 50.0, none)}, 1: {6: none}, 2: {2: (91.0, 0.0, 0.0)}, 3: {4: (13.0, 99.0, 1.0)}}.get(i, {})
        (folder / f"DJI_{i:04}.JPG").write_bytes(edited(i, gps=odd))


def masks_of_all_kinds(folder: Path) -> None:
    """Masks at half size, of another aspect, all white, all black, with alpha, empty, for photos that do not exist."""
    photos = copy_photos(folder / "photos", FEW)
    masks = folder / "photos/masks"
    masks.mkdir()
    half = np.full((450, 600), 255, np.uint8)
    half[:100] = 0
    Image.fromarray(half).save(masks / f"{photos[0].stem}.png")
    Image.fromarray(half[:, :450]).save(masks / f"{photos[1].name}.png")
    Image.new("L", (1200, 900), 0).save(masks / f"{photos[2].name}.png")
    Image.new("L", (1200, 900), 255).save(masks / f"{photos[3].name}.png")
    alpha = Image.new("RGBA", (1200, 900), (255, 255, 255, 255))
    alpha.paste((255, 255, 255, 0), (0, 0, 1200, 200))
    alpha.save(masks / f"{photos[4].name}.png")
    Image.new("1", (1200, 900), 1).save(masks / f"{photos[5].stem}_mask.png")
    Image.new("L", (1200, 900), 255).save(masks / "DJI_9999.JPG.png")
    (masks / f"{photos[6].name}.png").write_bytes(b"")


PHOTO_INPUTS = (
    FieldInput("orientations", orientations, ("check .",), 0),
    FieldInput("no_references", no_references, ("check .",), 0, ("state no hemisphere",)),
    FieldInput("zero_positions", zero_positions, ("check .",), 0, ("Impossible positions: DJI_0000.JPG",)),
    FieldInput("below_the_sea", below_the_sea, ("check .",), 0),
    FieldInput("odd_times", odd_times, ("check .",), 0),
    FieldInput("colour_encodings", colour_encodings, ("check .", "run . ../colour_out --until ingest"), 0),
    FieldInput("twelve_bits", twelve_bits, ("check .",), 0),
    FieldInput(
        "float_tiffs",
        float_tiffs,
        ("check .",),
        1,
        ("a TIFF of a kind that is not read",),
        mended='colour of floats: "damaged"',
    ),
    FieldInput("odd_names", odd_names, ("check photos",), 0, mended="accents taken apart: not found"),
    FieldInput(
        "case_twins",
        case_twins,
        ("check photos",),
        1,
        ("may be 100MEDIA/DJI_0005.JPG, 101MEDIA/",),
        mended="not told with both",
    ),
    FieldInput(
        "no_photos_at_all",
        no_photos_at_all,
        ("check photos",),
        0,
        ("LOGIN.JPG is no JPEG picture", "HALF.JPG, PADDED.JPG; each is truncated"),
        mended="a copy was asked for of what is not broken",
    ),
    FieldInput("payload_twins", payload_twins, ("check .",), 0, ("is a stitched panorama", "without thermal")),
    FieldInput("sent_by_messenger", sent_by_messenger, ("check .",), 0, ("Duplicate photos", "saved again")),
    FieldInput("broken_rationals", broken_rationals, ("check .",), 0, ("Impossible positions", "Without an altitude")),
    FieldInput("masks_of_all_kinds", masks_of_all_kinds, ("check photos", "run photos out --until ingest"), 0),
)
