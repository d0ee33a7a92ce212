"""Measure the machine's performance ceilings beside every benchmark: ``python benchmarks ceilings --threads N``."""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import tempfile
from pathlib import Path

from splatpipe.pipeline.native import _native

SOURCE = Path(__file__).with_name("ceilings.cpp")
FLAGS = {"avx512": ["-mavx512f", "-mprefer-vector-width=512", "-DLANES=16"], "avx2": ["-mavx2", "-mfma", "-DLANES=8"]}
PLAIN = ["-DLANES=4"]  # SSE2 and NEON: four floats


@functools.cache
def measure_ceilings(threads: int) -> dict[str, float | str]:
    """Compile the small C++ program for this CPU's best instruction set, and run it.

    Args:
        threads: Concurrent threads, each with its own registers and memory.

    Returns:
        ``fma_gflops_per_core`` (an FMA counts as two; by CPU time, with all threads busy), ``gproducts_per_core`` (of
            8-bit numbers, summed to 32 bits, by VNNI or AVX2, else as floats), ``copy_gb_s`` of all threads together
            (bytes read and written both count), and the ``ceiling_isa`` that they were measured with.
    """
    isa = _native.isas()[0]
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "ceilings"
        flags = ["-std=c++17", "-O3", *FLAGS.get(isa, PLAIN), "-pthread"]
        subprocess.run([os.environ.get("CXX", "c++"), *flags, str(SOURCE), "-o", str(program)], check=True)
        found = json.loads(subprocess.run([program, str(threads)], check=True, capture_output=True).stdout)
    return {
        "fma_gflops_per_core": round(found["gflops"], 2),
        "gproducts_per_core": round(found["gproducts"], 2),
        "copy_gb_s": round(found["copy_gb_s"], 2),
        "ceiling_isa": isa,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    print(json.dumps(measure_ceilings(parser.parse_args().threads), indent=1))


if __name__ == "__main__":
    main()
