"""Every choice of the method: one frozen dataclass per stage, collected in `Parameters`.

Standard library only, so that PDAL's and QGIS's interpreters can load it. Each field says what it is, its unit, its
range and the paper's symbol or section; `loda-pdal params` prints the same. Lengths are metres and angles radians
unless the name says otherwise. Presets: ``street`` (vehicle LiDAR, the default), ``aerial`` (airborne LiDAR), both
ours, and ``paper`` (the paper to the letter wherever the letter can be computed).
"""

from __future__ import annotations

import json
import math
import tomllib
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from loda_pdal.model.errors import ParameterError

PRESETS = ("street", "aerial", "paper")

AUTO = "auto"
"""In place of a preset's name: the one that suits the surveys (`loda_pdal.preset_choice`)."""


def param(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    symbol: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    is_length: bool = False,
) -> Any:
    """A dataclass field with its documentation and range; `is_length` marks neighbourhood sizes that grow with the
    point spacing (see `Parameters.for_spacing`)."""
    metadata = {
        "doc": doc,
        "unit": unit,
        "symbol": symbol,
        "low": low,
        "high": high,
        "choices": choices,
        "is_length": is_length,
    }
    return field(default=default, metadata=metadata)


def _coerced(kind: Any, value: Any, name: str) -> Any:
    """``value`` as ``kind`` (float takes int, tuple takes list), else `ParameterError`."""
    origin = typing.get_origin(kind)
    if origin is tuple:
        if not isinstance(value, (list, tuple)) or not value:
            raise _wrong_type(name, "a list", value)
        inner = typing.get_args(kind)[0]
        return tuple(_coerced(inner, item, name) for item in value)
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind in (bool, str) and isinstance(value, kind):
        return value
    raise _wrong_type(name, {float: "a number", int: "a whole number", bool: "true or false"}.get(kind, "text"), value)


def _wrong_type(name: str, expected: str, value: Any) -> ParameterError:
    return ParameterError(f"{name} must be {expected}, not {value!r}.", "See `loda-pdal params`.", "parameter-invalid")


def _check_range(name: str, value: Any, metadata: Mapping[str, Any]) -> None:
    low, high, choices = metadata["low"], metadata["high"], metadata["choices"]
    for item in value if isinstance(value, tuple) else (value,):
        if choices and item not in choices:
            raise ParameterError(
                f"{name} must be one of {', '.join(choices)}, not {item!r}.",
                "See `loda-pdal params`.",
                "parameter-range",
            )
        is_number = isinstance(item, (int, float)) and not isinstance(item, bool)
        if is_number and not ((low is None or item >= low) and (high is None or item <= high)):
            raise ParameterError(
                f"{name} = {item} is outside {low} to {high}" + (f" {metadata['unit']}." if metadata["unit"] else "."),
                "Choose a value in that range.",
                "parameter-range",
            )


@dataclass(frozen=True)
class StageParams:
    """Base of all stage parameters: types and ranges are checked when an instance is made."""

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for item in fields(self):
            value = _coerced(hints[item.name], getattr(self, item.name), item.name)
            object.__setattr__(self, item.name, value)
            _check_range(item.name, value, item.metadata)


@dataclass(frozen=True)
class FuseParams(StageParams):
    """Raw points to one point per voxel (paper, section 4.1: the 0.25 m fused map)."""

    leaf_m: float = param(0.25, "edge of the finest voxel", unit="m", low=0.01, high=10, is_length=True)


@dataclass(frozen=True)
class OutlierParams(StageParams):
    """Statistical outlier removal (paper, section 4.1)."""

    is_enabled: bool = param(True, "remove statistical outliers")
    k: int = param(20, "neighbours whose mean distance is judged", symbol="k", low=1, high=200)
    std_multiplier: float = param(3.0, "standard deviations above the mean that make an outlier", low=0.1, high=20)
    keep_voxels: int = param(
        8,
        "outliers that hang together in clusters of this many are thin or far away and stay; 0: none",
        low=0,
        high=10000,
    )
    keep_gap_m: float = param(0.6, "largest gap within such a cluster", unit="m", low=0.05, high=20, is_length=True)


@dataclass(frozen=True)
class NormalParams(StageParams):
    """Local planes: normals and roughness (paper, section 4.1)."""

    radius_m: float = param(0.75, "neighbourhood radius", unit="m", symbol="r_n", low=0.02, high=20, is_length=True)
    max_neighbours: int = param(30, "at most this many nearest neighbours", low=4, high=200)
    min_neighbours: int = param(6, "fewer make no plane", low=3, high=200)
    max_isotropy: float = param(0.5, "smallest over middle eigenvalue above which there is no plane", low=0.01, high=1)


@dataclass(frozen=True)
class NdtParams(StageParams):
    """First pose by multi-resolution normal distributions transform (paper, section 4.1)."""

    is_enabled: bool = param(True, "look for a coarse pose before ICP")
    cells_m: tuple[float, ...] = param(
        (8.0, 4.0, 2.0, 1.0), "cell edges, coarse to fine", unit="m", low=0.1, high=100, is_length=True
    )
    max_iterations: int = param(30, "Gauss-Newton steps per level", low=1, high=500)
    min_points: int = param(6, "points that make a cell's distribution", low=4, high=1000)


