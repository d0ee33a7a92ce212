"""Downloads of a completed task by the node: whole, and by ranges as PyODM asks for them."""

import io
import zipfile
from pathlib import Path

import pytest
from asgi import ask

from splatpipe.pipeline.app.node.api.routes import Api, make_app
from splatpipe.pipeline.app.node.assets.archive import Entry, write_archive
from splatpipe.pipeline.app.node.tasks.node import NewTask, Node
from splatpipe.pipeline.app.node.tasks.settings import Settings

RASTER = bytes(range(256)) * 3000  # more than an answer sends at a time
ENTRIES = [Entry("odm_dem/dsm.tif", RASTER), Entry("3d_tiles/model/tileset.json", b"{}"), Entry("report.html", b"<p>")]


class Completed:
    """A task that is completed, and the application that serves it."""

    def __init__(self, folder: Path) -> None:
        node = Node(Settings(folder, least_free_bytes=0))
        task = node.create(NewTask())
        for name in ("a.jpg", "b.jpg"):
            part = node.begin_file(task.uuid, name)
            assert part is not None
            part.write(name.encode())
            part.finish()
        task = node.commit(task.uuid)
        assets = node.jobs.assets(task.job)
        assets.mkdir(parents=True)
        write_archive(assets / "all.zip", ENTRIES)
        node.tasks.change(task.uuid, state="completed", ended_ms=1000)
        self.whole, self.app = (assets / "all.zip").read_bytes(), make_app(Api(node), [])
        self.address = f"/task/{task.uuid}/download/"


@pytest.fixture
def task(tmp_path: Path) -> Completed:
    return Completed(tmp_path)


def test_assets_are_sent_whole_with_their_length_and_type(task: Completed) -> None:
    for name, content, kind in (("all.zip", task.whole, "application/zip"), ("dsm.tif", RASTER, "image/tiff")):
        answer = ask(task.app, task.address + name)
        assert answer.status == 200 and answer.body == content
        assert answer.headers["content-length"] == str(len(content)) and answer.headers["content-type"] == kind
        assert answer.headers["accept-ranges"] == "bytes" and name in answer.headers["content-disposition"]
    model = ask(task.app, task.address + "3d_tiles_model.zip")
    with zipfile.ZipFile(io.BytesIO(model.body)) as archive:
        assert archive.namelist() == ["tileset.json"] and archive.read("tileset.json") == b"{}"


def test_ranges_are_exact(task: Completed) -> None:
    size = len(RASTER)
    for first, last in ((0, 9), (100, 600_000), (size - 5, size - 1)):
        answer = ask(task.app, task.address + "dsm.tif", headers=[("Range", f"bytes={first}-{last}")])
        assert answer.status == 206 and answer.body == RASTER[first : last + 1]
        assert answer.headers["content-range"] == f"bytes {first}-{last}/{size}"
    assert ask(task.app, task.address + "dsm.tif", headers=[("Range", f"bytes={size}-")]).status == 416


def test_an_asset_resumes_only_the_same_file(task: Completed) -> None:
    tags = {ask(task.app, task.address + name, method="HEAD").headers["etag"] for name in ("all.zip", "dsm.tif")}
    assert len(tags) == 2
    answer = ask(task.app, task.address + "dsm.tif", headers=[("Range", "bytes=5-9"), ("If-Range", '"another"')])
    assert answer.status == 200 and answer.body == RASTER


def test_what_was_not_made_is_no_asset(task: Completed) -> None:
    for name in ("dtm.tif", "textured_model.zip", "tileset.json", "task.json"):
        assert ask(task.app, task.address + name).json == {"error": "Invalid asset"}
