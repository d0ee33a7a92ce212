"""The CUDA library's ctypes declarations, how it is loaded, and the errors if it cannot be used."""

import ctypes
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from building import build_on_cpu
from repository import ROOT

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.cuda import cuda_api, cuda_driver, cuda_library
from splatpipe.pipeline.raster.cuda.cuda_library import CudaDevice, CudaInstallation, CudaLibrary, reason_of

NATIVE = ROOT / "pipeline" / "native"
API = "".join((NATIVE / name).read_text() for name in ("cuda/api.h", "raster/shot.h"))
H200 = CudaDevice("NVIDIA H200", 90, 13000, 13000, 150_000_000_000)
GOOD = CudaInstallation(13000, library=(0, H200), torch_cuda="12.8")


def build(source: str, out: Path, *flags: str) -> None:
    subprocess.run(
        ["g++", "-std=c++17", "-x", "c++", "-", f"-I{NATIVE}", "-o", str(out), *flags],
        input=source,
        text=True,
        check=True,
    )


def fields_of(structure: type[ctypes.Structure]) -> dict[str, tuple[int, int]]:
    """Offset and size of each field, as ctypes lays them out."""
    return {name: (getattr(structure, name).offset, getattr(structure, name).size) for name, *_ in structure._fields_}


def test_structures_are_those_of_the_header(tmp_path):
    names = set(re.findall(r"^} (Splat\w+);", API, re.MULTILINE))
    assert names == {structure.__name__ for structure in cuda_api.STRUCTURES}
    lines = ['std::printf("{\\n");']
    for structure in cuda_api.STRUCTURES:
        name = structure.__name__
        lines.append(f'std::printf("\\"{name}\\": [%zu, {{", sizeof({name}));')
        for field in fields_of(structure):
            size = f"sizeof((({name}*)nullptr)->{field})"
            lines.append(f'std::printf("\\"{field}\\": (%zu, %zu), ", offsetof({name}, {field}), {size});')
        lines.append('std::printf("}],\\n");')
    lines.append('std::printf("}\\n");')
    includes = '#include "cuda/api.h"\n#include <cstddef>\n#include <cstdio>\n'
    build(f"{includes}int main() {{ {' '.join(lines)} }}", tmp_path / "sizes")
    printed = subprocess.run([tmp_path / "sizes"], capture_output=True, text=True, check=True).stdout
    expected = eval(printed)
    for structure in cuda_api.STRUCTURES:
        assert [ctypes.sizeof(structure), fields_of(structure)] == expected[structure.__name__], structure.__name__


def test_functions_and_constants_are_those_of_the_header():
    declared = {}
    for returns, name, arguments in re.findall(r"SPLAT_API ([\w ]+\*?) ?(splat_\w+)\(([^)]*)\);", API):
        declared[name] = (returns.strip(), 0 if arguments == "void" else len(arguments.split(",")))
    mirrored = {name: ("int64_t", len(arguments)) for name, arguments in cuda_api.SIZES.items()}
    mirrored |= {name: ("int32_t", len(arguments)) for name, arguments in cuda_api.CALLS.items()}
    assert declared == mirrored | {"splat_abi": ("int32_t", 0), "splat_error": ("const char*", 1)}
    assert int(re.search(r"#define SPLAT_CUDA_ABI (\d+)", API)[1]) == cuda_api.ABI
    assert int(re.search(r"#define SPLAT_ADAM_TENSORS (\d+)", API)[1]) == cuda_api.ADAM_TENSORS
    assert int(re.search(r"SPLAT_NO_KERNEL = (-?\d+)", API)[1]) == cuda_api.NO_KERNEL


def test_a_missing_library_is_reported(tmp_path):
    with pytest.raises(MachineError, match="no CUDA kernels at"):
        CudaLibrary(tmp_path / "libsplat_cuda.so")


