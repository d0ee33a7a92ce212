"""`splatpipe edit`: the result looks right from known views, lies in the right place, and records its edits."""

import json
import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from command import splatpipe
from pyproj import Transformer
from tiny_scene import Recorder, cameras, true_model

from splatpipe.pipeline.app.cli.edit import steps_in_order
from splatpipe.pipeline.delivery.delivery_frame import frame_of
from splatpipe.pipeline.edit.editing import EditTask, edit_splat
from splatpipe.pipeline.edit.pictures import choose_views, oblique_view
from splatpipe.pipeline.edit.record import with_edits
from splatpipe.pipeline.edit.size import OutputFile
from splatpipe.pipeline.edit.sources import SplatSource, open_source, read_cameras
from splatpipe.pipeline.edit.steps import parse_steps
from splatpipe.pipeline.edit.workpiece import Workpiece, between
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import property_names
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.formats.catalogue import format_named
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import MAX_EDITS, Scene, SceneFacts, SplatOrigin, turn_of
from splatpipe.pipeline.survey.crs.frames import Origin
from splatpipe.pipeline.survey.crs.world import open_world

PLACE = SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634")
PLACED = SceneFacts("z up", False, True, PLACE)
SAME_DB = 60.0  # what is only moved: float32's rounding of means, scales and harmonics
OUTPUT = OutputFile(Path("out.ply"), format_named("ply"))


def edited(scene: Scene, *given: tuple[str, Any], local: bool = False) -> Scene:
    """Return a scene after edit steps; the input stays unchanged."""
    piece = Workpiece(Scene(scene.gaussians.clone(), scene.facts))
    for step in parse_steps(given, OUTPUT, local):
        step.apply(piece)
    return piece.scene()


def view(scene: Scene, camera: Camera) -> torch.Tensor:
    options = rasterizer.RenderOptions(sh_degree=scene.gaussians.sh_degree, background=(0.4, 0.5, 0.6))
    with torch.no_grad():
        return rasterizer.render(scene.gaussians, camera, options).colour


def decibels(first: torch.Tensor, second: torch.Tensor) -> float:
    return -10.0 * math.log10(max(float((first - second).square().mean()), 1e-12))


def moved(camera: Camera, similarity: Similarity) -> Camera:
    return replace(camera, cam_from_world=similarity.camera_pose(camera.cam_from_world))


def about(point: Sequence[float], scale: float, rotation: np.ndarray) -> Similarity:
    centre = np.array(point, np.float64)
    return Similarity(scale, rotation, centre - scale * (rotation @ centre))


def upright(vector: Sequence[float]) -> np.ndarray:
    return rotation_from_vector(np.array(vector, np.float64))


def same(first: Gaussians, second: Gaussians) -> bool:
    return all(torch.equal(tensor, getattr(second, name)) for name, tensor in first.tensors().items())


@pytest.mark.parametrize("axes", ["z up", "y down"])
def test_rotated_by_37_degrees_it_looks_the_same_from_cameras_rotated_with_it(axes):
    scene = Scene(true_model(), SceneFacts(axes))
    up = turn_of(axes, "z up").numpy() @ [0.0, 0.0, 1.0]
    turned = edited(scene, ("about", "0.2,0.1,-0.3"), ("rotate", "37"))
    similarity = about([0.2, 0.1, -0.3], 1.0, upright(math.radians(37.0) * up))
    for camera in cameras(3):
        assert decibels(view(scene, camera), view(turned, moved(camera, similarity))) >= SAME_DB
        assert decibels(view(scene, camera), view(turned, camera)) < 30.0


def test_any_axis_any_scale_and_a_move_look_the_same_from_cameras_that_follow():
    scene = Scene(true_model(), SceneFacts())
    steps = ("about", "1,2,3"), ("rotate", "-140,0,3,4"), ("scale", "2.5"), ("move", "5,-1,0.5")
    changed = edited(scene, *steps)
    turn = about([1, 2, 3], 1.0, upright(math.radians(-140.0) * np.array([0.0, 0.6, 0.8])))
    similarity = Similarity(1.0, np.eye(3), np.array([5.0, -1.0, 0.5])).compose(
        about([1, 2, 3], 2.5, np.eye(3)).compose(turn)
    )
    for camera in cameras(3):
        assert decibels(view(scene, camera), view(changed, moved(camera, similarity))) >= SAME_DB


def test_steps_are_applied_in_order():
    scene = Scene(true_model(), SceneFacts())
    box = ("crop_box", "0,-9,-9,9,9,9")
    first, last = edited(scene, box, ("move", "-1,0,0")), edited(scene, ("move", "-1,0,0"), box)
    assert float(first.gaussians.means[:, 0].min()) < 0.0 <= float(last.gaussians.means[:, 0].min())
    assert len(first.gaussians) > len(last.gaussians) > 0


