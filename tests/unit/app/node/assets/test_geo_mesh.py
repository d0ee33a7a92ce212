"""The mesh in the CRS: z up and at its place, read by trimesh; what is not one of ours is refused."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import pytest
import trimesh
from glb_parts import packed, parts
from hills import placed
from made_mesh import made_site

from splatpipe.pipeline.app.node.assets import geo_glb, geo_obj
from splatpipe.pipeline.app.node.assets.earth import Earth, open_earth
from splatpipe.pipeline.app.node.assets.geo_glb import UnusableMesh, plan_centre, write_geo_glb
from splatpipe.pipeline.app.node.assets.geo_obj import write_geo_obj
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.texture.glb_mesh import write_glb
from splatpipe.pipeline.surface.texture.obj_mesh import write_obj
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

PENNSYLVANIA = Origin(40.3, -75.1, 60.0)
FEET = 12.0 / 39.37  # metres in a US survey foot
FRAMES = {
    "metres": placed("EPSG:25832", "ellipsoidal"),
    "feet": placed("EPSG:6565", "unknown", PENNSYLVANIA),
    "nowhere": Frame("arbitrary", Similarity.identity(), metres=True),
}


@dataclass(frozen=True)
class Files:
    """A mesh in local metres, and its files."""

    made: TexturedMesh
    glb: Path
    obj: Path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("mesh")
    made = made_site(folder, cells=50, page_px=256, side_m=60.0)
    with (folder / "mesh.glb").open("wb") as file:
        write_glb(file, made)
    with (folder / "mesh.obj").open("wb") as file:
        write_obj(file, made, "mesh.mtl", ["a comment"])
    return Files(made, folder / "mesh.glb", folder / "mesh.obj")


def opened(name: str) -> Earth:
    earth = open_earth(FRAMES[name])
    assert earth is not None
    return earth


def independent(name: str, local: np.ndarray) -> np.ndarray:
    """Place local metres by PROJ's own topocentric conversion."""
    origin = FRAMES[name].origin
    if origin is None:
        return local
    step = f"+proj=topocentric +lat_0={origin.latitude} +lon_0={origin.longitude} +h_0={origin.height_m}"
    pipeline = f"+proj=pipeline +step +inv {step} +ellps=WGS84 +step +inv +proj=cart +ellps=WGS84"
    degrees = pyproj.Transformer.from_pipeline(f"{pipeline} +step +proj=unitconvert +xy_in=rad +xy_out=deg")
    lon, lat, height = degrees.transform(*local.T)
    crs = FRAMES[name].crs
    x, y = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    return np.stack([x, y, height / (FEET if name == "feet" else 1.0)], axis=1)


