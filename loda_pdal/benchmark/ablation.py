"""What each part of the method is worth: the paper's ablation table, and the same for what is ours (paper, section 5).

A row is a change of parameters. Each is run on every block of a suite, and the table says what it costs against the
full method, with the interval that drawing the blocks anew gives that difference. A row of the paper that no parameter
can make is named with the reason.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.benchmark.evaluate import (
    N_RESAMPLES,
    KnownBlock,
    Say,
    described,
    prepared_blocks,
    read_block,
    read_stamp,
    version_of,
    write_stamp,
)
from loda_pdal.benchmark.metrics import LABELS, Scores, markdown_table
from loda_pdal.benchmark.protocols import ScoreReport, judge
from loda_pdal.benchmark.reuse import Runs
from loda_pdal.benchmark.runs import judged_result
from loda_pdal.model.cloud import Int64Array
from loda_pdal.model.errors import LodaError
from loda_pdal.params import Parameters

Change = Callable[[Parameters], Parameters]


@dataclass(frozen=True)
class Variant:
    """One row: its place in the table, its name, and the parameters that make it (none: the full method).

    ``why_not`` says why no parameter can make it; ``is_ours`` tells rows about what is ours from the paper's.
    """

    category: str
    name: str
    settings: tuple[str, ...] = ()
    why_not: str = ""
    is_ours: bool = False
    change: Change | None = None

    def of(self, parameters: Parameters) -> Parameters:
        """The parameters of this row."""
        changed = self.change(parameters) if self.change is not None else parameters
        for setting in self.settings:
            changed = changed.with_setting(setting)
        return changed


def _finest_level(p: Parameters) -> Parameters:
    """The last level of the pyramid alone, with the iterations of all."""
    last = {"leaves_m": p.icp.leaves_m[-1:], "radii_m": p.icp.radii_m[-1:]}
    return p.with_values({"icp": {**last, "max_iterations": [sum(p.icp.max_iterations)]}})


def _other_bodies(p: Parameters) -> Parameters:
    return p.with_values({"changes": {"fills_buildings": not p.changes.fills_buildings}})


FULL = Variant("Reference", "full method")

PAPER = (
    Variant(
        "Registration and LoD",
        "no LoD gating in decisions",
        ("changes.use_lod=false", "ground_changes.lod_factor=0"),
    ),
    Variant("Registration and LoD", "global LoD", ("lod.variation=global",)),
    Variant("Registration and LoD", "LoD without pose covariance", ("lod.pose_term=none",)),
    Variant("Registration and LoD", "ICP without robust loss", ("icp.loss=l2",)),
    Variant(
        "Registration and LoD",
        "no vertical alignment and height normalisation",
        ("ground.vertical=plumb", "changes.height_reference=map"),
        why_not="classes need heights above ground; what changes compare is switched",
    ),
    Variant("Correspondence", "no geometry-only proxies", ("proxies.is_enabled=false",)),
    Variant("Correspondence", "greedy matching", ("association.solver=greedy",)),
    Variant("Instance formation", "components instead of superpoints", ("superpoints.method=components",)),
    Variant("Instance formation", "no planar merging for buildings", ("instances.merge_patches=false",)),
    Variant("Instance formation", "fixed-radius vegetation clustering", ("instances.is_density_adaptive=false",)),
    Variant("Change cues", "without height cue", ("changes.use_height=false",)),
    Variant("Change cues", "without volume cue", ("changes.use_volume=false",)),
    Variant("Change cues", "without normal-direction cue", ("changes.use_displacement=false",)),
    Variant("Change cues", "height cue only", ("changes.use_volume=false", "changes.use_displacement=false")),
)
"""Rows of the paper's table, in its order."""