def test_moving_away_and_back_rounds_only_once():
    scene = Scene(true_model(), SceneFacts())
    back = edited(scene, ("move", "1e7,0,0"), ("rotate", "180,z"), ("rotate", "-180,z"), ("move", "-1e7,0,0"))
    assert float((back.gaussians.means - scene.gaussians.means).abs().max()) < 1e-6


def test_two_measured_points_set_the_scale_and_the_first_stays_fixed():
    scene = Scene(true_model(), SceneFacts(metres=False))
    scene.gaussians.means[0] = torch.tensor([1.0, 0.0, 0.0])
    scene.gaussians.means[1] = torch.tensor([1.0, 0.5, 0.0])
    scaled = edited(scene, ("scale_from", ("1,0,0", "1,0.5,0", "12.40m")))
    assert scaled.facts == SceneFacts(metres=True)
    torch.testing.assert_close(scaled.gaussians.means[:2], torch.tensor([[1.0, 0.0, 0.0], [1.0, 12.4, 0.0]]))
    assert edited(scaled, ("scale", "2")).facts == SceneFacts(metres=False)


def test_a_georeferenced_splat_keeps_its_georeference_except_under_a_plain_scale():
    scene = Scene(true_model(), PLACED)
    for steps in ((("rotate", "12"),), (("move", "1,2,3"),), (("scale_from", ("0,0,0", "1,0,0", "1.003m")),)):
        assert edited(scene, *steps, local=True).facts == PLACED
    assert edited(scene, ("scale", "1.003")).facts == replace(PLACED, place=None, metres=False)


def test_a_splat_is_moved_to_the_given_coordinates():
    scene = Scene(true_model(), PLACED)
    world = open_world(frame_of(PLACE))
    start = world.crs_from_local(np.array([[0.5, 0.25, -0.125]]))[0]
    target = start + np.array([40.0, -30.0, 2.0])
    steps = ("about", ",".join(map(repr, start.tolist()))), ("move_to", ",".join(map(repr, target.tolist())))
    there = edited(scene, *steps)
    means = there.gaussians.means.double().numpy() - scene.gaussians.means.double().numpy()
    expected = world.local_from_crs(target[None])[0] - [0.5, 0.25, -0.125]
    np.testing.assert_allclose(means, np.broadcast_to(expected, means.shape), atol=5e-5)  # east differs there by 8 µrad
    level = edited(scene, ("move_to", f"{target[0]},{target[1]}"))
    np.testing.assert_allclose(level.gaussians.means.median(0)[0][2], scene.gaussians.means.median(0)[0][2], atol=0.01)


def test_moved_far_away_it_is_upright_in_a_new_local_frame():
    scene = Scene(true_model(), PLACED)
    far = Transformer.from_crs("EPSG:4326", "EPSG:32634", always_xy=True).transform(21.9, 53.1)
    piece = Workpiece(Scene(scene.gaussians.clone(), scene.facts))
    for step in parse_steps([("move_to", f"{far[0]!r},{far[1]!r},100")], OUTPUT, False):
        step.apply(piece)
    moved = piece.scene()
    place = moved.facts.place
    assert place is not None
    assert (place.latitude, place.longitude) == pytest.approx((53.1, 21.9), abs=1e-6)
    assert place.height_m == pytest.approx(100.0, abs=0.01)
    assert "origin" in piece.notes[0]
    shift = (moved.gaussians.means - scene.gaussians.means).double().numpy()
    np.testing.assert_allclose(shift - shift[0], 0.0, atol=1e-4)  # neither tipped nor turned
    with pytest.raises(SplatpipeError, match="60 km away"):
        edited(scene, ("move", "60000,0,0"))


def test_without_georeference_it_is_not_moved_beyond_float32_precision():
    with pytest.raises(SplatpipeError, match="32-bit"):
        edited(Scene(true_model(), SceneFacts()), ("move", "500000,5800000,0"))


def test_a_box_crop_keeps_its_contents_bit_identical_and_a_cut_keeps_the_rest():
    scene = Scene(true_model(), SceneFacts("y down"))
    inside = ((scene.gaussians.means[:, :2] >= 0.0) & (scene.gaussians.means[:, :2] <= 2.0)).all(1)
    kept, rest = edited(scene, ("crop_box", "2,2,0,0")), edited(scene, ("cut_box", "0,0,2,2"))
    assert same(kept.gaussians, scene.gaussians.select(inside))
    assert same(rest.gaussians, scene.gaussians.select(~inside))


def test_heights_are_along_the_up_axis_whichever_it_is():
    scene = Scene(true_model(), SceneFacts("y down"))
    heights = -scene.gaussians.means[:, 1]
    assert same(edited(scene, ("crop_heights", "0.25,")).gaussians, scene.gaussians.select(heights >= 0.25))
    assert same(edited(scene, ("crop_heights", ",0.25")).gaussians, scene.gaussians.select(heights <= 0.25))


