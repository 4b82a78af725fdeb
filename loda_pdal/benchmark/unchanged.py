"""Blocks surveyed twice without edits: does LoD95 cover 95 % of what did not move, and what is called changed all the
same (METHOD 3).

The later survey has noise, drift, lanes, density, foliage and weather of its own, as in the blocks of the suites.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from loda_pdal.benchmark.evaluate import KnownBlock, Say, described, prepared_blocks, read_block
from loda_pdal.benchmark.metrics import markdown_table
from loda_pdal.benchmark.protocols import judge
from loda_pdal.benchmark.runs import judged_result
from loda_pdal.benchmark.suites import SuiteBlock
from loda_pdal.benchmark.truth import Truth
from loda_pdal.io.summary import is_changed
from loda_pdal.model.cloud import BoolArray, Int64Array
from loda_pdal.model.grid import Lattice, cells_of
from loda_pdal.model.labels import ObjectClass
from loda_pdal.model.lod_grid import LodGrid
from loda_pdal.model.records import ChangeResult, ObjectRecord
from loda_pdal.model.transform import invert, transform_points
from loda_pdal.params import Parameters
from loda_pdal.pipeline import detect_changes

SURFACES = ("ground", "facade", "roof", "other")
"""What a cell of the LoD grid holds; other is vegetation, vehicles and furniture."""

UPRIGHT = 0.3
"""A building's surface with |n.z| below this is a facade, else a roof."""


class Coverage(NamedTuple):
    """Valid cells of one kind of surface, how many of them are within LoD95, and their limits (m)."""

    is_within: BoolArray
    lod95: npt.NDArray[np.float32]

    @property
    def share(self) -> float | None:
        """Share of the cells within their limit."""
        return float(self.is_within.mean()) if len(self.is_within) else None

    @property
    def median_m(self) -> float | None:
        """Median limit, m."""
        return float(np.median(self.lod95)) if len(self.lod95) else None


@dataclass(frozen=True)
class UnchangedBlock:
    """What the method says of one block.

    Attributes
    ----------
    coverage : dict
        By surface; ``all`` for all of them.
    n_objects, n_ground : int
        Objects, and pieces of ground that are called changed.
    changed : list of ObjectRecord
        Objects that are called changed.
    alarms : frozenset of int
        Which of these count: the others lie on instances that the surveys hold too few returns of to be judged (strict
        protocol, `loda_pdal.benchmark.protocols`).
    """

    name: str
    coverage: dict[str, Coverage]
    n_objects: int
    n_ground: int
    changed: list[ObjectRecord]
    alarms: frozenset[int]


@dataclass(frozen=True)
class Unchanged:
    """What the method says of blocks in which nothing changed."""

    title: str
    blocks: list[UnchangedBlock]

    def coverage(self, surface: str) -> Coverage:
        """Coverage over all blocks."""
        return _pooled(block.coverage[surface] for block in self.blocks)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "title": self.title,
            "coverage": {s: _plain(self.coverage(s)) for s in ("all", *SURFACES)},
            "blocks": {
                block.name: {
                    "coverage": {s: _plain(found) for s, found in block.coverage.items()},
                    "objects": block.n_objects,
                    "changed_ground": block.n_ground,
                    "changed": [_plain_object(o) | {"counts": o.object_id in block.alarms} for o in block.changed],
                }
                for block in self.blocks
            },
        }

    def to_markdown(self) -> str:
        """Coverage by block and surface, and every object that is called changed."""
        everything = UnchangedBlock(
            "all",
            {s: self.coverage(s) for s in ("all", *SURFACES)},
            sum(block.n_objects for block in self.blocks),
            sum(block.n_ground for block in self.blocks),
            [o for block in self.blocks for o in block.changed],
            frozenset(),
        )
        n_alarms = sum(len(block.alarms) for block in self.blocks)
        header = [
            "block",
            "cells",
            "all, %",
            *SURFACES,
            "median LoD95, m",
            "objects",
            "changed",
            "that count",
            "ground",
        ]
        lines = [
            f"# Nothing changed: {self.title}",
            "Cells whose displacement is within LoD95, by surface, and what is called changed:",
            markdown_table(header, [*(_row(b, len(b.alarms)) for b in self.blocks), _row(everything, n_alarms)]),
        ]
        if everything.changed:
            called = ["block", "object", "counts", "label", "class", "m2", "points", "reason"]
            rows = [
                [
                    block.name,
                    o.object_id,
                    "yes" if o.object_id in block.alarms else "no",
                    o.label.title,
                    o.object_class.title,
                    f"{o.footprint.area:.1f}",
                    f"{o.points_before or 0} / {o.points_after or 0}",
                    o.reason,
                ]
                for block in self.blocks
                for o in block.changed
            ]
            lines.append(markdown_table(called, rows))
        return "\n\n".join(lines)


