"""The method, read top to bottom: `detect_changes` calls one step per stage of the paper, in order.

Each step below takes both epochs and what earlier steps found, and returns what it found: the PDAL face calls the same
steps one at a time. Swapping the epochs swaps the answer exactly, because every step treats the two alike and the
analysis frame is chosen by what the clouds hold (see `Registration.reference`).
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from loda_pdal.assembly import ground_records, instance_records, object_records, outline_of, point_labels
from loda_pdal.model.cloud import BoolArray, FloatArray, IntArray, VoxelCloud
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair, at_once
from loda_pdal.model.records import (
    ChangeResult,
    InstanceRecord,
    PointLabels,
    StageCost,
)
from loda_pdal.model.registration import Registration
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import transform_points
from loda_pdal.params import ChangeParams, Parameters
from loda_pdal.preset_choice import doubts_about, preset_for
from loda_pdal.stages.association import Descriptors, Matches, associate, describe
from loda_pdal.stages.changes import Changes, decide_changes
from loda_pdal.stages.correspondence import Objects, match_instances
from loda_pdal.stages.crowns import Crowns, find_crowns
from loda_pdal.stages.cues import Surface
from loda_pdal.stages.features import Features, eigen_features
from loda_pdal.stages.filling import bodies, filled, filled_everywhere
from loda_pdal.stages.fuse import fuse_survey
from loda_pdal.stages.ground import GroundModel, ground_model, vertical_rotation
from loda_pdal.stages.ground_changes import GroundChanges, ground_changes
from loda_pdal.stages.instances import Instances, form_instances
from loda_pdal.stages.lod import level_of_detection
from loda_pdal.stages.observability import coverage
from loda_pdal.stages.outliers import remove_outliers
from loda_pdal.stages.proxies import Proxies, build_proxies
from loda_pdal.stages.registration import register
from loda_pdal.stages.semantics import Semantics, classify
from loda_pdal.stages.sight import Sight, lines_of_sight
from loda_pdal.stages.superpoints import Superpoints, superpoints

Progress = Callable[[int, int, str], None]

NO_SIGHT: Pair[Sight | None] = Pair(None, None)
"""The rays of surveys without trajectories."""

STEPS = {
    "fuse": "fusing points",
    "register": "registering the epochs",
    "ground": "modelling the ground",
    "lod": "estimating the limit of detection",
    "proxies": "matching proxies",
    "superpoints": "partitioning into superpoints",
    "semantics": "classifying",
    "instances": "forming instances",
    "objects": "matching objects",
    "changes": "deciding changes",
    "ground_changes": "comparing the ground",
    "result": "outlining objects",
}
"""The steps in order, with the words that progress shows."""


def detect_changes(
    before: Survey, after: Survey, parameters: Parameters | None = None, progress: Progress | None = None
) -> ChangeResult:
    """Objects that were added, removed, grew or shrank between two surveys (paper, section 4).

    Parameters
    ----------
    before, after : Survey
        Both epochs in one local frame, see `read_epochs`.
    parameters : Parameters, optional
        Choices of the method; the preset that suits the surveys (`preset_for`) if left out.
    progress : callable, optional
        ``progress(done, total, text)``, called before each step and at the end.

    Returns
    -------
    ChangeResult
        Objects, changed ground, and values for every raw point, in local metres of the after frame.
    """
    surveys = Pair(before, after)
    p = resolve(parameters or Parameters.preset(preset_for(surveys).name), surveys)
    clock = StepClock(progress)
    with clock("fuse"):
        fused = fuse_epochs(surveys, p)
    with clock("register"):
        registration = register_epochs(fused, p)
        clouds = into_frame(fused, registration)
    with clock("ground"):
        ground = model_ground(clouds, p)
    with clock("lod"):
        lod = limit_of_detection(clouds, registration, p)
    with clock("proxies"):
        proxies = match_proxies(clouds, ground, p)
    with clock("superpoints"):
        segments = form_superpoints(clouds, ground, p)
    with clock("semantics"):
        classes = classify_superpoints(clouds, segments, p)
    with clock("instances"):
        instances = segment_instances(clouds, ground, classes, p)
    with clock("objects"):
        objects = match_objects(clouds, ground, instances, proxies, p)
    with clock("changes"):
        sight = look(surveys, fused, registration, p)
        changes = label_objects(clouds, ground, segments, instances, objects, lod, sight, p)
    with clock("ground_changes"):
        ground_change = compare_ground(clouds, instances, lod, p)
    with clock("result"):
        result = assemble(surveys, clouds, registration, ground, lod, segments, instances, changes, ground_change, p)
    return replace(result, costs=clock.costs)


@dataclass(frozen=True)
class Ground:
    """Ground model of one epoch and the height of its fused points above it, (m,) float64 m; NaN where unknown."""

    model: GroundModel
    height: FloatArray


@dataclass(frozen=True)
class ProxyMatches:
    """Proxies of both epochs and which of them belong together; None where the preset has no proxies."""

    proxies: Pair[Proxies]
    matches: Matches


@dataclass(frozen=True)
class Segments:
    """Features and superpoints of one epoch's fused points."""

    features: Features
    superpoints: Superpoints


