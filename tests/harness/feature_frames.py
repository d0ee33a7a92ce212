"""Features through the CUDA kernels' C interface in this machine's memory, from activated Gaussians to images and back.

Without torch: faults run separately.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from frames import Memory, pointer

from splatpipe.pipeline.raster.cuda.cuda_api import (
    INLINE_CHANNELS,
    SplatActivated,
    SplatActivatedGradients,
    SplatFeatureGradients,
    SplatFeaturePictureGradients,
    SplatFeaturePictures,
    SplatFeatures,
    SplatFrame,
    SplatFrameFacts,
    SplatProjected,
    SplatProjectedGradients,
    SplatProjectOptions,
    SplatShot,
    SplatShRows,
)
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

GAUSSIANS = ("means", "quats", "scales", "opacities")
START = np.float32(0.5)
"""What gradients are added to."""


@dataclass(frozen=True)
class FeatureCase:
    """A view of activated Gaussians, and the upstream gradients of its images.

    Attributes:
        rows: means (n, 3), quats (n, 4), scales (n, 3), opacities (n,); features (n, d), or sh (n, k, 3); float32.
        pose: cam_from_world, (3, 4); it may scale.
        intrinsics: fx, fy, cx, cy.
        size: Width and height, pixels.
        upstream: dL/d(features) (h, w, d), dL/d(alpha) (h, w).
        options: far, blur_px2, plane_sigmas, compensation_min, radius_clip.
        depth: Whether the last channel is the depth, besides the features.
        slanted: Whether that varies within a Gaussian.
        background: (d,), without the depth's; None for zeros.
    """

    rows: dict[str, np.ndarray]
    pose: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    upstream: dict[str, np.ndarray] = field(default_factory=dict)
    near: float = 0.2
    options: tuple[float, float, float, float, float] = (1e10, 0.3, 0.0, 0.0, 0.0)
    compensate: bool = False
    depth: bool = False
    slanted: bool = False
    magnitudes: bool = False
    alpha_max: float = 0.999
    background: np.ndarray | None = None
    sh_degree: int = 0

    @property
    def count(self) -> int:
        return len(self.rows["means"])

    @property
    def channels(self) -> int:
        return (3 if "sh" in self.rows else self.rows["features"].shape[1]) + self.depth

    def shot(self) -> SplatShot:
        sh = self.rows.get("sh")
        shot = SplatShot(near_z=self.near, sh_degree=self.sh_degree, sh_count=1 if sh is None else sh.shape[1])
        shot.cam_from_world[:] = self.pose.ravel().tolist()
        shot.fx, shot.fy, shot.cx, shot.cy = self.intrinsics
        shot.width, shot.height = shot.whole_width, shot.whole_height = self.size
        return shot

    def changed(self, **changes: object) -> FeatureCase:
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class FeatureOutcome:
    """Images (features and alpha), radii; gradients by the case's rows, and the magnitudes; the frame's facts."""

    pictures: dict[str, np.ndarray]
    gradients: dict[str, np.ndarray]
    facts: tuple[int, int, int] = (0, 0, 0)

    def differs(self, other: FeatureOutcome) -> list[str]:
        """Return the names of results that are not bit-identical."""
        ours, theirs = self.pictures | self.gradients, other.pictures | other.gradients
        return [name for name in ours if ours[name].tobytes() != theirs[name].tobytes()]


class FeatureDevice:
    """A case on the device."""

    def __init__(self, library: CudaLibrary, case: FeatureCase) -> None:
        self.library, self.case, self.at, self.shot = library, case, Memory(), case.shot()
        self.held = {name: self.at.put(name, np.ascontiguousarray(rows)) for name, rows in case.rows.items()}
        self.gaussians = SplatActivated(case.count, *(pointer(self.held[name]) for name in GAUSSIANS))
        self.how = SplatProjectOptions(*case.options)
        n = case.count
        self.fields = {
            "means2d": self.at.empty("means2d", (n, 2)),
            "depths": self.at.empty("depths", (n,)),
            "covariances": self.at.empty("covariances", (n, 3)),
            "determinants": self.at.empty("determinants", (n,)),
            "compensations": self.at.empty("compensations", (n,)) if case.compensate else None,
            "slants": self.at.empty("slants", (n, 2)) if case.slanted else None,
            "radii": self.at.empty("radii", (n, 2), np.int32),
        }

    def project(self) -> None:
        out = SplatProjected(**{name: pointer(value) for name, value in self.fields.items()})
        self.library.call("splat_project_activated", self.shot, self.how, self.gaussians, out, None)

    def sh_rows(self) -> SplatShRows:
        given = SplatShRows(self.case.count, *(pointer(self.held[name]) for name in ("means", "sh")))
        given.radii = pointer(self.fields["radii"])
        whole = np.vstack([self.case.pose, [0.0, 0.0, 0.0, 1.0]])
        given.centre[:] = np.linalg.inv(whole)[:3, 3].tolist()
        return given

    def colours(self) -> np.ndarray:
        colours = self.at.empty("colours", (self.case.count, 3))
        self.library.call("splat_sh_colours", self.shot, self.sh_rows(), pointer(colours), None)
        return colours

    def given(self) -> SplatFeatures:
        """What is blended: features, or colours, with the depth; opacities with their factors."""
        case = self.case
        channels, fields = case.channels, self.fields
        stride = channels if channels <= INLINE_CHANNELS else -(-channels // 4) * 4
        rows = self.at.empty("features", (case.count, stride))
        rows[:] = 0.0
        plain = channels - case.depth
        rows[:, :plain] = self.colours() if "sh" in case.rows else case.rows["features"]
        if case.depth:
            rows[:, plain] = fields["depths"]
        opacities = self.at.put("opacities on screen", case.rows["opacities"].copy())
        if fields["compensations"] is not None:
            opacities *= fields["compensations"]
        given = SplatFeatures(channels=channels, stride=stride, alpha_max=case.alpha_max)
        for name in ("means2d", "depths", "covariances", "determinants", "slants", "radii"):
            setattr(given, name, pointer(fields[name]))
        given.features, given.opacities = pointer(rows), pointer(opacities)
        if case.background is not None:
            behind = np.append(case.background, [0.0] * case.depth).astype(np.float32)
            given.background = pointer(self.at.put("background", behind))
        self.kept = rows, opacities
        return given


def run_features(library: CudaLibrary, case: FeatureCase, capacity: int = 1 << 16, passes: int = 1) -> FeatureOutcome:
    """Run forward and, if there are upstream gradients, backward; assert that nothing was written out of bounds."""
    device = FeatureDevice(library, case)
    at, n, channels, (width, height) = device.at, case.count, case.channels, case.size
    device.project()
    given = device.given()
    capacity = max(capacity, n, 1)
    memory = at.empty("frame", (library.size("splat_frame_bytes", device.shot, n, capacity),), np.uint8)
    back = at.empty("back", (library.size("splat_feature_back_bytes", device.shot, n, capacity, channels),), np.uint8)
    frame = SplatFrame(pointer(memory), len(memory), pointer(back), len(back), n, capacity, passes)
    pictures = {
        "features": at.empty("features", (height, width, channels)),
        "alpha": at.empty("alpha", (height, width)),
    }
    to = SplatFeaturePictures(**{name: pointer(picture) for name, picture in pictures.items()})
    library.call("splat_blend_features", device.shot, given, frame, to, None)
    facts = SplatFrameFacts.from_buffer(memory)
    numbers = facts.pairs, facts.visible, facts.chunks
    gradients = back_features(device, given, frame) if case.upstream else {}
    assert not at.overrun(), f"written beside {at.overrun()}"
    return FeatureOutcome(pictures | {"radii": device.fields["radii"]}, gradients, numbers)


def back_features(device: FeatureDevice, given: SplatFeatures, frame: SplatFrame) -> dict[str, np.ndarray]:
    """Return the gradients of a frame by the case's rows, which the kernels add to what is there."""
    case, at, library = device.case, device.at, device.library
    n, plain = case.count, case.channels - case.depth
    planes = at.put("d features", np.ascontiguousarray(case.upstream["features"].transpose(2, 0, 1), np.float32))
    by_alpha = at.put("d alpha", np.ascontiguousarray(case.upstream["alpha"], np.float32))
    shapes = {"means2d": (n, 2), "covariances": (n, 3), "opacities": (n,), "features": (n, case.channels)}
    shapes |= {"slants": (n, 2)} if case.slanted else {}
    shapes |= {"magnitudes": (n, 2)} if case.magnitudes else {}

    def started(name: str, shape: tuple[int, ...]) -> np.ndarray:
        out = at.empty(f"d {name}", shape)
        out[...] = START
        return out

    screen = {name: started(name, shape) for name, shape in shapes.items()}
    library.call(
        "splat_blend_features_backward",
        *(device.shot, given, frame),
        SplatFeaturePictureGradients(pointer(planes), pointer(by_alpha)),
        SplatFeatureGradients(**{name: pointer(value) for name, value in screen.items()}),
        None,
    )
    screen = {name: at.put(name, value - START) for name, value in screen.items()}
    by_opacities, factors = screen["opacities"], device.fields["compensations"]
    by_factors = None if factors is None else at.put("d factors", by_opacities * case.rows["opacities"])
    by_depths = at.put("d depths", np.ascontiguousarray(screen["features"][:, -1])) if case.depth else None
    by = SplatProjectedGradients(
        *(pointer(screen["means2d"]), pointer(by_depths), pointer(screen["covariances"])),
        *(pointer(by_factors), pointer(screen.get("slants"))),
    )
    found = {name: started(name, case.rows[name].shape) for name in GAUSSIANS[:3]}
    radii, out = pointer(device.fields["radii"]), SplatActivatedGradients(*map(pointer, found.values()))
    library.call("splat_project_activated_backward", device.shot, device.how, device.gaussians, radii, by, out, None)
    by_features = at.put("d plain", np.ascontiguousarray(screen["features"][:, :plain]))
    if "sh" in case.rows:
        found["sh"] = started("sh", case.rows["sh"].shape)
        added = pointer(found["means"]), pointer(found["sh"])
        library.call("splat_sh_colours_backward", device.shot, device.sh_rows(), pointer(by_features), *added, None)
    found = {name: value - START for name, value in found.items()}
    found["opacities"] = by_opacities if factors is None else by_opacities * factors
    if "sh" not in case.rows:
        found["features"] = by_features
    return found | ({"magnitudes": screen["magnitudes"]} if case.magnitudes else {})