def survey_unchanged(
    folder: Path,
    suite: str,
    split: str,
    parameters: Parameters,
    *,
    models: Path | None = None,
    limit: int | None = None,
    say: Say = lambda text: None,
) -> Unchanged:
    """Run the method on the blocks of a split without their edits; arguments as for `run_suite`."""
    blocks = []
    for name, block_dir in prepared_blocks(
        folder, suite, split, models=models, limit=limit, say=say, variant=SuiteBlock.unchanged
    ):
        known = read_block(block_dir)
        result = detect_changes(known.surveys.before, known.surveys.after, parameters)
        judged = judge(judged_result(result, known.annotation, known.truth.T_after_before), known.truth)
        block = UnchangedBlock(
            name,
            coverage_of(result.lod, surface_of_cells(result, known)),
            len(result.objects),
            len(result.ground_changes),
            [o for o in result.objects if is_changed(o)],
            frozenset(alarm.object_id for alarm in judged.false_alarms),
        )
        blocks.append(block)
        say(f"{name}: {len(block.changed)} of {block.n_objects} objects called changed, {len(block.alarms)} that count")
    return Unchanged(f"suite {suite}, {split} split: {len(blocks)} blocks, {described(parameters)}", blocks)


def coverage_of(lod: LodGrid, surface: Int64Array) -> dict[str, Coverage]:
    """Coverage over all valid cells and by what they hold, an index of `SURFACES` (c,)."""
    is_within = np.abs(lod.displacement) <= lod.lod95

    def of(is_kind: BoolArray) -> Coverage:
        inside = is_kind & lod.is_valid
        return Coverage(is_within[inside], lod.lod95[inside])

    by_surface = {name: of(surface == code) for code, name in enumerate(SURFACES)}
    return {"all": of(np.ones(len(surface), np.bool_)), **by_surface}


def surface_of_cells(result: ChangeResult, block: KnownBlock) -> Int64Array:
    """Index of `SURFACES` of each LoD cell (c,): of what most of its points are, by their annotation."""
    kinds, lod = _kind_of_ids(block.truth), result.lod
    lattice = Lattice.around(lod.cells.astype(np.int64))
    keys = lattice.keys(lod.cells.astype(np.int64))
    T_frame_after = invert(result.registration.T_after_frame)
    votes = np.zeros(len(keys) * 3, dtype=np.int64)
    for xyz, labels, known in zip(result.clouds, result.points, block.annotation, strict=True):
        cell_of_voxel = lattice.find(keys, cells_of(transform_points(T_frame_after, xyz), lod.cell_m))
        cell = np.append(cell_of_voxel, -1)[labels.voxel_idx]
        inside = cell >= 0
        votes += np.bincount(cell[inside] * 3 + kinds[known.truth_id[inside]], minlength=len(votes))
    ground, building, other = votes.reshape(-1, 3).T
    is_facade = np.abs(lod.normal[:, 2]) < UPRIGHT
    of_building = np.where(is_facade, SURFACES.index("facade"), SURFACES.index("roof"))
    most = np.argmax(np.column_stack([ground, building, other]), axis=1)
    return np.asarray(np.choose(most, [SURFACES.index("ground"), of_building, SURFACES.index("other")]), dtype=np.int64)


def _kind_of_ids(truth: Truth) -> Int64Array:
    """0 ground, 1 building, 2 other, by ``TruthId``."""
    kinds = np.zeros(max(truth.by_id, default=0) + 1, dtype=np.int64)
    for i in truth.instances:
        kinds[i.instance_id] = {ObjectClass.GROUND: 0, ObjectClass.BUILDING: 1}.get(i.object_class, 2)
    return kinds


def _pooled(found: Iterable[Coverage]) -> Coverage:
    parts = list(found)
    return Coverage(np.concatenate([p.is_within for p in parts]), np.concatenate([p.lod95 for p in parts]))


def _row(block: UnchangedBlock, n_alarms: int) -> list[Any]:
    whole = block.coverage["all"]
    return [
        block.name,
        len(whole.is_within),
        *(found.share for found in block.coverage.values()),
        None if whole.median_m is None else f"{whole.median_m:.3f}",
        block.n_objects,
        len(block.changed),
        n_alarms,
        block.n_ground,
    ]


def _plain(found: Coverage) -> dict[str, Any]:
    return {"cells": len(found.is_within), "share": found.share, "median_lod95_m": found.median_m}


def _plain_object(record: ObjectRecord) -> dict[str, Any]:
    return {
        "object_id": record.object_id,
        "label": record.label.title,
        "object_class": record.object_class.title,
        "area_m2": float(record.footprint.area),
        "points_before": record.points_before,
        "points_after": record.points_after,
        "reason": record.reason,
    }
