"""Plain rivals on the same blocks, judged by the same protocols.

``m3c2``, ``ndsm``, ``forest`` and ``c2c`` are one method each; ``scene`` is what all of them get, ``compare`` runs and
tunes them, ``tuned`` keeps what the search found.
"""

from __future__ import annotations

from loda_pdal.benchmark.baselines.compare import Comparison, Tuned, run_baselines, tune

__all__ = ["Comparison", "Tuned", "run_baselines", "tune"]