@pytest.mark.parametrize("name", list(FRAMES))
def test_its_vertices_are_where_proj_puts_them(
    files: Files, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(geo_glb, "VERTICES_AT_ONCE", 1000)
    monkeypatch.setattr(geo_obj, "VERTICES_AT_ONCE", 700)
    earth = opened(name)
    centre = plan_centre(earth, files.glb)
    write_geo_glb(files.glb, tmp_path / "geo.glb", earth, centre)
    write_geo_obj(files.obj, tmp_path / "geo.obj", earth, centre, "geo.mtl")
    document, _ = parts((tmp_path / "geo.glb").read_bytes())
    assert document["extensions"]["CESIUM_RTC"]["center"] == list(centre) and centre[2] == 0.0
    (mesh,) = trimesh.load(tmp_path / "geo.glb", process=False).geometry.values()
    (before,) = trimesh.load(files.glb, process=False).geometry.values()
    local = np.asarray(before.vertices) @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
    wanted = independent(name, local)
    np.testing.assert_allclose(np.asarray(mesh.vertices) + centre, wanted, atol=2e-4)  # float32 of heights of feet
    assert np.abs(np.asarray(mesh.vertices)[:, :2]).max() < 150.0  # so floats resolve hundredths of millimetres
    assert (np.asarray(mesh.faces) == before.faces).all() and (mesh.visual.uv == before.visual.uv).all()
    corners = [float(line.split()[1]) for line in (tmp_path / "geo.obj").read_text().splitlines() if line[:2] == "v "]
    vertices = independent(name, files.made.coloured.mesh.vertices)
    np.testing.assert_allclose(corners, vertices[:, 0] - centre[0], atol=3e-4)  # four decimals of metres, then of feet


def test_all_else_stays_as_it_is(files: Files, tmp_path: Path) -> None:
    earth = opened("metres")
    write_geo_glb(files.glb, tmp_path / "geo.glb", earth, (1.0, 2.0, 0.0))
    (before, old), (after, new) = parts(files.glb.read_bytes()), parts((tmp_path / "geo.glb").read_bytes())
    view = after["bufferViews"][after["accessors"][0]["bufferView"]]
    start, stop = view["byteOffset"], view["byteOffset"] + view["byteLength"]
    assert old[:start] == new[:start] and old[stop:] == new[stop:] and old[start:stop] != new[start:stop]
    assert after["bufferViews"] == before["bufferViews"] and after["images"] == before["images"]
    positions = np.frombuffer(new[start:stop], "<f4").reshape(-1, 3)
    assert after["accessors"][0]["min"] == positions.min(axis=0).tolist()
    write_geo_obj(files.obj, tmp_path / "geo.obj", earth, (1.0, 2.0, 0.0), "geo.mtl")
    lines, made = files.obj.read_text().splitlines(), (tmp_path / "geo.obj").read_text().splitlines()
    assert [line for line in made if line[:2] in ("vt", "f ", "us")] == [
        line for line in lines if line[:2] in ("vt", "f ", "us")
    ]
    assert "mtllib geo.mtl" in made and [path.name for path in tmp_path.glob("*.vertices")] == []


def attacked(data: bytes, change: str) -> bytes:
    document, binary = parts(data)
    accessor, view = document["accessors"][0], document["bufferViews"][0]
    if change == "cut":
        return data[: len(data) // 2]
    if change == "document":
        return packed(document, binary)[:20] + b"{" * 2000
    if change == "nan":
        start = view.get("byteOffset", 0)
        binary = binary[:start] + b"\xff" * 4 + binary[start + 4 :]
    changes = {
        "count": lambda: accessor.update(count=1 << 40),
        "offset": lambda: view.update(byteOffset=-12),
        "beyond": lambda: (accessor.update(count=5), view.update(byteOffset=len(binary) - 12)),
        "shorts": lambda: accessor.update(componentType=5123),
        "stride": lambda: view.update(byteStride=16),
        "moved": lambda: document["nodes"][0].update(translation=[1, 2, 3]),
        "meshes": lambda: document.update(meshes=3),
        "twice": lambda: document["meshes"].append({"primitives": [{"attributes": {"POSITION": 1}}]}),
        "number": lambda: document["meshes"][0]["primitives"][0]["attributes"].update(POSITION="x"),
        "nan": lambda: None,
    }
    changes[change]()
    return packed(document, binary)


@pytest.mark.parametrize(
    "change",
    ["cut", "document", "count", "offset", "beyond", "shorts", "stride", "moved", "meshes", "twice", "number", "nan"],
)
def test_a_file_that_is_not_ours_is_refused(files: Files, tmp_path: Path, change: str) -> None:
    (tmp_path / "mesh.glb").write_bytes(attacked(files.glb.read_bytes(), change))
    with pytest.raises(UnusableMesh):
        write_geo_glb(tmp_path / "mesh.glb", tmp_path / "geo.glb", opened("metres"), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("text", ["", "o mesh\n", "v 1 2\n", "v 1 2 x\n", "v 1 2 nan\n", "v " + "1" * 9000])
def test_an_obj_without_vertices_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "mesh.obj").write_text(text)
    with pytest.raises(UnusableMesh):
        write_geo_obj(tmp_path / "mesh.obj", tmp_path / "geo.obj", opened("metres"), (0.0, 0.0, 0.0), "geo.mtl")


def test_the_document_says_what_the_coordinates_are(files: Files, tmp_path: Path) -> None:
    earth = opened("feet")
    write_geo_glb(files.glb, tmp_path / "geo.glb", earth, plan_centre(earth, files.glb))
    document, _ = parts((tmp_path / "geo.glb").read_bytes())
    extras = json.dumps(document["asset"]["extras"])
    assert "EPSG:6565" in extras and "US survey foot" in extras and "CESIUM_RTC" in document["extensionsUsed"]
    assert "extensionsRequired" not in document
