"""Change report: the report of a result once more, with the reviews."""

from __future__ import annotations

from qgis.core import QgsProcessingOutputHtml, QgsProcessingParameterFile

from .base import LodaAlgorithm


class ChangeReport(LodaAlgorithm):
    """``loda-pdal report``."""

    NAME, TITLE, ICON = "changereport", "Change report", "report"
    SHORT = "Writes the report of a result anew, with the state of its review."
    HELP = (
        "Writes report.html of an earlier result anew. Run it after a review: the report then shows what was noted on "
        "each change. Save the edits of the layer first."
    )
    TAGS = ("html", "review", "document")

    def initAlgorithm(self, configuration=None):
        self._add(
            QgsProcessingParameterFile("FOLDER", "Folder of the result", QgsProcessingParameterFile.Behavior.Folder),
            "The folder that Detect changes wrote.",
        )
        self.addOutput(QgsProcessingOutputHtml("REPORT", "Report"))

    def processAlgorithm(self, parameters, context, feedback):
        folder = self.parameterAsFile(parameters, "FOLDER", context)
        return {"REPORT": self._ask(["report", folder], feedback).strip().splitlines()[-1]}
