"""Render the demo capture: ``python -m splatpipe.demo.generate --work /tmp/demo-renders --out demo/capture``.

Requires ``pip install 'splatpipe[demo]'`` and an LLVM shared library (``apt-get install libllvm19``, and if it is not
found, ``DRJIT_LIBLLVM_PATH``). About a CPU minute per photo at 64 paths per pixel. Renders are kept in ``--work`` and
reused: an interrupted run resumes, and exposure, noise, JPEG and metadata can be redone without rendering. Everything
is seeded.
"""

from __future__ import annotations

import argparse
import io
import json
from datetime import datetime, timedelta
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatpipe.demo.photography.cameras import LENSES, BrownLens, Pose, flight
from splatpipe.demo.photography.geodesy import Origin
from splatpipe.demo.photography.metadata import GpsPosition, build_exif, build_xmp, position_attributes, with_metadata
from splatpipe.demo.photography.render import Renderer
from splatpipe.demo.photography.sensor import GAIN, WHITE_BALANCE, coded
from splatpipe.demo.photography.survey import gcp_list, sightings
from splatpipe.demo.site.mesh import Array
from splatpipe.demo.site.scene import PLOT_YAW_DEG, DemoScene, build_scene, surface_of

SEED = 2026
EXPOSURE_SIGMA_EV = 0.1
SHOT_NOISE, READ_NOISE = 2.0e-5, 1.0e-6  # variance per unit of light, and in the dark
GPS_SIGMA_M = (1.5, 1.5, 3.0)
RTK_SIGMA_M = (0.02, 0.02, 0.03)
MARK_SIGMA_PX = 0.3
PHOTO_BUDGET_BYTES = 7_150_000  # at 1200 x 900; larger photos get the same per pixel
CALIBRATED_FOCAL_PX = 853.0  # the maker's calibration, 0.2 % off, as is usual
RTK_XMP = {
    "GpsStatus": "RTK",
    "AltitudeType": "RtkAlt",
    "RtkFlag": "50",
    "RtkStdLon": "0.02000",
    "RtkStdLat": "0.02000",
    "RtkStdHgt": "0.03000",
    "RtkDiffAge": "1.00000",
    "SurveyingMode": "1",
}


def unbiased(rng: np.random.Generator, count: int, sigmas: tuple[float, ...]) -> Array:
    """Normal errors (count, len(sigmas)) with zero mean and an RMS of exactly sigma in each column."""
    errors = rng.standard_normal((count, len(sigmas)))
    errors -= errors.mean(axis=0)
    return np.asarray(errors / np.sqrt((errors**2).mean(axis=0)) * np.array(sigmas))


