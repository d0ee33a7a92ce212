"""A film's boxes: what they state is read, and hostile ones do no harm."""

import os
import random
import resource
import struct
from pathlib import Path

import pytest
from scenes.film_boxes import FilmParts, box, full, table

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.video.boxes import read_container


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_what_the_boxes_state_is_read(tmp_path: Path) -> None:
    film = read_container(written(tmp_path / "a.mp4", FilmParts().written()))
    assert (film.codec, film.width, film.height, film.frames, film.seconds) == ("avc1", 1920, 1080, 6, 1.2)
    assert film.turn_deg == 0 and film.location == (47.8411, 13.5126)
    assert film.recorded is not None and film.recorded.isoformat() == "2026-08-08T02:13:20"
    assert [(cue.begin_s, cue.end_s) for cue in film.cues] == [(0.0, 1.0), (1.0, 2.0)]
    assert film.cues[1].text.startswith("[latitude: 47.8411]")


@pytest.mark.parametrize(("matrix", "turn"), [((0, 1, -1, 0), 90), ((-1, 0, 0, -1), 180), ((0, -1, 1, 0), 270)])
def test_the_turn_of_a_player_is_told(tmp_path: Path, matrix: tuple[int, ...], turn: int) -> None:
    a, b, c, d = (value << 16 for value in matrix)
    film = read_container(written(tmp_path / "a.mov", FilmParts(matrix=(a, b, 0, c, d, 0, 0, 0, 1 << 30)).written()))
    assert film.turn_deg == turn


def test_every_beginning_of_a_film_is_refused(tmp_path: Path) -> None:
    whole = FilmParts().written()
    for length in range(len(whole)):
        with pytest.raises(SplatpipeError, match=r"is truncated|no MP4"):
            read_container(written(tmp_path / "a.mp4", whole[:length]))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (FilmParts(keys=[]), "no key frames"),
        (FilmParts(frames=0, keys=None), "no frames"),
        (FilmParts(replaced={b"stco": table(b"stco", [(1 << 31,)])}), "is truncated"),
        (FilmParts(replaced={b"stsz": full(b"stsz", struct.pack(">II", 1, 0xFFFFFFFF))}), "contradicts itself"),
        (FilmParts(replaced={b"stsz": full(b"stsz", struct.pack(">II", 0, 1 << 20))}), "contradicts itself"),
        (FilmParts(replaced={b"stsz": full(b"stsz", struct.pack(">II", 0xFFFFFFFF, 6))}), "is truncated"),
        (FilmParts(replaced={b"stsc": table(b"stsc", [(1, 0xFFFFFFFF, 1), (0xFFFFFFFF, 1, 1)])}), "contradicts itself"),
        (FilmParts(replaced={b"stsc": table(b"stsc", [(7, 6, 1)])}), "contradicts itself"),
        (FilmParts(replaced={b"stco": table(b"stco", [(40,)], count=0xFFFFFFFF)}), "contradicts itself"),
        (FilmParts(replaced={b"stsd": b""}), "contradicts itself"),
    ],
)
def test_tables_that_contradict_the_file_are_refused(tmp_path: Path, parts: FilmParts, message: str) -> None:
    with pytest.raises(SplatpipeError, match=message):
        read_container(written(tmp_path / "a.mp4", parts.written()))


def test_gigabytes_of_zeros_and_other_files_are_refused_at_once(tmp_path: Path) -> None:
    path = written(tmp_path / "zeros.mp4", b"")
    os.truncate(path, 4 << 30)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SplatpipeError, match=r"zeros\.mp4 is no MP4 or MOV film"):
        read_container(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10_000  # kB
    for content in (b"", b"#EXTM3U\nhttp://127.0.0.1/a.ts\n", b"\x1aE\xdf\xa3" + bytes(99), b"\0\0\0\x08free" * 20_000):
        with pytest.raises(SplatpipeError, match=r"no MP4|truncated"):
            read_container(written(tmp_path / "other.mp4", content))


def test_a_fragmented_film_is_refused_with_a_command(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError) as caught:
        read_container(written(tmp_path / "a.mp4", FilmParts().written() + box(b"moof", bytes(8))))
    assert "-c copy" in caught.value.hint


def test_a_claimed_index_of_gigabytes_is_not_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mp4", box(b"ftyp", bytes(8)) + struct.pack(">I4sQ", 1, b"moov", 3 << 30))
    os.truncate(path, 16 + (3 << 30))
    with pytest.raises(SplatpipeError, match="contradicts itself"):
        read_container(path)


def test_mutated_boxes_raise_nothing_else(tmp_path: Path) -> None:
    whole, rng = FilmParts().written(), random.Random(0)
    for _ in range(600):
        data = bytearray(whole)
        for _ in range(rng.randint(1, 6)):
            data[rng.randrange(len(data))] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
        try:
            film = read_container(written(tmp_path / "a.mp4", bytes(data)))
        except SplatpipeError:
            continue
        assert film.frames <= len(whole) and sum(len(cue.text) for cue in film.cues) <= len(whole)