def resolve(parameters: Parameters, surveys: Pair[Survey]) -> Parameters:
    """Parameters for these points: neighbourhoods grow with the sparser survey's spacing where that is allowed."""
    if not parameters.adapts_to_spacing:
        return parameters
    return parameters.for_spacing(max(survey.extent.spacing_m for survey in surveys))


def fuse_epochs(surveys: Pair[Survey], p: Parameters) -> Pair[VoxelCloud]:
    """One point per voxel, without statistical outliers (section 4.1)."""
    return at_once(lambda survey: remove_outliers(fuse_survey(survey, p.fuse), p.outliers), surveys)


def register_epochs(fused: Pair[VoxelCloud], p: Parameters) -> Registration:
    """Move between the epochs, its covariance, and the common vertical axis (section 4.1, equation 1)."""
    registration = register(fused, p)
    if p.ground.vertical == "plumb":
        return registration
    clouds = into_frame(fused, registration)
    ups = at_once(lambda cloud: ground_model(cloud.xyz, cloud.n_raw, p.ground).up, clouds)
    up = ups.before + ups.after
    return registration.with_vertical(vertical_rotation(up / np.linalg.norm(up)))


def into_frame(fused: Pair[VoxelCloud], registration: Registration) -> Pair[VoxelCloud]:
    """Both epochs in the analysis frame."""
    moves = Pair(registration.T_frame_before, registration.T_frame_after)
    return fused.join(moves, lambda cloud, T: cloud.moved(transform_points(T, cloud.xyz)))


def model_ground(clouds: Pair[VoxelCloud], p: Parameters) -> Pair[Ground]:
    """Ground model of each epoch and heights above it (section 4.1)."""

    def of_epoch(cloud: VoxelCloud) -> Ground:
        model = ground_model(cloud.xyz, cloud.n_raw, p.ground)
        return Ground(model, cloud.xyz[:, 2] - model.height_at(cloud.xyz[:, :2]))

    return at_once(of_epoch, clouds)


def limit_of_detection(clouds: Pair[VoxelCloud], registration: Registration, p: Parameters) -> LodGrid:
    """LoD95 on a sparse grid (equation 2)."""
    return level_of_detection(
        clouds.before.xyz, clouds.after.xyz, registration.covariance_in_frame, registration.centre_in_frame, p.lod
    )


def match_proxies(clouds: Pair[VoxelCloud], ground: Pair[Ground], p: Parameters) -> ProxyMatches | None:
    """Geometry-only proxies and their assignment (section 4.1)."""
    if not p.proxies.is_enabled:
        return None
    proxies = at_once(
        lambda cloud, g: build_proxies(cloud.xyz, g.height, _is_on_ground(g, p), p.proxies, p.association.boxes),
        clouds,
        ground,
    )
    return ProxyMatches(proxies, associate(proxies.before.descriptors, proxies.after.descriptors, p.association))


