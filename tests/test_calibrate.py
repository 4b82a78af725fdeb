"""Calibration of the confidence, on scores whose truth is drawn from a known curve."""

from __future__ import annotations

import numpy as np
import pytest

from loda_pdal.benchmark.calibrate import calibration_error, logistic


def test_a_known_curve_is_found_again() -> None:
    rng = np.random.default_rng(0)
    raw = rng.random(20000)
    is_right = rng.random(20000) < 1 / (1 + np.exp(-(-1.0 + 4.0 * raw)))
    offset, slope = logistic(raw.tolist(), is_right.tolist())
    assert offset == pytest.approx(-1.0, abs=0.15)
    assert slope == pytest.approx(4.0, abs=0.3)
    confidence = 1 / (1 + np.exp(-(offset + slope * raw)))
    assert calibration_error(confidence, is_right) < 0.02


def test_labels_that_are_always_right_keep_a_finite_slope() -> None:
    offset, slope = logistic([0.5, 0.9, 0.7], [True, True, True])
    assert 0 <= slope < 40
    assert offset < 20


def test_the_calibration_error_can_be_checked_by_hand() -> None:
    confidence = np.array([0.95, 0.95, 0.15, 0.15])
    assert calibration_error(confidence, np.array([True, True, False, False])) == pytest.approx(0.1)
    assert calibration_error(confidence, np.array([False, False, True, True])) == pytest.approx(0.9)
    assert np.isnan(calibration_error(np.zeros(0), np.zeros(0, np.bool_)))
