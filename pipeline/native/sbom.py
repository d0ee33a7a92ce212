"""The wheel's bill of materials (SBOM): a CycloneDX 1.6 file of its third-party contents and its dependencies.

CMake runs it after the pages are bundled; the wheel has the file in its ``*.dist-info/sboms`` (PEP 770). It needs
only Python, and the same sources give the same bytes. The contents of a page's script are read from the script:
esbuild's list of licences at its top, and the crates that Spark's WebAssembly names in its messages.
"""

from __future__ import annotations

import argparse
import base64
import json
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DIST = ROOT / "pipeline" / "web" / "dist"
LICENCES = Path(__file__).resolve().parent / "licences"
NEEDED = "# What a run needs"  # the section of constraints.txt
BUNDLED = "splatpipe:bundled"  # whether a component's code is in the wheel
NATIVE = {"nanobind": "BSD-3-Clause", "robin-map": "MIT"}  # in the kernels' module, the second as a part of the first
CUDA = "LicenseRef-NVIDIA-CUDA-EULA"
HEAD = re.compile(r"^/\*! With:\n(.*?)^\*/", re.MULTILINE | re.DOTALL)
PACKAGE = re.compile(r"^((?:@[\w.-]+/)?[\w.-]+) (\d+\.\d+\.\d+\S*)$", re.MULTILINE)
WASM = re.compile(r"AGFzbQ[A-Za-z0-9+/]{20000,}={0,2}")  # base64 of a module's first bytes, and long
CRATE = re.compile(rb"registry/src/[\w.-]+/([\w-]+?)-(\d+\.\d+\.\d+)/")

Component = dict[str, Any]


def main() -> int:
    """Write the file and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--nanobind", required=True, help="Version of nanobind that the kernels' module was made with.")
    parser.add_argument("--cuda", default="", help="Version of the CUDA runtime in libsplat_cuda.so, if there is one.")
    arguments = parser.parse_args()
    text = json.dumps(bill(arguments.nanobind, arguments.cuda), indent=2, ensure_ascii=False)
    arguments.output.write_text(text + "\n", encoding="utf-8")
    return 0


def bill(nanobind: str, cuda: str = "") -> dict[str, Any]:
    """The whole file.

    Args:
        nanobind: Version of nanobind.
        cuda: Version of the CUDA runtime; empty without one.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own = component("pypi", project["name"], project["version"], project["license"], kind="application")
    packages, crates = list(npm_packages()), list(crates_of(bundle_texts()))
    native = [component("generic", name, nanobind if name == "nanobind" else "", NATIVE[name]) for name in NATIVE]
    if cuda:
        native.append(component("generic", "cuda-runtime", cuda, CUDA))
    needed = [component("pypi", name, version, bundled=False) for name, version in tested_versions()]
    spark = [each["bom-ref"] for each in packages if each["name"] == "@sparkjsdev/spark"]
    own["licenses"] = [{"expression": project["license"]}]
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": own},
        "components": [*packages, *crates, *native, *needed],
        "dependencies": [
            {"ref": own["bom-ref"], "dependsOn": [each["bom-ref"] for each in (*packages, *native, *needed)]},
            *({"ref": ref, "dependsOn": [each["bom-ref"] for each in crates]} for ref in spark),
        ],
    }


def component(
    registry: str, name: str, version: str, licence: str = "", *, kind: str = "library", bundled: bool = True
) -> Component:
    """A CycloneDX component; its package URL is also its reference."""
    known = name.lower().replace("_", "-") if registry == "pypi" else name.replace("@", "%40")
    purl = f"pkg:{registry}/{known}" + (f"@{version}" if version else "")
    found: Component = {"type": kind, "bom-ref": purl, "name": name, "purl": purl}
    if version:
        found["version"] = version
    if licence:
        is_ours = licence.startswith("LicenseRef-")
        found["licenses"] = [{"license": {"name": licence} if is_ours else {"id": licence}}]
    if kind == "library":
        found["scope"] = "required"
        found["properties"] = [{"name": BUNDLED, "value": str(bundled).lower()}]
    return found


def bundle_texts() -> list[str]:
    """Every page's script.

    Raises:
        FileNotFoundError: if they have not been bundled.
    """
    scripts = sorted(DIST.glob("*.js"))
    if not scripts:
        raise FileNotFoundError(f"no scripts in {DIST}: pipeline/web/build.py makes them")
    return [path.read_text(encoding="utf-8") for path in scripts]


def bundled_npm() -> dict[str, str]:
    """Each npm package that is in a page's script, and its version."""
    return dict(pair for text in bundle_texts() for head in HEAD.findall(text) for pair in PACKAGE.findall(head))


def npm_packages() -> Iterator[Component]:
    """The bundled npm packages, with the lock file's licences and digests."""
    locked = json.loads((ROOT / "pipeline/web/package-lock.json").read_text(encoding="utf-8"))["packages"]
    for name, version in sorted(bundled_npm().items()):
        facts = locked[f"node_modules/{name}"]
        if facts["version"] != version:
            raise ValueError(f"{name} {version} is bundled, and {facts['version']} locked: run pipeline/web/build.py")
        found = component("npm", name, version, facts["license"])
        algorithm, _, digest = facts["integrity"].partition("-")
        found["hashes"] = [{"alg": algorithm.upper().replace("SHA", "SHA-"), "content": base64.b64decode(digest).hex()}]
        yield found


def crates_of(texts: Iterable[str]) -> Iterator[Component]:
    """The crates named in a script's WebAssembly; crates without error messages may be missing."""
    found = set()
    for text in texts:
        for packed in WASM.findall(text):
            module = base64.b64decode(packed + "=" * (-len(packed) % 4))
            found |= {(name.decode(), version.decode()) for name, version in CRATE.findall(module)}
    for name, version in sorted(found):
        yield component("cargo", name, version)


def tested_versions() -> list[tuple[str, str]]:
    """Run-time dependencies, with the versions in constraints.txt."""
    _, _, rest = (ROOT / "constraints.txt").read_text(encoding="utf-8").partition(NEEDED)
    lines = rest.partition("\n")[2].partition("\n#")[0].split()
    return [(name, version) for name, _, version in (line.partition("==") for line in lines)]


def licence_file(name: str) -> Path:
    """Path of the licence of an npm package or library."""
    return LICENCES / f"{name.lstrip('@').replace('/', '-')}.txt"


def bundled_names(found: Mapping[str, Any]) -> list[str]:
    """The npm packages and libraries of a bill whose code is in the wheel."""
    inside = {"name": BUNDLED, "value": "true"}
    chosen = [each for each in found["components"] if inside in each["properties"]]
    return [each["name"] for each in chosen if not each["purl"].startswith("pkg:cargo/")]


if __name__ == "__main__":
    sys.exit(main())
