"""Which devices a CUDA library has kernels for, by the architectures that it was compiled for."""

from __future__ import annotations

import ctypes

import pytest
from building import NATIVE, build_on_cpu, load

from splatpipe.pipeline.raster.cuda.cuda_api import NO_KERNEL, SplatDevice


def open_library(built_for: str) -> tuple[int, SplatDevice]:
    """Return what a library compiled for some architectures, as nvcc lists them, reports for the harness's device."""
    library = load(build_on_cpu([NATIVE / "cuda" / "device.cu"], "device", flags=[f"-D__CUDA_ARCH_LIST__={built_for}"]))
    device = SplatDevice()
    return library.splat_device(0, ctypes.byref(device)), device


@pytest.mark.parametrize(
    ("built_for", "has_kernels"),
    [
        ("{same}", True),
        ("500,{same}", True),
        ("500", True),  # PTX of the last is compiled by the driver
        ("{newer_minor}", False),
        ("500,{newer}", False),
    ],
)
def test_kernels_exist_for_the_family_and_as_ptx_for_newer_devices(built_for, has_kernels):
    _, device = open_library("500")
    architecture = 10 * device.architecture
    assert architecture > 500
    built_for = built_for.format(same=architecture, newer_minor=architecture + 10, newer=architecture + 100)
    code, reported = open_library(built_for)
    assert code == (0 if has_kernels else NO_KERNEL)
    assert reported.architecture == device.architecture
    assert reported.runtime > 0


def test_no_such_device_is_an_error_and_codes_have_texts():
    library = load(build_on_cpu([NATIVE / "cuda" / "device.cu"], "device"))
    library.splat_error.restype = ctypes.c_char_p
    device = SplatDevice()
    code = library.splat_device(99, ctypes.byref(device))
    assert code > 0
    assert {library.splat_error(code) for code in (0, -1, -2, NO_KERNEL)} == {
        b"no error",
        b"an argument makes no sense",
        b"less memory than was asked for",
        b"no kernel for this device",
    }