def test_a_library_with_another_interface_is_refused(tmp_path):
    build('extern "C" int splat_abi() { return 99; }', tmp_path / "other.so", "-shared", "-fPIC")
    with pytest.raises(MachineError, match="version 99, not"):
        CudaLibrary(tmp_path / "other.so")
    (tmp_path / "broken.so").write_bytes(b"\x7fELF and no more")
    with pytest.raises(MachineError, match="cannot be loaded"):
        CudaLibrary(tmp_path / "broken.so")
    build('extern "C" int splat_abi() { return ' + f"{cuda_api.ABI}; }}", tmp_path / "half.so", "-shared", "-fPIC")
    with pytest.raises(MachineError, match=r"cannot be loaded: .*splat_error"):
        CudaLibrary(tmp_path / "half.so")


def test_a_good_installation_has_no_obstacle():
    assert reason_of(GOOD) is None
    newer = replace(GOOD, library=(0, replace(H200, driver=13000, runtime=13020)))
    assert reason_of(newer) is None  # minor versions of CUDA 13 run on its first driver


@pytest.mark.parametrize(
    ("installed", "reason", "hint"),
    [
        (CudaInstallation(0), "No NVIDIA driver", "install its driver"),
        (CudaInstallation(12080, driver_code=100), "no NVIDIA graphics card", "nvidia-smi"),
        (CudaInstallation(12080, driver_code=803), "driver does not start .*803", "nvidia-smi"),
        (CudaInstallation(13000, has_library=False), "built without CUDA kernels", "nvcc"),
        (
            replace(GOOD, driver=12080),
            r"too old: it supports CUDA 12.8, less than the CUDA kernels \(CUDA 13\) need",
            "driver: 580.65.06 or newer.*you need splatpipe built here with CUDA 12's nvcc.$",
        ),
        (
            replace(GOOD, driver=12080, torch_cuda="13.0", torch_works=False),
            r"less than the CUDA kernels \(CUDA 13\) and the installed torch \(CUDA 13\) need",
            "580.65.06 or newer.*CUDA 12's nvcc and a torch for CUDA 12",
        ),
        (
            replace(GOOD, driver=11080, library=(0, replace(H200, runtime=12080)), torch_cuda="13.0"),
            "CUDA 12",
            "580.65",
        ),
        (replace(GOOD, library=(-3, replace(H200, architecture=61))), r"not built for NVIDIA H200 \(sm_61\)", "sm_75"),
        (replace(GOOD, library=(999, H200)), "does not answer", "nvidia-smi"),
        (replace(GOOD, torch_cuda="", torch_works=False), "torch is a CPU-only build", "pytorch.org"),
        (
            replace(
                GOOD, driver=12080, library=(0, replace(H200, runtime=12080)), torch_cuda="13.0", torch_works=False
            ),
            r"too old: it supports CUDA 12.8, less than the installed torch \(CUDA 13\) need",
            "580.65.06 or newer.*you need a torch for CUDA 12 ",
        ),
        (replace(GOOD, torch_works=False), "torch does not find", "torch.cuda.init"),
    ],
)
def test_each_reason_is_reported_with_what_to_do(installed, reason, hint):
    found = reason_of(installed)
    assert found is not None
    assert re.search(reason, found.reason), found.reason
    assert re.search(hint, found.hint), found.hint


def test_finding_the_reason_imports_no_torch_without_a_device():
    code = """
import sys
from splatpipe.pipeline.raster.cuda import cuda_library
assert "torch" not in sys.modules
found = cuda_library.unavailable_reason()
assert "torch" not in sys.modules or cuda_library.driver() != (0, 0)
print(found)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(("NoCuda(reason=", "None"))


@pytest.fixture(scope="module")
def fake_driver(tmp_path_factory) -> Path:
    """A folder with a fake driver library that reports what its environment variables specify."""
    folder = tmp_path_factory.mktemp("driver")
    source = """
#include <cstdlib>
extern "C" int cuDriverGetVersion(int* version) { *version = std::atoi(std::getenv("FAKE_VERSION")); return 0; }
extern "C" int cuInit(unsigned) { return std::atoi(std::getenv("FAKE_INIT")); }
"""
    build(source, folder / "libcuda.so.1", "-shared", "-fPIC")
    source = """
