"""`splatpipe surface`: products by name, sections and volumes of a finished run."""

import json
from pathlib import Path
from typing import Any

import pytest
import rasterio
from command import plain_reports, splatpipe
from finished_run import write_apart

from splatpipe.pipeline.app.surfaces import MeasurementRequest, check_possible, measurement_lines
from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, UsageError
from splatpipe.pipeline.engine.quantities import parse_length
from splatpipe.pipeline.surface.facades.facades import parse_lines
from splatpipe.pipeline.surface.shapes import tsdf
from splatpipe.stages.products import options_for


def surface(out: Path, *arguments: str) -> tuple[int, dict[str, Any]]:
    done = splatpipe("surface", out, *arguments, "--json")
    return done.returncode, json.loads(done.stdout)


def polygon(west: float, south: float, east: float, north: float) -> dict[str, Any]:
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    crs = {"type": "name", "properties": {"name": "EPSG:32633"}}
    feature = {"type": "Feature", "properties": {"name": "Heap <A>"}}
    return {**feature, "crs": crs, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def test_a_finished_run_is_cut_and_measured(demo_copy: Path, tmp_path: Path) -> None:
    out = demo_copy
    with rasterio.open(out / "dsm.tif") as raster:
        west, south, east, north = raster.bounds
    x, y = (west + east) / 2, (south + north) / 2
    (tmp_path / "heap.geojson").write_text(json.dumps(polygon(x - 12.0, y - 12.0, x + 12.0, y + 12.0)))
    line = f"{x - 15.0},{y},{x + 15.0},{y}"
    code, output = surface(
        out, "--section", line, "--section", f"{x},{y},{x},{y + 5.0}", "--volume", str(tmp_path / "heap.geojson")
    )
    assert code == 0
    assert all(stage["state"] == "reused" for stage in output["stages"])
    section, _ = output["surface"]["sections"]
    with (out / "sections" / section["csv"]).open(encoding="utf-8") as file:
        assert file.readline().strip().endswith("ground_m,over_ground_m")
    assert section["length_m"] == pytest.approx(30.0, abs=0.05)
    for kind in ("csv", "dxf", "picture"):
        assert (out / "sections" / section[kind]).stat().st_size > 500
    report, viewer = ((out / name).read_text(encoding="utf-8") for name in ("report.html", "viewer.html"))
    for text in ("30.0", 'alt="Section 2"', "Heap &lt;A&gt;", "Volumes"):
        assert text in report
    for text in ('"name": "Section 2"', '"name": "Heap \\u003cA>"'):
        assert text in viewer
    assert all('"Section 2"' not in path.read_text() for path in (out / "stages").glob("export-*/viewer/viewer.html"))
    (volume,) = json.loads((out / "volumes.json").read_text())["volumes"]
    assert volume["area_m2"] == pytest.approx(576.0, rel=0.01)
    assert 300.0 < volume["cut_m3"] < 2000.0  # the house of 13 by 9 metres, 8 high, on a lawn
    assert volume["cut_sigma_m3"] < 0.1 * volume["cut_m3"]
    with plain_reports():
        assert surface(out, "--volume", str(tmp_path / "heap.geojson"), "--base", "ground")[0] == 0
    (over_ground,) = json.loads((out / "volumes.json").read_text())["volumes"]
    assert (over_ground["base"], over_ground["model"]) == ({"kind": "ground"}, "dsm")
    assert over_ground["cut_m3"] == pytest.approx(volume["cut_m3"], rel=0.25)  # the plot is level
    assert over_ground["fill_m3"] < 1.0

    def files() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in [*(out / "sections").iterdir(), out / "viewer.html"]}

    before = files()
    with plain_reports():  # the page was looked at
        code, output = surface(out, "--section", line, "--section", "0,0,10,10")
    assert code == 1
    assert "does not cross" in output["error"]["message"]
    assert files() == before  # nothing is half done
    (out / "sections/notes.txt").write_text("mine")
    with plain_reports():
        assert surface(out, "--section", f"{x},{y},{x},{y + 5.0}")[0] == 0
    after = files()
    assert "section-2.csv" not in after
    assert after.keys() > {"section-1.csv", "section-1.png", "notes.txt"}
    viewer = after["viewer.html"].decode()
    assert "Section 2" not in viewer
    assert "Heap" in viewer  # volumes stay


def test_the_report_shows_heights_and_the_orthophoto(demo_run: Path) -> None:
    page = (demo_run / "report.html").read_text(encoding="utf-8")
    for text in (
        'id="surfaces"',
        'alt="orthophoto"',
        'alt="surface model"',
        'alt="terrain model"',
        "expected deviation of a height",
    ):
        assert text in page


def test_products_request_their_inputs_and_keep_the_rest() -> None:
    assert options_for(None, None, None).keys() == {"depths", "dsm", "dtm", "ortho"}
    table = options_for("cloud, facades", 0.02, "both")
    assert table["cloud"] == {"enabled": True, "spacing_m": 0.02}
    assert table["facades"] == {"enabled": True, "gsd_m": 0.02}
    assert table["dsm"] == {"enabled": True}
    assert table["dtm"] == {"enabled": True}  # without the ground, points have no classes
    assert table["splat_depths"] == {"enabled": True}
    assert "ortho" not in table
    assert options_for("dsm", 0.02, "splat")["depths"] == {"enabled": False}


