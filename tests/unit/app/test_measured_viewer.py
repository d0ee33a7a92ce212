"""viewer.html and the report with measurements: the same bits for the same state, and only valid measurements."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from splatpipe.pipeline.app import measured_viewer, measurements
from splatpipe.pipeline.app.measured_viewer import SHOWN, update_viewer
from splatpipe.pipeline.app.measurements import MEASURED, outdated, read_measurements, write_measurements
from splatpipe.pipeline.app.report.chapters.surfaces import measures
from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.runs.store import Artifact, StageInputs, Store, open_store
from splatpipe.pipeline.engine.stage import Stage
from splatpipe.pipeline.web.measured_page import BEGIN, END, SURFACES, SURFACES_BEGIN, with_measurements
from splatpipe.stages.line import DSM, EXPORT, GEOREF, LINE, PUBLISH

PLAIN = b"<title>House</title>" + BEGIN + b"null" + END + SURFACES_BEGIN + b"null" + END + b"<script>draw()</script>"
HOSTILE = "</script><script>alert(1)</script>\u202e\u2028"
TRACE = {
    "distance": [0.0, 1.0, 2.0, 3.0],
    **{name: [0.0, 1.0, None, 3.0] for name in ("height", "sigma", "x", "y", "z")},
    "point_distance": [],
    "point_height": [],
}
SECTION = {"name": "section-1", "length_m": 3.0, "share_with_height": 0.75, "height_sigma_m": 0.01}
SECTION |= {"csv": "section-1.csv", "trace": TRACE}
AMOUNTS = {f"{kind}_{figure}": 2.5 for kind in ("cut", "fill", "net") for figure in ("m3", "sigma_m3")}
VOLUME = {"polygon": 1, "name": HOSTILE, "area_m2": 9.0, "share_without_height": 0.0, **AMOUNTS}
VOLUME |= {"base": {"kind": "rim", "height_m": 1.0}, "trace": [{"x": [0.0, 1.0], "y": [0.0, 1.0], "z": [0.0, 1.0]}]}


def make(store: Store, stage: Stage, reads: dict[str, str], content: str = "") -> Artifact:
    """An artifact whose parts are small files, delivered."""
    inputs = StageInputs(stage.name, stage.version, {"content": content}, {}, reads)
    partial = store.begin(stage, inputs.key)
    for path in stage.parts.values():
        file = partial / path if "." in path else partial / path / f"{stage.name}-{path}.txt"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content + stage.name)
    if stage is EXPORT:
        (partial / "viewer/viewer.html").write_bytes(PLAIN)
    if stage is PUBLISH:
        (partial / "viewer" / SURFACES).write_text(content)
    artifact = store.commit(stage, inputs, partial, {}, {})
    store.deliver(artifact, stage)
    return artifact


def digests(artifact: Artifact, *names: str) -> dict[str, str]:
    return {name: artifact.parts[name].digest for name in names}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An OUT with a viewer and a surface model in one frame, on which a section and a volume were measured."""
    store = open_store(tmp_path / "out", create=True)
    frame = digests(make(store, GEOREF, {}), "georef.frame")
    make(store, EXPORT, frame)
    surface = make(store, DSM, frame)
    found = (surface.parts["dsm.files"].digest, frame["georef.frame"])
    (store.out / "sections").mkdir()
    (store.out / "sections/section-1.csv").write_text("distance_m\n")
    (store.out / "volumes.json").write_text("{}")
    write_measurements(store.out, "sections", found, [SECTION])
    write_measurements(store.out, "volumes", found, [VOLUME])
    return store.out


def embedded(out: Path) -> Any:
    """Return the data embedded in the page."""
    return json.loads((out / "viewer.html").read_bytes().partition(BEGIN)[2].partition(END)[0])


def artifact_page(out: Path) -> Path:
    (path,) = (out / "stages").glob("export-*/viewer/viewer.html")
    return path


