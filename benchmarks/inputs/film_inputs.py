"""Field inputs: films, drawn as a flight over a flat mosaic of the demo's photos and encoded by ffmpeg."""

from __future__ import annotations

import subprocess
from io import BytesIO
from pathlib import Path

import numpy as np
from field_case import FieldInput, copy_photos, demo_bytes
from PIL import Image

SIZE = (640, 360)
RATE = 30
SECONDS = 8


def frames() -> bytes:
    """Return the raw frames of a flight at 90 pixels a second."""
    mosaic = Image.new("RGB", (1600, 900))
    for n, i in enumerate((12, 30)):
        part = Image.open(BytesIO(demo_bytes(i))).convert("RGB").resize((1200, 900))
        mosaic.paste(part, (800 * n, 0))
    pixels = np.asarray(mosaic)
    count = RATE * SECONDS
    tops = 200 + 100 * np.sin(np.arange(count) / 60)
    return b"".join(
        pixels[int(top) : int(top) + SIZE[1], 3 * n : 3 * n + SIZE[0]].tobytes() for n, top in enumerate(tops)
    )


def encode(path: Path, *options: str, before: tuple[str, ...] = ()) -> None:
    """Encode the flight with ffmpeg."""
    path.parent.mkdir(parents=True, exist_ok=True)
    start = ["ffmpeg", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    source = ["-s", f"{SIZE[0]}x{SIZE[1]}", "-r", str(RATE), "-i", "-"]
    command = [*start, *source, *before, "-pix_fmt", "yuv420p", *options, str(path)]
    subprocess.run(command, input=frames(), check=True)


def turned_hevc(folder: Path) -> None:
    """A phone held upright: HEVC in MOV, turned by the container, with sound and a single location."""
    sound = ("-f", "lavfi", "-i", f"sine=duration={SECONDS}")
    coding = ("-c:v", "libx265", "-x265-params", "log-level=error", "-tag:v", "hvc1", "-c:a", "aac")
    flat = folder / "flat.mov"
    encode(flat, *coding, "-metadata", "location=+47.8412+013.5127/", before=sound)
    copy = ["ffmpeg", "-v", "error", "-i", str(flat), "-c", "copy"]
    subprocess.run([*copy, "-metadata:s:v:0", "rotate=90", str(folder / "IMG_0001.MOV")], check=True)
    flat.unlink()


def variable_rate(folder: Path) -> None:
    """A screen recorder's or phone's variable frame rate: gaps of up to a second, H.264."""
    keep = "select='not(between(mod(n,60),20,45))'"
    encode(folder / "phone.mp4", "-vf", keep, "-vsync", "vfr", "-c:v", "libx264")


def srt_blocks(lines: list[str], start_s: float = 0.0, step_s: float = 1.0) -> str:
    """Return subtitles, one a step."""

    def stamp(seconds: float) -> str:
        return f"00:00:{int(seconds):02},{round(seconds % 1 * 1000):03}"

    return "\r\n".join(
        f"{n + 1}\r\n{stamp(start_s + n * step_s)} --> {stamp(start_s + (n + 1) * step_s)}\r\n{line}\r\n"
        for n, line in enumerate(lines)
    )


def other_subtitles(folder: Path) -> None:
    """A .srt with BOM, HTML, decimal commas and no fix at first; an Autel's; one of another film; one of speech."""
    spots = [(47.8412 + n * 1e-5, 13.5127 + n * 2e-5) for n in range(SECONDS)]
    comma = [
        f'<font size="28">FrameCnt: {n}, DiffTime: 33ms\r\n2026-06-18 13:42:{n:02}.123\r\n[iso: 100] '
        f"[latitude: {'0,000000' if n < 2 else f'{a:.6f}'.replace('.', ',')}] "
        f"[longitude: {'0,000000' if n < 2 else f'{o:.6f}'.replace('.', ',')}] [rel_alt: 30,100 abs_alt: 547,2] </font>"
        for n, (a, o) in enumerate(spots)
    ]
    autel = [f"HOME(E: 13.512700, N: 47.841200) 2026-06-18 13:42:{n:02}\r\n"
             f"GPS(E: {o:.6f}, N: {a:.6f}, 30.10m) \r\nISO:100 SHUTTER:500 EV:0 F-NUM:2.8"
             for n, (a, o) in enumerate(spots)]  # fmt: skip
    speech = ["And here we see the house,", "built in 1912 (GPS was not known then)."]
    minutes_off = [f"[latitude: {a:.6f}] [longitude: {o:.6f}] [rel_alt: 30.1 abs_alt: 547.2]" for a, o in spots]
    for name, text in (("comma", srt_blocks(comma)), ("autel", srt_blocks(autel)), ("speech", srt_blocks(speech)),
                       ("later", srt_blocks(minutes_off, 40.0))):  # fmt: skip
        encode(folder / f"{name}.mp4", "-c:v", "libx264", "-crf", "28")
        (folder / f"{name}.srt").write_bytes(text.encode("utf-8-sig"))


def other_containers(folder: Path) -> None:
    """The same flight as MKV, AVI with Motion JPEG, MPEG transport stream, WebM, GIF; a sound file; a playlist."""
    encode(folder / "flight.mkv", "-c:v", "libx264")
    encode(folder / "flight.avi", "-c:v", "mjpeg")
    encode(folder / "flight.mts", "-c:v", "libx264", "-f", "mpegts")
    encode(folder / "flight.webm", "-c:v", "libvpx", "-b:v", "1M")
    (folder / "list.mp4").write_text("file 'a.mp4'\nfile 'b.mp4'\n")
    subprocess.run(
        ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", "sine=duration=2", str(folder / "voice.mp4")], check=True
    )


def films_in_a_folder(folder: Path) -> None:
    """A folder of two films alone; and one of photos with a film, its proxy and its subtitles."""
    encode(folder / "films/DJI_0001.MP4", "-c:v", "libx264")
    encode(folder / "films/DJI_0002.MP4", "-c:v", "libx264")
    copy_photos(folder / "both", range(8))
    encode(folder / "both/DJI_0041.MP4", "-c:v", "libx264")
    (folder / "both/DJI_0041.LRF").write_bytes((folder / "both/DJI_0041.MP4").read_bytes())
    (folder / "both/DJI_0041.SRT").write_text(srt_blocks(["[latitude: 47.8412] [longitude: 13.5127]"]))


FILM_INPUTS = (
    FieldInput("turned_hevc", turned_hevc, ("check IMG_0001.MOV",), 0),
    FieldInput("variable_rate", variable_rate, ("check phone.mp4",), 0),
    FieldInput(
        "other_subtitles",
        other_subtitles,
        tuple(f"check {name}.mp4" for name in ("comma", "autel", "speech", "later")),
        0,
        mended="decimal commas: all frames at whole degrees",
    ),
    FieldInput(
        "other_containers",
        other_containers,
        tuple(
            f"check {name}"
            for name in ("flight.mkv", "flight.avi", "flight.mts", "flight.webm", "list.mp4", "voice.mp4")
        ),
        1,
        ("is a film in a container that is not read", "MP4 and MOV are read", "-c:v copy"),
        mended='"is a file"',
    ),
    FieldInput(
        "films_in_a_folder",
        films_in_a_folder,
        ("check films", "check both"),
        0,
        ("There are no photos in films, but films: DJI_0001.MP4, DJI_0002.MP4",),
        mended='"None of the photos can be used"',
    ),
)