@pytest.mark.parametrize("products", ["", "orthos", "ortho;dsm", "dsm,../x"])
def test_other_products_are_refused(products: str) -> None:
    with pytest.raises(UsageError):
        options_for(products, None, None)


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,4,5", "1,2,3,nan", "1,2,3,inf", "a,b,c,d", "1 2 3 4", "1," * 999])
def test_other_sections_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        MeasurementRequest.of([text], None, "rim")
    if text:
        with pytest.raises(UsageError):
            parse_lines(text)


def test_a_mesh_without_its_library_is_refused_and_the_request_not_stored(
    demo_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(tsdf.importlib, "import_module", missing)
    before = (demo_run / "config.toml").read_bytes()
    check_possible(demo_run, options_for("facades,cloud", None, None))
    check_possible(demo_run, options_for("mesh", None, None), {"mesh": {"enabled": False}})
    with pytest.raises(MachineError, match="open3d"):
        check_possible(demo_run, options_for("mesh", None, None))
    assert (demo_run / "config.toml").read_bytes() == before


def test_a_run_without_scale_is_refused_at_once_unless_it_is_georeferenced_again(
    demo_run: Path, demo_copy: Path
) -> None:
    out = demo_copy
    for path in (out / "stages").glob("georef-*/frame.json"):
        text = path.read_text()
        placed = {**json.loads(text), "kind": "arbitrary", "origin": None}
        # Padded to its former size, or the artifact would count as damaged.
        write_apart(path, json.dumps(placed).ljust(len(text)))
    check_possible(demo_run, options_for("ortho", None, None))
    check_possible(out, options_for("ortho", None, None), {"georef": {"max_position_error_m": 5.0}})
    with pytest.raises(SplatpipeError, match="no metric scale"):
        check_possible(out, options_for("ortho", None, None))


def test_measurements_are_printed_line_by_line() -> None:
    section = {"name": "Section 1", "length_m": 41.767, "share_with_height": 0.98, "height_sigma_m": 0.0171}
    volume = {"polygon": 2, "name": "", "cut_m3": 23.834, "cut_sigma_m3": 0.9, "fill_m3": 0.0, "fill_sigma_m3": 0.01}
    facts = {"sections": [{**section, "dxf": "section-1.dxf"}], "volumes": [volume]}
    first, second = measurement_lines(Path("out"), facts)
    assert first == "Section 1: 41.77 m, 98% with heights, accurate to 1.7 cm: out/sections/section-1.dxf"
    assert second == "Polygon 2: cut 23.83 ± 0.90 m³, fill 0.00 ± 0.01 m³: out/volumes.json"
    assert measurement_lines(Path("out"), {}) == []


def test_a_section_without_length_is_refused() -> None:
    with pytest.raises(UsageError, match="no length"):
        MeasurementRequest.of(["1,2,1,2.0"], None, "rim")


def test_polygons_outside_the_surface_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no file"):
        MeasurementRequest.of([], tmp_path / "heap.geojson", "rim")


def test_lines_are_parsed_completely_or_refused() -> None:
    assert len(parse_lines(";".join(["388700,5299700,388710.5,5299710.5"] * 200))) == 200
    with pytest.raises(UsageError, match="too many"):
        parse_lines(";".join(["388700,5299700,388710.5,5299710.5"] * 400))


@pytest.mark.parametrize("base", ["", "top", "1e999", "nan"])
def test_other_bases_are_refused(base: str) -> None:
    with pytest.raises(UsageError):
        MeasurementRequest.of([], None, base)
    assert MeasurementRequest.of([], None, "512.5").base == 512.5


def test_the_ground_is_made_where_it_is_needed(tmp_path: Path) -> None:
    polygons = tmp_path / "heap.geojson"
    polygons.write_text("{}")
    asked = {
        (base, model): MeasurementRequest.of([], polygons, base, model).products
        for base, model in (("rim", "dsm"), ("ground", "dsm"), ("rim", "dtm"))
    }
    assert list(asked.values()) == ["dsm", "dtm", "dtm"]
    assert MeasurementRequest.of(["1,2,3,4"], None, "ground").products == "dsm"
    for base, model in (("ground", "dtm"), ("rim", "chm")):
        with pytest.raises(UsageError):
            MeasurementRequest.of([], polygons, base, model)


@pytest.mark.parametrize(("text", "metres"), [("2cm", 0.02), ("25mm", 0.025), ("0.1m", 0.1), (" 5 cm ", 0.05)])
def test_lengths_have_units(text: str, metres: float) -> None:
    assert parse_length(text, "--gsd") == metres


@pytest.mark.parametrize("text", ["", "2", "-2cm", "0cm", "2 inches", "1e3m", "9" * 30 + "m"])
def test_other_lengths_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--gsd"):
        parse_length(text, "--gsd")