def test_measurements_are_in_the_page_and_not_in_the_artifact(out: Path) -> None:
    assert update_viewer(out) == ""
    (section,), (volume,) = embedded(out)["sections"], embedded(out)["volumes"]
    assert (section["name"], section["length_m"], section["trace"]) == ("Section 1", 3.0, TRACE)
    assert (volume["net_m3"], volume["base"]) == (2.5, "rim")
    assert artifact_page(out).read_bytes() == PLAIN
    assert (out / "viewer.html").read_bytes().endswith(END + b"<script>draw()</script>")


def test_a_hostile_name_stays_text(out: Path) -> None:
    update_viewer(out)
    page = (out / "viewer.html").read_text(encoding="utf-8")
    assert page.count("</script>") == PLAIN.decode().count("</script>")
    assert embedded(out)["volumes"][0]["name"] == "</script><script>alert(1)</script>\ufffd\ufffd"


def test_the_page_is_kept_and_the_store_accepts_it_as_its_copy(out: Path) -> None:
    update_viewer(out)
    page = out / "viewer.html"
    content, before = page.read_bytes(), page.stat()
    update_viewer(out)
    store = Store(out)
    (artifact,) = store.artifacts("export")
    store.deliver(artifact, EXPORT)
    assert (page.stat().st_ino, page.stat().st_mtime_ns) == (before.st_ino, artifact_page(out).stat().st_mtime_ns)
    newer = make(store, EXPORT, artifact.manifest["inputs"]["reads"], "newer ")
    assert embedded(out) is None
    update_viewer(out)
    assert page.read_bytes() == content
    parts = open_run_folder(out, LINE).lineage(EXPORT)
    assert parts["export.viewer"].path.parent == newer.folder


def test_the_page_for_web_hosts_shows_the_same(out: Path) -> None:
    (out / "web").mkdir()
    (out / "web/index.html").write_bytes(PLAIN)
    assert update_viewer(out) == ""
    assert (out / "web/index.html").read_bytes() == (out / "viewer.html").read_bytes() != PLAIN
    (out / "web/index.html").write_bytes(b"<title>of an earlier version</title>")
    (out / "viewer.html").write_bytes(PLAIN)
    assert "web/index.html was written by an earlier version" in update_viewer(out)
    assert embedded(out)["sections"]


def publish(out: Path, frame: dict[str, str], surfaces: Any) -> None:
    make(Store(out), PUBLISH, frame, surfaces if isinstance(surfaces, str) else json.dumps(surfaces))


def frame_of(out: Path) -> dict[str, str]:
    (artifact,) = Store(out).artifacts("georef")
    return digests(artifact, "georef.frame")


def surfaces_in(page: Path) -> Any:
    return json.loads(page.read_bytes().partition(SURFACES_BEGIN)[2].partition(END)[0])


def test_mesh_and_points_are_in_the_page_and_beside_the_sites_page(out: Path) -> None:
    (out / "web").mkdir()
    (out / "web/index.html").write_bytes(PLAIN)
    surfaces = {"points": {"xyz": "AAAA"}, "mesh": {"texture": HOSTILE}, "other": 1}
    publish(out, frame_of(out), surfaces)
    assert update_viewer(out) == ""
    shown = {"mesh": surfaces["mesh"], "points": surfaces["points"]}
    assert surfaces_in(out / "viewer.html") == {"layers": ["mesh", "points"], **shown}
    assert (out / "viewer.html").read_text().count("</script>") == PLAIN.decode().count("</script>")
    site = surfaces_in(out / "web/index.html")
    assert site["layers"] == ["mesh", "points"] and site["address"].startswith("surfaces.json?v=")
    assert json.loads((out / "web/surfaces.json").read_text()) == shown
    assert embedded(out)["sections"]
    content, stamp = (out / "viewer.html").read_bytes(), (out / "viewer.html").stat()
    update_viewer(out)
    assert (out / "viewer.html").stat() == stamp and (out / "viewer.html").read_bytes() == content


