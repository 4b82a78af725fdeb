"""The move between the epochs as a file that other programs can apply: transform.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.io.plain import to_json
from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.registration import Registration

FORMAT = "loda-pdal transform 1"


def transform_document(registration: Registration, frame: LocalFrame) -> dict[str, Any]:
    """What transform.json holds (see `to_json`).

    Points of the before epoch in full map coordinates go onto the after epoch by ``map.matrix @ (x, y, z, 1)``.
    """
    local = registration.T_after_before
    centre_map = frame.to_map(registration.centre[None, :])[0]
    return {
        "format": FORMAT,
        "from": "before",
        "to": "after",
        "crs_wkt": frame.crs_wkt,
        "map": {
            "matrix": frame.transform_to_map(local),
            "unit_xy_m": frame.unit_xy_m,
            "unit_z_m": frame.unit_z_m,
        },
        "local": {
            "matrix": local,
            "origin": frame.origin,
            "unit": "m",
            "meaning": "local metres are (map - origin) times metres per map unit",
        },
        "covariance": {
            "matrix": registration.covariance,
            "order": ["tx", "ty", "tz", "rx", "ry", "rz"],
            "units": ["m", "m", "m", "rad", "rad", "rad"],
            "frame": registration.reference,
            "centre_local_m": registration.centre,
            "centre_map": centre_map,
        },
        "diagnostics": registration_diagnostics(registration),
    }


def registration_diagnostics(registration: Registration) -> dict[str, Any]:
    """What one needs to know to trust a registration."""
    return {
        "converged": registration.converged,
        "message": registration.message,
        "reference": registration.reference,
        "iterations": registration.iterations,
        "n_pairs": registration.n_pairs,
        "rmse_m": registration.rmse_m,
        "overlap": registration.overlap,
        "shift_m": registration.shift_m,
        "rotation_deg": registration.rotation_deg,
        "sigma_m": _sigmas(registration.covariance[:3, :3]),
        "sigma_rad": _sigmas(registration.covariance[3:, 3:]),
    }


def write_transform(path: Path, registration: Registration, frame: LocalFrame) -> None:
    """Write transform.json."""
    path.write_text(to_json(transform_document(registration, frame)), encoding="utf-8")


def read_map_transform(path: Path) -> FloatArray:
    """The (4, 4) matrix of a transform.json that moves before-points in full map coordinates."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != FORMAT:
            raise ValueError(f"format is {document['format']!r}")
        return np.array(document["map"]["matrix"], dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: is not a transform file of loda-pdal ({error}).",
            "Give the transform.json of a run.",
            "transform-unreadable",
        ) from error


def _sigmas(block: FloatArray) -> FloatArray:
    variances = np.diag(block)
    return np.sqrt(np.where(variances >= 0, variances, np.nan))
