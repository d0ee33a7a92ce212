"""A real node with PyODM, and what went wrong with NodeODM: one run of small photos for all tests."""

import http.client
import io
import json
import sqlite3
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from uuid import uuid4

import numpy as np
import pyodm
import pytest
from node_clients import call, form
from node_stress import CHEAPEST, HOST, SIZE, Node, check_gone, processes_of, small_photos
from numpy.typing import NDArray
from PIL import Image
from pyodm.exceptions import NodeConnectionError, NodeResponseError, TaskFailedError
from pyodm.types import TaskStatus
from timeouts import wait_until

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.photos.metadata.exif import read_exif

CONTROL = "gcp_list.txt"
FULL_WIDTH = 1200  # of the demo's photos, whose pixels the control file states


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """A node's process."""
    folder = tmp_path_factory.mktemp("node")
    node = Node(folder / "node", folder / "node.log")
    yield node
    node.stop()
    assert not processes_of(folder)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Twenty small photos, and the control points in them."""
    folder = tmp_path_factory.mktemp("photos")
    photos = dict(small_photos())
    crs, *lines = (capture_path().parent / CONTROL).read_text().splitlines()
    kept = [crs]
    for line in lines:
        words = line.split()
        words[3:5] = [f"{float(word) * SIZE[0] / FULL_WIDTH:.2f}" for word in words[3:5]]
        if words[5] in photos:
            kept.append(" ".join(words))
    for name, data in {**photos, CONTROL: "\n".join(kept).encode()}.items():
        (folder / name).write_bytes(data)
    return sorted(map(str, folder.iterdir()))


@pytest.fixture(scope="module")
def client(node: Node) -> pyodm.Node:
    return pyodm.Node(HOST, node.port)


@pytest.fixture(scope="module")
def finished(client: pyodm.Node, files: list[str]) -> pyodm.api.Task:
    """A task that ran to its end, watched as WebODM does."""
    task = client.create_task(files, {**CHEAPEST, "pc-ept": True}, "house")
    lines: list[str] = []

    def watch(_info: object) -> None:
        lines.extend(task.info(with_output=len(lines)).output)

    task.wait_for_completion(status_callback=watch, interval=0.5)
    lines.extend(task.info(with_output=len(lines)).output)
    assert lines == task.output() and "pc-ept" in lines[0] and any("georef" in line for line in lines)
    return task


def _upload(node: Node, files: list[str]) -> str:
    """Upload files in one request and commit them twice."""
    options = json.dumps([{"name": name, "value": value} for name, value in {**CHEAPEST, "pc-ept": True}.items()])
    uuid = str(call(node.port, "POST", "/task/new/init", *form(options=options))["uuid"])
    body = form([(Path(path).name, Path(path).read_bytes()) for path in files])
    for _ in range(2):
        assert call(node.port, "POST", f"/task/new/upload/{uuid}", *body) == {"success": True}
        assert call(node.port, "POST", f"/task/new/commit/{uuid}") == {"uuid": uuid}
    return uuid


def test_pyodm_reads_the_node(client: pyodm.Node) -> None:
    info = client.info()
    assert (info.version, info.engine, info.max_parallel_tasks) == ("2.2.4", "splatpipe", 1)
    assert {"preset", "dsm", "mesh-size", "boundary"} <= {option.name for option in client.options()}
    assert client.version_greater_or_equal_than("1.4.0")


def test_a_run_keeps_the_control_files_names_and_is_reported(finished: pyodm.api.Task) -> None:
    info = finished.info()
    assert (info.status, info.images_count, info.progress, info.name) == (TaskStatus.COMPLETED, 20, 100, "house")
    assert isinstance(info.processing_time, int) and info.processing_time > 0
    assert {"name": "mark-first", "value": True} in info.options
    assert any("control" in line and "point" in line for line in finished.output())


@pytest.mark.parametrize("chunk_megabytes", [10, 0.05])
def test_all_zip_is_downloaded_whole_and_by_ranges(
    finished: pyodm.api.Task, tmp_path: Path, chunk_megabytes: float
) -> None:
    path = finished.download_zip(str(tmp_path), parallel_chunks_size=chunk_megabytes)
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        names = archive.namelist()
    assert len({name.partition("/")[0] for name in names}) > 1, "clients unwrap a lone folder"
    assert {"report.html", "odm_report/report.pdf", "task_output.txt"} <= set(names)


def test_ranges_have_exactly_the_bytes_that_were_asked_for(node: Node, finished: pyodm.api.Task) -> None:
    def get(asset: str, method: str = "GET", **headers: str) -> tuple[http.client.HTTPResponse, bytes]:
        connection = http.client.HTTPConnection(HOST, node.port)
        connection.request(method, f"/task/{finished.uuid}/download/{asset}", headers=headers)
        response = connection.getresponse()
        data = response.read()
        connection.close()
        return response, data

    for asset in ("all.zip", "report.html"):
        response, whole = get(asset)
        assert response.status == 200 and response.headers["Accept-Ranges"] == "bytes"
        for asked, expected in (
            ("bytes=0-99", whole[:100]),
            ("bytes=100-", whole[100:]),
            ("bytes=-7", whole[-7:]),
            (f"bytes={len(whole) - 1}-{len(whole) + 50}", whole[-1:]),
        ):
            response, part = get(asset, Range=asked)
            assert (response.status, part) == (206, expected)
            assert int(response.headers["Content-Length"]) == len(expected)
        assert get(asset, Range=f"bytes={len(whole)}-")[0].status == 416
        response, nothing = get(asset, "HEAD")
        assert (int(response.headers["Content-Length"]), nothing) == (len(whole), b"")


def test_one_job_sent_three_times_is_run_once(node: Node, finished: pyodm.api.Task, files: list[str]) -> None:
    again = [_upload(node, files) for _ in range(2)]
    for uuid in again:
        done = wait_until(lambda uuid=uuid: call(node.port, "GET", f"/task/{uuid}/info")["status"] == {"code": 40})
        assert done
    assert len(list((node.folder / "jobs").iterdir())) == 1
    photos = [node.folder / "tasks" / uuid / "upload" / Path(files[0]).name for uuid in (finished.uuid, *again)]
    assert photos[0].samefile(photos[1]) and photos[0].samefile(photos[2])
    assert call(node.port, "POST", "/task/remove", f"uuid={again[0]}".encode()) == {"success": True}
    assert call(node.port, "POST", "/task/cancel", f"uuid={again[1]}".encode()) == {"success": True}
    assert finished.info().status == TaskStatus.COMPLETED


def test_a_wrong_uuid_is_a_response_error_everywhere(client: pyodm.Node) -> None:
    task = client.get_task("wrong-uuid")
    for ask in (task.info, task.output, task.restart, task.cancel, task.remove):
        with pytest.raises(NodeResponseError):
            ask()


def test_a_restart_echoes_its_options_and_reuses_results_and_tasks_end_as_clients_expect(
    node: Node, client: pyodm.Node, files: list[str], finished: pyodm.api.Task
) -> None:
    task = client.get_task(_upload(node, files))
    wait_until(lambda: task.info().status == TaskStatus.COMPLETED)
    assert task.cancel() and task.info().status == TaskStatus.CANCELED
    assert task.restart({**CHEAPEST, "mesh-size": 12345, "some-option": 1})
    assert {"name": "mesh-size", "value": 12345} in task.info().options
    assert not any(option["name"] == "some-option" for option in task.info().options)
    task.wait_for_completion(interval=0.5)
    output = "\n".join(task.output())
    assert "reused" in output and "some-option" in output
    assert task.cancel() and task.info().status == TaskStatus.CANCELED
    with pytest.raises(TaskFailedError):
        task.wait_for_completion()
    assert task.remove()
    with pytest.raises(NodeResponseError):
        task.remove()


ORIGIN = (13.5127, 47.8412)  # of the demo: longitude, latitude
LENS = f"""<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>{SIZE[0]}</width><height>{SIZE[1]}</height>
  <f>283.8</f><cx>0</cx><cy>0</cy><k1>-0.052</k1>
