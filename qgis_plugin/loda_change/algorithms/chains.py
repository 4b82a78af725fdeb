"""Parts of the method: each runs one of the engine's pipelines."""

from __future__ import annotations

import json
from pathlib import Path

from qgis.core import (
    QgsProcessingOutputFile,
    QgsProcessingOutputHtml,
    QgsProcessingOutputPointCloudLayer,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterFile,
)

from .base import LodaAlgorithm

REGISTRATION = ("fuse", "outliers", "normals", "ndt", "icp")
SEGMENTATION = ("ground", "features", "superpoints", "semantics", "instances")


_STEPS = {
    "before": "reading the survey before",
    "after": "reading the survey after",
    "epoch_before": "marking the survey before",
    "epoch_after": "marking the survey after",
    "epochs": "joining the surveys",
    "register": "registering the epochs",
    "ground": "modelling the ground",
    "lod": "estimating the limit of detection",
    "superpoints": "partitioning into superpoints",
    "semantics": "classifying",
    "instances": "forming instances",
    "objects": "matching objects",
    "changes": "deciding changes",
    "ground_changes": "comparing the ground",
    "result": "outlining objects and writing the results",
    "move": "moving the survey before",
    "output": "writing the point cloud",
}
"""What the stages of a pipeline do, by their tags."""


class Chain(LodaAlgorithm):
    """One pipeline of the engine, run without PDAL because PDAL reports no progress."""

    CHAIN = CLOUD = ""
    FILES = ()
    """Files that the pipeline leaves in its folder: output name, file name, class and title of the output."""
    KEEPS_STEPS = False
    """Whether the results of its steps stay in the folder, for another algorithm to go on from."""

    def initAlgorithm(self, configuration=None):
        self._add_surveys()
        self._add_choices()
        self._add_place()
        self.addOutput(QgsProcessingOutputPointCloudLayer("CLOUD", "Point cloud"))
        for name, _, kind, title in self.FILES:
            self.addOutput(kind(name, title))

    def _add_place(self):
        self._add_folder()

    def processAlgorithm(self, parameters, context, feedback):
        folder, is_new = self._folder(parameters, context)
        cloud = folder / self.CLOUD
        choices = {
            "run": str(folder),
            "preset": self.parameterAsEnumString(parameters, "PRESET", context),
            "set": self._chosen(parameters),
        }
        optional = {
            "params": self.parameterAsFile(parameters, "PARAMS", context),
            "epsg": self._crs(parameters, context),
            "assume_same_crs": self.parameterAsBoolean(parameters, "ASSUME_SAME_CRS", context),
        }
        choices.update((name, value) for name, value in optional.items() if value)
        arguments = [
            "pipeline",
            self.CHAIN,
            "--engine",
            "embedded",
            f"--stage.before.filename={self._survey('BEFORE', parameters, context)}",
            f"--stage.after.filename={self._survey('AFTER', parameters, context)}",
            f"--stage.output.filename={cloud}",
            f"--filters.python.pdalargs={json.dumps(choices)}",
        ]
        if parameters.get("THREADS"):
            arguments += ["--threads", str(int(parameters["THREADS"]))]
        folder.mkdir(parents=True, exist_ok=True)
        self._run(arguments, feedback, folder if is_new else None)
        if not self.KEEPS_STEPS:
            _remove_steps(folder)
        self._load(folder, parameters, context)
        files = {name: folder / file for name, file, _, _ in self.FILES}
        layers = {
            name: f"{path}|layername=changes" if path.suffix == ".gpkg" else str(path) for name, path in files.items()
        }
        return {"OUTPUT": str(folder), "CLOUD": str(cloud), **layers}

    def _stage_title(self, stage):
        tag = stage.rpartition("(")[2].rstrip(")")
        return _STEPS.get(tag, stage)

    def _chosen(self, parameters):
        """The settings as values, which pdalargs wants."""
        pairs = (setting.partition("=") for setting in self._settings(parameters))
        return {key: _value(text) for key, _, text in pairs}


