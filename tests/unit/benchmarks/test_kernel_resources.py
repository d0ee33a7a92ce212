"""The table of the CUDA kernels' registers, spills and shared memory reads what the compiler says."""

import pytest
from kernel_resources import KernelResources, kernel_name, resources_in, spills, table

SAID = """
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function '_Z11rest_kernelILb1EEv' for 'sm_90'
ptxas info    : Function properties for _Z11rest_kernelILb1EEv
    8 bytes stack frame, 8 bytes spill stores, 4 bytes spill loads
ptxas info    : Used 128 registers, used 1 barriers, 8 bytes cumulative stack size, 37392 bytes smem
ptxas info    : Compile time = 4303.785 ms
ptxas info    : Function properties for _Z9bin_chunk
    16 bytes stack frame, 20 bytes spill stores, 0 bytes spill loads
ptxas info    : Compiling entry function '_Z4plain' for 'sm_120a'
ptxas info    : Function properties for _Z4plain
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 24 registers, used 0 barriers, 400 bytes cmem[0]
"""
FOUND = [
    KernelResources("frame.cu", "_Z11rest_kernelILb1EEv", 90, 128, 32, 37392),
    KernelResources("frame.cu", "_Z4plain", 120, 24, 0, 0),
]


def test_output_of_the_compiler_is_read_with_the_functions_that_a_kernel_calls() -> None:
    assert list(resources_in(SAID, "frame.cu")) == FOUND
    assert list(resources_in("ptxas info    : 0 bytes gmem", "device.cu")) == []  # no kernels
    with pytest.raises(AssertionError, match="says nothing of _Z4plain"):
        list(resources_in(SAID.replace("Used 24", "Took 24"), "frame.cu"))


@pytest.mark.parametrize(
    ("demangled", "name"),
    [
        ("void splat::cuda::(anonymous namespace)::rest_kernel<true>(splat::cuda::Job, int)", "rest_kernel<true>"),
        ("splat::cuda::(anonymous namespace)::adam_kernel(splat::cuda::(anonymous namespace)::Step)", "adam_kernel"),
        ("void splat::cuda::back<true, false>(splat::cuda::Job)", "back<true, false>"),
        ("_Z4plain", "_Z4plain"),
    ],
)
def test_names_of_kernels_are_short(demangled: str, name: str) -> None:
    assert kernel_name(demangled) == name


def test_table_is_of_one_device_and_spills_are_of_all() -> None:
    lines = table(FOUND, 90)
    assert lines[0].startswith("| sm_90 |") and lines[2:] == [
        "| frame.cu: `_Z11rest_kernelILb1EEv` | 128 | 32 | 37,392 |"
    ]
    assert spills(FOUND) == ["- `_Z11rest_kernelILb1EEv`: 32 on sm_90"]
