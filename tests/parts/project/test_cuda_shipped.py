"""The shipped CUDA library: one file with the C interface and nothing else, for every requested architecture.

Whether there is one follows from SPLATPIPE_CUDA, as in `pipeline/native/cuda/CMakeLists.txt`: CI asks for all.
With ``auto``, the build records what it found.
"""

import os
import re
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

from splatpipe.pipeline import native

API = ROOT / "pipeline" / "native" / "cuda" / "api.h"
LIBRARY = Path(native.__file__).parent / "libsplat_cuda.so"
EVERY_DEVICE = {75, 80, 86, 89, 90, 100, 120}
NEWEST = 120
FAT_MAGIC = 0xBA55ED50  # first word of a container in which nvcc packs code for several devices
PTX, MACHINE_CODE = 1, 2
SYSTEM = re.compile(r"lib(stdc\+\+|gcc_s|c|m|dl|rt|pthread)\.so\.\d+|ld-linux.*")


def devices_asked_for() -> set[int]:
    """Return what SPLATPIPE_CUDA requests; with ``auto``, what the last build recorded."""
    stamp = Path(sys.prefix) / ".cuda"  # what `make` built for last
    built = stamp.read_text().split()[:1] if stamp.exists() else []
    asked = os.environ.get("SPLATPIPE_CUDA") or "".join(built) or "auto"
    if asked == "all":
        return EVERY_DEVICE
    if asked != "auto":
        return {int(device) for device in re.findall(r"\d+", asked)}
    builds = sorted(ROOT.glob("build/*/cuda.txt"), key=lambda path: path.stat().st_mtime)
    return reported_devices(builds[-1].read_text()) if builds else set()


def reported_devices(text: str) -> set[int]:
    """Return the architectures that a build recorded: cuda.txt in its folder."""
    built = re.fullmatch(r"with CUDA for ([\d ]+) \(nvcc .*\)\n", text)
    assert built or text.startswith("without CUDA: "), text
    return {int(device) for device in built[1].split()} if built else set()


def exports(library: Path) -> set[str]:
    lines = subprocess.check_output(["nm", "-D", "--defined-only", library], text=True).splitlines()
    return {line.split()[-1] for line in lines}


def needed(library: Path) -> list[str]:
    return re.findall(r"\(NEEDED\).*\[(.+)\]", subprocess.check_output(["readelf", "-d", library], text=True))


def fat_binaries(content: bytes) -> list[list[tuple[int, int]]]:
    """Kind and device of each part of each fat binary: one per source file, behind one another.

    The layout is that of nvcc 13, as ``cuobjdump --list-elf`` (which does not come with every toolkit) reads it: a
    header (magic, version, its size, bytes that follow), then parts, each with a header (kind, its size, bytes; the
    device at 28).
    """
    found, at = [], 0
    while at + 16 <= len(content):
        magic, _, header, size = struct.unpack_from("<IHHQ", content, at)
        assert magic == FAT_MAGIC, hex(magic)
        part, end, parts = at + header, at + header + size, []
        while part < end:
            kind, _, part_header, part_size = struct.unpack_from("<HHIQ", content, part)
            parts.append((kind, struct.unpack_from("<I", content, part + 28)[0]))
            part += part_header + part_size
        found.append(parts)
        at = (end + 7) // 8 * 8
    return found


def section(library: Path, name: str) -> bytes:
    listed = subprocess.check_output(["readelf", "-SW", library], text=True)
    row = re.search(rf" {re.escape(name)} +PROGBITS +\w+ (\w+) (\w+) ", listed)
    assert row, listed
    begin, size = (int(number, 16) for number in row.groups())
    return library.read_bytes()[begin : begin + size]


def strangers(library: Path) -> list[str]:
    """Return a library's exports apart from the C interface, and its dependencies apart from the system's."""
    interface = set(re.findall(r"^SPLAT_API .*?(splat_\w+)\(", API.read_text(), re.MULTILINE))
    missing = [f"{name} is missing" for name in interface - exports(library)]
    return sorted([*(exports(library) - interface), *missing, *(n for n in needed(library) if not SYSTEM.fullmatch(n))])


def test_a_builds_record_is_read() -> None:
    assert reported_devices("with CUDA for 86 90 (nvcc 13.0.88)\n") == {86, 90}
    assert reported_devices("without CUDA: this machine has no NVIDIA GPU (nvidia-smi finds none)\n") == set()
    with pytest.raises(AssertionError):
        reported_devices("with CUDA\n")


def test_the_library_exists_if_it_was_requested() -> None:
    assert LIBRARY.exists() == bool(devices_asked_for()), os.environ.get("SPLATPIPE_CUDA")


def test_the_library_exports_only_the_interface_and_needs_no_library_of_cuda_or_torch() -> None:
    assert [strangers(library) for library in LIBRARY.parent.glob(LIBRARY.name)] == [[]] * bool(devices_asked_for())


def test_each_source_is_compiled_for_every_device() -> None:
    asked = devices_asked_for()
    for library in LIBRARY.parent.glob(LIBRARY.name):
        binaries = fat_binaries(section(library, ".nv_fatbin"))
        assert binaries
        for parts in binaries:
            assert {device for kind, device in parts if kind == MACHINE_CODE} == asked
            if asked == EVERY_DEVICE:
                assert (PTX, NEWEST) in parts


def build(library: Path, source: str, *flags: str) -> Path:
    library.with_suffix(".cpp").write_text(source)
    subprocess.run(["c++", "-shared", "-fPIC", "-o", library, library.with_suffix(".cpp"), *flags], check=True)
    return library


@pytest.mark.parametrize(
    ("source", "stranger"),
    [
        ("", "splat_forward is missing"),
        ('extern "C" int splat_secret() { return 1; }', "splat_secret"),
        ("int helper() { return 1; }", "_Z6helperv"),
        ('extern "C" int other(); int (*use)() = other;', "libother.so"),
    ],
)
def test_foreign_exports_and_dependencies_are_found(tmp_path: Path, source: str, stranger: str) -> None:
    build(tmp_path / "libother.so", 'extern "C" int other() { return 1; }')
    assert stranger in strangers(build(tmp_path / "library.so", source, f"-L{tmp_path}", "-Wl,--as-needed", "-lother"))


def test_a_fat_binary_is_read_part_by_part() -> None:
    parts = [(MACHINE_CODE, 75, b"code"), (PTX, NEWEST, b"text....")]
    packed = [struct.pack("<HHIQQII", kind, 0, 32, len(code), 0, 0, device) + code for kind, device, code in parts]
    one = struct.pack("<IHHQ", FAT_MAGIC, 1, 16, sum(map(len, packed))) + b"".join(packed)
    one += bytes(-len(one) % 8)
    assert fat_binaries(one + one) == [[(MACHINE_CODE, 75), (PTX, NEWEST)]] * 2
