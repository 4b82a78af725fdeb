"""One run, step by step: what a stage needs is taken from the run folder, or computed if it is not there yet.

The steps are those of `loda_pdal.pipeline.detect_changes`, called with the same arguments, so a chain of PDAL stages
and one call of `detect_changes` give the same numbers.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pyproj import CRS
from pyproj.exceptions import CRSError

import loda_pdal
from loda_pdal import pipeline
from loda_pdal.assembly import height_of_points, spread
from loda_pdal.io.crs import DeclaredCrs, MapCrs, common_crs
from loda_pdal.io.las import check_coverage, common_frame
from loda_pdal.io.outputs import write_outputs
from loda_pdal.io.raster import write_lod_raster
from loda_pdal.io.run_folder import RunFolder
from loda_pdal.io.transform import write_transform
from loda_pdal.model import dimensions as dims
from loda_pdal.model.cloud import BoolArray, FloatArray, VoxelCloud
from loda_pdal.model.dimensions import Dimension
from loda_pdal.model.errors import InputError, ParameterError, PipelineError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ObjectClass
from loda_pdal.model.pair import Pair, at_once
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.params import AUTO, Parameters
from loda_pdal.pdal_face.adapter import Call, Points
from loda_pdal.preset_choice import preset_for

logger = logging.getLogger(__name__)

_NAMES = Pair("the before epoch", "the after epoch")

Values = dict[Dimension, Pair[npt.NDArray[Any]]]


@dataclass(frozen=True)
class Arguments:
    """The ``pdalargs`` that every stage understands.

    Attributes
    ----------
    run : Path or None
        Run folder; None keeps nothing, so that each stage computes all it needs.
    parameters : Parameters
        From ``preset``, ``params`` (a file) and ``set`` (``{"lod.radius_m": 1.5}``).
    is_auto : bool
        No preset was chosen: the one that suits the surveys is taken, see `for_surveys`.
    epsg : int or None
        CRS of both surveys, whatever their files say.
    assume_same_crs : bool
        Go on although the files name different CRS, or none.
    """

    run: Path | None
    parameters: Parameters
    is_auto: bool
    epsg: int | None
    assume_same_crs: bool
    given: Mapping[str, Any]

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Arguments:
        """Arguments from ``pdalargs``; unknown names are errors."""
        known = ("run", "preset", "params", "set", "epsg", "assume_same_crs")
        unknown = [name for name in given if name not in known]
        if unknown:
            raise ParameterError(
                f"pdalargs: unknown name {unknown[0]!r}.", f"Known are {', '.join(known)}.", "pdalargs-invalid"
            )
        is_auto = given.get("preset", AUTO) == AUTO
        parameters = _chosen(given)
        run, epsg = given.get("run"), given.get("epsg")
        if epsg is not None and (not isinstance(epsg, int) or isinstance(epsg, bool)):
            raise ParameterError(f"pdalargs: epsg is {epsg!r}.", 'Write "epsg": 28992.', "pdalargs-invalid")
        folder = Path(str(run)) if run else None
        return cls(folder, parameters, is_auto, epsg, bool(given.get("assume_same_crs", False)), given)

    def for_surveys(self, surveys: Pair[Survey]) -> Parameters:
        """The parameters, with the preset that suits the surveys where that was asked for."""
        if not self.is_auto:
            return self.parameters
        suits = preset_for(surveys)
        parameters = _chosen(self.given, suits.name)
        if parameters.name == suits.name:
            logger.info("Preset %s: %s.", suits.name, suits.reason)
        return parameters


def _chosen(given: Mapping[str, Any], suits: str = "street") -> Parameters:
    """Parameters as ``preset``, ``params`` and ``set`` choose them, ``suits`` where neither names a preset."""
    path = Path(str(given["params"])) if given.get("params") else None
    parameters = Parameters.chosen(str(given.get("preset", AUTO)), path, suits)
    settings = given.get("set", {})
    if not isinstance(settings, Mapping):
        raise ParameterError("pdalargs: set is no table.", 'Write "set": {"lod.radius_m": 1.5}.', "pdalargs-invalid")
    for key, value in settings.items():
        stage, _, name = str(key).partition(".")
        parameters = parameters.with_values({stage: {name: value}}, where="pdalargs")
    return parameters


class Run:
    """Points of both epochs with one set of parameters, and every result on the way, made when first asked for.

    Parameters
    ----------
    call : Call
        The points of a stage, both epochs in one view told apart by Epoch.
    """

    def __init__(self, call: Call) -> None:
        self.arguments = Arguments.parse(call.arguments)
        self._call = call
        self._results: dict[str, Any] = {}
        epoch = call.points.column(dims.EPOCH.name)
        self._is_before: BoolArray = epoch == 0
        n_before = int(self._is_before.sum())
        if n_before in (0, len(epoch)) or np.any(epoch > 1):
            raise PipelineError(
                f"Stage {call.points.stage} needs both epochs in one view, Epoch 0 and 1; it got Epoch "
                f"{', '.join(str(e) for e in np.unique(epoch)[:5])}.",
                "Put the stages `before` and `after`, then filters.merge, before it.",
                "epochs-not-merged",
            )
        self._folder = self._open_folder(call.points, epoch)

    @cached_property
    def _map_xyz(self) -> Pair[FloatArray]:
        xyz = self._call.points.xyz
        if not np.all(np.isfinite(xyz)):
            raise InputError("Some coordinates are not finite.", "Drop those points first.", "input-not-finite")
        return Pair(xyz[self._is_before], xyz[~self._is_before])

    @cached_property
    def frame(self) -> LocalFrame:
        """The local frame that both epochs share."""
        return common_frame(self._map_xyz.map(lambda xyz: xyz.min(axis=0)), _map_crs(self._call, self.arguments))

    @cached_property
    def surveys(self) -> Pair[Survey]:
        """Raw points of both epochs."""
        return self._map_xyz.map(lambda xyz: Survey(self.frame.to_local(xyz), self.frame))

    @cached_property
    def parameters(self) -> Parameters:
        """Parameters as resolved for these points."""
        resolved: Parameters = self["parameters"]
        return resolved

    @cached_property
    def clouds(self) -> Pair[VoxelCloud]:
        """Fused points of both epochs in the analysis frame."""
        return pipeline.into_frame(self["fuse"], self["register"])

    def __getitem__(self, step: str) -> Any:
        """Result of a step: from this call, else from the run folder, else computed and kept there."""
        if step not in self._results:
            self._results[step] = self._load_or_compute(step)
        return self._results[step]

    def _load_or_compute(self, step: str) -> Any:
        if self._folder is not None:
            try:
                return self._folder.load(step)
            except KeyError:
                pass
        start = time.perf_counter()
        result = STEPS[step](self)
        if self._folder is not None:
            self._folder.save(step, result, time.perf_counter() - start)
        return result

    def _open_folder(self, points: Points, epoch: npt.NDArray[Any]) -> RunFolder | None:
        if self.arguments.run is None:
            return None
        about = {
            "loda_pdal": loda_pdal.__version__,
            "points_before": int(self._is_before.sum()),
            "points_after": int(len(epoch) - self._is_before.sum()),
            "epsg": self.arguments.epsg,
            "assume_same_crs": self.arguments.assume_same_crs,
            "crs_wkt": self._call.crs_wkt,
            "is_auto": self.arguments.is_auto,
            "parameters": self.arguments.parameters.to_dict(),
        }
        digest = hashlib.blake2b(json.dumps(about, sort_keys=True).encode(), digest_size=16)
        for column in (epoch, *(points.ins[axis] for axis in "XYZ")):
            digest.update(np.ascontiguousarray(column).data)
        return RunFolder(self.arguments.run, digest.hexdigest(), about)

    def write(self, values: Values) -> None:
        """Hand values of both epochs back to PDAL, each (n,) in the order of its epoch's points."""
        for dimension, pair in values.items():
            column = np.empty(len(self._is_before), dtype=dimension.dtype)
            column[self._is_before], column[~self._is_before] = pair.before, pair.after
            self._call.points.write_dimension(dimension, column)

    def write_transform(self) -> None:
        """The move between the epochs as transform.json in the run folder."""
        if self._folder is not None:
            write_transform(self._folder.path / "transform.json", self["register"], self.frame)

    def write_lod_raster(self) -> None:
        """The limit of detection as lod95.tif in the run folder."""
        if self._folder is not None:
            T_after_frame = self["register"].T_after_frame
            write_lod_raster(self._folder.path / "lod95.tif", self["lod"], T_after_frame, self.frame)

    def move_before(self) -> None:
        """Move the before-points onto the after epoch: X, Y and Z change."""
        moved = self.frame.to_map(transform_points(self["register"].T_after_before, self.surveys.before.xyz))
        for column, axis in enumerate("XYZ"):
            values = self._call.points.column(axis)
            values[self._is_before] = moved[:, column]
            self._call.points.write(axis, values)

    def assembled(self) -> ChangeResult:
        """The whole result; its GeoPackage, raster and report are written to the run folder."""
        result = pipeline.assemble(
            self.surveys,
            self.clouds,
            self["register"],
            self["ground"],
            self["lod"],
            self["superpoints"],
            self["instances"],
            self["changes"],
            self["ground_changes"],
            self.parameters,
        )
        if self._folder is not None:
            write_outputs(result, self.surveys, self._folder.path, overwrite=True, with_cloud=False)
        return result


