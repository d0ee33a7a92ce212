"""A textured mesh in levels: cut without gaps, simplified without moving what must stay, textures at their places."""

import io
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hills import IDENTITY, placed
from made_mesh import made_site, site_height
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh, cut_along
from splatpipe.pipeline.surface.levels.mesh_quadtree import MeshQuadtree, MeshTile, depth_of, pixels_per_metre
from splatpipe.pipeline.surface.levels.mesh_simplification import simplified
from splatpipe.pipeline.surface.levels.mesh_texture import MAX_SIDE, TexturePages, pack, packed_texture
from splatpipe.pipeline.surface.levels.mesh_tiles import charted, write_mesh_tiles
from splatpipe.pipeline.surface.texture.textured_mesh import TexturedMesh
from splatpipe.pipeline.survey.crs.frames import Frame

CELLS, PAGE_PX, SITE_M = 100, 512, 20.0
FRAME = placed("EPSG:25832", "ellipsoidal")
CENTRE_M = np.array([300.0, -200.0, 40.0])  # of the site in the run's frame


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> TexturedMesh:
    return made_site(tmp_path_factory.mktemp("site"), CELLS, PAGE_PX, SITE_M)


@pytest.fixture(scope="module")
def mesh(made: TexturedMesh) -> ChartedMesh:
    return charted(made)[0]


@pytest.fixture(scope="module")
def tiles(mesh: ChartedMesh) -> dict[str, MeshTile]:
    """All tiles of three levels, by name."""
    found: dict[str, MeshTile] = {}
    tree = MeshQuadtree(mesh, 0.0)
    tree.build(lambda tile: found.setdefault(tile.key.name, tile) and None)
    assert len(found) == tree.tile_count == 1 + 4 + 16
    return found


