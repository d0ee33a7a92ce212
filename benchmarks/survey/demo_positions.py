"""Place a finished run of the demo by accurate positions alone: ``demo_positions OUT [--seeds 20]``.

The true camera centres with the noise of ``position_scenes`` (white, drifting and common), stated to 1.4 and 2.1 cm, go
through the stage `georef` with all surveyed points as check points. RMS errors of these points over all seeds, in GSD
and over the standard deviation that is stated for a typical point, and the share of seeds in which the 95 % interval
that is stated for all points together holds their mean error.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from measure import SilentReporter
from position_scenes import STATED_M, stated_positions
from tables import Row, print_table

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.engine.runs.run_folder import RunFolder, open_run_folder
from splatpipe.pipeline.engine.stage import JSON, Inputs
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.uncertainty import NORMAL_95
from splatpipe.stages.georef import run as georef
from splatpipe.stages.line import GEOREF, LINE

TRUTH: dict[str, Any] = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))
PLACE = Origin(**TRUTH["frame"]["origin"])
AXES = "ENU"
COLUMNS = {
    "seeds": "seeds:",
    "adopted": "adopted:",
    **{f"GSD {axis}": f"rmse_{axis}:.2f" for axis in AXES},
    **{f"/sigma {axis}": f"sigma_{axis}:.2f" for axis in AXES},
    **{f"held {axis}": f"held_{axis}:.2f" for axis in AXES},
}


def drawn_positions(stated: dict[str, Any], seed: int) -> dict[str, Any]:
    """The contents of ``positions.json`` with the truth and an RTK receiver's noise."""
    centres = np.array([photo["centre_m"] for photo in TRUTH["photos"]])
    drawn, _ = stated_positions(centres, "none", np.random.default_rng([7, seed]))
    places = dict(zip([photo["name"] for photo in TRUTH["photos"]], PLACE.geodetic_from_enu(drawn.stated), strict=True))
    known = {
        "rtk": "fixed",
        "source": "xmp",
        "altitude_source": "rtk",
        "sigma_source": "xmp",
        "vertical": "ellipsoidal",
    }
    known |= {"sigma_horizontal_m": float(STATED_M[0]), "sigma_vertical_m": float(STATED_M[2])}
    for record in stated["positions"]:
        latitude, longitude, height_m = places[record["name"]].tolist()
        record |= {**known, "latitude": latitude, "longitude": longitude, "altitude_m": height_m}
    return stated


def placed_anew(folder: RunFolder, photos_dir: Path, seed: int) -> tuple[Float64[np.ndarray, "n 3"], JSON]:
    """Errors of the check points, metres, and the stage's ``accuracy.json``."""
    parts = {name: part.path for name, part in folder.lineage(GEOREF).items()}
    control = CAPTURE / "gcp_list.txt"
    names = sorted({line.split()[-1] for line in control.read_text("utf-8").splitlines()[1:]})
    whole = json.loads(parts["ingest.positions"].read_text("utf-8"))
    parts |= {"source.control": control, "source.boundary": photos_dir / "boundary.geojson"}
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        parts["ingest.positions"] = work / "positions.json"
        parts["ingest.positions"].write_text(json.dumps(drawn_positions(whole, seed)), "utf-8")
        config = GeorefConfig(check_points=",".join(names))
        georef(config, Inputs(parts, photos_dir, {"sparse.lens": "auto"}), work, SilentReporter())
        points = json.loads((work / "control.json").read_text("utf-8"))["points"]
        accuracy = json.loads((work / "accuracy.json").read_text("utf-8"))
    return np.array([point["residual_m"] for point in points]), accuracy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    folder = open_run_folder(given.out, LINE)
    photos_dir, _ = folder.settings()
    found = [placed_anew(folder, photos_dir, seed) for seed in range(given.seeds)]
    errors = np.array([each for each, _ in found])
    adjustments = [accuracy["adjustment"] for _, accuracy in found]
    typical = np.array([each["heights"]["typical_sigma_m"] for each in adjustments])
    together = np.array([each["heights"]["together_sigma_m"] for each in adjustments])
    rmse = np.sqrt((errors**2).mean(axis=(0, 1)))
    values = {
        "rmse": rmse / found[0][1]["gsd_m"],
        "sigma": rmse / np.sqrt((typical**2).mean(axis=0)),
        "held": (np.abs(errors.mean(axis=1)) <= NORMAL_95 * together).mean(axis=0),
    }
    row: Row = {"seeds": given.seeds, "adopted": sum(each["adopted"] for each in adjustments)}
    row |= {
        f"{key}_{axis}": float(value) for key, each in values.items() for axis, value in zip(AXES, each, strict=True)
    }
    print_table("check points, no control", [row], COLUMNS)


if __name__ == "__main__":
    main()
