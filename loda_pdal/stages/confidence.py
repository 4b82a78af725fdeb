"""Deterministic confidence of a label (paper, section 4.3) and its calibration (METHOD 3)."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.lod_grid import Z_95
from loda_pdal.params import ConfidenceParams
from loda_pdal.stages.ground_changes import GroundChanges


def raw_confidence(
    label: ChangeLabel,
    *,
    height: float,
    volume: float,
    overlap: float,
    shift: float,
    displacement: float,
    support: float,
    observability: float,
    params: ConfidenceParams,
) -> float:
    """Score in [0, 1] for ranking and inspection (paper, section 4.3, last paragraph).

    The paper names the cues and not the formula. Each cue is first brought to [0, 1), 0.5 at its threshold: ``height``,
    ``volume``, ``shift`` and ``displacement`` are given as multiples of their thresholds (NaN: not informative),
    ``overlap`` is the 3D IoU. A changed pair is scored by how far its cues lie above their thresholds, an unchanged
    one by how far below, an unmatched object by how little of it the other survey shows and how well it saw the place.

    Returns
    -------
    float
        0 unsure to 1 sure.
    """
    if label in (ChangeLabel.ADDED, ChangeLabel.REMOVED):
        return _clipped((1.0 - support) * observability)
    cues = [
        (params.weight_height, _saturated(height)),
        (params.weight_volume, _saturated(volume)),
        (params.weight_displacement, _saturated(displacement)),
        (params.weight_shift, _saturated(shift)),
        (params.weight_overlap, 1.0 - overlap),
    ]
    informative = [(weight, value) for weight, value in cues if not math.isnan(value) and weight > 0]
    total = sum(weight for weight, _ in informative)
    if total == 0:
        return 0.0
    if label == ChangeLabel.UNCHANGED:
        mean = sum(weight * value for weight, value in informative) / total
        return _clipped((1.0 - mean) * (0.5 + 0.5 * observability))
    strongest = max(value for _, value in informative[:3])
    return _clipped(strongest * (0.5 + 0.5 * observability))


def calibrated(raw: float, label: ChangeLabel, params: ConfidenceParams) -> float:
    """Share of objects with this raw score whose label is right, on the validation scenes of the preset."""
    if label in (ChangeLabel.ADDED, ChangeLabel.REMOVED):
        offset, slope = params.calibration_unmatched
    elif label == ChangeLabel.UNCHANGED:
        offset, slope = params.calibration_unchanged
    else:
        offset, slope = params.calibration_changed
    return 1.0 / (1.0 + math.exp(-(offset + slope * raw)))


def ground_confidence(ground: GroundChanges, min_dz_m: float) -> FloatArray:
    """Probability (t,) that the label of each ground tile is right; NaN where it is undetermined.

    The measured elevation change is taken as normal about the true one, with LoD95 / 1.96 as its standard deviation:
    a changed tile is right if the ground really moved in that direction, an unchanged one if it moved less than the
    least change that counts.
    """
    deviation = np.maximum(ground.lod95 / Z_95, 1e-6) * math.sqrt(2.0)
    moved = 0.5 * (1.0 + erf(np.abs(ground.dz) / deviation))
    margin = (min_dz_m - np.abs(ground.dz)) / deviation
    still = 0.5 * (1.0 + erf(margin))
    is_changed = np.isin(ground.label, (ChangeLabel.INCREASED, ChangeLabel.DECREASED))
    sure = np.where(is_changed, moved, still)
    return np.where(ground.label == ChangeLabel.UNDETERMINED, np.nan, sure)


def _saturated(multiple: float) -> float:
    """0 at 0, 0.5 at the threshold (1), towards 1 far above it."""
    return multiple if math.isnan(multiple) else abs(multiple) / (1.0 + abs(multiple))


def _clipped(value: float) -> float:
    return min(max(value, 0.0), 1.0)