def test_boxes_and_heights_are_in_the_crs_of_the_run():
    scene = Scene(true_model(), PLACED)
    stated = open_world(frame_of(PLACE)).crs_from_local(scene.gaussians.means.double().numpy())
    low, high = np.quantile(stated, [0.2, 0.8], axis=0)
    inside = ((stated >= low) & (stated <= high)).all(1)
    text = ",".join(map(repr, [*low.tolist(), *high.tolist()]))
    assert 0 < inside.sum() < len(inside)
    assert same(edited(scene, ("crop_box", text)).gaussians, scene.gaussians.select(torch.from_numpy(inside)))
    above = stated[:, 2] >= 113.25
    kept = edited(scene, ("crop_heights", "113.25,")).gaussians
    assert same(kept, scene.gaussians.select(torch.from_numpy(above)))
    assert same(edited(scene, ("crop_box", "0,0,2,2"), local=True).gaussians, _in_plan(scene, 0.0, 2.0))


def _in_plan(scene: Scene, low: float, high: float) -> Gaussians:
    plan = scene.gaussians.means[:, :2]
    return scene.gaussians.select(((plan >= low) & (plan <= high)).all(1))


def geojson(path: Path, ring: Sequence[Sequence[float]], crs: str = "") -> Path:
    value: dict[str, Any] = {"type": "Polygon", "coordinates": [[*map(list, ring), list(ring[0])]]}
    if crs:
        value["crs"] = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{crs}"}}
    path.write_text(json.dumps(value))
    return path