@dataclass(frozen=True)
class IcpParams(StageParams):
    """Robust point-to-plane ICP (paper, equation 1)."""

    leaves_m: tuple[float, ...] = param(
        (1.0, 0.5, 0.25), "voxel pyramid, coarse to fine", unit="m", low=0.01, high=100, is_length=True
    )
    radii_m: tuple[float, ...] = param(
        (1.5, 0.75, 0.35), "correspondence radius per level", unit="m", low=0.01, high=100, is_length=True
    )
    max_iterations: tuple[int, ...] = param((60, 40, 30), "iterations per level", low=1, high=1000)
    stop_update: float = param(1e-4, "stop when the pose changes less", unit="m, rad", low=1e-9, high=0.1)
    max_normal_angle_deg: float = param(30.0, "largest angle between paired normals", unit="deg", low=1, high=90)
    tukey_m: float = param(0.30, "residual at which a pair is rejected", unit="m", symbol="tau", low=0.01, high=10)
    adapts_tukey: bool = param(
        True, "tukey_m follows the residuals: less where surfaces fit well, more at first where they start apart"
    )
    sigma0_m: float = param(0.02, "fixed sensor noise", unit="m", symbol="sigma_0", low=1e-4, high=1)
    loss: str = param("tukey", "robust loss, or least squares", choices=("tukey", "l2"))
    covariance: str = param(
        "block",
        "pose covariance: residuals resampled by blocks, or the inverse normal matrix",
        symbol="Sigma_T",
        choices=("block", "normal"),
    )
    covariance_block_m: float = param(10.0, "edge of the blocks of the covariance estimate", unit="m", low=1, high=1000)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.leaves_m) == len(self.radii_m) == len(self.max_iterations):
            raise ParameterError(
                f"leaves_m, radii_m and max_iterations have {len(self.leaves_m)}, {len(self.radii_m)} and "
                f"{len(self.max_iterations)} entries.",
                "Give one of each per pyramid level.",
                "parameter-invalid",
            )