STEPS: dict[str, Callable[[Run], Any]] = {
    "parameters": lambda run: _resolved(run),
    "fuse": lambda run: pipeline.fuse_epochs(run.surveys, run.parameters),
    "register": lambda run: pipeline.register_epochs(run["fuse"], run.parameters),
    "ground": lambda run: pipeline.model_ground(run.clouds, run.parameters),
    "lod": lambda run: pipeline.limit_of_detection(run.clouds, run["register"], run.parameters),
    "proxies": lambda run: pipeline.match_proxies(run.clouds, run["ground"], run.parameters),
    "superpoints": lambda run: pipeline.form_superpoints(run.clouds, run["ground"], run.parameters),
    "semantics": lambda run: pipeline.classify_superpoints(run.clouds, run["superpoints"], run.parameters),
    "instances": lambda run: pipeline.segment_instances(run.clouds, run["ground"], run["semantics"], run.parameters),
    "objects": lambda run: pipeline.match_objects(
        run.clouds, run["ground"], run["instances"], run["proxies"], run.parameters
    ),
    "changes": lambda run: pipeline.label_objects(
        run.clouds,
        run["ground"],
        run["superpoints"],
        run["instances"],
        run["objects"],
        run["lod"],
        pipeline.NO_SIGHT,
        run.parameters,
    ),
    "ground_changes": lambda run: pipeline.compare_ground(run.clouds, run["instances"], run["lod"], run.parameters),
}
"""The steps of the method, each from the results it needs: the words of `loda_pdal.pipeline.detect_changes`."""


