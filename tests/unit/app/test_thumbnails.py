"""Thumbnails of files that only claim to be photos."""

from pathlib import Path

import pytest

from splatpipe.pipeline.app.thumbnails import thumbnail


@pytest.mark.parametrize("target", ["/proc/kmsg", "/dev/zero", "/proc/self/mem"])
def test_a_link_to_a_file_of_the_kernels_is_not_waited_for(tmp_path: Path, target: str) -> None:
    (tmp_path / "a.jpg").symlink_to(target)
    assert thumbnail(tmp_path / "a.jpg", 480) is None