</calibration>
"""


def _square(east_deg: float, north_deg: float, half_deg: float) -> str:
    """GeoJSON of a square about a place, which is given from the demo's origin."""
    x, y = ORIGIN[0] + east_deg, ORIGIN[1] + north_deg
    ring = [(x + half_deg * a, y + half_deg * b) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    return json.dumps({"type": "Polygon", "coordinates": [ring]})


def _surveyed(folder: Path, files: list[str]) -> list[str]:
    """The files, and beside them positions, a lens, a boundary, and a mask over the left half of a photo."""
    lines = ["EPSG:4326"]
    for path in (Path(path) for path in files if path.endswith(".JPG")):
        with Image.open(path) as photo:
            gps = read_exif(photo).gps
        assert gps is not None
        lines.append(f"{path.name} {gps.longitude} {gps.latitude} {gps.altitude_m} 0 0 0 2.5 4.5")
    mask = Image.new("L", SIZE, 255)
    mask.paste(0, (0, 0, SIZE[0] // 2, SIZE[1]))
    mask.save(folder / "DJI_0001_mask.JPG")
    for name, text in (("geo.txt", "\n".join(lines)), ("lens.xml", LENS), ("boundary.geojson", _square(0, 0, 1e-4))):
        (folder / name).write_text(text)
    return [*files, *sorted(map(str, folder.iterdir()))]


def _part(node: Node, uuid: str, stage: str, name: str) -> Path:
    """A file of the newest artifact of a stage in a task's run."""
    job = json.loads((node.folder / "tasks" / uuid / "task.json").read_text())["job"]
    artifacts = (node.folder / "jobs" / job / "out" / "stages").glob(f"{stage}-*")
    return max(artifacts, key=lambda path: path.stat().st_mtime_ns) / name


def _keypoints_x(database: Path) -> dict[str, NDArray[np.float32]]:
    """The columns of each photo's keypoints, pixels."""
    with closing(sqlite3.connect(database)) as connection:
        rows = connection.execute("SELECT name, cols, data FROM keypoints JOIN images USING (image_id)").fetchall()
    return {name: np.frombuffer(data, np.float32).reshape(-1, columns)[:, 0] for name, columns, data in rows}


def test_masks_positions_lens_boundary_and_control_work_as_in_a_folder(
    node: Node, client: pyodm.Node, files: list[str], tmp_path: Path
) -> None:
    task = client.create_task(_surveyed(tmp_path, files), CHEAPEST, "surveyed")
    task.wait_for_completion(interval=0.5)
    part = partial(_part, node, task.uuid)
    masked = {photo["name"]: photo["mask"] for photo in read_json(part("ingest", "photos/photos.json"))["photos"]}
    assert len(masked) == 20 and [name for name, mask in masked.items() if mask] == ["DJI_0001.JPG"]
    columns = _keypoints_x(part("features", "database.db"))
    assert len(columns["DJI_0001.JPG"]) > 20 and columns["DJI_0001.JPG"].min() > 0.48 * SIZE[0]
    assert columns["DJI_0002.JPG"].min() < 0.25 * SIZE[0]
    positions = read_json(part("ingest", "positions.json"))["positions"]
    assert len(positions) == 20
    for each in positions:
        assert (each["source"], each["sigma_source"], each["sigma_horizontal_m"], each["sigma_vertical_m"]) == (
            *("file", "file"),
            *(2.5, 4.5),
        )
    (lens,) = read_json(part("ingest", "lenses.json"))["lenses"]
    assert (lens["source"], lens["params"][0]) == ("lens-file", 283.8)
    assert len(read_json(part("georef", "control.json"))["points"]) > 3
    before = _bounded(part, _square(0, 0, 1e-4))
    assert 0.0 < before["boundary_points"] < 1.0

    other = _square(0, 1e-4, 1e-4)  # as WebODM sends what was drawn on its map: it counts over the file
    assert task.restart({**CHEAPEST, "boundary": other})
    task.wait_for_completion(interval=0.5)
    after = _bounded(part, other)
    assert after["boundary_m2"] == pytest.approx(before["boundary_m2"], rel=0.01)
    assert after["boundary_points"] != before["boundary_points"] and "reused" in "\n".join(task.output())


def _bounded(part: Callable[[str, str], Path], geojson: str) -> dict[str, float]:
    """The summary of a run's georeference, whose boundary must be that of GeoJSON."""
    ((ring,),) = read_json(part("georef", "boundary.json"))["degrees"]
    (drawn,) = json.loads(geojson)["coordinates"]
    assert {tuple(np.round(place, 7)) for place in ring} == {tuple(np.round(place, 7)) for place in drawn}
    summary: dict[str, float] = read_json(part("georef", "manifest.json"))["summary"]
    return summary


def test_a_token_is_asked_for_by_pyodm(tmp_path: Path) -> None:
    token = "a-token-of-sixteen-letters"
    guarded = Node(tmp_path / "node", tmp_path / "log", "--token", token)
    try:
        assert pyodm.Node(HOST, guarded.port, token).info().version == "2.2.4"
        wrong = pyodm.Node(HOST, guarded.port, "wrong")
        with pytest.raises(NodeResponseError):
            wrong.info()
        task = wrong.get_task(str(uuid4()))
        for ask in (task.info, task.output, task.restart, task.cancel, task.remove):
            with pytest.raises(NodeResponseError):
                ask()
    finally:
        guarded.stop()


def test_no_poll_fails_while_the_node_is_killed_and_started_again(tmp_path: Path, files: list[str]) -> None:
    node = Node(tmp_path / "node", tmp_path / "log")
    uuid, over, codes = _upload(node, files), threading.Event(), []

    def poll() -> None:
        task = pyodm.Node(HOST, node.port).get_task(uuid)
        while not over.is_set():
            try:
                codes.append(task.info().status)
            except NodeConnectionError:  # alone retried by clients
                time.sleep(0.02)

    polling = threading.Thread(target=poll)
    polling.start()
    try:
        wait_until(lambda: TaskStatus.RUNNING in codes)
        had = node.kill()
        assert had, "the run has a process"
        check_gone(had)
        node.start()
        before = len(codes)
        wait_until(lambda: TaskStatus.RUNNING in codes[before:])
        began_s = time.monotonic()
        assert call(node.port, "POST", "/task/cancel", f"uuid={uuid}".encode()) == {"success": True}
        assert time.monotonic() - began_s < 30.0  # as long as clients wait
        wait_until(lambda: codes[-1] == TaskStatus.CANCELED)
    finally:
        over.set()
        polling.join()
        node.stop()
    assert not processes_of(tmp_path)


def test_the_end_is_told_to_a_webhook_and_a_zip_is_fetched_from_an_allowed_host(
    tmp_path: Path, files: list[str], told: Callable[[bytes], tuple[int, list[dict[str, object]]]]
) -> None:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as target:
        for path in files:
            target.write(path, f"flight/{Path(path).name}")
    port, hooks = told(archive.getvalue())
    node = Node(tmp_path / "node", tmp_path / "log", "--allow-host", f"{HOST}:{port}")
    try:
        fields = {"zipurl": f"http://{HOST}:{port}/photos.zip", "webhook": f"http://{HOST}:{port}/end"}
        uuid = call(node.port, "POST", "/task/new", *form(**fields))["uuid"]
        wait_until(lambda: call(node.port, "GET", f"/task/{uuid}/info")["imagesCount"] == 20)
        assert call(node.port, "POST", "/task/cancel", f"uuid={uuid}".encode()) == {"success": True}
        end = wait_until(lambda: hooks and hooks[0])
        assert end["uuid"] == uuid and end["status"] == {"code": 50} and len(end["images"]) == 20  # type: ignore[arg-type]
    finally:
        node.stop()


@pytest.fixture
def told() -> Iterator[Callable[[bytes], tuple[int, list[dict[str, object]]]]]:
    """Yield a function that starts a server of one file, which keeps what is posted to it."""
    from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

    servers = []

    def serve(file: bytes) -> tuple[int, list[dict[str, object]]]:
        posted: list[dict[str, object]] = []

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self._answer(file)

            def do_POST(self) -> None:
                posted.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
                self._answer(b"")

            def _answer(self, data: bytes) -> None:
                self.send_response(200)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: object) -> None:
                pass

        server = ThreadingHTTPServer((HOST, 0), Handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return server.server_port, posted

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()