@pytest.mark.parametrize("crs", ["", "2180", "25834", "3857"])
@pytest.mark.parametrize("axes", ["z up", "y down"])
def test_a_polygon_in_any_crs_crops_at_its_place_on_earth(tmp_path: Path, crs, axes):
    scene = Scene(true_model(), PLACED)
    corners = np.array([[-1.0, -0.5, 0.0], [1.2, -0.75, 0.0], [0.3, 1.5, 0.0]])
    geodetic = Origin(PLACE.latitude, PLACE.longitude, PLACE.height_m).geodetic_from_enu(corners)
    ring = np.column_stack([geodetic[:, 1], geodetic[:, 0]])
    if crs:
        to_crs = Transformer.from_crs("EPSG:4326", f"EPSG:{crs}", always_xy=True)
        ring = np.column_stack(to_crs.transform(ring[:, 0], ring[:, 1]))
    path = geojson(tmp_path / "site.geojson", ring.tolist(), crs)
    plan = scene.gaussians.means[:, :2].double().numpy()
    sides = [
        (b[0] - a[0]) * (plan[:, 1] - a[1]) - (b[1] - a[1]) * (plan[:, 0] - a[0])
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    inside = torch.from_numpy(np.min(sides, axis=0) > 0.0)
    kept = edited(scene.turned(axes), ("crop_polygon", path))
    rest = edited(scene.turned(axes), ("cut_polygon", path))
    assert 0 < len(kept.gaussians) == int(inside.sum()) < len(scene.gaussians)
    assert same(kept.gaussians, scene.turned(axes).gaussians.select(inside))
    assert len(rest.gaussians) + len(kept.gaussians) == len(scene.gaussians)


def test_a_self_intersecting_polygon_is_reported_and_filled_by_the_even_odd_rule(tmp_path: Path):
    path = geojson(tmp_path / "bow.geojson", [[-3, -3], [3, 3], [3, -3], [-3, 2]])
    piece = Workpiece(Scene(true_model(), SceneFacts("z up")))
    parse_steps([("crop_polygon", path)], OUTPUT, True)[0].apply(piece)
    assert "crosses itself" in piece.notes[0]
    x, y, _ = piece.scene().gaussians.means.unbind(1)
    assert len(x) > 10
    assert bool(((y - x) * (y + 3.0 - (3.0 - x) * 5.0 / 6.0) < 1e-5).all())  # between the two lines that cross


def test_crops_that_leave_nothing_state_where_the_splat_is(tmp_path: Path):
    scene = Scene(true_model(), PLACED)
    with pytest.raises(SplatpipeError, match="would remove the whole splat") as caught:
        edited(scene, ("crop_box", "0,0,1,1"))
    assert "EPSG:32634" in caught.value.hint and "--local" in caught.value.hint
    away = geojson(tmp_path / "away.geojson", [[21.1, 52.2], [21.2, 52.2], [21.2, 52.3]])
    with pytest.raises(SplatpipeError, match=r"km (north-)?east") as caught:
        edited(scene, ("crop_polygon", away))
    swapped = geojson(tmp_path / "swapped.geojson", [[52.1, 20.9], [52.3, 20.9], [52.3, 21.1], [52.1, 21.1]])
    with pytest.raises(SplatpipeError) as caught:
        edited(scene, ("crop_polygon", swapped))
    assert "swapped" in caught.value.hint and "georef.boundary" not in caught.value.hint
    nowhere = Scene(true_model(), SceneFacts())
    with pytest.raises(SplatpipeError, match="not georeferenced"):
        edited(nowhere, ("crop_polygon", away))
    with pytest.raises(SplatpipeError, match="would remove the whole splat"):
        edited(nowhere, ("crop_polygon", away), local=True)
    with pytest.raises(SplatpipeError, match="would remove the whole splat"):
        edited(nowhere, ("crop_heights", "100,200"))
    with pytest.raises(SplatpipeError, match="would remove the whole splat"):
        edited(nowhere, ("cut_box", "-99,-99,99,99"))


def test_a_polygon_of_many_vertices_cuts_like_the_circle_it_is(tmp_path: Path):
    angles = np.linspace(0.0, 2.0 * math.pi, 4_999, endpoint=False)
    path = geojson(tmp_path / "round.geojson", np.column_stack([np.cos(angles), np.sin(angles)]).tolist())
    scene = Scene(true_model(), SceneFacts())
    inside = scene.gaussians.means[:, :2].norm(dim=1) < 1.0
    assert same(edited(scene, ("crop_polygon", path), local=True).gaussians, scene.gaussians.select(inside))


def test_two_halves_merge_to_the_whole(tmp_path: Path):
    scene = Scene(true_model(), PLACED)
    right = edited(scene, ("crop_box", "0,-9,9,9"), local=True)
    plain_ply.write(tmp_path / "left.ply", edited(scene, ("cut_box", "0,-9,9,9"), local=True))
    merged = edited(right, ("merge", tmp_path / "left.ply"))
    assert len(merged.gaussians) == len(scene.gaussians)
    for camera in cameras(3):
        assert decibels(view(scene, camera), view(merged, camera)) >= SAME_DB
    order = lambda gaussians: gaussians.select(torch.argsort(gaussians.means[:, 0]))  # noqa: E731
    assert same(order(merged.gaussians), order(scene.gaussians))


@pytest.mark.parametrize("axes", ["z up", "y up"])
def test_a_splat_of_another_run_is_merged_at_its_place_on_earth(tmp_path: Path, axes):
    scene = Scene(true_model(), PLACED)
    other = replace(PLACE, latitude=52.21, longitude=21.02, height_m=90.0, crs="EPSG:2180")
    here, there = (Origin(place.latitude, place.longitude, place.height_m) for place in (PLACE, other))
    to_other = between(here, there)
    rotation, translation = (
        torch.from_numpy(np.ascontiguousarray(a)) for a in (to_other.rotation, to_other.translation)
    )
    elsewhere = Scene(scene.gaussians.transformed(1.0, rotation, translation), replace(PLACED, place=other))
    plain_ply.write(tmp_path / "other.ply", elsewhere.turned(axes))
    few = edited(scene, ("crop_box", "-0.1,-9,0.1,9"), local=True)
    merged = edited(few, ("merge", tmp_path / "other.ply"))
    added = merged.gaussians.after(len(few.gaussians))
    assert float((added.means - scene.gaussians.means).abs().max()) < 5e-4  # float32 at 1.8 km: 0.12 mm an axis
    camera = cameras(3)[1]
    assert decibels(view(scene, camera), view(Scene(added), camera)) >= 45.0  # PSNR against what was rounded


def test_degrees_of_harmonics_may_differ(tmp_path: Path):
    scene = Scene(true_model(), PLACED)
    flat = Gaussians(*(t if name != "sh" else t[:, :1] for name, t in scene.gaussians.tensors().items()))
    plain_ply.write(tmp_path / "flat.ply", Scene(flat, PLACED))
    merged = edited(scene, ("merge", tmp_path / "flat.ply")).gaussians
    assert same(merged.first(len(flat)), scene.gaussians)
    assert torch.equal(merged.sh[len(flat) :, :1], flat.sh) and not merged.sh[len(flat) :, 1:].any()


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        (replace(PLACED, place=replace(PLACE, vertical_datum="ellipsoidal")), "tens of metres"),
        (replace(PLACED, place=replace(PLACE, vertical_datum="unknown")), "tens of metres"),
        (replace(PLACED, place=replace(PLACE, vertical_datum="EPSG:nonsense")), "nonsense"),
        (replace(PLACED, place=replace(PLACE, latitude=53.2)), "111 km from the splat"),
        (SceneFacts("z up", metres=True), "not georeferenced"),
    ],
)
def test_splats_of_unknown_place_are_not_merged(tmp_path: Path, facts, message):
    plain_ply.write(tmp_path / "other.ply", Scene(true_model(), facts))
    with pytest.raises(SplatpipeError, match=message):
        edited(Scene(true_model(), PLACED), ("merge", tmp_path / "other.ply"))