def develop(radiance: Array, exposure_ev: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Develop radiance (h, w, 3) to an 8-bit sRGB photo: exposure, sensor noise, soft highlights."""
    light = radiance * GAIN * 2**exposure_ev * WHITE_BALANCE
    light = light + rng.standard_normal(light.shape) * np.sqrt(SHOT_NOISE * light + READ_NOISE)
    return coded(light)


def compress(photos: list[NDArray[np.uint8]], budget: float) -> list[bytes]:
    """Encode all photos as JPEG, at the best common quality within the budget (total bytes)."""
    for quality in range(94, 40, -1):
        files = []
        for photo in photos:
            buffer = io.BytesIO()
            Image.fromarray(photo).save(buffer, "JPEG", quality=quality, optimize=True, subsampling=2)
            files.append(buffer.getvalue())
        if sum(map(len, files)) <= budget:
            print(f"JPEG quality {quality}")
            break
    return files


def render_all(scene: Renderer, poses: list[Pose], lens: BrownLens, spp: int, work: Path) -> list[Path]:
    """Render what does not exist yet; return the files with radiance as float16."""
    work.mkdir(parents=True, exist_ok=True)
    tag = f"{spp}" if lens == BrownLens() else f"{spp}.{sha256(repr(lens).encode()).hexdigest()[:8]}"
    files = [work / f"{pose.name}.{tag}.npy" for pose in poses]
    for number, (pose, file) in enumerate(zip(poses, files, strict=True)):
        if not file.exists():
            partial = file.with_suffix(".part.npy")
            np.save(partial, scene.photo(pose, lens, spp, number).astype(np.float16))
            partial.rename(file)
        print(f"{pose.name}: rendered ({number + 1} of {len(poses)})", flush=True)
    return files


def _flight_attributes(pose: Pose, lens: BrownLens, barometer_m: float, rng: np.random.Generator) -> dict[str, str]:
    """DJI's XMP attributes of angles and height; angles to 0.1 degrees, with the gimbal's error."""
    yaw, pitch, roll = np.array([pose.yaw_deg, pose.pitch_deg, pose.roll_deg]) + rng.normal(0, 0.2, 3)
    flight_yaw = yaw + rng.normal(0, 1.0)
    return {
        "Version": "1.6",
        "ImageSource": "WideCamera",
        "GpsStatus": "GPS",
        "AltitudeType": "GpsFusionAlt",
        "RelativeAltitude": f"{pose.centre[2] + barometer_m:+.3f}",
        "GimbalRollDegree": f"{roll:+.2f}",
        "GimbalYawDegree": f"{(yaw + 180) % 360 - 180:+.2f}",
        "GimbalPitchDegree": f"{max(pitch, -90.0):+.2f}",
        "FlightRollDegree": f"{rng.normal(0, 2):+.2f}",
        "FlightYawDegree": f"{(flight_yaw + 180) % 360 - 180:+.2f}",
        "FlightPitchDegree": f"{rng.normal(0, 2):+.2f}",
        "CamReverse": "0",
        "GimbalReverse": "0",
        "CalibratedFocalLength": f"{CALIBRATED_FOCAL_PX * lens.width / BrownLens.width:.6f}",
        "CalibratedOpticalCenterX": f"{lens.width / 2:.6f}",
        "CalibratedOpticalCenterY": f"{lens.height / 2:.6f}",
        "DewarpFlag": "0",
    }


def write_photos(
    out: Path, renders: list[Path], poses: list[Pose], lens: BrownLens, origin: Origin
) -> list[dict[str, object]]:
    """Develop, compress and tag the photos, write ``rtk.json``; return each photo's entry in truth.json."""
    rng = np.random.default_rng(SEED)
    count = len(poses)
    exposures = unbiased(rng, count, (EXPOSURE_SIGMA_EV,))[:, 0]
    gps, rtk = unbiased(rng, count, GPS_SIGMA_M), unbiased(rng, count, RTK_SIGMA_M)
    barometer = rng.normal(0, 0.15, count)
    centres = np.stack([pose.centre for pose in poses])
    fixes, rtk_fixes = origin.geodetic(centres + gps), origin.geodetic(centres + rtk)
    developed = [
        develop(np.load(f).astype(np.float64), e, np.random.default_rng((SEED, k)))
        for k, (f, e) in enumerate(zip(renders, exposures, strict=True))
    ]
    (out / "photos").mkdir(parents=True, exist_ok=True)
    start, entries = datetime(2026, 6, 18, 13, 42, 5), []
    budget = PHOTO_BUDGET_BYTES * (lens.width * lens.height) / (BrownLens.width * BrownLens.height)
    for k, (pose, jpeg) in enumerate(zip(poses, compress(developed, budget), strict=True)):
        taken = (start + timedelta(seconds=7 * k + (45 if k >= 16 else 0) + (60 if k >= 31 else 0))).strftime(
            "%Y:%m:%d %H:%M:%S"
        )
        position = GpsPosition(*(float(x) for x in fixes[k]))
        exif = build_exif((lens.width, lens.height), taken, 2 ** exposures[k] / 640, position)
        xmp = build_xmp(taken, {**_flight_attributes(pose, lens, barometer[k], rng), **position_attributes(position)})
        (out / "photos" / pose.name).write_bytes(with_metadata(jpeg, exif, xmp))
        entries.append(
            {
                "name": pose.name,
                "cam_from_world": pose.cam_from_world.round(12).tolist(),
                "centre_m": pose.centre.round(9).tolist(),
                "yaw_pitch_roll_deg": [pose.yaw_deg, pose.pitch_deg, pose.roll_deg],
                "exposure_ev": round(float(exposures[k]), 5),
                "gps_error_m": gps[k].round(4).tolist(),
                "rtk_error_m": rtk[k].round(5).tolist(),
            }
        )
    positions = {
        pose.name: [round(float(lat), 11), round(float(lon), 11), round(float(h), 4)]
        for pose, (lat, lon, h) in zip(poses, rtk_fixes, strict=True)
    }
    (out / "rtk.json").write_text(json.dumps({"xmp": RTK_XMP, "positions": positions}, indent=1) + "\n", "utf-8")
    return entries


def write_survey(
    out: Path, scene: DemoScene, renderer: Renderer, poses: list[Pose], lens: BrownLens, origin: Origin
) -> list[dict[str, object]]:
    """Write ``gcp_list.txt``; return the points' entries in truth.json."""
    rng = np.random.default_rng(SEED + 1)
    exact = sightings(scene.points, poses, lens, renderer.first_hit)
    marks = {
        n: {photo: pixel + rng.normal(0, MARK_SIGMA_PX, 2) for photo, pixel in seen.items()}
        for n, seen in exact.items()
    }
    utm = dict(zip(exact, origin.utm(np.stack([p.xyz for p in scene.points])), strict=True))
    (out / "gcp_list.txt").write_text(gcp_list(origin.utm_epsg, utm, marks), "utf-8")
    return [
        {
            "name": p.name,
            "where": p.where,
            "xyz_m": p.xyz.round(6).tolist(),
            "normal": p.normal.round(9).tolist(),
            "utm_m": utm[p.name].round(5).tolist(),
            "seen_px": {photo: pixel.round(4).tolist() for photo, pixel in exact[p.name].items()},
        }
        for p in scene.points
    ]


def write_surface(path: Path, scene: DemoScene) -> None:
    """Write the scene's triangles as binary PLY, east, north, up, with 16-bit indices."""
    vertices, triangles = surface_of(scene)
    assert len(vertices) < 2**16
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment the demo scene, east north up in metres\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar ushort vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), np.dtype([("count", "u1"), ("corners", "<u2", 3)]))
    faces["count"], faces["corners"] = 3, triangles
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + faces.tobytes())