OURS = tuple(
    Variant(category, name, settings, is_ours=True, change=change, why_not=why_not)
    for category, name, settings, change, why_not in (
        ("Registration and LoD", "paper's outlier limit (1 sigma)", ("outliers.std_multiplier=1.0",), None, ""),
        ("Registration and LoD", "no first pose by NDT", ("ndt.is_enabled=false",), None, ""),
        ("Registration and LoD", "finest ICP level only", (), _finest_level, ""),
        ("Registration and LoD", "fixed tau", ("icp.adapts_tukey=false",), None, ""),
        ("Registration and LoD", "covariance by the normal matrix", ("icp.covariance=normal",), None, ""),
        ("Registration and LoD", "translation covariance only", ("lod.pose_term=translation",), None, ""),
        ("Registration and LoD", "LoD without drift term", ("lod.drift_term=none",), None, ""),
        ("Registration and LoD", "LoD without small-sample factor", ("lod.small_sample=false",), None, ""),
        (
            "Registration and LoD",
            "paper's vertical axis and heights above ground",
            ("ground.vertical=ground", "changes.height_reference=ground"),
            None,
            "",
        ),
        ("Correspondence", "no gates", ("association.gate_m=100", "association.gate_iou=0"), None, ""),
        ("Correspondence", "boxes by principal axes", ("association.boxes=pca",), None, ""),
        ("Correspondence", "left-over instances stay alone", (), None, "no parameter"),
        ("Instance formation", "small superpoints stay", ("superpoints.absorb_below=1",), None, ""),
        ("Instance formation", "superpoints not cut at edges", ("semantics.split_angle_deg=0",), None, ""),
        ("Instance formation", "no class rules", (), None, "instances are formed by class"),
        ("Instance formation", "no roofs", ("semantics.has_roofs=false",), None, ""),
        ("Instance formation", "low planes may be buildings", ("semantics.building_top_m=0",), None, ""),
        (
            "Instance formation",
            "paper's vegetation sphericity (0.35)",
            ("semantics.vegetation_sphericity=0.35",),
            None,
            "",
        ),
        ("Instance formation", "paper's vehicles", ("semantics.vehicle_roughness=0",), None, ""),
        ("Instance formation", "roofs and facades stay apart", ("instances.join_by_footprint=false",), None, ""),
        ("Instance formation", "a few fused points are no thing", ("instances.other_min_points=0",), None, ""),
        ("Instance formation", "touching crowns stay together", ("instances.splits_crowns=false",), None, ""),
        ("Observability", "no observability", ("observability.is_enabled=false",), None, ""),
        ("Observability", "volumes compared everywhere", ("changes.visible_only=false",), None, ""),
        ("Observability", "from the air seen wherever a column has returns", ("changes.looks_down=false",), None, ""),
        ("Observability", "voxels empty whatever the sampling", ("changes.min_expected_points=0",), None, ""),
        ("Change decisions", "no parts", ("changes.find_parts=false",), None, ""),
        ("Change decisions", "things stay with what they stand beside", ("changes.thing_voxels=0",), None, ""),
        ("Change decisions", "plants stay with what they stand beside", ("changes.plant_width_m=0",), None, ""),
        ("Change decisions", "annexes without their house", ("changes.frontage_m=0",), None, ""),
        ("Change decisions", "buildings as sheets or bodies: the other", (), _other_bodies, ""),
        (
            "Change decisions",
            "cues need no backing",
            ("changes.backing_voxels=0", "changes.backing_share=0"),
            None,
            "",
        ),
        ("Change decisions", "unmatched whatever its surface shows", ("changes.min_support=1.0",), None, ""),
        ("Change decisions", "a few returns decide", ("changes.min_returns=0",), None, ""),
        ("Change decisions", "nothing is replaced", ("changes.replaced_m=0", "changes.replaced_top_m=0"), None, ""),
        ("Change decisions", "no change by displacement alone", ("changes.displacement_m=0",), None, ""),
        ("Change decisions", "volume relative to the before volume", ("changes.volume_reference=before",), None, ""),
        ("Change decisions", "confidence weights", (), None, "labels do not depend on the confidence"),
        ("Altogether", "preset paper", (), lambda p: Parameters.preset("paper"), ""),
    )
)
"""Rows about what is ours: each without one of our decisions (docs/method.md)."""


