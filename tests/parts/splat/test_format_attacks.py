"""Damaged splat files through every reader: no crash, no hang, little memory, no error but ours."""

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Iterator

import container_layers
import mutated_files
import numpy as np
import pytest
from mutated_files import ReadProcess, Sample, attack, damaged, own_samples
from mutations import mutated
from PIL import Image

READABLE = list(mutated_files.readable())
FILES = 60  # damaged files per format; benchmarks/formats/mutated_files.py reads 5,000
FIRST = 19_000  # other seeds than the benchmark's


@pytest.fixture(scope="module")
def process() -> Iterator[ReadProcess]:
    reading = ReadProcess()
    yield reading
    reading.close()


@pytest.fixture(scope="module", params=READABLE, ids=lambda each: each.name)
def samples(request) -> list[Sample]:
    return own_samples(request.param)


def test_damaged_files_are_read_or_refused(samples, process):
    found = attack(samples, range(FIRST, FIRST + FILES), process, None)
    assert found.failures == []
    assert found.ends["refused"] > FILES // 10  # the damage is damage


def test_whole_files_are_read_by_their_reader_and_by_content(samples, process, tmp_path):
    for number, sample in enumerate(samples):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = sample.write(folder)
        for name in (sample.splat_format.name, ""):
            answer = process.read(name, path)
            assert (answer["outcome"], answer["detail"]) == ("read", "")


def test_a_seed_reproduces_its_file(samples):
    for seed in range(30):
        first, again = damaged(samples, seed), damaged(samples, seed)
        assert first[0] == again[0] and first[1].files == again[1].files


def containers() -> dict[str, bytes]:
    content = np.random.default_rng(0).bytes(400)
    binary = struct.pack("<II", 400, 0x004E4942) + content
    pixels, zipped = io.BytesIO(), io.BytesIO()
    Image.frombytes("RGBA", (10, 10), content).save(pixels, "WEBP", lossless=True, exact=True)
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("content", content)
    return {
        "gzip": gzip.compress(content, mtime=0),
        "zip": zipped.getvalue(),
        "glb": struct.pack("<4sII", b"glTF", 2, 12 + len(binary)) + binary,
        "webp": pixels.getvalue(),
    }


@pytest.mark.parametrize("kind", sorted(containers()))
def test_damage_gets_past_check_sums(kind):
    """Damaged containers still unpack, with different contents."""
    container, generator, changed = containers()[kind], np.random.default_rng(0), 0
    whole = container_layers.layer_of(container, generator)
    assert whole is not None
    for seed in range(60):
        what, data = mutated(container, container, np.random.default_rng(seed))
        if what.endswith("inside"):
            layer = container_layers.layer_of(data, generator)
            assert layer is not None
            changed += layer[0] != whole[0]
    assert changed > 25


def test_bombs_unpack_to_their_declared_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1 << 26)  # reading photos removes the limit for the whole process
    packed, crc = container_layers.deflated_zeros()
    unpack, total, found = zlib.decompressobj(-15), 0, 0
    rest = packed
    while rest:
        piece = unpack.decompress(rest, 1 << 22)
        total, found, rest = total + len(piece), zlib.crc32(piece, found), unpack.unconsumed_tail
    assert (total, found) == (container_layers.BOMB_BYTES, crc)
    for side in (1, 1000):
        with Image.open(io.BytesIO(container_layers.blank_webp(side))) as picture:
            assert picture.size == (side, side)
            picture.load()
    with pytest.raises(Image.DecompressionBombError):
        Image.open(io.BytesIO(container_layers.blank_webp()))


WORKER = """
import json, os, sys, time
print("ready", flush=True)
for line in sys.stdin:
    name = json.loads(line)["format"]
    if name == "dies":
        os.abort()
    time.sleep(600 if name == "hangs" else 0)
    print(json.dumps({"outcome": "read", "detail": "", "cpu_s": 0.0, "peak_bytes": 0}), flush=True)
"""


def test_a_reader_that_dies_or_hangs_is_noticed_and_replaced(tmp_path):
    worker = tmp_path / "worker.py"
    worker.write_text(WORKER)
    process = ReadProcess(worker, patience_s=5.0)
    ends = [mutated_files.end_of(process.read(name, tmp_path)) for name in ("reads", "dies", "reads", "hangs", "reads")]
    process.close()
    assert ends == ["read", "crashed", "read", "slow", "read"]
