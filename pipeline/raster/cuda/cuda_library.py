"""The CUDA kernels' shared library: loading and calling it, and why it cannot be used here.

Cheap to import: torch is imported only to check whether it can use the device too.
"""

from __future__ import annotations

import ctypes
import functools
import warnings
from ctypes import c_char_p, c_int32, c_int64
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline import native
from splatpipe.pipeline.engine.errors import CARD_HINT, MachineError
from splatpipe.pipeline.raster.cuda.cuda_api import ABI, CALLS, NO_KERNEL, SIZES, SplatDevice
from splatpipe.pipeline.raster.cuda.cuda_driver import driver, driver_release

LIBRARY = Path(native.__file__).parent / "libsplat_cuda.so"
NO_DEVICE = 100  # cudaErrorNoDevice, and the driver's code for it
DRIVERS = {11: "450.80.02", 12: "525.60.13", 13: "580.65.06"}
"""The minimum Linux driver for each major version of CUDA, whatever the minor version (CUDA Compatibility, NVIDIA,
"Minor version compatibility")."""


@dataclass(frozen=True)
class CudaDevice:
    """A device as the library sees it.

    Attributes:
        name: E.g. "NVIDIA H200".
        architecture: 10 · major + minor of its compute capability.
        driver: CUDA version that the driver knows, 1000 · major + 10 · minor; 0 without a driver.
        runtime: CUDA version that the library was built with.
        memory_bytes: Total memory.
        release: The driver's own version, e.g. "580.65.06"; "" if unknown.
    """

    name: str
    architecture: int
    driver: int
    runtime: int
    memory_bytes: int
    release: str = ""

    def described(self) -> str:
        """For manifests and problem reports: everything that may change the last bits."""
        known = f"CUDA {version_text(self.driver)}"
        versions = f"{self.release} ({known})" if self.release else known
        return f"cuda sm_{self.architecture} {self.name}, driver {versions}, kernels CUDA {version_text(self.runtime)}"


