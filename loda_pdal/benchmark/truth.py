"""What is known about a benchmark scene: its annotated instances, its true transform, its extent."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.model.cloud import FloatArray
from loda_pdal.model.errors import InputError
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair

FORMAT = "loda-pdal truth"
VERSION = 1

EVALUATED_CLASSES = (ObjectClass.BUILDING, ObjectClass.VEGETATION, ObjectClass.MOBILE, ObjectClass.OTHER)
"""Annotated classes that the paper's protocol counts: every non-ground instance (paper, section 4.4)."""


@dataclass(frozen=True)
class TruthInstance:
    """One annotated instance.

    Attributes
    ----------
    instance_id : int
        ``TruthId`` of its points, from 1.
    object_class, label
        What it is, and what was done to it: from the edit list, never from a threshold on geometry.
    kind, edit, note : str
        In words: what it is, the kind of edit (empty for none) and the edit's figures.
    exists : Pair of bool
        Which surveys it stood in.
    n_points : Pair of int
        Returns from it in each survey.
    n_changed : Pair of int
        Those of them on surface that only one of the surveys has (``TruthChange`` not Unchanged).
    visible : Pair of float or None
        Share of its place that each survey could have measured; None where it was not worked out.
    centre : tuple of float or None
        Mean of its points, map coordinates of the after frame.
    partner : int or None
        The other half of one edit: where a moved vehicle went, what replaced a replaced one.
    excluded : str or None
        Why the instance is left out of the scores; None where it counts.
    """

    instance_id: int
    object_class: ObjectClass
    label: ChangeLabel
    kind: str
    exists: Pair[bool]
    n_points: Pair[int]
    n_changed: Pair[int]
    visible: Pair[float | None]
    edit: str = ""
    note: str = ""
    centre: tuple[float, float, float] | None = None
    partner: int | None = None
    excluded: str | None = None

    @property
    def is_changed(self) -> bool:
        """Whether its label is a change."""
        return self.label is not ChangeLabel.UNCHANGED

    @property
    def is_evaluated(self) -> bool:
        """Whether it counts in the paper's protocol."""
        return self.excluded is None and self.object_class in EVALUATED_CLASSES


@dataclass(frozen=True)
class Truth:
    """Everything that is known about a scene.

    Attributes
    ----------
    T_after_before : (4, 4) float64
        True move of before-points onto the after epoch, in full map coordinates (m).
    outline : list of (float, float)
        Corners of the block in map coordinates of the after frame, anticlockwise.
    area_m2 : float
        Area of the block.
    """

    instances: list[TruthInstance]
    T_after_before: FloatArray
    outline: list[tuple[float, float]]
    area_m2: float
    crs: str = ""
    made_by: dict[str, Any] = field(default_factory=dict)

    @property
    def by_id(self) -> dict[int, TruthInstance]:
        """Instances by their id."""
        return {i.instance_id: i for i in self.instances}

    def counts(self) -> dict[str, dict[str, int]]:
        """Number of instances per class and label, those left out under ``excluded``."""
        table: dict[str, Counter[str]] = {}
        for i in self.instances:
            key = "excluded" if i.excluded else i.label.title
            table.setdefault(i.object_class.title, Counter())[key] += 1
        return {name: dict(sorted(row.items())) for name, row in sorted(table.items())}

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `from_dict` takes them."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "crs": self.crs,
            "made_by": self.made_by,
            "T_after_before": self.T_after_before.tolist(),
            "outline": [list(corner) for corner in self.outline],
            "area_m2": self.area_m2,
            "counts": self.counts(),
            "instances": [_plain(i) for i in self.instances],
        }

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Truth:
        """The truth that `to_dict` wrote."""
        if values.get("format") != FORMAT or values.get("version") != VERSION:
            raise InputError(
                f"Not a truth file of version {VERSION}: format {values.get('format')!r}, "
                f"version {values.get('version')!r}.",
                "Give the truth.json that `loda-pdal bench simulate` wrote.",
                "truth-format",
            )
        return Truth(
            [_instance(row) for row in values["instances"]],
            np.array(values["T_after_before"], dtype=float),
            [(float(x), float(y)) for x, y in values["outline"]],
            float(values["area_m2"]),
            values["crs"],
            values["made_by"],
        )

    def write(self, path: Path) -> None:
        """Write as JSON, the same bytes for the same truth."""
        path.write_text(json.dumps(self.to_dict(), indent=1) + "\n", encoding="utf-8")

    @staticmethod
    def read(path: Path) -> Truth:
        """Read what `write` wrote."""
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"Cannot read {path}: {error}.", "Give a truth.json.", "truth-unreadable") from error
        return Truth.from_dict(values)


def _plain(instance: TruthInstance) -> dict[str, Any]:
    row = asdict(instance)
    row["object_class"] = instance.object_class.title
    row["label"] = instance.label.title
    return row


def _instance(row: dict[str, Any]) -> TruthInstance:
    values = dict(row)
    values["object_class"] = ObjectClass[row["object_class"].upper()]
    values["label"] = ChangeLabel[row["label"].upper()]
    for name in ("exists", "n_points", "n_changed", "visible"):
        values[name] = Pair(row[name]["before"], row[name]["after"])
    values["centre"] = tuple(row["centre"]) if row["centre"] is not None else None
    return TruthInstance(**values)
