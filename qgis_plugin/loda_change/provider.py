"""The Processing provider."""

from __future__ import annotations

from pathlib import Path

from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithms.chains import CompareSegmented, DetectionLimit, RegisterClouds, SegmentObjects
from .algorithms.detect import DetectChanges
from .algorithms.info import CheckInputs
from .algorithms.report import ChangeReport

ICON = Path(__file__).resolve().parent / "icon.svg"
ALGORITHMS = (
    DetectChanges,
    RegisterClouds,
    DetectionLimit,
    SegmentObjects,
    CompareSegmented,
    ChangeReport,
    CheckInputs,
)


class LodaProvider(QgsProcessingProvider):
    """All algorithms under ``loda``."""

    def id(self):
        return "loda"

    def name(self):
        return "LoDA change detection"

    def longName(self):
        return "LoDA: object-level change detection between LiDAR surveys"

    def icon(self):
        return QIcon(str(ICON))

    def svgIconPath(self):
        return str(ICON)

    def loadAlgorithms(self):
        for algorithm in ALGORITHMS:
            self.addAlgorithm(algorithm())