class CudaLibrary:
    """The loaded library.

    Args:
        path: Path of the shared object.

    Raises:
        MachineError: if it is missing, cannot be loaded, or has a different interface version.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            raise MachineError(f"There are no CUDA kernels at {path}.", _BUILT_WITHOUT.hint)
        try:
            self._functions = ctypes.CDLL(str(path))
            abi = self._functions.splat_abi()
            if abi != ABI:
                raise MachineError(f"The CUDA kernels' interface is version {abi}, not {ABI}.", _REINSTALL)
            self._functions.splat_error.argtypes, self._functions.splat_error.restype = (c_int32,), c_char_p
            for functions, result in ((SIZES, c_int64), (CALLS, c_int32)):
                for name, arguments in functions.items():
                    function = getattr(self._functions, name)
                    function.argtypes, function.restype = arguments, result
        except (OSError, AttributeError) as error:
            raise MachineError(f"The CUDA kernels cannot be loaded: {error}.", _REINSTALL) from error

    def size(self, name: str, *arguments: object) -> int:
        """Call one of ``SIZES``; returns a number of bytes.

        Raises:
            ValueError: if an argument is invalid.
        """
        result = int(getattr(self._functions, name)(*arguments))
        if result < 0:
            raise ValueError(f"{name}: {self.error(result)}")
        return result

    def call(self, name: str, *arguments: object) -> None:
        """Call one of ``CALLS``.

        Raises:
            ValueError: if an argument is invalid.
            MachineError: if the device fails.
        """
        code = int(getattr(self._functions, name)(*arguments))
        if code < 0:
            raise ValueError(f"{name}: {self.error(code)}")
        if code > 0:
            raise MachineError(
                f"The graphics card failed in {name}: {self.error(code)}.",
                hint=CARD_HINT,
            )

    def error(self, code: int) -> str:
        """The text of an error code."""
        text: bytes = self._functions.splat_error(code)
        return text.decode(errors="replace")

    def device(self, index: int) -> tuple[int, CudaDevice]:
        """The return code of querying a device, and the device; its versions are valid even on an error."""
        found = SplatDevice()
        code = int(self._functions.splat_device(index, ctypes.byref(found)))
        name = found.name.decode(errors="replace")
        versions = (found.driver, found.runtime)
        return code, CudaDevice(name, found.architecture, *versions, found.memory_bytes, driver_release())


@functools.cache
def load(path: Path = LIBRARY) -> CudaLibrary:
    """The library, loaded once; errors as in ``CudaLibrary``."""
    return CudaLibrary(path)


@dataclass(frozen=True)
class NoCuda:
    """Why CUDA cannot be used here.

    Attributes:
        reason: A sentence.
        hint: What to do about it.
    """

    reason: str
    hint: str

    def error(self) -> MachineError:
        """The error to raise if CUDA was requested explicitly."""
        return MachineError(f"CUDA does not work here. {self.reason}", self.hint)


@dataclass(frozen=True)
class CudaInstallation:
    """The facts that decide whether CUDA can be used here.

    Attributes:
        driver: CUDA version that the system's driver supports, 1000 · major + 10 · minor; 0 without a driver.
        driver_code: Return code of the driver's initialization; 0 for success.
        has_library: Whether this program came with CUDA kernels.
        library: Return code and properties of device 0 from the library; None if not queried.
        torch_cuda: CUDA version that torch was built with, "" without CUDA; None if not queried.
        torch_works: Whether torch can use the device.
    """

    driver: int
    driver_code: int = 0
    has_library: bool = True
    library: tuple[int, CudaDevice] | None = None
    torch_cuda: str | None = None
    torch_works: bool = True


_REINSTALL = "Reinstall splatpipe: its parts have different versions."
_NO_DRIVER = NoCuda("No NVIDIA driver is installed.", "With an NVIDIA graphics card, install its driver.")
_NO_DEVICE = NoCuda(
    "CUDA finds no NVIDIA graphics card.",
    "If there is one, check its driver with nvidia-smi; CUDA_VISIBLE_DEVICES and containers can hide it.",
)
_BUILT_WITHOUT = NoCuda(
    "This splatpipe was built without CUDA kernels.",
    "Install a build that has them, or build it where nvcc (CUDA 12 or 13) is installed.",
)
_TORCH_CPU = NoCuda(
    "The installed torch is a CPU-only build.",
    "Replace it by one with CUDA: see https://pytorch.org/get-started for the command.",
)


def reason_of(installed: CudaInstallation) -> NoCuda | None:
    """The first obstacle to using CUDA, or None if there is none."""
    if installed.driver == 0:
        return _NO_DRIVER
    if installed.driver_code == NO_DEVICE:
        return _NO_DEVICE
    if installed.driver_code:
        return NoCuda(f"The NVIDIA driver does not start (its error {installed.driver_code}).", _NO_DEVICE.hint)
    if not installed.has_library:
        return _BUILT_WITHOUT
    if installed.library is not None:
        code, device = installed.library
        if installed.driver // 1000 < device.runtime // 1000:
            return _too_old(installed)
        if code == NO_KERNEL:
            return NoCuda(
                f"The CUDA kernels were not built for {device.name} (sm_{device.architecture}).",
                "They are built for cards from sm_75 (Turing, 2018) on, and by `make run` for the card it finds: "
                "build splatpipe on this machine.",
            )
        if code:
            return NoCuda(f"The NVIDIA card does not answer (error {code}).", _NO_DEVICE.hint)
    if installed.torch_cuda == "":
        return _TORCH_CPU
    if installed.torch_cuda is not None and not installed.torch_works:
        if installed.driver // 1000 < _major(installed.torch_cuda):
            return _too_old(installed)
        return NoCuda("torch does not find the NVIDIA card.", "python -c 'import torch; torch.cuda.init()' says why.")
    return None


def unavailable_reason(path: Path = LIBRARY) -> NoCuda | None:
    """Why CUDA cannot be used here; None if it can. Checks cheap things first, and torch last.

    Args:
        path: Path of the library.
    """
    code, known = driver()
    installed = CudaInstallation(known, code, path.exists())
    if reason := reason_of(installed):
        return reason
    try:
        library = load(path).device(0)
    except MachineError as error:
        return NoCuda(error.message, error.hint)
    import torch

    built_with = torch.version.cuda or ""
    if reason := reason_of(CudaInstallation(known, code, True, library, built_with)):
        return reason
    with warnings.catch_warnings():  # torch warns at length about an old driver, which the result reports anyway
        warnings.simplefilter("ignore")
        works = torch.cuda.is_available()
    return reason_of(CudaInstallation(known, code, True, library, built_with, works))


def cannot_compute() -> NoCuda | None:
    """Why torch cannot compute on a card without known obstacles; None if it can.

    This runs a trial, which leaves a context of some hundred MB on the card: only for processes that will compute
    there.
    """
    import torch

    try:
        torch.ones(1, device="cuda").add_(1.0).cpu()
    except RuntimeError as error:
        said = str(error).strip().split("\n")[0].rstrip(".")
        return NoCuda(f"torch cannot compute on the NVIDIA card: {said}.", "nvidia-smi shows what else uses it.")
    return None


def version_text(version: int) -> str:
    """1000 · major + 10 · minor as "major.minor"."""
    return f"{version // 1000}.{version % 1000 // 10}"


def _major(version: str) -> int:
    """The major version of e.g. "13.0"; 0 for ""."""
    return int(version.split(".")[0] or 0)


def _too_old(installed: CudaInstallation) -> NoCuda:
    """The reason with the minimum driver for the kernels and torch, which may need different ones."""
    kernels = 0 if installed.library is None else installed.library[1].runtime // 1000
    built = {"the CUDA kernels": kernels, "the installed torch": _major(installed.torch_cuda or "")}
    known, most = installed.driver // 1000, max(built.values())
    newer = " and ".join(f"{name} (CUDA {major})" for name, major in built.items() if major > known)
    needed = f"{DRIVERS[most]} or newer" if most in DRIVERS else f"one for CUDA {most}"
    others = {
        "the CUDA kernels": f"splatpipe built here with CUDA {known}'s nvcc",
        "the installed torch": f"a torch for CUDA {known} (see https://pytorch.org/get-started for the command)",
    }
    instead = " and ".join(other for name, other in others.items() if built[name] > known)
    return NoCuda(
        f"The NVIDIA driver is too old: it supports CUDA {version_text(installed.driver)}, less than {newer} need.",
        f"Install a newer NVIDIA driver: {needed}. With the current driver, you need {instead}.",
    )
