"""What all algorithms share: inputs, the run of the engine, and how its words reach the user."""

from __future__ import annotations

import shutil
from configparser import ConfigParser
from functools import lru_cache
from pathlib import Path

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterPointCloudLayer,
)
from qgis.PyQt.QtGui import QIcon

from .. import results, settings
from ..engine.errors import EngineCancelled, EngineError
from ..engine.locate import engine_version
from ..engine.process import answer, run_engine
from ..parameters import generated
from ..parameters import settings as chosen_settings

SURVEYS = ("BEFORE", "AFTER")
ICONS = Path(__file__).resolve().parent.parent / "icons"


@lru_cache
def homepage():
    """Where the project lives, as metadata.txt says it."""
    metadata = ConfigParser(interpolation=None)
    metadata.read(ICONS.parent / "metadata.txt", encoding="utf-8")
    return metadata["general"]["homepage"]


class Listener:
    """The engine's words, said through the feedback of an algorithm."""

    def __init__(self, feedback, stage_title):
        self._feedback, self._stage_title = feedback, stage_title
        self._stage = None

    def progress(self, percent, stage):
        self._feedback.setProgress(percent)
        if stage != self._stage:
            self._stage = stage
            title = self._stage_title(stage)
            self._feedback.setProgressText(f"{title[:1].upper()}{title[1:]}")

    def info(self, text):
        self._feedback.pushInfo(text)

    def warning(self, text):
        self._feedback.pushWarning(text)

    def console(self, text):
        self._feedback.pushConsoleInfo(text)