def areas(mesh: ChartedMesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0


def border_sides(tile: MeshTile, axis: int, line: float) -> Counter:
    """Return the sides of a tile's triangles that lie on a line, by the places of their ends."""
    ends = np.concatenate([tile.mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    places = tile.mesh.vertices[ends]
    places = places[(places[:, :, axis] == line).all(axis=1)]
    return Counter(tuple(sorted(map(tuple, side))) for side in places.tolist())


def test_a_cut_keeps_the_surface_and_its_places_in_the_pages(mesh: ChartedMesh) -> None:
    lines = np.array([-3.3, 0.0, 4.7])
    cut = cut_along(cut_along(mesh, 0, lines), 1, lines)
    for axis in (0, 1):
        side = np.sign(cut.vertices[cut.triangles, axis][:, :, None] - lines)
        assert not ((side.min(axis=1) < 0) & (side.max(axis=1) > 0)).any()
    assert areas(cut).sum() == pytest.approx(areas(mesh).sum(), rel=1e-12)
    for chart in np.unique(mesh.charts):
        before, after = mesh.select(mesh.charts == chart), cut.select(cut.charts == chart)
        fit, *_ = np.linalg.lstsq(
            np.c_[before.vertices[before.triangles.ravel(), :2], np.ones(3 * len(before))],
            before.corners.reshape(-1, 2),
            rcond=None,
        )
        expected = np.c_[after.vertices[after.triangles.ravel(), :2], np.ones(3 * len(after))] @ fit
        assert np.abs(expected - after.corners.reshape(-1, 2)).max() < 1e-3  # pages show the site from above


def test_tiles_of_any_two_levels_meet_in_the_same_sides(tiles: dict[str, MeshTile]) -> None:
    compared = 0
    for name, tile in tiles.items():
        key = tile.key
        line = -SITE_M / 2.0 + SITE_M * (key.x + 1) / (1 << key.level)
        if key.x + 1 == 1 << key.level:
            continue
        mine = border_sides(tile, 0, line)
        assert mine and set(mine.values()) == {1}, name
        for other in tiles.values():
            scale = 1 << abs(other.key.level - key.level)
            finer = other.key.level >= key.level
            if finer and other.key.x == (key.x + 1) * scale and other.key.y // scale == key.y:
                theirs = border_sides(other, 0, line)
                assert set(theirs) <= set(mine)
                compared += len(theirs)
    assert compared > 500


def test_all_children_together_have_their_parents_outer_border(tiles: dict[str, MeshTile]) -> None:
    parent = tiles["1-0-0"]
    for axis in (0, 1):
        whole = border_sides(parent, axis, 0.0)
        leaves = [tile for tile in tiles.values() if tile.key.level == 2 and (tile.key.x, tile.key.y)[axis] == 1]
        along = [tile for tile in leaves if (tile.key.x, tile.key.y)[1 - axis] < 2]
        assert sum((border_sides(tile, axis, 0.0) for tile in along), Counter()) == whole


def test_each_level_has_fewer_triangles_and_says_what_it_misses(tiles: dict[str, MeshTile]) -> None:
    counts = Counter()
    for tile in tiles.values():
        counts[tile.key.level] += len(tile.mesh)
    assert counts[0] < 0.3 * counts[1] < 0.1 * counts[2]
    root = tiles["0-0-0"]
    assert 0.0 < root.error_m < 1.0
    middle = root.mesh.vertices[root.mesh.triangles].mean(axis=1)
    off = np.abs(site_height(middle[:, :2], SITE_M) - middle[:, 2])
    assert np.median(off) < 0.3 * root.error_m  # the block's walls stand where two heights are


def test_simplifying_moves_nothing_locked_and_keeps_borders(mesh: ChartedMesh) -> None:
    locked = np.abs(mesh.vertices[:, 0] - 2.0) < 0.3
    small, _ = simplified(mesh, locked, 2000)
    assert len(small) <= 2000
    assert np.isin(np.flatnonzero(locked), small.triangles).all()
    flat = [np.c_[each.vertices[each.triangles, :2].reshape(-1, 2)] for each in (mesh, small)]
    for extreme in (np.min, np.max):
        np.testing.assert_array_equal(extreme(flat[0], axis=0), extreme(flat[1], axis=0))
    plan = small.vertices[small.triangles, :2]
    a, b = plan[:, 1] - plan[:, 0], plan[:, 2] - plan[:, 0]
    signed = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    assert (signed > 0.0).all() and signed.sum() / 2.0 == pytest.approx(SITE_M**2, rel=1e-9)  # no hole, no overlap


def test_a_level_plane_becomes_a_few_triangles(mesh: ChartedMesh) -> None:
    plan = mesh.vertices * np.array([1.0, 1.0, 0.0])
    flat = ChartedMesh(plan, mesh.triangles, mesh.corners, np.zeros_like(mesh.charts))
    one_page = ChartedMesh(plan, mesh.triangles, np.ascontiguousarray(plan[mesh.triangles, :2]), flat.charts)
    small, error = simplified(one_page, np.zeros(len(plan), np.bool_), 6)
    assert 2 <= len(small) <= 6 and error < 1e-5 and areas(small).sum() == pytest.approx(SITE_M**2)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_texture_shows_the_page_at_the_same_place(made: TexturedMesh, tmp_path: Path, factor: int) -> None:
    mesh, rects = charted(made)
    part = mesh.select(np.flatnonzero(np.abs(mesh.vertices[mesh.triangles, 0].mean(axis=1) - 1.0) < 3.0))
    pages = TexturePages(made.pages, tmp_path / "pages")
    packed = packed_texture(part, rects, pages, factor)
    picture = np.asarray(Image.open(io.BytesIO(packed.jpeg)).convert("RGB"), float)
    assert picture.shape[1::-1] == packed.size and max(packed.size) <= MAX_SIDE
    page = np.asarray(Image.open(made.pages[0]).convert("RGB"), float)
    inside = packed.uv.astype(float).mean(axis=1) * np.array(packed.size)
    there = picture[tuple(inside.astype(int).T[::-1])]
    at = part.corners.mean(axis=1).astype(int)
    around = [page[max(row - 8, 0) : row + 9, max(column - 8, 0) : column + 9] for column, row in at]
    smooth = np.array([each.reshape(-1, 3).std(axis=0).max() for each in around]) < 12.0
    off = np.abs(there - page[tuple(at.T[::-1])]).max(axis=1)
    assert smooth.sum() > 50 and np.quantile(off[smooth], 0.95) < 12.0
    pages.remove()
    assert not list(tmp_path.iterdir())


def test_packed_rectangles_do_not_overlap() -> None:
    random = np.random.default_rng(2)
    sizes = random.integers(1, 90, (300, 2))
    places, (width, height) = pack(sizes)
    used = np.zeros((height, width), int)
    for (left, top), (wide, high) in zip(places, sizes, strict=True):
        used[top : top + high, left : left + wide] += 1
    assert used.max() == 1 and used.sum() > 0.75 * used.size


@pytest.fixture(scope="module")
def tileset(made: TexturedMesh, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moved(made, tmp_path_factory.mktemp("tiles"))


def write_moved(made: TexturedMesh, folder: Path) -> Path:
    """Write the tiles of the site somewhere in a run's frame."""
    coloured = made.coloured
    moved = type(coloured.mesh)(coloured.mesh.vertices + CENTRE_M, coloured.mesh.triangles)
    there = TexturedMesh(type(coloured)(moved, coloured.colours), made.atlas, made.pages)
    write_mesh_tiles(folder, there, FRAME, folder / "work", lambda done, total: None)
    return folder


def nodes(tile: dict) -> list[dict]:
    return [tile, *(node for child in tile.get("children", ()) for node in nodes(child))]


def test_the_tileset_places_vertices_on_the_earth_as_the_frame_does(tileset: Path) -> None:
    found = json.loads((tileset / "tileset.json").read_text())
    assert found["asset"]["version"] == "1.1" and found["root"]["refine"] == "REPLACE"
    matrix = np.array(found["root"]["transform"]).reshape(4, 4).T
    part = trimesh.load(tileset / found["root"]["content"]["uri"], force="mesh", process=False)
    local = np.asarray(part.vertices) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # y up to z up
    assert FRAME.origin is not None
    ours = FRAME.origin.enu_from_geodetic
    from splatpipe.pipeline.survey.crs.geodesy import geodetic_from_ecef

    back = ours(geodetic_from_ecef(local @ matrix[:3, :3].T + matrix[:3, 3])) - CENTRE_M
    heights = site_height(back[:, :2], SITE_M)
    assert np.quantile(np.abs(heights - back[:, 2]), 0.9) < 1e-4
    assert np.abs(back[:, :2]).max() == pytest.approx(SITE_M / 2.0, abs=1e-4)


def test_every_tile_is_a_textured_mesh_inside_of_its_box(tileset: Path) -> None:
    found = json.loads((tileset / "tileset.json").read_text())
    every = nodes(found["root"])
    assert len(every) == 21 and {path.name for path in (tileset / "tiles").iterdir()} == {
        Path(node["content"]["uri"]).name for node in every
    }
    for node in every:
        part = trimesh.load(tileset / node["content"]["uri"], force="mesh", process=False)
        assert part.visual.material.baseColorTexture.size[0] > 16
        box = np.array(node["boundingVolume"]["box"])
        local = np.asarray(part.vertices) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        assert (np.abs(local - box[:3]) <= box[3:].reshape(3, 3).sum(axis=0) + 1e-6).all()
        errors = [child["geometricError"] for child in node.get("children", ())]
        assert all(error < node["geometricError"] for error in errors)
        assert (node["geometricError"] == 0.0) == (not errors)
    assert found["geometricError"] >= found["root"]["geometricError"]


def test_textures_shrink_with_the_level(made: TexturedMesh, tileset: Path) -> None:
    def pixels(level: int) -> int:
        paths = (tileset / "tiles").glob(f"{level}-*.glb")
        parts = [trimesh.load(path, force="mesh", process=False) for path in paths]
        return sum(np.prod(part.visual.material.baseColorTexture.size) for part in parts)

    assert pixels(0) < 0.4 * pixels(1) < 0.16 * pixels(2)


def test_the_same_mesh_gives_the_same_bytes(made: TexturedMesh, tileset: Path, tmp_path: Path) -> None:
    write_moved(made, tmp_path)
    again = {path.relative_to(tmp_path): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert again == {path.relative_to(tileset): path.read_bytes() for path in tileset.rglob("*") if path.is_file()}


def test_a_mesh_that_lies_nowhere_is_refused(made: TexturedMesh, tmp_path: Path) -> None:
    nowhere = Frame("arbitrary", IDENTITY, metres=True)
    with pytest.raises(SplatpipeError, match="georeferenced"):
        write_mesh_tiles(tmp_path, made, nowhere, tmp_path / "work", lambda done, total: None)


def test_the_depth_follows_triangles_and_pixels(mesh: ChartedMesh) -> None:
    assert (depth_of(100, 0.0), depth_of(1_000_000, 0.0), depth_of(100, 1e9)) == (2, 3, 5)
    pixels, density = pixels_per_metre(mesh)
    assert density == pytest.approx(np.sqrt(pixels / areas(mesh).sum()), rel=0.1)