def form_superpoints(clouds: Pair[VoxelCloud], ground: Pair[Ground], p: Parameters) -> Pair[Segments]:
    """Geometric features and superpoints (section 4.2, equations 3 and 4)."""

    def of_epoch(cloud: VoxelCloud, g: Ground) -> Segments:
        features = eigen_features(cloud.xyz, g.height, p.features)
        return Segments(features, superpoints(cloud.xyz, features, p.superpoints))

    return at_once(of_epoch, clouds, ground)


def classify_superpoints(clouds: Pair[VoxelCloud], segments: Pair[Segments], p: Parameters) -> Pair[Semantics]:
    """Class of every superpoint (section 4.2)."""
    return at_once(
        lambda cloud, s: classify(
            cloud.xyz, p.fuse.leaf_m, s.features, s.superpoints.labels, s.superpoints.n, p.semantics
        ),
        clouds,
        segments,
    )


def segment_instances(
    clouds: Pair[VoxelCloud], ground: Pair[Ground], classes: Pair[Semantics], p: Parameters
) -> Pair[Instances]:
    """Instances within each class (section 4.2); touching crowns part in both where one epoch shows it."""
    crowns: Pair[Crowns | None] = Pair(None, None)
    if p.instances.splits_crowns:
        is_plant = classes.map(lambda side: side.classification == ObjectClass.VEGETATION)
        plants = clouds.join(is_plant, lambda cloud, asked: cloud.xyz[asked])
        found = find_crowns(plants, ground.join(is_plant, lambda g, asked: g.height[asked]))
        crowns = Pair(found.before, found.after)

    def of_epoch(cloud: VoxelCloud, g: Ground, semantics: Semantics, own: Crowns | None) -> Instances:
        return form_instances(cloud.xyz, cloud.n_raw, g.height, semantics, own, p.instances, p.semantics)

    return at_once(of_epoch, clouds, ground, classes, crowns)


def match_objects(
    clouds: Pair[VoxelCloud],
    ground: Pair[Ground],
    instances: Pair[Instances],
    proxies: ProxyMatches | None,
    p: Parameters,
) -> Objects:
    """Class-consistent association of the instances (sections 4.1 and 4.2)."""
    descriptors = at_once(lambda cloud, g, i: _descriptors(cloud, g, i, p), clouds, ground, instances)
    proxy_pairs = None if proxies is None else (proxies.proxies.map(lambda side: side.proxy), proxies.matches)
    xyz = clouds.map(lambda cloud: cloud.xyz)
    space = at_once(lambda cloud, g, i: bodies(cloud.xyz, g.height, i, p.changes), clouds, ground, instances)
    reach_m, has_sides = p.changes.query_radius_m, p.changes.needs_sight
    return match_instances(xyz, instances, space, descriptors, proxy_pairs, reach_m, p.association, has_sides=has_sides)


def look(
    surveys: Pair[Survey], fused: Pair[VoxelCloud], registration: Registration, p: Parameters
) -> Pair[Sight | None]:
    """Rays of the surveys whose trajectory is known, in the analysis frame."""
    moves = Pair(registration.T_frame_before, registration.T_frame_after)

    def of_epoch(survey: Survey, cloud: VoxelCloud, T: FloatArray) -> Sight | None:
        sight = lines_of_sight(survey, cloud, p.observability)
        return None if sight is None else sight.moved(T)

    return at_once(of_epoch, surveys, fused, moves)


