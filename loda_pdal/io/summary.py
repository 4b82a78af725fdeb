"""A run in a few figures: the ``--json`` summary, the head of the report, and what run.json keeps of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.io.colours import LABEL_COLOURS
from loda_pdal.model.labels import OBJECT_CLASSES, ChangeLabel
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult, GroundChangeRecord, ObjectRecord
from loda_pdal.model.registration import Registration
from loda_pdal.model.survey import Survey

FEW_VALID = 0.5
"""Share of cells with a limit of detection below which the reader is told."""


def summarise(result: ChangeResult, surveys: Pair[Survey]) -> dict[str, Any]:
    """The figures of a run as plain JSON values: lengths in m, areas in m2, volumes in m3, unknown as None."""
    registration, lod = registration_figures(result.registration), lod_figures(result.lod)
    figures: dict[str, Any] = {
        "objects": len(result.objects),
        "changed": sum(is_changed(o) for o in result.objects),
        "undetermined": sum(o.label is ChangeLabel.UNDETERMINED for o in result.objects),
        "counts": count_objects(result.objects),
        "ground_changes": ground_figures(result.ground_changes),
        "registration": registration,
        "lod95": lod,
        "has_ground": result.has_ground,
        "area_m2": _number(result.block.area) if result.block is not None else None,
        "epochs": {"before": survey_figures(surveys.before), "after": survey_figures(surveys.after)},
    }
    figures["warnings"] = [*result.warnings, *few_valid_cells(lod)]
    return figures


def is_changed(record: ObjectRecord) -> bool:
    """Whether an object has one of the paper's four change labels (Undetermined is no change)."""
    return record.label not in (ChangeLabel.UNCHANGED, ChangeLabel.UNDETERMINED)


def count_objects(objects: list[ObjectRecord]) -> dict[str, dict[str, int]]:
    """``{label: {class: n}}`` over all labels and the classes that form objects, zeros included."""
    counts = {label.title: {kind.title: 0 for kind in OBJECT_CLASSES} for label in LABEL_COLOURS}
    for record in objects:
        row = counts[record.label.title]
        row[record.object_class.title] = row.get(record.object_class.title, 0) + 1
    return counts


def ground_figures(records: list[GroundChangeRecord]) -> dict[str, dict[str, float]]:
    """Pieces, area (m2) and volume (m3) of raised and of lowered ground."""
    figures = {}
    for label in (ChangeLabel.INCREASED, ChangeLabel.DECREASED):
        found = [r for r in records if r.label is label]
        figures[label.title] = {
            "pieces": len(found),
            "area_m2": float(sum(r.area_m2 for r in found)),
            "volume_m3": float(sum(r.volume_m3 for r in found)),
        }
    return figures


def registration_figures(registration: Registration) -> dict[str, Any]:
    """What the alignment found and how sure it is."""
    variance = np.diag(registration.covariance)
    return {
        "converged": bool(registration.converged),
        "message": registration.message,
        "reference": registration.reference,
        "shift_m": [_number(value) for value in registration.shift_m],
        "rotation_deg": _number(registration.rotation_deg),
        "sigma_position_m": _number(np.sqrt(variance[:3].sum())),
        "sigma_rotation_deg": _number(np.degrees(np.sqrt(variance[3:].sum()))),
        "rmse_m": _number(registration.rmse_m),
        "overlap": _number(registration.overlap),
        "pairs": int(registration.n_pairs),
    }


def lod_figures(lod: LodGrid) -> dict[str, Any]:
    """Median and 90th percentile of LoD95 over the cells that have one, and the share of such cells."""
    valid = lod.lod95[lod.is_valid].astype(np.float64)
    return {
        "median_m": float(np.median(valid)) if len(valid) else None,
        "p90_m": float(np.percentile(valid, 90)) if len(valid) else None,
        "valid_share": float(np.mean(lod.is_valid)) if len(lod.is_valid) else None,
        "cells": len(lod.cells),
    }


def survey_figures(survey: Survey) -> dict[str, Any]:
    """Name, size, dates and notes of one survey."""
    first, last = survey.dates
    return {
        "file": Path(survey.path).name or "array",
        "points": len(survey),
        "first_date": first,
        "last_date": last,
        "notes": list(survey.notes),
    }


def few_valid_cells(lod: dict[str, Any]) -> list[str]:
    """A warning where most of the occupied space has no limit of detection."""
    share = lod["valid_share"]
    if share is None or share >= FEW_VALID:
        return []
    return [
        f"Only {share:.0%} of the occupied space was measured densely enough by both surveys to state a limit of "
        "detection; elsewhere small changes are not claimed."
    ]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
