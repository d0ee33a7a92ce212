"""Third-party parts of the wheel: each has its licence and is listed in the bill of materials (SBOM, CycloneDX)."""

import importlib.metadata
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from typing import Any

import pytest
import sbom
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from repository import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PURL = re.compile(r"pkg:(npm|cargo|pypi|generic)/[A-Za-z0-9%._/-]+(@[A-Za-z0-9.+_-]+)?")


@pytest.fixture(scope="module")
def bill(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("sbom") / "splatpipe.cdx.json"
    subprocess.run(
        [sys.executable, ROOT / "pipeline/native/sbom.py", path, "--nanobind", "3.1.0", "--cuda", "13.0"],
        check=True,
    )
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def test_the_bill_meets_cyclonedxs_schema(bill: dict[str, Any]) -> None:
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.6", 1)
    own = bill["metadata"]["component"]
    assert (own["name"], own["version"], own["type"]) == ("splatpipe", PROJECT["version"], "application")
    references = [each["bom-ref"] for each in (own, *bill["components"])]
    assert len(set(references)) == len(references)
    for each in bill["components"]:
        assert each["type"] == "library"
        assert each["name"]
        assert PURL.fullmatch(each["purl"]), each["purl"]
        assert all(set(one["license"]) in ({"id"}, {"name"}) for one in each.get("licenses", []))
        assert all(len(one["content"]) == 128 for one in each.get("hashes", []) if one["alg"] == "SHA-512")
    for each in bill["dependencies"]:
        assert {each["ref"], *each["dependsOn"]} <= set(references)


def test_every_package_in_a_page_is_in_the_bill_with_its_locked_version(bill: dict[str, Any]) -> None:
    locked = json.loads((ROOT / "pipeline/web/package-lock.json").read_text(encoding="utf-8"))["packages"]
    shipped = {path.removeprefix("node_modules/"): facts for path, facts in locked.items() if path}
    shipped = {name: facts["version"] for name, facts in shipped.items() if not facts.get("dev")}
    named = {each["name"]: each["version"] for each in bill["components"] if each["purl"].startswith("pkg:npm/")}
    assert named == shipped == sbom.bundled_npm()
    assert {"three", "uplot", "@sparkjsdev/spark"} <= set(named)


def test_every_package_in_a_page_has_its_own_licence_in_the_wheel() -> None:
    heads = "".join(head for text in sbom.bundle_texts() for head in sbom.HEAD.findall(text))
    for name, version in sbom.bundled_npm().items():
        text = sbom.licence_file(name).read_text(encoding="utf-8").strip()
        assert f"{name} {version}\n{text}\n" in heads.replace("* /", "*/"), name


def test_bundled_code_has_a_licence_in_the_wheel(bill: dict[str, Any]) -> None:
    taken = {path for pattern in PROJECT["license-files"] for path in ROOT.glob(pattern)}
    for name in sbom.bundled_names(bill):
        if name != "cuda-runtime":  # its toolkit has it, and CMake puts it into a wheel with CUDA
            assert sbom.licence_file(name) in taken, name
    named = {part for part in PROJECT["license"].split() if part != "AND"}
    bundled = [one["license"] for each in bill["components"] for one in each.get("licenses", [])]
    assert {one["id"] for one in bundled if "id" in one} <= named


def test_every_crate_in_a_page_is_named_with_its_licence(bill: dict[str, Any]) -> None:
    text = (sbom.LICENCES / "spark-crates.txt").read_text(encoding="utf-8")
    words = set(re.findall(r"[\w-]+", text))
    crates = [each["name"] for each in bill["components"] if each["purl"].startswith("pkg:cargo/")]
    assert "zlib-rs" in crates
    assert set(crates) <= words


def needed_by(requirements: Iterable[str]) -> set[str]:
    """All distributions that these lead to, as they are installed here."""
    found: set[tuple[str, frozenset[str]]] = set()
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        requirement = waiting.pop()
        key = (canonicalize_name(requirement.name), frozenset(requirement.extras))
        if key in found:
            continue
        found.add(key)
        for text in importlib.metadata.requires(requirement.name) or []:
            other = Requirement(text)
            extras = ["", *requirement.extras]
            if other.marker is None or any(other.marker.evaluate({"extra": extra}) for extra in extras):
                waiting.append(other)
    return {name for name, _ in found}


def test_the_bill_lists_a_runs_dependencies_with_the_tested_versions(bill: dict[str, Any]) -> None:
    named = {
        canonicalize_name(each["name"]): each for each in bill["components"] if each["purl"].startswith("pkg:pypi/")
    }
    gpu = {name for name in needed_by(PROJECT["dependencies"]) if name.startswith(("nvidia-", "cuda-", "triton"))}
    assert set(named) == needed_by(PROJECT["dependencies"]) - gpu  # torch with CUDA brings those, and pins them itself
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert all(f"{each['name']}=={each['version']}" in pinned for each in named.values())