def label_objects(
    clouds: Pair[VoxelCloud],
    ground: Pair[Ground],
    segments: Pair[Segments],
    instances: Pair[Instances],
    objects: Objects,
    lod: LodGrid,
    sight: Pair[Sight | None],
    p: Parameters,
) -> Changes:
    """Cues and change labels (section 4.3); ``sight`` has the rays of epochs whose trajectory is known."""

    def surface(cloud: VoxelCloud, g: Ground, s: Segments, i: Instances, own: IntArray) -> Surface:
        is_surface = (i.classification != ObjectClass.GROUND) | is_raised(cloud.xyz, ground, p.changes.raised_m)
        return Surface(cloud.xyz, s.features.normals, g.height, cloud.n_raw, own, is_surface)

    surfaces = at_once(surface, clouds, ground, segments, instances, objects.owner)
    covered = at_once(lambda cloud, rays: coverage(cloud.xyz, p.observability, rays), clouds, sight)

    def decide(sides: Pair[Surface], params: ChangeParams) -> Changes:
        found = decide_changes(sides, objects.object_class, covered, lod, params, p.observability, p.confidence)
        return replace(found, owner=found.owner.join(clouds, lambda own, cloud: own[: len(cloud)]))

    if not p.changes.fills_buildings:
        return decide(surfaces, p.changes)
    # buildings as bodies on a finer lattice, then everything else, beside which the buildings stand as bodies too
    is_building = np.append(objects.object_class == ObjectClass.BUILDING, False)
    step_m = p.changes.body_voxel_m
    buildings = surfaces.map(lambda side: side.only(is_building[side.owner]))
    of_buildings = decide(at_once(lambda side: filled_everywhere(side, step_m), buildings), p.changes.for_bodies())
    with_bodies = at_once(lambda side: filled(side, is_building[side.owner], step_m), surfaces)
    of_others = decide(with_bodies.map(lambda side: side.only(~is_building[side.owner])), p.changes)
    return of_buildings.together(of_others, clouds.map(lambda cloud: cloud.xyz))


def is_raised(xyz: FloatArray, ground: Pair[Ground], raised_m: float) -> BoolArray:
    """Which points (m, 3) lie so far above the lower of both ground models that they show a thing, whatever class.

    A hedge or a skip that one survey met with few returns is ground there, and its model climbs over it.
    """
    if raised_m <= 0:
        return np.zeros(len(xyz), dtype=np.bool_)
    heights = ground.map(lambda side: side.model.height_at(xyz[:, :2]))
    return np.asarray(xyz[:, 2] - np.fmin(heights.before, heights.after) > raised_m)


def compare_ground(clouds: Pair[VoxelCloud], instances: Pair[Instances], lod: LodGrid, p: Parameters) -> GroundChanges:
    """Changed ground on a 2 m raster (section 4.3)."""
    is_ground = instances.map(lambda side: side.classification == ObjectClass.GROUND)
    return ground_changes(clouds.map(lambda cloud: cloud.xyz), is_ground, lod, p.ground_changes)


def assemble(
    surveys: Pair[Survey],
    clouds: Pair[VoxelCloud],
    registration: Registration,
    ground: Pair[Ground],
    lod: LodGrid,
    segments: Pair[Segments],
    instances: Pair[Instances],
    changes: Changes,
    ground_change: GroundChanges,
    p: Parameters,
) -> ChangeResult:
    """Everything found, on raw points and as records with outlines, in the after frame."""
    in_after = clouds.map(lambda cloud: transform_points(registration.T_after_frame, cloud.xyz))

    def labels_of(
        survey: Survey, T: FloatArray, cloud: VoxelCloud, g: Ground, s: Segments, i: Instances, o: IntArray
    ) -> PointLabels:
        return point_labels(
            survey,
            T,
            cloud,
            g.model,
            lod,
            s.superpoints.labels,
            i,
            o,
            changes,
            ground_change,
            p.ground_changes.min_dz_m,
        )

    def instances_of(cloud: VoxelCloud, xyz: FloatArray, g: Ground, i: Instances, o: IntArray) -> list[InstanceRecord]:
        return instance_records(cloud, xyz, g.height, i, o, _outline_m(p), p.changes.voxel_m)

    moves = Pair(registration.T_frame_before, registration.T_frame_after)
    has_ground = ground.before.model.has_ground and ground.after.model.has_ground
    return ChangeResult(
        objects=object_records(in_after, instances, changes, _outline_m(p)),
        ground_changes=ground_records(ground_change, registration.T_after_frame),
        instances=at_once(instances_of, clouds, in_after, ground, instances, changes.owner),
        points=at_once(labels_of, surveys, moves, clouds, ground, segments, instances, changes.owner),
        registration=registration,
        lod=lod,
        clouds=in_after,
        object_of_voxel=changes.owner.map(lambda side: (side + 1).astype(np.uint32)),
        block=outline_of(in_after),
        parameters=p,
        has_ground=has_ground,
        warnings=[*doubts_about(p.name, surveys), *warnings_of(registration, has_ground, changes, ground_change)],
    )


