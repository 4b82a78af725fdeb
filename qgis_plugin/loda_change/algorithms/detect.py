"""Detect changes: two surveys in, a folder with the changes out."""

from __future__ import annotations

from qgis.core import (
    QgsProcessingOutputFile,
    QgsProcessingOutputHtml,
    QgsProcessingOutputNumber,
    QgsProcessingOutputPointCloudLayer,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterEnum,
    QgsProcessingParameterNumber,
)

from .. import results
from .base import LodaAlgorithm

CLOUD_FORMATS = ("copc", "laz", "las")


class DetectChanges(LodaAlgorithm):
    """The whole method."""

    NAME, TITLE, ICON = "detectchanges", "Detect changes", "detect"
    SHORT = "Finds the objects that changed between two LiDAR surveys, with a limit of detection for every place."
    HELP = (
        "Finds what changed between two LiDAR surveys of one place, object by object: added, removed, increased, "
        "decreased, or undetermined where the other survey could not see.\n\n"
        "The surveys are aligned first, and a change must exceed the limit of detection (LoD95) of its place. The "
        "folder then holds changes.gpkg with all objects, why each was decided and how sure that is, the labelled "
        "point cloud, the limit of detection as a raster, and a report with a before and after picture of each "
        "change.\n\n"
        "Review the result with the buttons of the LoDA Change toolbar. Running again into the same folder keeps the "
        "reviews of the objects that are still the same."
    )
    TAGS = ("difference", "compare", "buildings", "vegetation", "vehicles", "LoD95", "M3C2", "street", "aerial")

    def initAlgorithm(self, configuration=None):
        self._add_surveys()
        self._add_choices()
        self._add(
            QgsProcessingParameterBoolean("KEEP_FRAMES", "Leave the before-points where they are", False),
            "Do not move the before-points of the output cloud onto the later survey.",
            advanced=True,
        )
        self._add(
            QgsProcessingParameterNumber(
                "MAX_MEMORY", "Memory the run may take [GB]", QgsProcessingParameterNumber.Type.Double, optional=True
            ),
            "The run is refused, before it begins, where it would need more.",
            advanced=True,
        )
        self._add(
            QgsProcessingParameterEnum(
                "CLOUD_FORMAT", "Point cloud format", CLOUD_FORMATS, defaultValue="copc", usesStaticStrings=True
            ),
            "COPC opens in every QGIS; LAZ and LAS keep the order of the points.",
            advanced=True,
        )
        self._add(
            QgsProcessingParameterBoolean("OVERWRITE", "Replace an earlier result in the folder", False),
            "Reviews of objects that are still the same are kept; other notes go to the layer earlier_reviews.",
        )
        self._add_folder()
        self.addOutput(QgsProcessingOutputVectorLayer("CHANGES", "Changes"))
        self.addOutput(QgsProcessingOutputPointCloudLayer("CLOUD", "Labelled point cloud"))
        self.addOutput(QgsProcessingOutputRasterLayer("LOD95", "Limit of detection (LoD95)"))
        self.addOutput(QgsProcessingOutputHtml("REPORT", "Report"))
        self.addOutput(QgsProcessingOutputFile("TRANSFORM", "Move between the surveys"))
        self.addOutput(QgsProcessingOutputNumber("OBJECTS", "Number of objects"))
        self.addOutput(QgsProcessingOutputNumber("CHANGED", "Number of changed objects"))
        self.addOutput(QgsProcessingOutputNumber("UNDETERMINED", "Number of undetermined objects"))

    def checkParameterValues(self, parameters, context):
        fine, message = super().checkParameterValues(parameters, context)
        output = parameters.get("OUTPUT")
        if fine and isinstance(output, str):
            unsaved = results.unsaved_layers(output)
            if unsaved:
                return False, f"{unsaved[0]} in this folder has unsaved edits. Save or discard them first."
        return fine, message

    def processAlgorithm(self, parameters, context, feedback):
        folder, _ = self._folder(parameters, context)
        arguments = [
            "detect",
            self._survey("BEFORE", parameters, context),
            self._survey("AFTER", parameters, context),
            "-o",
            str(folder),
            "--preset",
            self.parameterAsEnumString(parameters, "PRESET", context),
            "--cloud-format",
            self.parameterAsEnumString(parameters, "CLOUD_FORMAT", context),
        ]
        for option, value in (
            ("--params", self.parameterAsFile(parameters, "PARAMS", context)),
            ("--epsg", self._crs(parameters, context)),
            ("--threads", parameters.get("THREADS")),
            ("--max-memory", parameters.get("MAX_MEMORY")),
        ):
            if value:
                arguments += [option, str(value)]
        for setting in self._settings(parameters):
            arguments += ["--set", setting]
        for flag in ("ASSUME_SAME_CRS", "KEEP_FRAMES", "OVERWRITE"):
            if self.parameterAsBoolean(parameters, flag, context):
                arguments.append(f"--{flag.lower().replace('_', '-')}")
        done = self._run(arguments, feedback)
        outputs, summary = done["outputs"], done["summary"]
        feedback.pushInfo(f"{summary['changed']} of {summary['objects']} objects changed.")
        self._load(folder, parameters, context)
        return {
            "OUTPUT": str(folder),
            "CHANGES": f"{outputs['changes']}|layername=changes",
            "CLOUD": outputs["cloud"],
            "LOD95": outputs["lod95"],
            "REPORT": outputs["report"],
            "TRANSFORM": outputs["transform"],
            "OBJECTS": summary["objects"],
            "CHANGED": summary["changed"],
            "UNDETERMINED": summary["undetermined"],
        }