def test_without_georeference_only_splats_in_one_frame_are_merged(tmp_path: Path):
    plain_ply.write(tmp_path / "other.ply", Scene(true_model(), SceneFacts("z up")))
    with pytest.raises(SplatpipeError, match="axis"):
        edited(Scene(true_model(), SceneFacts("y down")), ("merge", tmp_path / "other.ply"))
    with pytest.raises(SplatpipeError, match="metres"):
        edited(Scene(true_model(), SceneFacts("z up", metres=True)), ("merge", tmp_path / "other.ply"))
    merged = edited(Scene(true_model(), SceneFacts("z up")), ("merge", tmp_path / "other.ply"))
    assert len(merged.gaussians) == 2 * len(true_model())


def test_cleaning_uses_cameras_moved_with_the_splat():
    scene = Scene(true_model(), SceneFacts("y down"))
    scene.gaussians.opacity_logits[::10] = -8.0  # what nobody sees
    to_up = Similarity(1.0, turn_of("z up", "y down").numpy(), np.zeros(3))
    views = [moved(camera, to_up) for camera in cameras(4)]
    kept = []
    for steps in ((), (("rotate", "37"), ("move", "5,6,7"), ("scale", "3"))):
        piece = Workpiece(Scene(scene.gaussians.clone(), scene.facts))
        records = [step.apply(piece) for step in parse_steps([*steps, ("clean", True)], OUTPUT, False, views)]
        assert records[-1]["photos"] == 4
        assert records[-1]["removed"]["transparent"] == 15
        kept.append((records[-1]["removed"], piece.scene().gaussians.opacity_logits))
    assert kept[0][0] == kept[1][0] and torch.equal(kept[0][1], kept[1][1])


def test_photos_of_one_run_do_not_judge_merged_splats(tmp_path: Path):
    plain_ply.write(tmp_path / "other.ply", Scene(true_model(), SceneFacts()))
    piece = Workpiece(Scene(true_model(), SceneFacts()))
    records = [
        step.apply(piece)
        for step in parse_steps([("merge", tmp_path / "other.ply"), ("clean", True)], OUTPUT, False, cameras(2))
    ]
    assert records[-1]["photos"] == 0 and "before --merge" in piece.notes[0]


def test_held_out_photos_are_not_used_for_cleaning(run_folder: Path):
    assert len(open_source(run_folder).trained_on()) == 9
    (run_folder / "metrics.json").write_text(json.dumps({"per_view": [{"name": "flight 1/photo_0.png"}]}))
    assert next(camera.name for camera in open_source(run_folder).trained_on()) == "flight 1/photo_1.png"
    (run_folder / "metrics.json").write_text("[")
    assert len(open_source(run_folder / "splat.ply").trained_on()) == 9


def test_cleaning_drops_unusable_values_and_says_how_many(tmp_path: Path):
    plain_ply.write(tmp_path / "a.ply", Scene(true_model(600)))
    data = bytearray((tmp_path / "a.ply").read_bytes())
    row = 4 * len(property_names(true_model(600).sh_degree))
    start, last = len(data) - 600 * row, row // 4 - 1
    for number, column, value in ((5, 0, math.nan), (7, 2, math.inf), (11, last, math.nan), (12, last - 5, 50.0)):
        struct.pack_into("<f", data, start + number * row + 4 * column, value)
    (tmp_path / "a.ply").write_bytes(data)
    source, output = open_source(tmp_path / "a.ply"), OutputFile(tmp_path / "b.ply", format_named("ply"))
    with pytest.raises(SplatpipeError, match="3 of 600") as refused:
        edit_splat(EditTask(source, output, parse_steps([("rotate", "1")], output, False)), Recorder())
    assert "splatpipe edit" in refused.value.hint and "--clean" in refused.value.hint
    facts = edit_splat(EditTask(source, output, parse_steps([("clean", True)], output, False)), Recorder())
    assert facts["steps"][0] == {"step": "drop unusable values", "gaussians": [600, 596]}
    assert facts["steps"][1]["gaussians"][0] == 596
    assert bool(plain_ply.read(output.path).gaussians.finite().all())
    assert (tmp_path / "b.edit.png").is_file()


