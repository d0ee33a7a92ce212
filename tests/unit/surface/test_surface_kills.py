"""A killed writer of a surface product leaves nothing under the product's name, and the next one cleans up."""

from pathlib import Path

import pytest

from splatpipe.pipeline.engine.durable import whole_file


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a[1].tif"  # a name that is no pattern
    path.write_text("old")
    (tmp_path / ".a[1].tif.999999.0.new").mkdir()
    with pytest.raises(OSError, match="No space"), whole_file(path) as aside:
        aside.write_text("half")
        (aside.parent / "overviews.tmp").write_text("of a library")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with whole_file(path) as aside:
        aside.write_text("new")
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileNotFoundError), whole_file(path):
        pass  # nothing was written: that is no file
    assert path.read_text() == "new"