#include <cstdio>
#include <cstdlib>
extern "C" int nvmlInit_v2() { return 0; }
extern "C" int nvmlSystemGetDriverVersion(char* text, unsigned bytes) {
  return std::snprintf(text, bytes, "%s", std::getenv("FAKE_RELEASE")) < 0;
}
extern "C" int nvmlShutdown() { return 0; }
"""
    build(source, folder / "libnvidia-ml.so.1", "-shared", "-fPIC")
    return folder


@pytest.mark.parametrize(
    ("version", "init", "has_kernels", "reason"),
    [
        (13000, 100, True, "no NVIDIA graphics card"),
        (13000, 0, False, "built without CUDA kernels"),
        (12080, 0, True, "too old: it supports CUDA 12.8, less than the CUDA kernels (CUDA 13)"),
        (13000, 0, True, "torch does not find" if torch.version.cuda else "torch is a CPU-only build"),
    ],
)
def test_the_systems_state_leads_to_the_reason(fake_driver, version, init, has_kernels, reason):
    library = build_on_cpu() if has_kernels else fake_driver / "libsplat_cuda.so"
    code = f"""
from pathlib import Path
from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason
print(unavailable_reason(Path({str(library)!r})).reason)
"""
    environment = os.environ | {
        "LD_LIBRARY_PATH": str(fake_driver),
        "FAKE_VERSION": f"{version}",
        "FAKE_INIT": f"{init}",
    }
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert reason in done.stdout


def test_a_devices_description_includes_what_may_change_its_bits():
    assert H200.described() == "cuda sm_90 NVIDIA H200, driver CUDA 13.0, kernels CUDA 13.0"
    known = replace(H200, release="580.65.06").described()
    assert known == "cuda sm_90 NVIDIA H200, driver 580.65.06 (CUDA 13.0), kernels CUDA 13.0"
    assert cuda_library.version_text(12080) == "12.8"


@pytest.mark.parametrize(
    ("content", "release"),
    [
        (
            b"NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.183.01  Sun May 12 19:39:15 UTC 2024\nGCC",
            "535.183.01",
        ),
        (b"NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.65.06  Release Build  (dvs)\n", "580.65.06"),
        (b"NVRM version: NVIDIA UNIX x86_64 Kernel Module  470.86  Tue Oct 26 21:55:45 UTC 2021\n", "470.86"),
        (b"", ""),
        (b"\xff\x00" * 100_000 + b"580.65.06", ""),
        (b"GCC version\n580.65.06\n", ""),
    ],
)
def test_the_drivers_own_version_is_the_kernels(tmp_path, monkeypatch, content, release):
    monkeypatch.setattr(cuda_driver, "_nvml_version", lambda: "")
    assert cuda_driver.driver_release(tmp_path) == ""
    file = tmp_path / "proc" / "driver" / "nvidia" / "version"
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    assert cuda_driver.driver_release(tmp_path) == release


@pytest.mark.parametrize(("text", "release"), [("577.00", "577.00"), ("580.65.06", "580.65.06"), ("\\xff?", "")])
def test_if_the_kernel_does_not_report_the_version_nvml_does(fake_driver, tmp_path, text, release):
    code = f"""
from pathlib import Path
from splatpipe.pipeline.raster.cuda.cuda_driver import driver_release
print(repr(driver_release(Path({str(tmp_path)!r}))))
"""
    environment = os.environ | {"LD_LIBRARY_PATH": str(fake_driver), "FAKE_RELEASE": text}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.strip() == repr(release)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, False),
        ({"dev/nvidiactl": ""}, False),
        ({"dev/nvidia0": ""}, True),
        ({"proc/driver/nvidia/gpus/0000:01:00.0/information": ""}, True),
        ({"sys/bus/pci/devices/0/vendor": "0x8086\n", "sys/bus/pci/devices/0/class": "0x030000\n"}, False),
        ({"sys/bus/pci/devices/0/vendor": "0x10de\n", "sys/bus/pci/devices/0/class": "0x020700\n"}, False),
        ({"sys/bus/pci/devices/0/vendor": "0x10de\n", "sys/bus/pci/devices/0/class": "0x030200\n"}, True),
    ],
)
def test_a_card_is_seen_with_and_without_its_driver(tmp_path, files, expected):
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    assert cuda_driver.has_card(tmp_path) == expected