def test_coordinates_of_a_splat_with_an_origin_taken_off_are_its_original_ones():
    offset = (388714.0, 5299720.0, 515.0)
    scene = Scene(true_model(600), SceneFacts("z up", offset=offset))
    inside = scene.gaussians.means[:, 0] > 0.0
    for given, local in (("388714,5299000,389000,5300000", False), ("0,-99,99,99", True)):
        kept = edited(scene, ("crop_box", given), local=local)
        assert len(kept.gaussians) == int(inside.sum())
        assert kept.facts.offset == offset
    high = int((scene.gaussians.means[:, 2] >= 0.1).sum())
    assert len(edited(scene, ("crop_heights", "515.1,")).gaussians) == high
    far = edited(scene, ("about", "388714,5299720,515"), ("move_to", "500000,5400000,100"))
    moved_by = np.array([500000.0, 5400000.0, 100.0]) - offset
    whole = far.gaussians.means.double().numpy() + far.facts.offset
    np.testing.assert_allclose(whole, scene.gaussians.means.double().numpy() + offset + moved_by, atol=1e-5)


def test_splats_with_origins_taken_off_are_merged_by_their_coordinates(tmp_path: Path):
    model = true_model(300)
    other = SceneFacts("z up", offset=(388704.0, 5299700.0, 515.0))
    plain_ply.write_about_origin(tmp_path / "other.ply", Scene(model, other))
    ours = Scene(model.clone(), SceneFacts("z up", offset=(388714.0, 5299720.0, 515.0)))
    merged = edited(ours, ("merge", tmp_path / "other.ply")).gaussians.means[300:]
    torch.testing.assert_close(merged, model.means + torch.tensor([-10.0, -20.0, 0.0]), atol=1e-5, rtol=0.0)
    for axes in ("y up", "y down"):
        turned = edited(ours.turned(axes), ("merge", tmp_path / "other.ply"))
        torch.testing.assert_close(turned.turned("z up").gaussians.means[300:], merged, atol=1e-5, rtol=0.0)
    with pytest.raises(SplatpipeError, match="one file cannot hold both"):
        edited(Scene(model.clone(), SceneFacts("z up")), ("merge", tmp_path / "other.ply"))


def test_it_is_reduced_to_a_count_or_a_size_in_bytes(tmp_path: Path):
    scene = Scene(true_model(600), SceneFacts())
    assert len(edited(scene, ("reduce", "200")).gaussians) == 200
    assert same(edited(scene, ("reduce", "900")).gaussians, scene.gaussians)
    output = OutputFile(tmp_path / "small.ply", format_named("ply"))
    piece = Workpiece(Scene(scene.gaussians.clone(), scene.facts))
    parse_steps([("reduce", "0.05MB")], output, False)[0].apply(piece)
    plain_ply.write(output.path, piece.scene())
    assert 0.9 * 50_000 <= output.path.stat().st_size <= 50_000
    with pytest.raises(SplatpipeError, match="is too small for"):
        parse_steps([("reduce", "0.001MB")], output, False)[0].apply(piece)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["small.ply"]


def test_a_record_keeps_the_newest_edits_and_counts_the_others():
    facts = SceneFacts()
    for number in range(MAX_EDITS + 5):
        facts = with_edits(facts, [{"step": "move", "by": [number, 0, 0]}])
    assert len(facts.edits) == MAX_EDITS
    assert facts.edits[0] == {"step": "earlier edits", "count": 6}
    assert facts.edits[-1]["by"] == [MAX_EDITS + 4, 0, 0]
    long = with_edits(SceneFacts(), [{"step": "crop", "polygon": "x" * 20_000}] * 6)
    assert long.edits[0]["count"] + len(long.edits) - 1 == 6
    long.record()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("crop_box", "nan,0,1,1"),
        ("crop_box", "0,0,1e400,1"),
        ("crop_box", ""),
        ("crop_box", "0,0,1"),
        ("crop_box", "0,0,0,1"),
        ("crop_box", "0,0,0,1,1"),
        ("crop_box", ",".join(["1"] * 100_000)),
        ("crop_heights", ","),
        ("crop_heights", "5"),
        ("crop_heights", "5,4"),
        ("crop_heights", "inf,"),
        ("crop_polygon", Path("/nowhere/site.geojson")),
        ("move", "1,2"),
        ("move", "1,2,1e30"),
        ("move_to", "somewhere"),
        ("rotate", "37°"),
        ("rotate", "nan"),
        ("rotate", "1e9"),
        ("rotate", "37,0,0,0"),
        ("rotate", "37,w"),
        ("scale", "0"),
        ("scale", "-1"),
        ("scale", "1e9"),
        ("scale_from", ("0,0,0", "1,0,0", "12.40")),
        ("scale_from", ("0,0,0", "1,0", "12.40m")),
        ("scale_from", ("0,0,0", "1,0,0", "0m")),
        ("about", "here"),
        ("reduce", "0"),
        ("reduce", "-5"),
        ("reduce", "99999999999"),
        ("reduce", "5XB"),
        ("reduce", "0.0000MB"),
        ("reduce", "١٢"),
    ],
)
def test_invalid_steps_are_refused_before_anything_is_read(name, value):
    with pytest.raises(UsageError) as caught:
        parse_steps([(name, value)], OUTPUT, False)
    assert caught.value.hint and len(caught.value.message) < 200