@dataclass(frozen=True)
class Outcome:
    """What is kept of one run on one block: confusion tables (5, 6), false alarms, and the area of the block."""

    confusion: Int64Array
    by_part: Int64Array
    n_false_alarms: int
    area_m2: float

    @classmethod
    def of(cls, report: ScoreReport) -> Outcome:
        """The outcome that a report tells of."""
        tables = report.scores().confusion, report.scores(by_part=True).confusion
        return cls(*tables, len(report.false_alarms), report.area_m2)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `from_dict` takes them."""
        return {
            "confusion": self.confusion.tolist(),
            "by_part": self.by_part.tolist(),
            "n_false_alarms": self.n_false_alarms,
            "area_m2": self.area_m2,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Outcome:
        """The outcome that `to_dict` wrote."""
        tables = np.array(values["confusion"]), np.array(values["by_part"])
        return cls(*tables, values["n_false_alarms"], values["area_m2"])


@dataclass(frozen=True)
class Row:
    """One variant with its outcome on every block; none where no parameter makes it, or where it is the full method."""

    variant: Variant
    outcomes: list[Outcome] = field(default_factory=list)
    remark: str = ""

    @property
    def scores(self) -> Scores:
        """All blocks pooled."""
        return Scores(np.sum([o.confusion for o in self.outcomes], axis=0))

    @property
    def part_scores(self) -> Scores:
        """All blocks pooled, by changed part."""
        return Scores(np.sum([o.by_part for o in self.outcomes], axis=0))

    @property
    def alarms_per_ha(self) -> float:
        """False alarms per hectare."""
        return sum(o.n_false_alarms for o in self.outcomes) / (sum(o.area_m2 for o in self.outcomes) / 1e4)

    def loss(self, full: Row) -> tuple[float, float, float]:
        """mIoU of this row less that of the full method, and between what 95 % of draws of blocks put it."""
        draws = np.random.default_rng(1).integers(len(self.outcomes), size=(N_RESAMPLES, len(self.outcomes)))
        own, base = (np.array([o.confusion for o in row.outcomes]) for row in (self, full))
        found = [_miou(own[draw].sum(axis=0)) - _miou(base[draw].sum(axis=0)) for draw in draws]
        low, high = np.percentile(found, (2.5, 97.5))
        return _miou(own.sum(axis=0)) - _miou(base.sum(axis=0)), float(low), float(high)


@dataclass(frozen=True)
class Ablation:
    """The full method and all its variants on the same blocks."""

    title: str
    full: Row
    rows: list[Row]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        rows = []
        for row in (self.full, *self.rows):
            entry: dict[str, Any] = {
                "category": row.variant.category,
                "variant": row.variant.name,
                "is_ours": row.variant.is_ours,
                "settings": list(row.variant.settings),
                "remark": row.remark,
            }
            if row.outcomes:
                loss = row.loss(self.full)
                entry |= {
                    "paper": row.scores.to_dict(),
                    "part": row.part_scores.to_dict(),
                    "false_alarms_per_ha": row.alarms_per_ha,
                    "macro_iou_difference": {"value": loss[0], "low": loss[1], "high": loss[2]},
                }
            rows.append(entry)
        return {"title": self.title, "rows": rows}

    def to_markdown(self) -> str:
        """One table: the paper's columns, the mIoU by part, false alarms, and the difference to the full method."""
        header = ["category", "variant", "ACC", "mF1", "mIoU", *(label.title for label in LABELS)]
        header += ["mIoU by part", "alarms per ha", "mIoU against full (95 %)"]
        sections = [f"# Ablation on {self.title}"]
        for name, is_ours in (("The paper's rows", False), ("What is ours", True)):
            rows = [row for row in self.rows if row.variant.is_ours is is_ours]
            sections += [f"## {name}", markdown_table(header, [self._cells(row) for row in (self.full, *rows)])]
        return "\n\n".join(sections)

    def _cells(self, row: Row) -> list[Any]:
        named = [row.variant.category, row.variant.name + (f" ({row.remark})" if row.remark else "")]
        if not row.outcomes:
            return [*named, *[None] * (5 + len(LABELS)), ""]
        s, (mean, low, high) = row.scores, row.loss(self.full)
        difference = "" if row is self.full else f"{100 * mean:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
        return [
            *named,
            *(s.accuracy, s.macro_f1, s.macro_iou),
            *(score.iou for score in s.labels),
            row.part_scores.macro_iou,
            f"{row.alarms_per_ha:.1f}",
            difference,
        ]