class RegisterClouds(Chain):
    """Registration."""

    NAME, TITLE, ICON = "registerclouds", "Register two clouds", "register"
    CHAIN, CLOUD, STAGES = "register", "registered.copc.laz", REGISTRATION
    SHORT = "Moves one survey onto the other and says how sure the move is."
    HELP = (
        "Aligns the earlier survey with the later one (NDT, then robust ICP). The result is one point cloud with both "
        "surveys, told apart by the dimension Epoch (0 before, 1 after), and transform.json with the move, its "
        "covariance and how well the surveys fit."
    )
    TAGS = ("align", "ICP", "NDT", "coregistration", "transformation")
    FILES = (("TRANSFORM", "transform.json", QgsProcessingOutputFile, "Move between the surveys"),)


class DetectionLimit(Chain):
    """Limit of detection."""

    NAME, TITLE, ICON = "detectionlimit", "Detection limit (LoD95)", "lod"
    CHAIN, CLOUD, STAGES = "lod", "lod95.copc.laz", (*REGISTRATION, "lod")
    SHORT = "How small a change could have been seen, for every place, at 95 %."
    HELP = (
        "Estimates the limit of detection at 95 % (LoD95, metres) of every place from roughness, number of points and "
        "the uncertainty of the alignment. Smaller differences between the surveys mean nothing.\n\n"
        "The result is a raster (largest limit in the column, and the share of it that could be judged) and the "
        "aligned point cloud with the dimension LoD95."
    )
    TAGS = ("uncertainty", "M3C2", "significance", "level of detection", "raster")
    FILES = (
        ("LOD95", "lod95.tif", QgsProcessingOutputRasterLayer, "Limit of detection (LoD95)"),
        ("TRANSFORM", "transform.json", QgsProcessingOutputFile, "Move between the surveys"),
    )


class SegmentObjects(Chain):
    """Segmentation."""

    NAME, TITLE, ICON = "segmentobjects", "Segment objects", "segment"
    CHAIN, CLOUD, STAGES = "segment", "segmented.copc.laz", (*REGISTRATION, *SEGMENTATION)
    KEEPS_STEPS = True
    SHORT = "Cuts both surveys into ground, buildings, vegetation, vehicles and other objects."
    HELP = (
        "Cuts both surveys into superpoints, classes (ground, building, vegetation, mobile, other) and single objects. "
        "The result is one point cloud with the dimensions Epoch, HeightAboveGround, Superpoint, InstanceId and a new "
        "Classification.\n\nThe folder also keeps what *Compare segmented clouds* goes on from."
    )
    TAGS = ("classification", "superpoints", "instances", "buildings", "trees", "vehicles")


class CompareSegmented(Chain):
    """Change detection on what was segmented."""

    NAME, TITLE, ICON = "comparesegmented", "Compare segmented clouds", "compare"
    CHAIN, CLOUD = "change_only", "changes.copc.laz"
    KEEPS_STEPS = True
    SHORT = "Finds the changes between two surveys that Segment objects has cut into objects."
    HELP = (
        "Goes on from the folder of *Segment objects*: matches the objects of both surveys and decides what changed. "
        "Give the same surveys, preset and parameters; with others everything is computed anew. The result is added to "
        "that folder: changes.gpkg, lod95.tif, report.html and the labelled point cloud."
    )
    TAGS = ("change", "association", "difference", "objects")
    FILES = (
        ("CHANGES", "changes.gpkg", QgsProcessingOutputVectorLayer, "Changes"),
        ("LOD95", "lod95.tif", QgsProcessingOutputRasterLayer, "Limit of detection (LoD95)"),
        ("REPORT", "report.html", QgsProcessingOutputHtml, "Report"),
        ("TRANSFORM", "transform.json", QgsProcessingOutputFile, "Move between the surveys"),
    )

    def _add_place(self):
        self._add(
            QgsProcessingParameterFile(
                "SEGMENTED", "Folder of the segmented clouds", QgsProcessingParameterFile.Behavior.Folder
            ),
            "The folder for the results of Segment objects; the changes are added to it.",
        )
        self._add_loading()

    def _folder(self, parameters, context):
        return Path(self.parameterAsFile(parameters, "SEGMENTED", context)), False


def _value(text):
    try:
        return json.loads(text)
    except ValueError:
        return text


def _remove_steps(folder):
    """Remove the run folder's own files: the results of single steps, named in its manifest."""
    manifest = folder / "manifest.json"
    try:
        steps = json.loads(manifest.read_text(encoding="utf-8"))["stages"]
    except (OSError, ValueError, KeyError):
        return
    for step in steps.values():
        (folder / step["file"]).unlink(missing_ok=True)
    manifest.unlink(missing_ok=True)