class LodaAlgorithm(QgsProcessingAlgorithm):
    """Base of all; a subclass says its words and builds its command."""

    NAME = TITLE = SHORT = HELP = ICON = ""
    TAGS = ()
    STAGES = None
    """Stages whose parameters are offered; None offers all."""

    def name(self):
        return self.NAME

    def displayName(self):
        return self.TITLE

    def shortDescription(self):
        return self.SHORT

    def shortHelpString(self):
        return self.HELP

    def helpUrl(self):
        return f"{homepage()}/blob/main/docs/qgis.md"

    def tags(self):
        return ["lidar", "point cloud", "change detection", "LoDA", "laz", "copc", *self.TAGS]

    def icon(self):
        return QIcon(str(ICONS / f"{self.ICON}.svg"))

    def svgIconPath(self):
        return str(ICONS / f"{self.ICON}.svg")

    def createInstance(self):
        return type(self)()

    def checkParameterValues(self, parameters, context):
        wrong = [
            definition
            for definition in self.parameterDefinitions()
            if not _is_survey_file(definition.name(), parameters)
            and not definition.checkValueIsAcceptable(parameters.get(definition.name()), context)
        ]
        if wrong:
            return super().checkParameterValues(parameters, context)
        try:
            settings.engine()
        except EngineError as error:
            return False, str(error)
        return True, ""

    def _add(self, definition, explanation, advanced=False):
        definition.setHelp(explanation)
        if advanced:
            definition.setFlags(definition.flags() | QgsProcessingParameterDefinition.Flag.FlagAdvanced)
        self.addParameter(definition)

    def _add_surveys(self, after_is_optional=False):
        for name, title, optional in (("BEFORE", "Before", False), ("AFTER", "After", after_is_optional)):
            self._add(
                QgsProcessingParameterPointCloudLayer(name, f"Survey {title.lower()}", optional=optional),
                f"The {'earlier' if name == 'BEFORE' else 'later'} survey: LAS, LAZ or COPC, as a layer or a file.",
            )
        self._add(
            QgsProcessingParameterCrs("CRS", "CRS of both surveys", optional=True),
            "Only where the files name none, or the wrong one. Needs an EPSG code.",
        )
        self._add(
            QgsProcessingParameterBoolean("ASSUME_SAME_CRS", "Go on although the CRS differ", False),
            "Go on although the surveys name different CRS, or only one names any.",
            advanced=True,
        )

    def _add_choices(self):
        definitions = settings.engine_definitions()
        presets = definitions.get("preset_names", list(definitions["presets"]))
        self._add(
            QgsProcessingParameterEnum(
                "PRESET",
                "Preset",
                presets,
                defaultValue="auto" if "auto" in presets else definitions["name"],
                usesStaticStrings=True,
            ),
            "Where all parameters start from: street (vehicle LiDAR), aerial (airborne LiDAR), paper (the published "
            "method to the letter) or auto (street or aerial, whichever the surveys look like).",
        )
        self._add(
            QgsProcessingParameterFile(
                "PARAMS", "Parameter file", optional=True, fileFilter="Parameters (*.toml *.json)"
            ),
            "TOML or JSON with parameters, over the preset: what `loda-pdal params -o mine.toml` writes.",
            advanced=True,
        )
        self._add(
            QgsProcessingParameterNumber("THREADS", "Threads", optional=True, minValue=1),
            "How many processors to use; all if left empty.",
            advanced=True,
        )
        self._generated = generated(definitions, self.STAGES)
        for definition, _ in self._generated.values():
            self.addParameter(definition)

    def _add_folder(self):
        self._add(
            QgsProcessingParameterFolderDestination("OUTPUT", "Folder for the results"),
            "Made where it does not exist.",
        )
        self._add_loading()

    def _add_loading(self):
        self._add(
            QgsProcessingParameterBoolean("LOAD", "Add the results to the map", True),
            "Add the layers, named and styled, in a group of their own. Off for models and batches.",
        )

    def _folder(self, parameters, context):
        """The output folder, and whether it is new."""
        folder = Path(self.parameterAsString(parameters, "OUTPUT", context))
        return folder, not folder.exists()

    def _survey(self, name, parameters, context):
        """The file of a survey, given as a layer or as a path; None where it was left out.

        A path is taken as it is: this QGIS need not be able to open the file itself.
        """
        if _is_survey_file(name, parameters):
            return parameters[name]
        layer = self.parameterAsPointCloudLayer(parameters, name, context)
        if layer is not None:
            return layer.source().partition("|")[0]
        text = self.parameterAsString(parameters, name, context)
        if text:
            raise QgsProcessingException(f"{text}: there is no such point cloud.")
        return None

    def _crs(self, parameters, context):
        """EPSG code, or None where none was chosen."""
        if not parameters.get("CRS"):
            return None
        crs = self.parameterAsCrs(parameters, "CRS", context)
        authority, _, code = crs.authid().partition(":")
        if authority != "EPSG" or not code.isdigit():
            raise QgsProcessingException(f"{crs.userFriendlyIdentifier()}: a CRS with an EPSG code is needed.")
        return int(code)

    def _settings(self, parameters):
        """``stage.key=value`` of the parameters that the user filled in."""
        return chosen_settings(self._generated, parameters)

    def _engine(self, feedback):
        """The engine's command, after a look at its version."""
        found = settings.engine()
        feedback.pushInfo(f"loda-pdal {engine_version(found)}, {found.origin}")
        return found.command

    def _run(self, arguments, feedback, new_folder=None):
        """The result of a run of the engine with progress; a folder that was new goes again if it fails."""
        try:
            command = [*self._engine(feedback), *arguments, "--progress", "json"]
            feedback.pushCommandInfo(" ".join(command))
            return run_engine(command, Listener(feedback, self._stage_title), feedback.isCanceled)
        except EngineCancelled:
            self._forget(new_folder)
            raise QgsProcessingException("Stopped; nothing was written.") from None
        except EngineError as error:
            self._forget(new_folder)
            raise QgsProcessingException(str(error)) from error

    def _ask(self, arguments, feedback, timeout_s=3600.0):
        """What a command without progress writes to stdout."""
        try:
            command = [*self._engine(feedback), *arguments]
            feedback.pushCommandInfo(" ".join(command))
            return answer(command, timeout_s)
        except EngineError as error:
            raise QgsProcessingException(str(error)) from error

    def _stage_title(self, stage):
        """What the user reads of a stage of the engine."""
        return stage

    def _load(self, folder, parameters, context):
        """Have the layers of a result added to the map when the algorithm is over."""
        if self.parameterAsBoolean(parameters, "LOAD", context):
            results.load_later(folder, context)

    @staticmethod
    def _forget(folder):
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _is_survey_file(name, parameters):
    """Whether a survey is given as a file. QGIS would refuse one that it cannot open itself, such as plain LAZ."""
    value = parameters.get(name)
    return name in SURVEYS and isinstance(value, str) and Path(value).is_file()