def warnings_of(registration: Registration, has_ground: bool, changes: Changes, ground: GroundChanges) -> list[str]:
    """What a user must know before trusting the result."""
    found = []
    if not registration.converged:
        found.append(f"Registration did not converge: {registration.message} Check the overlap before using any label.")
    dx, dy, dz = registration.shift_m
    if abs(dz) > _DATUM_SHIFT_M:
        found.append(
            f"The before survey was moved by {dz:+.2f} m in height to fit the after survey: check the vertical datums; "
            "a real uplift or subsidence of the whole area would look the same."
        )
    if math.hypot(dx, dy) > _PLAN_SHIFT_M:
        found.append(f"The before survey was moved by {math.hypot(dx, dy):.2f} m in plan to fit the after survey.")
    if not has_ground:
        found.append(
            "No ground was found: heights are above the lowest returns nearby, and ground changes were not evaluated."
        )
    measured = ground.dz[np.isfinite(ground.dz)]
    low, middle, high = np.percentile(measured, (25, 50, 75)) if len(measured) >= _MIN_TILES else (0.0, 0.0, 0.0)
    if max(abs(middle), high - low) > _GROUND_OFFSET_M:
        found.append(
            f"After registration the ground of the after survey lies {middle:+.2f} m from that of the before survey "
            f"(median of {len(measured)} tiles; half of them between {low:+.2f} and {high:+.2f} m): check the vertical "
            "datums and the calibration of the strips before believing small height changes."
        )
    unseen = np.count_nonzero(changes.label == ChangeLabel.UNDETERMINED)
    if len(changes) and unseen > _MOST_UNSEEN * len(changes):
        found.append(
            f"{unseen} of {len(changes)} objects are Undetermined: the other survey could not have seen enough of "
            "them, or only a few returns show them."
        )
    return found


_DATUM_SHIFT_M = 0.10
_PLAN_SHIFT_M = 0.50
_GROUND_OFFSET_M = 0.10
_MIN_TILES = 50
_MOST_UNSEEN = 0.2


def _outline_m(p: Parameters) -> float:
    """Resolution of outlines: the occupancy voxel."""
    return p.changes.voxel_m


def _descriptors(cloud: VoxelCloud, ground: Ground, instances: Instances, p: Parameters) -> Descriptors:
    """What the association compares of one epoch's instances."""
    return describe(
        cloud.xyz,
        np.where(np.isfinite(ground.height), ground.height, 0.0),
        instances.instance,
        len(instances),
        p.proxies.histogram_bins,
        p.proxies.voxel_m,
        p.association.boxes,
    )


def _is_on_ground(ground: Ground, p: Parameters) -> BoolArray:
    return np.asarray(np.abs(ground.height) < p.semantics.ground_distance_m)


class StepClock:
    """Says when steps begin and remembers what they took."""

    def __init__(self, progress: Progress | None) -> None:
        self.costs: list[StageCost] = []
        self._progress = progress or (lambda done, total, text: None)

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        """Announce a step, run it, note its seconds and the peak memory of the process so far."""
        self._progress(len(self.costs), len(STEPS), STEPS[step])
        start = time.perf_counter()
        yield
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        self.costs.append(StageCost(step, time.perf_counter() - start, peak_mb))
        if len(self.costs) == len(STEPS):
            self._progress(len(STEPS), len(STEPS), "done")
