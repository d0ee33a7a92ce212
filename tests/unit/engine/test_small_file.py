"""Small files are read without waiting, and no more of them than is allowed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.config import load_file
from splatpipe.pipeline.engine.digests import walk_files
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.files.json_file import parse_json, read_json
from splatpipe.pipeline.engine.files.small_file import open_regular, read_end, read_small
from splatpipe.pipeline.engine.machine import parse_mounts, pseudo_devices


def test_a_file_of_exactly_the_limit_is_read_and_one_byte_more_is_not(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_bytes(b"#" * 2000)
    assert read_small(path, 2000) == b"#" * 2000 and read_end(path, 3) == b"###"
    with pytest.raises(OSError, match="it is too large: more than 1 KiB"):
        read_small(path, 1999)


def test_a_file_that_states_no_size_is_read_up_to_the_limit() -> None:
    path = Path("/proc/self/maps")
    assert path.stat().st_size == 0 and read_small(path, 1 << 24).count(b"\n") > 10
    with pytest.raises(OSError, match="too large"):
        read_small(path, 10)


@pytest.mark.parametrize("target", ["/dev/zero", "/dev/null", "pipe"])
def test_pipes_and_devices_are_refused_at_once(tmp_path: Path, target: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "config.toml"
    path.symlink_to(target)
    for read in (lambda: read_small(path, 10), lambda: open_regular(path), lambda: read_json(path)):
        with pytest.raises(OSError, match=r"it is a (device|named pipe), not a file"):
            read()
    with pytest.raises(UsageError, match=r"Cannot read .*config.toml: it is a (device|named pipe), not a file\."):
        load_file(path)


def test_too_large_a_configuration_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(UsageError, match=r"config.toml: it is too large: more than 1 MiB\."):
        load_file(path)


@pytest.mark.parametrize(
    "text", ["9" * 400, "1," * 9 + "7" * 300, f'{{"psnr": -{"9" * 400}}}', "[" * 100_000, "", "{", "\udcff"]
)
def test_what_no_number_can_hold_and_no_stack_can_nest_is_no_json(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_json(text.encode("utf-8", "surrogateescape"))


def test_numbers_and_names_of_usual_length_are_json() -> None:
    value = {"seed": 2**128, "name": "7" * 250, "psnr": 27.25}
    assert parse_json(b'{"seed": %d, "name": "%s", "psnr": 27.25}' % (2**128, b"7" * 250)) == value


def test_pseudo_files_are_not_found_among_the_photos(tmp_path: Path) -> None:
    assert Path("/proc/self/status").stat().st_dev in pseudo_devices()
    assert tmp_path.stat().st_dev not in pseudo_devices()
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff")
    (tmp_path / "b.jpg").symlink_to(tmp_path / "a.jpg")
    for name, target in {"c": "/proc/kmsg", "d": "/dev/zero", "e": "/sys/kernel/notes", "f": "/proc/self/mem"}.items():
        (tmp_path / f"{name}.jpg").symlink_to(target)
    os.mkfifo(tmp_path / "g.jpg")
    assert [path.name for path in walk_files(tmp_path)] == ["a.jpg", "b.jpg"]


def test_the_device_of_a_mount_is_parsed() -> None:
    line = "36 35 98:5 / /mnt rw,noatime master:1 - ext3 /dev/root rw\n"
    broken = line.replace("98:5", "x:")
    assert [mount.device for mount in parse_mounts(line + broken)] == [os.makedev(98, 5), 0]


@pytest.mark.parametrize(
    "many", ["[" + "{}," * 5_000_001 + "0]", "[" + "[]," * 5_000_001 + "0]", f"[{'1,' * 10_000_001}1]"]
)
def test_more_values_than_memory_has_room_for_are_no_json(many: str) -> None:
    with pytest.raises(ValueError, match="it has more than 10,000,000 values"):
        parse_json(many.encode())


def test_a_configuration_with_a_line_of_dots_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text("a" + ".a" * 400_000 + " = 1\n")
    with pytest.raises(UsageError, match=r"is not valid TOML: it has lines with thousands of dots"):
        load_file(path)