def test_coinciding_points_and_absurd_factors_are_refused():
    scene = Scene(true_model(), SceneFacts())
    for points in (("1,1,1", "1,1,1"), ("0,0,0", "0,0,1e-9")):
        with pytest.raises(SplatpipeError, match="apart in the splat"):
            edited(scene, ("scale_from", (*points, "12.40m")))


def test_options_are_read_in_order_and_may_be_repeated():
    options = {"rotate": ["10", "20"], "move": ["1,0,0"], "scale_from": ("a", "b", "c"), "about": None}
    order = ["source", "rotate", "move", "local", "scale_from", "rotate"]
    expected = [("rotate", "10"), ("move", "1,0,0"), ("scale_from", ("a", "b", "c")), ("rotate", "20")]
    assert steps_in_order(order, options) == expected
    with pytest.raises(UsageError, match="--scale-from can be given only once"):
        steps_in_order([*order, "scale_from"], options)
    with pytest.raises(UsageError, match="too many"):
        parse_steps([("rotate", "1")] * 101, OUTPUT, False)


def splatpipe_edit(*arguments: object) -> dict[str, Any]:
    """The command; what it prints as JSON."""
    done = splatpipe("edit", *arguments, "--json")
    assert "Traceback" not in done.stderr
    return json.loads(done.stdout)


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """Create the parts of a run's OUT that an edit reads."""
    out = tmp_path / "run"
    (out / "stages").mkdir(parents=True)
    plain_ply.write(out / "splat.ply", Scene(true_model(), PLACED))
    listed = [
        {
            "id": number,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.centre().tolist(),
            "rotation": camera.cam_from_world[:3, :3].T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
        }
        for number, camera in enumerate(cameras())
    ]
    (out / "cameras.json").write_text(json.dumps(listed))
    return out


def test_a_run_is_edited_from_the_command_line_and_stays_unchanged(run_folder: Path, tmp_path: Path):
    before = (run_folder / "splat.ply").read_bytes()
    out = tmp_path / "site.ply"
    steps = "--rotate", "30", "--crop-box", "-1.5,-9,1.5,9", "--about", "0,0,0", "--rotate", "7", "--local"
    printed = splatpipe_edit(run_folder, out, *steps)
    assert printed["exit_code"] == 0
    assert [step["step"] for step in printed["steps"]] == ["rotate", "crop", "rotate"]
    assert [step.get("degrees") for step in printed["steps"]] == [30.0, None, 7.0]
    assert printed["place"] == [52.2, 21.0, 113.25]
    read = plain_ply.read(out)
    assert read.facts.place == PLACE and len(read.facts.edits) == 3
    expected = edited(Scene(true_model(), PLACED), ("rotate", "30"), ("crop_box", "-1.5,-9,1.5,9"), local=True)
    assert len(read.gaussians) == printed["gaussians"] == len(expected.gaussians)
    record = json.loads((tmp_path / "site.edits.json").read_text())
    assert record["input"]["sha256"] == SplatSource(run_folder / "splat.ply", None).digest()
    assert record["steps"] == printed["steps"] and record["output"]["gaussians"] == printed["gaussians"]
    assert (run_folder / "splat.ply").read_bytes() == before
    picture = cv2.imread(str(tmp_path / "site.edit.png"))
    assert picture is not None and picture[40:, :960].std() > 10 and picture[40:, 968:].std() > 10
    made = {name: (tmp_path / name).read_bytes() for name in ("site.ply", "site.edits.json", "site.edit.png")}
    given = [("rotate", "30"), ("crop_box", "-1.5,-9,1.5,9"), ("about", "0,0,0"), ("rotate", "7")]
    with same_bits(1):
        output = OutputFile(out, format_named("ply"))
        edit_splat(EditTask(open_source(run_folder), output, parse_steps(given, output, True)), Recorder())
    assert all((tmp_path / name).read_bytes() == content for name, content in made.items())
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["run", *made])


def test_what_a_step_loses_is_told(run_folder: Path, tmp_path: Path):
    output, recorder = OutputFile(tmp_path / "a.ply", format_named("ply")), Recorder()
    edit_splat(EditTask(open_source(run_folder), output, parse_steps([("scale", "2")], output, False)), recorder)
    assert [text for text in recorder.warnings if "drops the splat's georeference" in text]


