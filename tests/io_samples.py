"""Small LAS files and a small result made by hand, for the tests of reading and writing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import shapely
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from loda_pdal.io.las import read_epochs
from loda_pdal.model.dimensions import FOUND
from loda_pdal.model.errors import LodaError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import (
    ChangeResult,
    GroundChangeRecord,
    InstanceRecord,
    ObjectRecord,
    PointLabels,
    StageCost,
)
from loda_pdal.model.registration import Registration
from loda_pdal.model.survey import Survey
from loda_pdal.model.transform import exp_se3
from loda_pdal.params import Parameters

UTM = 32617
CORNER = np.array([634_120.0, 4_831_210.0, 75.0])


def scattered(n: int = 2000, seed: int = 1, size_m: float = 60.0) -> np.ndarray:
    """Full map coordinates (n, 3) of points scattered over a square whose lower corner is `CORNER`."""
    return CORNER + np.random.default_rng(seed).uniform(0.0, 1.0, (n, 3)) * [size_m, size_m, 12.0]


def make_las(
    path: Path,
    xyz: np.ndarray | None = None,
    *,
    crs: int | str | CRS | None = UTM,
    point_format: int = 6,
    version: str = "1.4",
    scale: float = 0.001,
    offset: Any = (634_000.0, 4_831_000.0, 0.0),
    fields: dict[str, Any] | None = None,
    extra: dict[str, Any] | None = None,
    extra_params: list[laspy.ExtraBytesParams] | None = None,
) -> Path:
    """A LAS or LAZ file of points; `fields` and `extra` hold values of standard and extra dimensions."""
    xyz = scattered() if xyz is None else xyz
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, scale), np.array(offset)
    for name, values in (extra or {}).items():
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.asarray(values).dtype))
    for params in extra_params or []:
        header.add_extra_dim(params)
    if crs is not None:
        found = CRS.from_user_input(crs)
        if point_format >= 6:
            header.vlrs.append(WktCoordinateSystemVlr(found.to_wkt("WKT1_GDAL")))
            header.global_encoding.wkt = True
        else:
            header.add_crs(found)
    data = laspy.LasData(header)
    data.points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    for column, axis in enumerate("XYZ"):
        data.points[axis] = np.rint((xyz[:, column] - header.offsets[column]) / scale)
    for name, values in {**(fields or {}), **(extra or {})}.items():
        data[name] = values
    data.write(path)
    return path


def make_surveys(folder: Path, **after: Any) -> Pair[Survey]:
    """Two overlapping surveys, 2000 and 1500 points, read back from files."""
    before = make_las(folder / "before.laz", scattered(2000, seed=1))
    return read_epochs(before, make_las(folder / "after.laz", scattered(1500, seed=2), **after))


def make_labels(survey: Survey, seed: int = 5) -> PointLabels:
    """Values of every kind, unknown ones among them; each point is a voxel of its own, but for some noise."""
    n, rng = len(survey), np.random.default_rng(seed)
    found = np.zeros(n + 1, dtype=FOUND)
    found["Classification"] = rng.choice(np.array([1, 2, 5, 6, 64, 65]), n + 1)
    found["LoD95"] = np.where(rng.random(n + 1) < 0.1, np.nan, rng.uniform(0.02, 0.3, n + 1))
    found["Superpoint"] = rng.integers(0, 100_000, n + 1)
    found["InstanceId"] = rng.integers(0, 50, n + 1)
    found["ObjectId"] = rng.integers(0, 70_000, n + 1)
    found["ChangeClass"] = rng.integers(0, 6, n + 1)
    found["ChangeConfidence"] = np.where(found["ChangeClass"] == 0, np.nan, rng.random(n + 1))
    found["Classification"][-1] = 7
    voxel_idx = np.where(rng.random(n) < 0.1, -1, np.arange(n)).astype(np.int32)
    return PointLabels(survey, voxel_idx, found, made_up_height)


def made_up_height(xyz: np.ndarray) -> np.ndarray:
    """A height (n,) for points (n, 3), NaN for a tenth of them."""
    return np.where(xyz[:, 0] % 1.0 < 0.1, np.nan, xyz[:, 2] - 75.0 + 0.1 * xyz[:, 1])


def make_registration() -> Registration:
    """A move of decimetres and half a degree about a centre in the middle of the block."""
    centre = np.array([150.0, 240.0, 80.0])
    to_centre, back = np.eye(4), np.eye(4)
    to_centre[:3, 3], back[:3, 3] = -centre, centre
    return Registration(
        T_after_before=back @ exp_se3(np.array([0.31, -0.22, 0.12, 0.002, -0.001, 0.009])) @ to_centre,
        reference="after",
        covariance=np.diag([1e-4, 1e-4, 4e-4, 1e-9, 1e-9, 1e-8]),
        centre=centre,
        converged=True,
        iterations=(12, 7, 5),
        n_pairs=18_000,
        rmse_m=0.021,
        overlap=0.93,
    )


def make_lod(cell_m: float = 1.0) -> LodGrid:
    """Five cells: two above one another, both valid; one not valid; a valid one beside one that is not."""
    cells = np.array([[120, 210, 75], [120, 210, 76], [121, 210, 75], [123, 212, 75], [123, 212, 80]], dtype=np.int32)
    is_valid = np.array([True, True, False, True, False])
    return LodGrid(
        cells=cells,
        cell_m=cell_m,
        lod95=np.array([0.05, 0.08, 0.5, 0.11, 0.5], dtype=np.float32),
        normal=np.tile(np.array([0, 0, 1], dtype=np.float32), (5, 1)),
        n_before=np.full(5, 40, dtype=np.int32),
        n_after=np.full(5, 50, dtype=np.int32),
        is_valid=is_valid,
        displacement=np.where(is_valid, 0.01, np.nan).astype(np.float32),
        low_observability_m=0.5,
    )


def square(x: float, y: float, size: float = 4.0) -> shapely.MultiPolygon:
    """A square in local metres, its ring clockwise on purpose."""
    ring = [(x, y), (x, y + size), (x + size, y + size), (x + size, y)]
    return shapely.MultiPolygon([shapely.Polygon(ring)])


def make_result(surveys: Pair[Survey], **changed: Any) -> ChangeResult:
    """A result with one object of each label, known and unknown values, and one of everything else."""
    objects = [
        ObjectRecord(
            object_id=number,
            label=label,
            object_class=ObjectClass.BUILDING if number % 2 else ObjectClass.MOBILE,
            footprint=square(120.0 + 6 * number, 215.0),
            reason=f"Reason of {label.title}: dh 0.80 m > 1.1 LoD95.",
        )
        for number, label in enumerate(ChangeLabel, start=1)
    ]
    objects.append(
        ObjectRecord(
            object_id=7,
            parent_id=3,
            label=ChangeLabel.INCREASED,
            object_class=ObjectClass.BUILDING,
            footprint=square(130.0, 230.0).union(square(140.0, 230.0)),
            reason="Height +3.00 m.",
            instance_before=4,
            instance_after=5,
            confidence=0.91,
            confidence_raw=0.72,
            observability=1.0,
            height_before_m=6.0,
            height_after_m=9.0,
            dh_m=3.0,
            volume_before_m3=96.0,
            volume_after_m3=144.0,
            dv_m3=48.0,
            dv_ratio=0.5,
            iou_3d=0.6,
            shift_m=0.1,
            d_perp_m=0.0,
            lod95_m=0.06,
            points_before=410,
            points_after=0,
            z_min_m=75.0,
            z_max_m=84.0,
        )
    )
    clouds = surveys.map(lambda survey: survey.xyz[::10])
    values: dict[str, Any] = {
        "objects": objects,
        "ground_changes": [
            GroundChangeRecord(
                1, ChangeLabel.DECREASED, square(150.0, 240.0, 6.0), -0.4, 0.07, 36.0, -14.4, "Lowered by 0.40 m."
            )
        ],
        "instances": Pair(
            [InstanceRecord(4, ObjectClass.BUILDING, square(130.0, 230.0), 410, 6.0, 96.0, 75.0, 81.0, 7)],
            [InstanceRecord(5, ObjectClass.OTHER, square(130.0, 230.0), 500, None, 144.0, 75.0, 84.0, None)],
        ),
        "points": Pair(make_labels(surveys.before, 5), make_labels(surveys.after, 6)),
        "registration": make_registration(),
        "lod": make_lod(),
        "clouds": clouds,
        "object_of_voxel": clouds.map(lambda xyz: np.zeros(len(xyz), dtype=np.uint32)),
        "block": shapely.box(120.0, 210.0, 180.0, 270.0),
        "parameters": Parameters(),
        "has_ground": True,
        "warnings": ["One made-up warning."],
        "costs": [StageCost("fuse", 0.5, 210.0), StageCost("register", 1.25, 250.0)],
    }
    return ChangeResult(**{**values, **changed})


def explain(error: LodaError) -> str:
    """What a user sees, for assertions on wording: every error of ours has a message, a remedy and a code."""
    assert error.message and error.remedy and error.code
    return str(error)