def main() -> None:
    """Render the capture and write everything that belongs to it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder that keeps the renders")
    parser.add_argument("--out", type=Path, required=True, help="folder of the capture")
    parser.add_argument("--spp", type=int, default=64, help="paths a pixel")
    parser.add_argument("--lens", choices=sorted(LENSES), default="simple", help="brown: one like the DJI P1's")
    parser.add_argument("--size", type=float, default=1.0, help="of the photos, over 1200 x 900")
    arguments = parser.parse_args()
    lens, origin, poses = LENSES[arguments.lens]().scaled(arguments.size), Origin(), flight()
    scene = build_scene()
    renderer = Renderer(scene)
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_surface(arguments.out / "surface.ply", scene)
    points = write_survey(arguments.out, scene, renderer, poses, lens, origin)
    renders = render_all(renderer, poses, lens, arguments.spp, arguments.work)
    photos = write_photos(arguments.out, renders, poses, lens, origin)
    truth = {
        "about": "Exact cameras and surveyed points of the photos, in local east, north, up metres about the origin.",
        "frame": {
            "kind": "enu",
            "origin": {"latitude": origin.latitude, "longitude": origin.longitude, "height_m": origin.height_m},
            "crs": "EPSG:4979",
            "projected_crs": f"EPSG:{origin.utm_epsg}",
            "heights": "above the WGS84 ellipsoid, in the EXIF, too",
        },
        "camera": {
            **lens.colmap(),
            "pixels": "the centre of the first pixel is (0.5, 0.5)",
        },
        "sigmas": {
            "gps_m": GPS_SIGMA_M,
            "rtk_m": RTK_SIGMA_M,
            "exposure_ev": EXPOSURE_SIGMA_EV,
            "marks_px": MARK_SIGMA_PX,
        },
        "house_yaw_deg": PLOT_YAW_DEG,
        "photos": photos,
        "points": points,
    }
    (arguments.out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", "utf-8")
    print(f"{sum(f.stat().st_size for f in arguments.out.rglob('*') if f.is_file()) / 1e6:.2f} MB in all")


if __name__ == "__main__":
    main()
