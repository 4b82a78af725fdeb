"""run.json: everything one needs to say how a result came about, and to make it again."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import loda_pdal
from loda_pdal.io.summary import summarise
from loda_pdal.io.transform import registration_diagnostics
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.survey import Survey

FORMAT = "loda-pdal run 1"

_PACKAGES = ("numpy", "scipy", "numba", "laspy", "lazrs", "pyproj", "shapely", "pyogrio", "rasterio")


def run_document(
    result: ChangeResult, surveys: Pair[Survey], run_info: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """What run.json holds (see `to_json`).

    Parameters
    ----------
    result : ChangeResult
        Gives parameters as resolved, registration, warnings, and seconds and peak memory per stage.
    surveys : Pair of Survey
        Gives inputs, their checksums, and the CRS.
    run_info : mapping, optional
        What a face knows of the run (command line, start), kept under ``run`` as it is.
    """
    frame = surveys.after.frame
    return {
        "format": FORMAT,
        "program": {"name": "loda-pdal", "version": loda_pdal.__version__},
        "run": dict(run_info or {}),
        "inputs": {"before": _input(surveys.before), "after": _input(surveys.after)},
        "crs": _crs(frame),
        "summary": summarise(result, surveys),
        "registration": registration_diagnostics(result.registration),
        "warnings": list(result.warnings),
        "stages": {cost.stage: {"seconds": cost.seconds, "peak_rss_mb": cost.peak_rss_mb} for cost in result.costs},
        "seconds": sum(cost.seconds for cost in result.costs),
        "parameters": result.parameters.to_dict(),
        "versions": package_versions(),
    }


def package_versions() -> dict[str, str]:
    """Versions of Python and of the libraries that results depend on."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _input(survey: Survey) -> dict[str, Any]:
    return {
        "path": survey.path or None,
        "bytes": survey.n_bytes,
        "sha256": survey.sha256,
        "points": len(survey),
        "notes": list(survey.notes),
    }


def _crs(frame: LocalFrame) -> dict[str, Any]:
    name, epsg = None, None
    if frame.crs_wkt is not None:
        from pyproj import CRS

        crs = CRS.from_wkt(frame.crs_wkt)
        name, epsg = crs.name, crs.to_epsg()
    return {
        "name": name,
        "epsg": epsg,
        "wkt": frame.crs_wkt,
        "unit_xy_m": frame.unit_xy_m,
        "unit_z_m": frame.unit_z_m,
        "local_origin": list(frame.origin),
    }