@dataclass(frozen=True)
class GroundParams(StageParams):
    """Ground model and common vertical axis (paper, section 4.1)."""

    cell_m: float = param(2.0, "edge of a ground cell", unit="m", low=0.5, high=50, is_length=True)
    detail_m: float = param(
        2.0, "where ground cells grew with the spacing, cells of the detail between planes", unit="m", low=0.5, high=50
    )
    inlier_m: float = param(0.10, "RANSAC inlier distance", unit="m", low=0.01, high=2)
    min_inliers: int = param(
        200,
        "inlying raw points that make a plane; scaled down where the cell holds fewer (METHOD 1.1)",
        low=3,
        high=100000,
    )
    min_voxels: int = param(8, "inlying fused points that make a plane at any density", low=3, high=1000)
    iterations: int = param(60, "RANSAC draws per cell", low=1, high=10000)
    max_slope_deg: float = param(30.0, "steepest ground", unit="deg", low=1, high=80)
    max_object_m: float = param(
        24.0, "largest roof, in plan, that is bridged as not being ground", unit="m", low=2, high=500
    )
    vertical: str = param(
        "plumb", "vertical axis: z of the map, or the median ground normal", choices=("plumb", "ground")
    )
    seed: int = param(1, "seed of the RANSAC draws", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class LodParams(StageParams):
    """Limit of detection at 95 % (paper, equation 2)."""

    cell_m: float = param(1.0, "edge of a cell of the sparse 3D grid", unit="m", low=0.1, high=50, is_length=True)
    radius_m: float = param(1.0, "pooling radius", unit="m", symbol="r_LoD", low=0.1, high=50, is_length=True)
    min_points: int = param(30, "points of each epoch that make a valid cell", symbol="N(g)", low=3, high=10000)
    max_isotropy: float = param(
        0.5, "smallest over middle eigenvalue above which a cell is not valid", low=0.001, high=1
    )
    small_sample: bool = param(True, "widen the limit where few points make it, so that 95 % stays 95 %")
    low_observability_m: float = param(0.50, "limit where a cell is not valid", unit="m", low=0.01, high=10)
    pose_term: str = param(
        "full",
        "pose covariance in the limit: full 6x6, translation only, or none",
        choices=("full", "translation", "none"),
    )
    drift_term: str = param(
        "measured",
        "what the surveys disagree by beyond noise and pose, on surfaces that mostly did not change, or nothing",
        choices=("measured", "none"),
    )
    max_drift_m: float = param(
        0.10, "largest drift, one sigma, that is believed; more is change", unit="m", low=0, high=5
    )
    variation: str = param("spatial", "limit per cell, or one number for the map", choices=("spatial", "global"))


@dataclass(frozen=True)
class ProxyParams(StageParams):
    """Geometry-only object proxies (paper, section 4.1)."""

    is_enabled: bool = param(True, "build and match proxies before semantics")
    voxel_m: float = param(0.5, "occupancy voxel", unit="m", low=0.05, high=10, is_length=True)
    min_height_m: float = param(0.3, "lowest height above ground of a proxy's points", unit="m", low=0, high=5)
    closing_voxels: int = param(1, "dilation and erosion steps", low=0, high=5)
    min_voxels: int = param(200, "smallest proxy", unit="voxels", low=1, high=100000)
    histogram_bins: int = param(10, "bins of the height histogram", symbol="H(o)", low=2, high=100)


@dataclass(frozen=True)
class AssociationParams(StageParams):
    """Gated assignment between epochs (paper, section 4.1)."""

    gate_m: float = param(2.0, "largest centroid distance", unit="m", low=0.1, high=100)
    gate_iou: float = param(0.10, "smallest box IoU", low=0, high=1)
    weight_position: float = param(1.0, "weight of the squared centroid distance", symbol="w_p", low=0, high=100)
    weight_box: float = param(2.0, "weight of 1 - IoU of the boxes", symbol="w_b", low=0, high=100)
    weight_histogram: float = param(
        0.5, "weight of the chi-square distance of height histograms", symbol="w_h", low=0, high=100
    )
    unmatched_cost: float = param(3.0, "cost of leaving an object unmatched", low=0, high=100)
    solver: str = param("hungarian", "optimal or greedy assignment", choices=("hungarian", "greedy"))
    boxes: str = param("upright", "gravity-aligned boxes, or 3D principal axes", choices=("upright", "pca"))
    splits_merged: bool = param(
        True, "a thing that stands apart in one epoch is taken out of what it is merged with in the other"
    )


@dataclass(frozen=True)
class FeatureParams(StageParams):
    """Eigenvalue features (paper, section 4.2, equation 3)."""

    radius_m: float = param(0.6, "neighbourhood radius", unit="m", low=0.05, high=20, is_length=True)
    min_neighbours: int = param(5, "points, itself included, that make a shape", low=3, high=200)


@dataclass(frozen=True)
class SuperpointParams(StageParams):
    """Superpoints by the L1 Potts energy (paper, equation 4)."""

    method: str = param(
        "partition", "minimise the energy, or connected voxels only", choices=("partition", "components")
    )
    k: int = param(20, "neighbours in the graph", symbol="k", low=2, high=100)
    max_edge_m: float = param(1.2, "longest edge", unit="m", low=0.1, high=50, is_length=True)
    beta: float = param(0.8, "weight of the boundary", symbol="beta", low=0, high=100)
    absorb_below: int = param(
        10,
        "superpoints with fewer voxels join the neighbour they share most weight with",
        unit="voxels",
        low=1,
        high=1000,
    )


@dataclass(frozen=True)
class SemanticParams(StageParams):
    """Class rules per superpoint (paper, section 4.2)."""

    ground_distance_m: float = param(0.10, "largest median height of ground", unit="m", low=0.01, high=1)
    ground_horizontal: float = param(0.996, "|n.z| of a horizontal normal", low=0.5, high=1)
    ground_share: float = param(0.80, "smallest share of horizontal normals in ground", low=0, high=1)
    points_near_ground_are_ground: bool = param(
        True, "single voxels within ground_distance_m with no plane of their own are ground too"
    )
    building_planarity: float = param(0.60, "smallest planarity", symbol="P", low=0, high=1)
    building_vertical: float = param(0.25, "largest |n.z| of a facade", low=0, high=1)
    building_rmse_m: float = param(0.08, "largest plane RMSE", unit="m", low=0.01, high=2)
    building_area_m2: float = param(
        5.0, "smallest support after merging coplanar neighbours", unit="m2", low=0.1, high=1000
    )
    merge_angle_deg: float = param(12.0, "largest angle between merged planes", unit="deg", low=1, high=90)
    split_angle_deg: float = param(
        12.0, "planar superpoints that run around a corner are cut at this angle; 0: never", unit="deg", low=0, high=90
    )
    has_roofs: bool = param(True, "elevated planar patches are building too (METHOD 1.8)")
    roof_height_m: float = param(2.0, "lowest median height of a roof", unit="m", low=0.5, high=20)
    roof_area_m2: float = param(6.0, "smallest support of a roof", unit="m2", low=0.1, high=1000)
    stepped_roof_m2: float = param(
        0.0,
        "smallest area of a roof that is flat all over but lies in no one plane, as those of a row that step a little "
        "from house to house; 0: there is none",
        unit="m2",
        low=0,
        high=10000,
    )
    building_top_m: float = param(
        2.2,
        "a building reaches at least this high; lower planes are walls or vehicles",
        unit="m",
        low=0,
        high=20,
    )
    vegetation_sphericity: float = param(0.20, "smallest sphericity", symbol="S", low=0, high=1)
    vegetation_height_m: float = param(0.5, "lowest median height of vegetation", unit="m", low=0, high=10)
    vegetation_azimuth_deg: float = param(30.0, "smallest spread of normal azimuths", unit="deg", low=0, high=360)
    mobile_length_m: float = param(5.0, "longest mobile object", unit="m", low=0.5, high=30)
    mobile_width_m: float = param(3.0, "widest mobile object", unit="m", low=0.5, high=30)
    mobile_height_m: float = param(3.0, "highest mobile object", unit="m", low=0.5, high=30)
    mobile_volume_m3: float = param(60.0, "largest voxelised volume", unit="m3", low=1, high=1000)
    vehicle_roughness: float = param(
        0.38,
        "neighbours on a vehicle lie no farther from each other's planes than this share of their distance; in foliage "
        "and the smear of traffic they do; 0: no vehicles are looked for but the paper's",
        low=0,
        high=1,
    )


@dataclass(frozen=True)
class InstanceParams(StageParams):
    """Instances per class (paper, section 4.2)."""

    merge_patches: bool = param(True, "merge adjacent planar patches into buildings")
    patch_angle_deg: float = param(12.0, "largest angle between merged patches", unit="deg", low=1, high=90)
    patch_iou: float = param(0.30, "smallest overlap of merged footprints", low=0, high=1)
    patch_min_points: int = param(800, "raw points below which a patch is absorbed or dropped", low=1, high=100000)
    absorb_distance_m: float = param(
        0.20, "largest centroid-to-plane distance of an absorbed patch", unit="m", low=0.01, high=5
    )
    join_by_footprint: bool = param(True, "roofs and facades over one footprint are one building (METHOD 1.8)")
    building_gap_m: float = param(
        0.6, "parts of one building lie closer than this", unit="m", low=0.1, high=10, is_length=True
    )
    building_min_voxels: int = param(40, "fewer fused points are no building", low=1, high=100000)
    roof_step_m: float = param(
        0.0, "rows of buildings are cut where the roof steps by this much; 0: never", unit="m", low=0, high=20
    )
    annex_gap_m: float = param(
        0.0,
        "what stands as high as a building and in plan closer to one than this is part of it, however much lower; "
        "0: never",
        unit="m",
        low=0,
        high=10,
        is_length=True,
    )
    roof_least_m2: float = param(
        25.0, "smaller pieces of a cut row join the neighbour they border most on", unit="m2", low=0, high=10000
    )
    cluster_radius_m: float = param(
        0.8, "smallest clustering radius of vegetation", unit="m", low=0.1, high=10, is_length=True
    )
    cluster_density_factor: float = param(
        1.8, "clustering radius is this over the cube root of the density", low=0.1, high=10
    )
    is_density_adaptive: bool = param(True, "clustering radius follows the local density")
    vegetation_min_points: int = param(200, "raw points of the smallest vegetation instance", low=1, high=100000)
    vegetation_min_voxels: int = param(30, "fused points of the smallest vegetation instance", low=1, high=100000)
    splits_crowns: bool = param(True, "touching crowns are split at their height maxima")
    twig_voxels: int = param(
        120,
        "fused points of the largest piece that is a trunk or twigs because it hangs on vegetation; larger ones are "
        "other objects",
        low=0,
        high=1000000,
    )
    mobile_eps_m: float = param(
        0.7, "DBSCAN radius in plan", unit="m", symbol="epsilon", low=0.1, high=10, is_length=True
    )
    mobile_min_points: int = param(30, "DBSCAN core size in raw points", symbol="minPts", low=1, high=10000)
    mobile_min_voxels: int = param(20, "fused points of the smallest mobile instance", low=1, high=10000)
    ground_erosion_m: float = param(0.15, "erosion of the ground mask", unit="m", low=0, high=5)
    other_min_voxels: int = param(5, "fused points of the smallest other object", low=1, high=10000)
    other_min_points: int = param(
        24, "raw points that make three fused points an other object as well; 0: never", low=0, high=10000
    )


@dataclass(frozen=True)
class ObservabilityParams(StageParams):
    """What the other survey could have seen (METHOD 2, beyond the paper)."""

    is_enabled: bool = param(True, "unmatched objects that the other survey could not see are Undetermined")
    min_observability: float = param(
        0.35, "share of an object the other survey must have been able to see", low=0, high=1
    )
    cell_m: float = param(1.0, "edge of a coverage cell", unit="m", low=0.1, high=10, is_length=True)
    method: str = param(
        "rays",
        "with a trajectory, what its rays passed and what returns hid from them; or columns with returns all the same",
        choices=("rays", "coverage"),
    )
    min_rays: int = param(2, "rays that passed through an occupancy voxel and show that it is empty", low=1, high=1000)
    station_m: float = param(
        5.0, "returns of a fused point from so much of the way are one ray", unit="m", low=0.1, high=1000
    )
    ray_margin_m: float = param(
        0.5, "a ray did not pass what lies so close before its return", unit="m", low=0.1, high=10, is_length=True
    )
    shadow_from_m: float = param(
        2.0,
        "nearer behind a return it is the thing that was hit: what stood there is gone, not hidden",
        unit="m",
        low=0.1,
        high=1000,
    )
    shadow_to_m: float = param(
        30.0, "what a ray meets up to so far behind its return is hidden", unit="m", low=0.1, high=1000
    )


@dataclass(frozen=True)
class ChangeParams(StageParams):
    """Cues and decision rules (paper, section 4.3)."""

    voxel_m: float = param(0.5, "occupancy voxel", unit="m", low=0.05, high=10, is_length=True)
    query_radius_m: float = param(
        0.6, "largest distance to the nearest surface point", unit="m", low=0.05, high=10, is_length=True
    )
    min_samples: int = param(50, "samples that make the displacement informative", low=1, high=10000)
    lod_factor: float = param(1.10, "a cue must exceed this many LoD95", symbol="alpha_LoD", low=0, high=10)
    use_lod: bool = param(True, "gate the cues by the limit of detection")
    use_height: bool = param(True, "height cue", symbol="dh")
    use_volume: bool = param(True, "volume cue", symbol="dV")
    use_displacement: bool = param(True, "normal displacement cue", symbol="D_perp")
    building_iou: float = param(0.12, "smallest IoU of a matched building", low=0, high=1)
    building_shift_m: float = param(1.5, "largest centroid shift of a matched building", unit="m", low=0, high=100)
    building_height_m: float = param(0.60, "height change of a building", unit="m", low=0, high=100)
    building_volume_ratio: float = param(0.12, "relative volume change of a building", low=0, high=10)
    vegetation_iou: float = param(0.08, "smallest IoU of matched vegetation", low=0, high=1)
    vegetation_shift_m: float = param(2.0, "largest centroid shift of matched vegetation", unit="m", low=0, high=100)
    vegetation_height_m: float = param(0.35, "height change of vegetation", unit="m", low=0, high=100)
    plant_rise_m: float = param(
        0.25,
        "median change of the tops of a plant's columns that is a change where the detection limit is less; 0: none is",
        unit="m",
        low=0,
        high=100,
    )
    vegetation_volume_ratio: float = param(0.25, "relative volume change of vegetation", low=0, high=10)
    mobile_iou: float = param(0.20, "IoU of an unchanged mobile object", low=0, high=1)
    mobile_shift_m: float = param(
        2.0, "largest centroid shift of an unchanged mobile object", unit="m", low=0, high=100
    )
    visible_only: bool = param(True, "compare volumes only where both surveys had coverage (METHOD 1.13)")
    displacement_m: float = param(
        0.15, "normal displacement that is a change on its own (METHOD 1.10); 0: never", unit="m", low=0, high=100
    )
    height_reference: str = param(
        "map",
        "dh between tops in the common frame, or between heights above each epoch's own ground",
        choices=("map", "ground"),
    )
    volume_reference: str = param(
        "mean", "dV is related to the mean volume of both epochs, or to the before volume", choices=("mean", "before")
    )
    min_support: float = param(
        0.5, "share of an unmatched object's surface in the other survey that makes it Unchanged", low=0, high=1
    )
    min_returns: int = param(
        12,
        "returns that a survey must have where the other saw nothing of it: stray ones behind a window come and go; "
        "fewer are Undetermined; 0: any",
        low=0,
        high=10000,
    )
    within_share: float = param(
        0.2,
        "a plant or other object of which the other survey shows less than this share is another one, and what it "
        "shows there is a thing in its midst; 0: never",
        low=0,
        high=1,
    )
    backing_voxels: int = param(
        8, "occupancy voxels gained or lost that must back a height or volume cue; 0: none", low=0, high=10000
    )
    backing_share: float = param(
        0.02, "share of the object's voxels that must back a height cue, beyond the other epoch's top", low=0, high=1
    )
    min_expected_points: float = param(
        6.0,
        "a voxel is empty only where the sampling let this many raw points of the object be expected in it and in the "
        "voxels beside it; 0: always",
        low=0,
        high=1000,
    )
    weighs_sampling: bool = param(
        False,
        "gained and lost voxels count by the odds that the other survey's points would have met them: a crown sampled "
        "more densely fills more voxels and has not grown",
    )
    needs_sight: bool = param(
        True,
        "what is solid is gained or lost only where the other survey shows something beneath it and nothing of the "
        "same object above it: else it was hidden",
    )
    needs_returns: bool = param(
        False,
        "a voxel is gained or lost only where the other survey has a return beneath it, in its column or beside it: a "
        "wet roof that returned nothing was not taken down",
    )
    looks_down: bool = param(
        False,
        "from the air a place was seen empty only where the other survey has a return beneath it in its column, and no "
        "roof above it or beside that: walls, porches and shadows are met by oblique strips alone",
    )
    fair_tops: bool = param(True, "columns' tops are compared as if both epochs had equally many points in them")
    volume_sigmas: float = param(
        0.0, "gained less lost voxels must exceed this many times the root of their sum; 0: need not", low=0, high=100
    )
    replaced_m: float = param(
        0.06,
        "how far a quarter of a parked vehicle's surface must be off, after the best move, to make it another one, and "
        "how far apart the faces of what stands fixed must be; 0: never",
        unit="m",
        low=0,
        high=10,
    )
    replaced_top_m: float = param(
        0.0,
        "difference of the tops that makes a parked vehicle another one, where too few points show its shape; 0: never",
        unit="m",
        low=0,
        high=10,
    )
    find_parts: bool = param(True, "a change confined to a part becomes its own object (METHOD 2b)")
    part_of_length_m: float = param(
        15.0, "only objects longer than this are looked through for parts", unit="m", low=0, high=1000
    )
    part_min_voxels: int = param(12, "occupancy voxels of the smallest part", low=1, high=10000)
    part_min_width_m: float = param(
        0.0,
        "a part is at least this wide in plan: edges of roofs that the surveys sampled differently do not",
        unit="m",
        low=0,
        high=10,
        is_length=True,
    )
    plant_width_m: float = param(
        1.5,
        "a piece of a tree this wide on what the other survey saw bare is a plant of its own; 0: never",
        unit="m",
        low=0,
        high=100,
        is_length=True,
    )
    frontage_m: float = param(
        6.0,
        "width of a house in a row: what is built onto a house changes it, and this much of a longer row; 0: only the "
        "part changes",
        unit="m",
        low=0,
        high=100,
    )
    thing_voxels: int = param(
        5,
        "occupancy voxels of the smallest thing that came or went beside what it is merged with; 0: none is looked for",
        low=0,
        high=10000,
    )
    raised_m: float = param(
        0.3,
        "what one survey calls ground shows the other's thing from this height above the lower ground model, and what "
        "rises no higher neither came nor went; 0: never",
        unit="m",
        low=0,
        high=10,
    )
    part_is_new_m3: float = param(
        16.0,
        "a part of a building that only one survey has, and as large as this, is a building that was Added or Removed",
        unit="m3",
        low=0,
        high=100000,
    )
    fills_buildings: bool = param(
        False, "buildings fill the space beneath their roofs: airborne surveys hardly see walls"
    )
    body_voxel_m: float = param(
        0.5,
        "occupancy voxel of filled buildings: the roof is a surface, and a smaller voxel is not noisier as in a crown",
        unit="m",
        low=0.05,
        high=10,
        is_length=True,
    )
    body_query_radius_m: float = param(
        0.55,
        "largest distance of a filled building's voxel to the nearest surface point",
        unit="m",
        low=0.05,
        high=10,
        is_length=True,
    )

    def for_bodies(self) -> ChangeParams:
        """The parameters for buildings that are filled."""
        return replace(
            self,
            voxel_m=self.body_voxel_m,
            query_radius_m=self.body_query_radius_m,
            weighs_sampling=False,
            needs_returns=True,
            looks_down=False,
        )


@dataclass(frozen=True)
class GroundChangeParams(StageParams):
    """Changed ground (paper, section 4.3)."""

    cell_m: float = param(2.0, "edge of a raster tile", unit="m", low=0.5, high=50, is_length=True)
    min_dz_m: float = param(0.15, "smallest elevation change", unit="m", low=0, high=10)
    lod_factor: float = param(1.1, "the change must exceed this many LoD95", low=0, high=10)
    min_area_m2: float = param(12.0, "connected area that is reported", unit="m2", low=0, high=100000)
    has_own_limit: bool = param(True, "a tile's limit is its own where the LoD grid has none so small")


@dataclass(frozen=True)
class ConfidenceParams(StageParams):
    """Deterministic confidence (paper, section 4.3) and its calibration (METHOD 3)."""

    weight_height: float = param(0.30, "weight of the height cue", low=0, high=1)
    weight_volume: float = param(0.25, "weight of the volume cue", low=0, high=1)
    weight_overlap: float = param(0.20, "weight of the overlap", low=0, high=1)
    weight_shift: float = param(0.10, "weight of the centroid shift", low=0, high=1)
    weight_displacement: float = param(0.15, "weight of the normal displacement", low=0, high=1)
    calibration_unmatched: tuple[float, ...] = param(
        (-0.21, 3.15), "logistic offset and slope of Added and Removed", low=-50, high=50
    )
    calibration_changed: tuple[float, ...] = param(
        (1.75, 0.84), "logistic offset and slope of Increased and Decreased", low=-50, high=50
    )
    calibration_unchanged: tuple[float, ...] = param(
        (-2.64, 4.86), "logistic offset and slope of Unchanged", low=-50, high=50
    )


@dataclass(frozen=True)
class Parameters:
    """All stages' parameters. Build one with `Parameters.preset`, `Parameters.from_dict` or `dataclasses.replace`."""

    name: str = "street"
    adapts_to_spacing: bool = False
    fuse: FuseParams = FuseParams()
    outliers: OutlierParams = OutlierParams()
    normals: NormalParams = NormalParams()
    ndt: NdtParams = NdtParams()
    icp: IcpParams = IcpParams()
    ground: GroundParams = GroundParams()
    lod: LodParams = LodParams()
    proxies: ProxyParams = ProxyParams()
    association: AssociationParams = AssociationParams()
    features: FeatureParams = FeatureParams()
    superpoints: SuperpointParams = SuperpointParams()
    semantics: SemanticParams = SemanticParams()
    instances: InstanceParams = InstanceParams()
    observability: ObservabilityParams = ObservabilityParams()
    changes: ChangeParams = ChangeParams()
    ground_changes: GroundChangeParams = GroundChangeParams()
    confidence: ConfidenceParams = ConfidenceParams()

    @classmethod
    def preset(cls, name: str = "street") -> Parameters:
        """The named preset; `ParameterError` if there is none of that name."""
        if name not in PRESETS:
            raise ParameterError(f"There is no preset {name!r}.", f"Use one of {', '.join(PRESETS)}.", "preset-unknown")
        return cls().with_values(_PRESET_VALUES[name], where=f"preset {name}")

    @classmethod
    def load(cls, path: Path, base: Parameters | None = None, otherwise: str = "street") -> Parameters:
        """Parameters from a TOML or JSON file, over ``base``; unknown keys are errors.

        Without ``base`` over the preset that the file names, and over ``otherwise`` where it names none.
        """
        try:
            text = path.read_text(encoding="utf-8")
            values = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
        except OSError as error:
            raise ParameterError(
                f"{path}: cannot be read ({error.strerror}).", "Check the path.", "params-unreadable"
            ) from error
        except (ValueError, tomllib.TOMLDecodeError) as error:
            raise ParameterError(
                f"{path}: is not valid TOML or JSON ({error}).",
                "Start from `loda-pdal params -o FILE`.",
                "params-unreadable",
            ) from error
        if not isinstance(values, dict):
            raise ParameterError(
                f"{path}: holds no table of stages.",
                "Start from `loda-pdal params -o FILE`.",
                "params-unreadable",
            )
        named = values.get("name")
        start = base or cls.preset(str(named) if named in PRESETS else otherwise)
        return start.with_values(values, where=str(path))

    @classmethod
    def chosen(cls, preset: str | None, path: Path | None, suits: str = "street") -> Parameters:
        """The ``preset`` under what the file at ``path`` sets, if any; where neither names one, or ``auto``,
        ``suits`` stands in: the preset that the surveys look like."""
        base = None if preset in (None, AUTO) else cls.preset(preset)
        return cls.load(path, base, suits) if path else base or cls.preset(suits)

    def with_values(self, values: Mapping[str, Any], where: str = "parameters") -> Parameters:
        """A copy with ``{stage: {key: value}}`` set; unknown stages and keys are errors."""
        stages: dict[str, Any] = {}
        for stage, entries in values.items():
            if stage in ("name", "adapts_to_spacing"):
                stages[stage] = _coerced(str if stage == "name" else bool, entries, stage)
                continue
            if stage not in STAGES:
                raise ParameterError(
                    f"{where}: unknown stage {stage!r}.", f"Stages: {', '.join(STAGES)}.", "parameter-unknown"
                )
            if not isinstance(entries, Mapping):
                raise ParameterError(
                    f"{where}: {stage} must be a table of keys.",
                    "Write it as [stage] key = value.",
                    "parameter-invalid",
                )
            current = getattr(self, stage)
            known = [item.name for item in fields(current)]
            unknown = [key for key in entries if key not in known]
            if unknown:
                raise ParameterError(
                    f"{where}: unknown parameter {stage}.{unknown[0]}.",
                    f"{stage} has: {', '.join(known)}.",
                    "parameter-unknown",
                )
            try:
                stages[stage] = replace(current, **entries)
            except ParameterError as error:
                raise ParameterError(f"{where}: {stage}.{error.message}", error.remedy, error.code) from None
        return replace(self, **stages)

    def with_setting(self, setting: str) -> Parameters:
        """A copy with one ``stage.key=value`` set, the value written as in TOML (bare words are text)."""
        key, equals, text = setting.partition("=")
        stage, dot, name = key.strip().partition(".")
        if not equals or not dot:
            raise ParameterError(
                f"--set {setting!r} is not of the form stage.key=value.",
                "For example --set lod.radius_m=1.5.",
                "parameter-invalid",
            )
        try:
            value = tomllib.loads(f"value = {text.strip()}")["value"]
        except tomllib.TOMLDecodeError:
            value = text.strip()
        return self.with_values({stage: {name: value}}, where="--set")

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, the inverse of `from_dict`; tuples become lists."""
        result: dict[str, Any] = {"name": self.name, "adapts_to_spacing": self.adapts_to_spacing}
        for stage in STAGES:
            values = getattr(self, stage)
            result[stage] = {f.name: _plain(getattr(values, f.name)) for f in fields(values)}
        return result

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Parameters:
        """Parameters from `to_dict` output; missing keys keep the defaults, unknown ones are errors."""
        return cls().with_values(values)

    def to_toml(self) -> str:
        """TOML text with units, symbols and meaning as comments, readable by `load`."""
        lines = [
            f"name = {json.dumps(self.name)}",
            f"adapts_to_spacing = {str(self.adapts_to_spacing).lower()}",
        ]
        stage = ""
        for entry in self.describe():
            if entry.stage != stage:
                stage = entry.stage
                lines += ["", f"# {entry.stage_doc}", f"[{stage}]"]
            note = ", ".join(filter(None, (entry.unit, entry.symbol)))
            lines.append(f"{entry.name} = {_toml(entry.value)}  # {entry.doc}" + (f" [{note}]" if note else ""))
        return "\n".join(lines) + "\n"

    def describe(self) -> Iterator[Described]:
        """Every parameter with its value, unit, range, symbol and meaning, in the order of the method."""
        for stage in STAGES:
            values = getattr(self, stage)
            for item in fields(values):
                m = item.metadata
                yield Described(
                    stage,
                    (values.__doc__ or "").split("\n")[0],
                    item.name,
                    _plain(getattr(values, item.name)),
                    _plain(item.default),
                    m["unit"],
                    m["symbol"],
                    m["low"],
                    m["high"],
                    list(m["choices"]),
                    m["doc"],
                )

    def for_spacing(self, spacing_m: float) -> Parameters:
        """Parameters whose neighbourhoods suit a mean point spacing (m, of the sparser survey).

        Neighbourhood sizes are written for a 0.25 m fused map. Where `adapts_to_spacing` is set and the survey is
        sparser, all of them are scaled by one factor, so that a neighbourhood keeps its number of points.
        """
        factor = min(max(1.0, spacing_m / REFERENCE_SPACING_M), MOST_SCALING)
        if not self.adapts_to_spacing or factor <= 1.0:
            return self
        factor = math.ceil(factor * 4) / 4  # steps of a quarter: two surveys of nearly equal density get equal grids
        scaled: dict[str, Any] = {}
        for stage in STAGES:
            values = getattr(self, stage)
            scaled[stage] = {
                f.name: _scaled(getattr(values, f.name), factor) for f in fields(values) if f.metadata["is_length"]
            }
        return self.with_values(scaled, where=f"{self.name} at {spacing_m:.2f} m point spacing")


REFERENCE_SPACING_M = 0.5
"""Point spacing up to which the presets' own neighbourhood sizes are used."""

MOST_SCALING = 4.0
"""Neighbourhoods grow no more than this: what is sparser than 2 m shows no objects in larger ones either."""

STAGES = tuple(f.name for f in fields(Parameters) if f.name not in ("name", "adapts_to_spacing"))


class Described(NamedTuple):
    """One parameter as `loda-pdal params` prints it."""

    stage: str
    stage_doc: str
    name: str
    value: Any
    default: Any
    unit: str
    symbol: str
    low: float | None
    high: float | None
    choices: list[str]
    doc: str


_PRESET_VALUES: dict[str, dict[str, Any]] = {
    "street": {"name": "street"},
    "aerial": {
        "name": "aerial",
        "adapts_to_spacing": True,
        "fuse": {"leaf_m": 0.5},
        "outliers": {"keep_voxels": 5, "keep_gap_m": 2.0},
        "normals": {"radius_m": 1.5},
        "icp": {"leaves_m": (2.0, 1.0, 0.5), "radii_m": (3.0, 1.5, 0.75)},
        "ground": {"max_object_m": 60.0, "min_voxels": 4},
        "lod": {"radius_m": 2.0, "min_points": 12, "max_drift_m": 0.25},
        "features": {"radius_m": 1.25},
        "superpoints": {"max_edge_m": 2.0},
        "proxies": {"voxel_m": 1.0, "min_voxels": 50},
        "semantics": {
            "building_rmse_m": 0.15,
            "stepped_roof_m2": 25.0,
            "vegetation_sphericity": 0.15,
            "vehicle_roughness": 0.0,
        },
        "instances": {
            "building_gap_m": 1.2,
            "roof_step_m": 1.0,
            "annex_gap_m": 1.0,
            "cluster_radius_m": 1.2,
            "patch_min_points": 30,
            "vegetation_min_points": 15,
            "vegetation_min_voxels": 15,
            "mobile_eps_m": 1.0,
            "mobile_min_points": 4,
            "mobile_min_voxels": 6,
            "other_min_voxels": 6,
            "other_min_points": 0,
            "twig_voxels": 1000000,
        },
        "changes": {
            "voxel_m": 1.0,
            "query_radius_m": 1.2,
            "min_samples": 20,
            "min_expected_points": 0.0,
            "volume_sigmas": 3.0,
            "weighs_sampling": True,
            "replaced_top_m": 0.2,
            "backing_voxels": 4,
            "vegetation_height_m": 0.8,
            "vegetation_volume_ratio": 0.18,
            "fills_buildings": True,
            "part_min_width_m": 1.5,
            "plant_width_m": 2.5,
            "needs_sight": False,
            "looks_down": True,
            "min_returns": 8,
            "within_share": 0.0,
            "plant_rise_m": 0.0,
            "fair_tops": False,
            "replaced_m": 0.2,
            "thing_voxels": 4,
            "part_min_voxels": 24,
            "part_is_new_m3": 80.0,
            "use_volume": False,
        },
        "observability": {"cell_m": 2.0},
        "confidence": {
            "calibration_unmatched": (1.33, 1.36),
            "calibration_changed": (1.61, 0.0),
            "calibration_unchanged": (-1.05, 4.05),
        },
    },
    "paper": {
        "name": "paper",
        "outliers": {"std_multiplier": 1.0, "keep_voxels": 0},
        "icp": {"covariance": "normal", "adapts_tukey": False},
        "ground": {"vertical": "ground"},
        "lod": {"pose_term": "translation", "small_sample": False, "drift_term": "none"},
        "association": {"boxes": "pca", "splits_merged": False},
        "superpoints": {"absorb_below": 1},
        "semantics": {
            "vegetation_sphericity": 0.35,
            "vehicle_roughness": 0.0,
            "split_angle_deg": 0.0,
            "has_roofs": False,
            "points_near_ground_are_ground": False,
            "building_top_m": 0.0,
        },
        "instances": {
            "join_by_footprint": False,
            "splits_crowns": False,
            "other_min_voxels": 12,
            "other_min_points": 0,
        },
        "observability": {"is_enabled": False},
        "ground_changes": {"min_area_m2": 25.0, "has_own_limit": False},
        "changes": {
            "visible_only": False,
            "find_parts": False,
            "displacement_m": 0.0,
            "height_reference": "ground",
            "volume_reference": "before",
            "vegetation_volume_ratio": 0.18,
            "min_support": 1.0,
            "backing_voxels": 0,
            "backing_share": 0.0,
            "min_expected_points": 0.0,
            "needs_sight": False,
            "min_returns": 0,
            "within_share": 0.0,
            "plant_rise_m": 0.0,
            "plant_width_m": 0.0,
            "fair_tops": False,
            "thing_voxels": 0,
            "replaced_m": 0.0,
            "raised_m": 0.0,
        },
    },
}


def _scaled(value: Any, factor: float) -> Any:
    return tuple(item * factor for item in value) if isinstance(value, tuple) else value * factor


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value)
