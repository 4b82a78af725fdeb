"""Parameters of the baselines, chosen on validation blocks and then frozen.

street  ``bench baselines --tune`` on the eight validation blocks of suite vehicle, with ``--train`` for its sixteen
        training blocks
aerial  the same on the five validation and the eight training blocks of suite airborne, with ``--preset aerial``
"""

from __future__ import annotations

from typing import Any

from loda_pdal.benchmark.baselines.c2c import C2cParams
from loda_pdal.benchmark.baselines.forest import ForestParams
from loda_pdal.benchmark.baselines.m3c2 import M3c2Params
from loda_pdal.benchmark.baselines.ndsm import NdsmParams

TUNED: dict[str, dict[str, Any]] = {
    "street": {
        "M3C2": M3c2Params(radius_m=0.7, min_points=10, standing_m=0.5, depth_m=0.5, min_distance_m=0.35),
        "nDSM difference": NdsmParams(threshold_m=0.3, opening=2, min_cells=1, standing_m=0.5),
        "C2C": C2cParams(radius_m=0.7, min_points=5, standing_m=0.5, threshold_m=0.5),
        "DSM random forest": ForestParams(min_probability=0.6, min_cells=1),
    },
    "aerial": {
        "M3C2": M3c2Params(radius_m=0.7, min_points=10, standing_m=0.5, depth_m=1.0, min_distance_m=0.35),
        "nDSM difference": NdsmParams(threshold_m=0.5, opening=2, min_cells=1, standing_m=0.5),
        "C2C": C2cParams(radius_m=0.7, min_points=5, standing_m=0.5, threshold_m=0.5),
        "DSM random forest": ForestParams(min_probability=0.5, min_cells=1),
    },
}
"""Parameters by preset and name of the method."""
