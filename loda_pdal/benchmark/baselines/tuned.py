"""Parameters of the baselines, chosen on training blocks and then frozen.

street  loda-pdal bench baselines --tune s101 s102 s103 s119 s120 --train s106 ... --train s115
"""

from __future__ import annotations

from typing import Any

from loda_pdal.benchmark.baselines.c2c import C2cParams
from loda_pdal.benchmark.baselines.forest import ForestParams
from loda_pdal.benchmark.baselines.m3c2 import M3c2Params
from loda_pdal.benchmark.baselines.ndsm import NdsmParams

TUNED: dict[str, dict[str, Any]] = {
    preset: {
        "nDSM difference": NdsmParams(),
        "C2C": C2cParams(),
        "M3C2": M3c2Params(),
        "DSM random forest": ForestParams(),
    }
    for preset in ("street", "aerial")
}
