"""Parameters of the baselines, chosen on training blocks and then frozen.

street  simulated streets of 100 m, ``bench baselines --tune`` on seeds 101 102 103 119 120, with ``--train`` for seeds
        106 107 109 110 112 115
aerial  120 m squares of Rotterdam from the air (``bench simulate --city ... --sensor airborne --length 120 --width 120
        --density-after 1.7``), ``bench baselines --preset aerial --tune`` on seeds 507 508 509, with ``--train`` for
        seeds 504 505 506
"""

from __future__ import annotations

from typing import Any

from loda_pdal.benchmark.baselines.c2c import C2cParams
from loda_pdal.benchmark.baselines.forest import ForestParams
from loda_pdal.benchmark.baselines.m3c2 import M3c2Params
from loda_pdal.benchmark.baselines.ndsm import NdsmParams

TUNED: dict[str, dict[str, Any]] = {
    "street": {
        "M3C2": M3c2Params(radius_m=0.7, min_points=10, standing_m=0.5, depth_m=0.5, min_distance_m=0.1),
        "nDSM difference": NdsmParams(threshold_m=0.3, opening=2, min_cells=1, standing_m=0.5),
        "C2C": C2cParams(radius_m=0.5, min_points=10, standing_m=0.5, threshold_m=0.4),
        "DSM random forest": ForestParams(min_probability=0.4, min_cells=8),
    },
    "aerial": {
        "M3C2": M3c2Params(radius_m=0.7, min_points=10, standing_m=0.5, depth_m=0.5, min_distance_m=0.35),
        "nDSM difference": NdsmParams(threshold_m=0.8, opening=2, min_cells=1, standing_m=0.5),
        "C2C": C2cParams(radius_m=0.7, min_points=5, standing_m=0.5, threshold_m=0.7),
        "DSM random forest": ForestParams(min_probability=0.5, min_cells=1),
    },
}
"""Parameters by preset and name of the method."""
