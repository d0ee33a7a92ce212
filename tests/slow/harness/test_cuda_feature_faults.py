"""Every mistake planted in the CUDA kernels of features is caught by checks that the sources themselves pass."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from exact_features import exact_features, feature_case
from faults import planted
from feature_agreement import FeatureTruth
from feature_faults import FEATURE_FAULTS
from feature_frames import FeatureCase
from repository import HARNESS


def ending() -> FeatureCase:
    """More translucent Gaussians in a tile than a batch, then walls that hide all others; many channels."""
    case = feature_case(2, 700, 33, (30, 17), compensate=True, alpha_max=0.87, options=(1e10, 0.3, 0.0, 0.9, 0.0))
    rows = {name: values.copy() for name, values in case.rows.items()}
    rows["means"] = ((rows["means"] - [0.0, 0.0, 4.0]) * [0.2, 0.2, 0.4] + [0.0, 0.0, 4.0]).astype(np.float32)
    rows["opacities"] *= np.float32(0.05)
    walls = np.arange(700) % 70 == 0
    rows["means"][walls] = [0.0, 0.0, 4.3]
    rows["scales"][walls], rows["opacities"][walls] = 9.0, 0.99
    return case.changed(rows=rows)


def slanted() -> FeatureCase:
    """Depths that vary within Gaussians, some of which reach the camera's plane."""
    return feature_case(
        5, 150, 3, (37, 18), depth=True, slanted=True, magnitudes=True, options=(9.0, 0.2, 8.0, 0.0, 0.0)
    )


def wide_slanted() -> FeatureCase:
    """The same as the last of several groups, with magnitudes of all of them."""
    return feature_case(6, 90, 16, (33, 18), depth=True, slanted=True, magnitudes=True)


def coloured() -> FeatureCase:
    """More coefficients than are used, a pose that scales, and Gaussians that are nowhere."""
    case = feature_case(9, 300, 3, (33, 18), sh_degree=2, magnitudes=True)
    case.rows["means"][::40] = np.nan
    return case.changed(pose=case.pose * 1.5)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the findings with no fault active, and with each."""
    cases = (coloured(), slanted(), wide_slanted(), ending())
    truth = FeatureTruth([(case, exact_features(case)) for case in cases])
    path = tmp_path_factory.mktemp("faults") / "truth.pickle"
    path.write_bytes(pickle.dumps(truth))
    library = planted(FEATURE_FAULTS, "splat_cuda_with_feature_faults")
    command = [sys.executable, str(HARNESS / "checking.py"), str(library), str(path), str(len(FEATURE_FAULTS))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answers: list[str] = json.loads(done.stdout)
    return answers


def test_sources_without_a_fault_pass_every_check(found: list[str]) -> None:
    """Nor is their behaviour undefined: an unaligned load, an error on every GPU, would end the process."""
    assert found[0] == ""


@pytest.mark.parametrize("number", range(len(FEATURE_FAULTS)), ids=[fault.name for fault in FEATURE_FAULTS])
def test_fault_is_found(found: list[str], number: int) -> None:
    assert found[1 + number], FEATURE_FAULTS[number]
