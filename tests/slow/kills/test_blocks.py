"""Blocks trained in any order, by processes of which one is killed."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import block_line
import building_site
import pytest
from block_scene import OPTIONS, SHARDS, prepared
from repository import LINES

LINE = LINES / "block_line.py"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the inputs of `blocks`: a dataset of 30 photos, its split, the initial Gaussians."""
    folder = tmp_path_factory.mktemp("scene")
    return prepared(building_site.write_dataset(folder / "dataset"), 8)


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An OUT that one process made from beginning to end."""
    out = tmp_path_factory.mktemp("undisturbed")
    assert block_line.make(scene, out, OPTIONS).ran == ["blocks", *SHARDS, "train"]
    return out


def digests(out: Path) -> dict[str, str]:
    """Return digests of everything that `blocks`, each shard and `train` wrote."""
    files = [path for path in out.glob("stages/*-*/**/*") if path.is_file() and path.name != "manifest.json"]
    return {
        path.relative_to(out / "stages").as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


def alone(scene: Path, out: Path, shard: str, threads: int) -> subprocess.Popen[str]:
    words = [sys.executable, str(LINE), scene, out, shard, json.dumps(OPTIONS), threads]
    return subprocess.Popen(
        list(map(str, words)), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )


def test_any_order_any_threads_and_a_kill_in_a_block_give_the_same_bits(
    scene: Path, undisturbed: Path, tmp_path: Path
) -> None:
    """Blocks of two processes, the last one first, each killed with -9 during training and restarted on two threads."""
    block_line.make(scene, tmp_path, {**OPTIONS, "blocks": {"least": 0}}, until="blocks")
    block_line.make(scene, tmp_path, OPTIONS, until="blocks")
    for shard in reversed(SHARDS):
        with alone(scene, tmp_path, shard, 1) as process:
            assert process.stdout is not None and process.stdout.readline().startswith(shard)
            os.killpg(process.pid, signal.SIGKILL)
        assert not list(tmp_path.glob(f"stages/{shard}-*"))
    assert block_line.make(scene, tmp_path, OPTIONS, "train.3", threads=2).ran == ["train.3"]
    assert block_line.make(scene, tmp_path, OPTIONS, threads=2).ran == ["train.1", "train.2", "train"]
    found, wanted = digests(tmp_path), digests(undisturbed)
    assert {name: found[name] for name in wanted} == wanted