def test_errors_leave_nothing_behind_and_say_what_to_do(run_folder: Path, tmp_path: Path):
    output = splatpipe_edit(run_folder, tmp_path / "a.ply", "--crop-box", "0,0,1,1")
    assert output["exit_code"] == 1 and "would remove the whole splat" in output["error"]["message"]
    with pytest.raises(UsageError, match="No edit step"):
        edit_splat(
            EditTask(open_source(run_folder), OutputFile(tmp_path / "a.ply", format_named("ply")), []), Recorder()
        )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("name", ["splat.ply", "stages/train/model.ply", ".partial/a.ply", "cameras.json"])
def test_files_of_a_run_are_not_overwritten(run_folder: Path, name):
    steps = parse_steps([("rotate", "1")], OUTPUT, False)
    task = EditTask(open_source(run_folder), OutputFile(run_folder / name, format_named("ply")), steps)
    with pytest.raises(UsageError) as caught:
        edit_splat(task, Recorder())
    assert "edited.ply" in caught.value.hint or "IN must not be overwritten" in caught.value.hint


def test_new_files_in_a_run_may_be_written_and_overwritten(run_folder: Path):
    for degrees in ("1", "2"):
        output = OutputFile(run_folder / "edited.ply", format_named("ply"))
        report = Recorder()
        edit_splat(EditTask(open_source(run_folder), output, parse_steps([("rotate", degrees)], output, False)), report)
        assert report.steps[-1][0] == report.steps[-1][1]
    assert plain_ply.read(run_folder / "edited.ply").facts.edits[0]["degrees"] == 2.0


def test_input_files_are_not_overwritten(tmp_path: Path):
    plain_ply.write(tmp_path / "a.ply", Scene(true_model(), SceneFacts()))
    plain_ply.write(tmp_path / "b.ply", Scene(true_model(), SceneFacts()))
    steps = parse_steps([("merge", tmp_path / "b.ply")], OUTPUT, False)
    for name in ("a.ply", "b.ply"):
        with pytest.raises(UsageError, match="is an input of this edit"):
            edit_splat(
                EditTask(open_source(tmp_path / "a.ply"), OutputFile(tmp_path / name, format_named("ply")), steps),
                Recorder(),
            )


def test_a_model_folder_is_written_completely_and_never_into_a_nonempty_folder(tmp_path: Path):
    plain_ply.write(tmp_path / "a.ply", Scene(true_model(), SceneFacts()))
    output = OutputFile(tmp_path / "model", format_named("model"))
    task = EditTask(open_source(tmp_path / "a.ply"), output, parse_steps([("rotate", "1")], output, False), False)
    edit_splat(task, Recorder())
    assert len(open_source(tmp_path / "model").read().gaussians) == len(true_model())
    assert len(open_source(tmp_path / "model").digest()) == 64
    with pytest.raises(UsageError, match="is a folder"):
        edit_splat(task, Recorder())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "model", "model.edits.json"]


def test_a_photo_that_shows_it_is_used_or_else_an_oblique_view(run_folder: Path):
    points = true_model().means.double().numpy()
    found = read_cameras(run_folder / "cameras.json")
    assert [camera.name for camera in found] == [camera.name for camera in cameras()]
    np.testing.assert_allclose(found[3].cam_from_world, cameras()[3].cam_from_world, atol=1e-12)
    views = choose_views(found, points, points)
    assert views.before is views.after and views.after.name.startswith("flight 1/")
    away = choose_views(found, points, points + 1000.0)
    assert away.after.name == "oblique" and away.before.name == "oblique"


def test_an_oblique_view_shows_all_of_a_box_from_above():
    box = np.array([[-3.0, -2.0, 0.0], [5.0, 4.0, 9.0]])
    camera = oblique_view(box)
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    pixels = camera.project(corners)
    assert (pixels >= 0).all() and (pixels <= [camera.width, camera.height]).all()
    assert camera.centre()[2] > box[1, 2] and camera.centre()[1] < box[0, 1]
    assert camera.cam_from_world[1, 2] < 0.0  # up in the world is up in the picture


@pytest.mark.parametrize("side", ["width", "height"])
@pytest.mark.parametrize("pixels", [0, -3, 10**9])
def test_cameras_of_absurd_size_are_ignored(run_folder: Path, tmp_path: Path, side: str, pixels: int):
    listed = json.loads((run_folder / "cameras.json").read_text())
    listed[2][side] = pixels
    (tmp_path / "cameras.json").write_text(json.dumps(listed))
    assert len(read_cameras(tmp_path / "cameras.json")) == len(listed) - 1


@pytest.mark.parametrize("text", ["", "{}", "[1]", '[{"rotation": 5}]', "[" * 10_000, "[null]"])
def test_damaged_cameras_are_ignored(tmp_path: Path, text):
    (tmp_path / "cameras.json").write_text(text)
    assert read_cameras(tmp_path / "cameras.json") == []
