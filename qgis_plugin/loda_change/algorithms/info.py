"""Check inputs: what the headers of two surveys say, and whether they can be compared."""

from __future__ import annotations

import json

from qgis.core import QgsProcessingOutputBoolean, QgsProcessingOutputNumber, QgsProcessingOutputString

from .base import LodaAlgorithm


class CheckInputs(LodaAlgorithm):
    """``loda-pdal info``."""

    NAME, TITLE, ICON = "checkinputs", "Check inputs", "info"
    SHORT = "Says points, CRS, extent and density of two surveys, and whether they can be compared."
    HELP = (
        "Reads the headers of one survey or two: number of points, CRS, extent, density, and for two how far they "
        "overlap and whether anything keeps them from being compared. Reads no points, so it takes no time."
    )
    TAGS = ("metadata", "header", "overlap", "CRS", "density")

    def initAlgorithm(self, configuration=None):
        self._add_surveys(after_is_optional=True)
        self.addOutput(QgsProcessingOutputBoolean("COMPARABLE", "Whether they can be compared"))
        self.addOutput(QgsProcessingOutputString("PROBLEM", "What keeps them from being compared"))
        self.addOutput(QgsProcessingOutputNumber("OVERLAP", "Overlap of the bounds, share of the smaller"))
        self.addOutput(QgsProcessingOutputNumber("POINTS_BEFORE", "Points before"))
        self.addOutput(QgsProcessingOutputNumber("POINTS_AFTER", "Points after"))

    def processAlgorithm(self, parameters, context, feedback):
        paths = [self._survey(name, parameters, context) for name in ("BEFORE", "AFTER")]
        arguments = ["info", *(path for path in paths if path), "--json"]
        epsg = self._crs(parameters, context)
        if epsg:
            arguments += ["--epsg", str(epsg)]
        if self.parameterAsBoolean(parameters, "ASSUME_SAME_CRS", context):
            arguments.append("--assume-same-crs")
        found = json.loads(self._ask(arguments, feedback))
        for survey in found["surveys"]:
            feedback.pushInfo(_described(survey))
        points = [survey["points"] for survey in found["surveys"]]
        result = {"POINTS_BEFORE": points[0]}
        if "pair" in found:
            pair = found["pair"]
            problem = " ".join(word for word in (pair["problem"], pair["remedy"]) if word)
            feedback.pushInfo(f"The bounds overlap by {pair['overlap_of_bounds']:.0%} of the smaller one.")
            if problem:
                feedback.pushWarning(f"Cannot be compared yet: {problem}")
            result.update(
                POINTS_AFTER=points[1],
                OVERLAP=pair["overlap_of_bounds"],
                COMPARABLE=not problem and pair["overlap_of_bounds"] > 0,
                PROBLEM=problem,
            )
        return result


def _described(survey):
    lines = [f"{survey['path']}", f"    {survey['points']:,} points, LAS {survey['las_version']}"]
    lines.append(f"    CRS {survey['crs'] or survey['crs_problem'] or 'none'}")
    if survey["size_m"]:
        lines.append("    {:.1f} x {:.1f} x {:.1f} m".format(*survey["size_m"]))
    if survey["density_per_m2"]:
        lines.append(f"    {survey['density_per_m2']:.1f} points per m² of its bounds")
    return "\n".join(lines)