def _resolved(run: Run) -> Parameters:
    """Parameters for these points, once they were found to be two surveys of one place."""
    check_coverage(_NAMES, run.surveys.map(lambda survey: survey.extent))
    return pipeline.resolve(run.arguments.for_surveys(run.surveys), run.surveys)


def heights(run: Run) -> Values:
    """Height of every raw point above the ground model of its epoch."""
    registration = run["register"]
    moves = Pair(registration.T_frame_before, registration.T_frame_after)
    models = run["ground"].map(lambda ground: ground.model)
    return {dims.HEIGHT: at_once(height_of_points, moves, models, run.surveys.map(lambda survey: survey.xyz))}


def limits(run: Run) -> Values:
    """LoD95 of every raw point."""
    lod = run["lod"]
    return {dims.LOD95: run.clouds.map(lambda cloud: spread(cloud, lod.at(cloud.xyz), math.nan, "float32"))}


def superpoint_numbers(run: Run) -> Values:
    """Superpoint of every raw point."""
    labels = run["superpoints"].map(lambda segments: segments.superpoints.labels + 1)
    return {dims.SUPERPOINT: run.clouds.join(labels, lambda cloud, label: spread(cloud, label, 0, "uint32"))}


def classes(run: Run) -> Values:
    """Class of every raw point by its superpoint."""
    return {dims.CLASSIFICATION: run.clouds.join(run["semantics"], _class_of_points)}


def instance_numbers(run: Run) -> Values:
    """Instance of every raw point, and its class now that instances were judged as wholes."""
    instances = run["instances"]
    return {
        dims.CLASSIFICATION: run.clouds.join(instances, _class_of_points),
        dims.INSTANCE: run.clouds.join(instances, lambda cloud, side: spread(cloud, side.instance, 0, "uint32")),
    }


def _class_of_points(cloud: VoxelCloud, labelled: Any) -> npt.NDArray[Any]:
    return spread(cloud, labelled.classification, ObjectClass.NOISE, "uint8")


def result_values(run: Run) -> Values:
    """Everything that is answered per point."""
    points = run.assembled().points
    return {
        dims.CLASSIFICATION: points.map(lambda side: side.classification),
        dims.HEIGHT: points.map(lambda side: side.height),
        dims.LOD95: points.map(lambda side: side.lod95),
        dims.SUPERPOINT: points.map(lambda side: side.superpoint),
        dims.INSTANCE: points.map(lambda side: side.instance),
        dims.OBJECT: points.map(lambda side: side.object),
        dims.CHANGE: points.map(lambda side: side.change),
        dims.CONFIDENCE: points.map(lambda side: side.confidence),
    }


def _map_crs(call: Call, arguments: Arguments) -> MapCrs:
    """The CRS of both epochs: as the stages `before` and `after` left it, else that of the view."""
    wkt = Pair(call.notes.get("before", call.crs_wkt), call.notes.get("after", call.crs_wkt))
    try:
        return common_crs(
            wkt.map(_declared),
            _NAMES,
            epsg=arguments.epsg,
            assume_same_crs=arguments.assume_same_crs,
        )
    except InputError as error:
        remedy = f'{error.remedy} In a pipeline these are "epsg": N and "assume_same_crs": true in pdalargs.'
        raise InputError(error.message, remedy, error.code) from None


def _declared(wkt: str | None) -> DeclaredCrs:
    try:
        return DeclaredCrs(CRS.from_wkt(wkt) if wkt else None)
    except CRSError as error:
        return DeclaredCrs(problem=f"its CRS cannot be parsed ({str(error).splitlines()[0][:120]})")