def test_pages_that_show_everything_are_not_read_again(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(out, frame_of(out), {"mesh": {}})
    assert update_viewer(out) == ""
    read = []
    monkeypatch.setattr(measured_viewer, "_update", lambda *page: read.append(page))
    assert update_viewer(out) == "" and not read
    (out / SHOWN).write_text("[" * 100_000)
    update_viewer(out)
    assert len(read) == 1
    (out / "viewer.html").write_bytes(PLAIN)
    update_viewer(out)
    assert len(read) == 2
    (out / "volumes.json").unlink()
    update_viewer(out)
    assert len(read) == 3


@pytest.mark.parametrize("surfaces", ["", "no JSON", "[]", "{}"])
def test_without_mesh_and_points_the_page_has_none(out: Path, surfaces: str) -> None:
    publish(out, frame_of(out), surfaces)
    (out / "web").mkdir()
    (out / "web/index.html").write_bytes(PLAIN)
    (out / "web/surfaces.json").write_text("of an earlier mesh")
    assert update_viewer(out) == ""
    assert surfaces_in(out / "viewer.html") is None and not (out / "web/surfaces.json").exists()


def test_a_mesh_in_another_frame_is_not_shown(out: Path) -> None:
    publish(out, digests(make(Store(out), GEOREF, {}, "moved "), "georef.frame"), {"mesh": {}})
    update_viewer(out)
    assert surfaces_in(out / "viewer.html") is None


def test_pages_with_different_contents_differ_in_size() -> None:
    one, other = (with_measurements(PLAIN, {"sections": [{"name": name}]}) for name in ("A", "B"))
    assert len(one) != len(other)
    assert with_measurements(one, {"sections": [{"name": "B"}]}) == other
    assert with_measurements(one, None) == PLAIN


def test_measurements_on_another_surface_model_are_not_shown(out: Path) -> None:
    update_viewer(out)
    store = Store(out)
    (artifact,) = store.artifacts("dsm")
    newer = make(store, DSM, artifact.manifest["inputs"]["reads"], "newer ")
    update_viewer(out)
    assert (out / "viewer.html").read_bytes() == PLAIN
    assert outdated(out, newer.parts["dsm.files"].digest)
    assert not outdated(out, artifact.parts["dsm.files"].digest)


def test_a_page_in_another_frame_shows_nothing(out: Path) -> None:
    make(Store(out), EXPORT, digests(make(Store(out), GEOREF, {}, "moved "), "georef.frame"))
    update_viewer(out)
    assert embedded(out) is None


def test_removed_measurements_are_not_shown(out: Path) -> None:
    (out / "volumes.json").unlink()
    update_viewer(out)
    assert [len(embedded(out)[kind]) for kind in ("sections", "volumes")] == [1, 0]
    (out / "sections/section-1.csv").unlink()
    update_viewer(out)
    assert (out / "viewer.html").read_bytes() == PLAIN


def test_a_page_of_an_earlier_version_is_left_alone(out: Path) -> None:
    (out / "viewer.html").write_bytes(b"<title>House</title>")
    assert "earlier version" in update_viewer(out)
    assert (out / "viewer.html").read_bytes() == b"<title>House</title>"
    (out / "viewer.html").unlink()
    assert update_viewer(out) == ""
    assert not (out / "viewer.html").exists()


def test_the_report_rounds_figures_to_their_uncertainty(out: Path) -> None:
    surface = next(iter(Store(out).artifacts("dsm"))).parts["dsm.files"].digest
    amounts = {"cut_m3": 12_345.678, "cut_sigma_m3": 45.6, "fill_m3": 0.123456, "fill_sigma_m3": 0.0456}
    amounts |= {"net_m3": -3.0, "net_sigma_m3": 0.0}
    write_measurements(out, "volumes", (surface, "any"), [{**VOLUME, **amounts}])
    embedded = measures(read_report_inputs(out))
    (volume,), (section,) = embedded["volumes"], embedded["sections"]
    assert volume["cut"] == "12,346 ± 46 m³"
    assert volume["fill"] == "0.123 ± 0.046 m³"
    assert volume["net"] == "-3.000 ± 0.000 m³"
    assert volume["base"] == "rim, 1.00 m"
    assert (section["length"], section["known"], section["picture"]) == ("3.00 m", "75 %", None)
    assert section["files"] == [("CSV", "sections/section-1.csv")]
    assert not embedded["outdated"]
    make(Store(out), DSM, {}, "newer ")
    embedded = measures(read_report_inputs(out))
    assert (embedded["sections"], embedded["volumes"], embedded["outdated"]) == ([], [], True)


def test_a_damaged_ground_hides_its_section_only(out: Path) -> None:
    value = json.loads((out / MEASURED).read_text())
    value["sections"]["items"][0]["trace"]["ground"] = [1.0, 1.0, None, 1.0]
    (out / MEASURED).write_text(json.dumps(value))
    update_viewer(out)
    assert embedded(out)["sections"][0]["trace"]["ground"] == [1.0, 1.0, None, 1.0]
    value["sections"]["items"][0]["trace"]["ground"] = [1.0, "2"]
    (out / MEASURED).write_text(json.dumps(value))
    update_viewer(out)
    assert not embedded(out)["sections"] and embedded(out)["volumes"]


def changed(item: dict[str, Any], **members: Any) -> dict[str, Any]:
    return {**item, **members}


@pytest.mark.parametrize(
    "items",
    [
        None,
        7,
        [7],
        [{}],
        [changed(SECTION, name=7)],
        [changed(SECTION, length_m="3")],
        [changed(SECTION, trace=None)],
        [changed(SECTION, trace={**TRACE, "z": [1.0]})],
        [changed(SECTION, trace={**TRACE, "x": ["1", 2.0, None, 3.0]})],
        [changed(SECTION, trace={**TRACE, "x": [float("nan"), 2.0, None, 3.0]})],
        [changed(SECTION, length_m=float("inf"))],
        [changed(SECTION, length_m=10**400)],
        [changed(SECTION, trace={**TRACE, "x": [1e300, 2.0, None, 3.0]})],
        [changed(SECTION, trace={**TRACE, "distance": [0.0, 0.0, 0.0, 0.0]})],
        [changed(SECTION, trace={**TRACE, "distance": [0.0, 1.0, 2.0, None]})],
        [changed(SECTION, trace={**TRACE, "height": [None] * 4})],
        [changed(SECTION, csv="../../nothing")],
    ],
)
def test_damaged_sections_are_not_shown(out: Path, items: Any) -> None:
    value = json.loads((out / MEASURED).read_text())
    value["sections"]["items"] = items
    value["volumes"]["items"][0]["trace"] = [{"x": [], "y": []}]
    (out / MEASURED).write_text(json.dumps(value))
    update_viewer(out)
    assert (out / "viewer.html").read_bytes() == PLAIN


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "\x00", "[" * 100_000, '{"format": 99}', '{"format": 1, "sections": []}']
)
def test_an_invalid_record_shows_nothing(out: Path, text: str) -> None:
    (out / MEASURED).write_text(text)
    assert update_viewer(out) == ""
    assert (out / "viewer.html").read_bytes() == PLAIN
    assert not outdated(out, "other")


def test_a_huge_record_is_not_read(out: Path) -> None:
    os.truncate(out / MEASURED, measurements.MAX_FILE_BYTES + 1)
    (surface,) = Store(out).artifacts("dsm")
    assert read_measurements(out, "volumes", surface.parts["dsm.files"].digest) == []


@pytest.mark.parametrize("page", [b"<title>House</title>", PLAIN.replace(END, b""), BEGIN + b"null", b""])
def test_a_page_without_a_whole_place_is_refused(page: bytes) -> None:
    with pytest.raises(ValueError, match="no place for"):
        with_measurements(page, {"sections": [], "volumes": []})
