"""A simulated block as files: two LAZ surveys, their trajectories, and the truth."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np

from loda_pdal.benchmark.simulate.block import COORDINATE_STEP_M, CRS, SimulatedBlock, SimulatedSurvey
from loda_pdal.model.errors import OutputError
from loda_pdal.model.pair import Pair

TRUTH_ID = "TruthId"
TRUTH_CHANGE = "TruthChange"

_SURVEYED = Pair(date(2023, 6, 25), date(2025, 6, 29))


def write_block(block: SimulatedBlock, folder: Path, *, overwrite: bool = False) -> dict[str, Path]:
    """Write both surveys, their trajectories and the truth; the same bytes for the same block.

    Parameters
    ----------
    block : SimulatedBlock
    folder : Path
        Made where it does not exist.
    overwrite : bool
        Replace files of these names.

    Returns
    -------
    dict of str to Path
        What was written: ``before``, ``after``, ``before_trajectory``, ``after_trajectory``, ``truth``.
    """
    folder = Path(folder)
    paths = {
        "before": folder / "before.laz",
        "after": folder / "after.laz",
        "before_trajectory": folder / "before_trajectory.csv",
        "after_trajectory": folder / "after_trajectory.csv",
        "truth": folder / "truth.json",
    }
    present = [path.name for path in paths.values() if path.exists()]
    if present and not overwrite:
        raise OutputError(
            f"{folder} already holds {', '.join(present)}.",
            "Choose another folder, or add --overwrite.",
            "output-exists",
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("before", "after"):
            survey = getattr(block.surveys, name)
            _write_laz(survey, getattr(_SURVEYED, name), paths[name])
            _write_trajectory(survey, paths[f"{name}_trajectory"])
        block.truth.write(paths["truth"])
    except OSError as error:
        raise OutputError(
            f"Cannot write to {folder}: {error}.", "Check the folder and its disk.", "output-unwritable"
        ) from error
    return paths


def _write_laz(survey: SimulatedSurvey, surveyed: date, path: Path) -> None:
    """LAS 1.4, point format 6, millimetres, with the truth as extra bytes."""
    import laspy
    import pyproj

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = surveyed
    header.system_identifier = "SIMULATED"
    header.generating_software = "loda-pdal"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.scales = np.full(3, COORDINATE_STEP_M)
    header.offsets = np.array(
        [*(np.floor(survey.xyz[:, :2].min(axis=0) / 1000) * 1000 if len(survey) else (0, 0)), 0.0]
    )
    header.add_crs(pyproj.CRS.from_user_input(CRS))
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(TRUTH_ID, np.uint32, "annotated instance, 0 none"),
            laspy.ExtraBytesParams(TRUTH_CHANGE, np.uint8, "change of this surface"),
        ]
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = survey.xyz.T
    las.intensity = survey.intensity
    las.gps_time = survey.gps_time
    las.return_number = survey.return_number
    las.number_of_returns = survey.n_returns
    las[TRUTH_ID] = survey.truth_id
    las[TRUTH_CHANGE] = survey.truth_change
    las.write(str(path))


def _write_trajectory(survey: SimulatedSurvey, path: Path) -> None:
    rows = "\n".join(f"{t:.4f},{x:.3f},{y:.3f},{z:.3f}" for t, x, y, z in survey.trajectory)
    path.write_text(f"time,x,y,z\n{rows}\n", encoding="utf-8")