def ablate(
    folder: Path,
    suite: str,
    split: str,
    parameters: Parameters,
    *,
    models: Path | None = None,
    limit: int | None = None,
    variants: Sequence[Variant] = (*PAPER, *OURS),
    say: Say = lambda text: None,
) -> Ablation:
    """Run every variant on the blocks of one split of a suite; arguments as for `run_suite`.

    What is known is kept in ``FOLDER/NAME/ablation.json``, so that an interrupted table goes on where it was.
    """
    rows = [Row(FULL), *(_row(variant, parameters) for variant in variants)]
    run = [rows[0], *(row for row in rows[1:] if row.variant.of(parameters) != parameters)]
    blocks = list(prepared_blocks(folder, suite, split, models=models, limit=limit, say=say))
    for n, (name, block_dir) in enumerate(blocks):
        say(f"{name}: block {n + 1} of {len(blocks)}, {len(run)} variants")
        for row, outcome in zip(run, _outcomes(block_dir, [r.variant.of(parameters) for r in run], say), strict=True):
            row.outcomes.append(outcome)
    title = f"suite {suite}, {split} split: {len(blocks)} blocks, {described(parameters)}"
    return Ablation(title, rows[0], rows[1:])


def _row(variant: Variant, parameters: Parameters) -> Row:
    if variant.why_not and not variant.settings:
        return Row(variant, remark=f"not to be had by a parameter: {variant.why_not}")
    if variant.of(parameters) == parameters:
        return Row(variant, remark="is so in the full method")
    return Row(variant, remark=variant.why_not)


def _outcomes(block_dir: Path, chosen: list[Parameters], say: Say) -> Iterable[Outcome]:
    """Outcome of each parameters on a block, known ones from the file beside it."""
    path = block_dir / "ablation.json"
    version = version_of(block_dir)
    known = read_stamp(path) or {}
    if known.get("version") != version:
        known = {"version": version, "outcomes": {}}
    loaded: tuple[Runs, KnownBlock] | None = None
    for parameters in chosen:
        key = hashlib.sha256(json.dumps(parameters.to_dict(), sort_keys=True).encode()).hexdigest()
        if key not in known["outcomes"]:
            if loaded is None:
                block = read_block(block_dir)
                loaded = Runs(block.surveys), block
            runs, block = loaded
            try:
                result = runs.detect(parameters)
            except LodaError as error:
                raise type(error)(
                    f"{block_dir.name}, {described(parameters)}: {error.message}", error.remedy, error.code
                ) from error
            outcome = Outcome.of(
                judge(judged_result(result, block.annotation, block.truth.T_after_before), block.truth)
            )
            say(f"  {described(parameters)}: mIoU {100 * _miou(outcome.confusion):.1f}")
            known["outcomes"][key] = outcome.to_dict()
            write_stamp(path, known)
        yield Outcome.from_dict(known["outcomes"][key])


def _miou(confusion: Int64Array) -> float:
    return Scores(confusion).macro_iou or 0.0
