"""Path tracing with Mitsuba 3 through a distorted lens. Needs ``pip install splatpipe[demo]`` and an LLVM library."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpipe.demo.photography.cameras import BrownLens, Pose
from splatpipe.demo.photography.parallel_view import ParallelView
from splatpipe.demo.site.mesh import Array
from splatpipe.demo.site.scene import DemoScene

SUN_ELEVATION_DEG, SUN_AZIMUTH_DEG = 46.0, 222.0
SUN_RADIUS_DEG = 0.2679
TURBIDITY = 3.5
GOLDEN = 1.32471795724474602596  # the plastic number, of the R2 sequence
BOUNCES = 3  # surfaces that a path may hit
PIXEL_FILTER_PX = 0.45  # sigma of the Gaussian pixel filter
RADIANCE_CAP, INDIRECT_CAP = 4.0, 0.4  # the sun's reflection in lacquer would otherwise produce single bright pixels


def load_mitsuba() -> Any:
    """Import Mitsuba and choose its LLVM variant."""
    import mitsuba as mi  # pyright: ignore[reportMissingImports] (extra: demo)

    mi.set_variant("llvm_ad_rgb")
    return mi


class Renderer:
    """The scene in Mitsuba."""

    def __init__(self, scene: DemoScene) -> None:
        self.mi = load_mitsuba()
        up, azimuth = np.deg2rad(SUN_ELEVATION_DEG), np.deg2rad(SUN_AZIMUTH_DEG)
        self.sun = np.array([np.cos(up) * np.sin(azimuth), np.cos(up) * np.cos(azimuth), np.sin(up)])
        light = {"type": "sunsky", "sun_direction": self.sun.tolist(), "turbidity": TURBIDITY, "albedo": 0.25}
        self.sun_irradiance = self._sun_irradiance(light)
        parts = {f"mesh{k}": self._mesh(k, mesh) for k, mesh in enumerate(scene.meshes)}
        self.scene = self.mi.load_dict({"type": "scene", "sky": {**light, "sun_scale": 0.0}, **parts})

    def _sun_irradiance(self, light: dict[str, Any]) -> Array:
        """Irradiance of a surface facing the sun, (3,): the disc's radiance in Mitsuba, times its solid angle."""
        import drjit as dr  # pyright: ignore[reportMissingImports] (extra: demo)

        mi = self.mi
        disc = mi.load_dict({"type": "scene", "sun": {**light, "sky_scale": 0.0}}).environment()
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(*(float(-x) for x in self.sun))
        solid_angle = 2 * np.pi * (1 - np.cos(np.deg2rad(SUN_RADIUS_DEG)))
        return np.asarray(np.array(disc.eval(si)).ravel() * solid_angle, np.float64)

    def _mesh(self, number: int, mesh: Any) -> Any:
        mi = self.mi
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(mesh.texture), "raw": False, "wrap_mode": "clamp"}
        if mesh.gloss:
            bsdf = {"type": "roughplastic", "diffuse_reflectance": bitmap, "alpha": 0.15, "nonlinear": True}
        else:
            bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap}}
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(bsdf)
        shape = mi.Mesh(
            f"mesh{number}",
            len(mesh.vertices),
            len(mesh.triangles),
            has_vertex_normals=True,
            has_vertex_texcoords=True,
            props=properties,
        )
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = mesh.vertices.ravel()
        parameters["vertex_normals"] = mesh.normals.ravel()
        parameters["faces"] = mesh.triangles.ravel()
        parameters["vertex_texcoords"] = mesh.uv.ravel()
        parameters.update()
        return shape

    def photo(self, pose: Pose, lens: BrownLens, spp: int, seed: int) -> NDArray[np.float32]:
        """Render radiance, (h, w, 3): ``spp`` paths per pixel through a Gaussian pixel filter.

        Args:
            pose: The camera's pose.
            lens: Its intrinsics; rays are bent by the distortion itself, no image is resampled.
            spp: Samples per pixel.
            seed: Seed of this photo.
        """
        import drjit as dr  # pyright: ignore[reportMissingImports] (extra: demo)

        mi = self.mi
        rotation = mi.Matrix3f(pose.world_from_cam[:3, :3].tolist())
        origin = mi.Point3f(*(float(x) for x in pose.world_from_cam[:3, 3]))
        dr.make_opaque(rotation, origin)  # literals would be compiled in, again for each photo and sample

        def ray(px: Any, py: Any) -> Any:
            xd, yd = (px - lens.cx) / lens.f, (py - lens.cy) / lens.f
            if lens.is_simple:
                scale = _undistort_scale(dr.sqrt(xd * xd + yd * yd), lens.k)
                x, y = xd * scale, yd * scale
            else:
                x, y = lens.undistort(xd, yd)
            return mi.Ray3f(origin, dr.normalize(rotation @ mi.Vector3f(x, y, 1.0)))

        return self._picture(lens.width, lens.height, ray, spp, seed)

    def orthographic(self, view: ParallelView, spp: int, seed: int) -> NDArray[np.float32]:
        """Render radiance, (h, w, 3), along parallel rays; otherwise as ``photo``."""
        import drjit as dr  # pyright: ignore[reportMissingImports] (extra: demo)

        mi = self.mi
        steps = (view.right * view.pixel_m, view.down * view.pixel_m, view.ahead)
        right, down, ahead = (mi.Vector3f(*vector.tolist()) for vector in steps)
        origin = mi.Point3f(*view.origin.tolist())
        dr.make_opaque(right, down, ahead, origin)
        return self._picture(
            view.width, view.height, lambda x, y: mi.Ray3f(origin + right * x + down * y, ahead), spp, seed
        )

    def _picture(
        self, width: int, height: int, ray: Callable[[Any, Any], Any], spp: int, seed: int
    ) -> NDArray[np.float32]:
        """Mean radiance of each pixel, (h, w, 3); ``ray`` converts pixel positions to rays."""
        import drjit as dr  # pyright: ignore[reportMissingImports] (extra: demo)

        mi = self.mi
        count = width * height
        index = dr.arange(mi.UInt32, count)
        px, py = mi.Float(index % width) + 0.5, mi.Float(index // width) + 0.5
        offsets = _filter_offsets(spp, seed)
        total = np.zeros((count, 3), np.float32)
        for sample in range(spp):
            shift = mi.Point2f(*(float(x) for x in offsets[sample]))
            number = dr.opaque(mi.UInt32, sample)
            dr.make_opaque(shift)
            radiance = self._path(ray(px + shift.x, py + shift.y), index, number, dr.opaque(mi.UInt32, seed))
            total += np.array(dr.minimum(radiance, RADIANCE_CAP)).T
        return np.asarray(total.reshape(height, width, 3) / spp, np.float32)

    def _path(self, ray: Any, pixel: Any, sample: Any, seed: Any) -> Any:
        """Radiance along rays: the sun by one shadow ray at each surface, the sky where the path leaves the scene.

        The sun always gets its ray, so that sunlit surfaces carry no noise; directions follow a low-discrepancy
        sequence that is rotated at random for each pixel and bounce.
        """
        import drjit as dr  # pyright: ignore[reportMissingImports] (extra: demo)

        mi = self.mi
        context = mi.BSDFContext()
        radiance, weight, alive = mi.Spectrum(0.0), mi.Spectrum(1.0), mi.Bool(True)
        for bounce in range(BOUNCES + 1):
            si = self.scene.ray_intersect(ray, alive)
            radiance += dr.select(alive & ~si.is_valid(), weight * self.scene.environment().eval(si), 0.0)
            alive &= si.is_valid()
            if bounce == BOUNCES:
                break
            bsdf = si.bsdf(mi.RayDifferential3f(ray))
            towards = self._sun_direction(_sequence(mi, pixel, sample, seed, 2 * bounce))
            lit = alive & ~self.scene.ray_test(si.spawn_ray(towards), alive)
            sunlight = mi.Color3f(self.sun_irradiance.tolist())
            reflected = weight * bsdf.eval(context, si, si.to_local(towards), lit) * sunlight
            reflected = dr.minimum(reflected, RADIANCE_CAP if bounce == 0 else INDIRECT_CAP)
            radiance += dr.select(lit, reflected, 0.0)
            point = _sequence(mi, pixel, sample, seed, 2 * bounce + 1)
            lobe = _sequence(mi, pixel, sample, seed, 2 * bounce + 64).x
            chosen, factor = bsdf.sample(context, si, lobe, point, alive)
            weight *= factor
            ray = si.spawn_ray(si.to_world(chosen.wo))
        return radiance

    def _sun_direction(self, point: Any) -> Any:
        """A direction to the sun's disc for a point of the unit square."""
        mi = self.mi
        frame = mi.Frame3f(mi.Vector3f(*self.sun.tolist()))
        return frame.to_world(mi.warp.square_to_uniform_cone(point, float(np.cos(np.deg2rad(SUN_RADIUS_DEG)))))

    def first_hit(self, origins: Array, directions: Array) -> Array:
        """Distance in metres to the first surface along rays, infinite where there is none; (n, 3), (n, 3) -> (n,)."""
        mi = self.mi
        ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
        return np.array(self.scene.ray_intersect(ray).t, dtype=np.float64)


def _sequence(mi: Any, pixel: Any, sample: Any, seed: Any, dimension: int) -> Any:
    """Point of the unit square: the R2 sequence (Roberts 2018) at ``sample``, shifted by a hash of the rest."""
    first, second = mi.sample_tea_32(pixel, seed * 131 + dimension)
    scale = 2.0**-32
    steps = [int(2**32 / GOLDEN**k) for k in (1, 2)]
    return mi.Point2f(mi.Float(first + sample * steps[0]) * scale, mi.Float(second + sample * steps[1]) * scale)


def _undistort_scale(distorted: Any, k: float) -> Any:
    """r / r_d for r_d = r (1 + k r^2), by five Newton steps from r_d: below 1e-7 in this field of view."""
    import drjit as dr  # pyright: ignore[reportMissingImports] (extra: demo)

    r = distorted
    for _ in range(5):
        r = r - (r * (1 + k * r * r) - distorted) / (1 + 3 * k * r * r)
    return dr.select(distorted > 1e-6, r / distorted, 1.0)


def _filter_offsets(spp: int, seed: int) -> Array:
    """Offsets from the pixel centre, (spp, 2): the R2 sequence shaped to a Gaussian, mean removed."""
    start = np.random.default_rng(seed).random(2)
    points = (start + np.arange(1, spp + 1)[:, None] / np.array([GOLDEN, GOLDEN**2])) % 1.0
    radius = PIXEL_FILTER_PX * np.sqrt(-2 * np.log(1 - points[:, 0] * 0.97))  # cut at 2.6 sigma
    offsets = radius[:, None] * np.c_[np.cos(2 * np.pi * points[:, 1]), np.sin(2 * np.pi * points[:, 1])]
    return np.asarray(offsets - offsets.mean(axis=0))
