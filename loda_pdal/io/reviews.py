"""What a reviewer noted on an earlier result: read before it is replaced, carried over to the objects that are still
the same, and kept beside them where none is.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyogrio.raw
import shapely
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError
from pyproj import CRS, Transformer

from loda_pdal.model.errors import OutputError

STATUSES = ("unreviewed", "confirmed", "rejected", "unsure")
"""What ``review_status`` may say; the first is where every change begins."""

SAME_IOU = 0.5
"""Outlines that overlap by this much (intersection over union) and have one label are one object."""

EARLIER_LAYER = "earlier_reviews"
"""Layer of the reviews whose objects a later run did not find again."""

_LAYERS = ("changes", "objects", EARLIER_LAYER)
_SQLITE = b"SQLite format 3\0"


@dataclass(frozen=True)
class Review:
    """What a reviewer noted on one object.

    ``footprint`` is the object's outline in map coordinates of the result that holds the review; ``reviewed_at`` is a
    NumPy datetime64 or None.
    """

    object_id: int
    label: str
    object_class: str
    status: str
    reviewer: str | None = None
    reviewed_at: Any = None
    note: str | None = None
    footprint: Any = None

    @classmethod
    def of_row(cls, row: dict[str, Any]) -> Review:
        """The review in a row of a layer with review columns."""
        at = row["reviewed_at"]
        return cls(
            object_id=int(row["object_id"]),
            label=str(row["label"]),
            object_class=str(row["object_class"]),
            status=row["review_status"] or STATUSES[0],
            reviewer=row["reviewer"] or None,
            reviewed_at=None if at is None or np.isnat(np.datetime64(at)) else at,
            note=row["review_note"] or None,
            footprint=row["footprint"],
        )

    @property
    def is_blank(self) -> bool:
        """Whether nobody has touched it."""
        return self.status == STATUSES[0] and not self.note

    @property
    def sentence(self) -> str:
        """``confirmed (AB, 2025-03-01): a note``."""
        day = None if self.reviewed_at is None else str(np.datetime64(self.reviewed_at, "D"))
        signed = ", ".join(word for word in (self.reviewer, day) if word)
        return f"{self.status}{f' ({signed})' if signed else ''}{f': {self.note}' if self.note else ''}"


def read_reviews(path: Path, crs_wkt: str | None) -> list[Review]:
    """Reviews in the GeoPackage of an earlier result, outlines moved into the CRS ``crs_wkt``; none where no file is.

    `OutputError` where the file cannot be read: replacing it would lose them.
    """
    if not path.is_file() or not _is_sqlite(path):
        return []
    try:
        layers = {str(name) for name, _ in pyogrio.list_layers(path)}
        reviews: dict[Any, Review] = {}
        for layer in _LAYERS:
            for review in _layer_reviews(path, layer, crs_wkt) if layer in layers else []:
                key = (review.object_id, review.label, review.sentence)  # what both layers say is said once
                reviews.setdefault(key, review)
    except (DataSourceError, DataLayerError, FeatureError, FieldError, KeyError, ValueError) as error:
        raise OutputError(
            f"{path}: its reviews cannot be read ({error}), and the new result would replace them.",
            "Move the file away, or name another output folder.",
            "reviews-unreadable",
        ) from error
    return list(reviews.values())


def match_reviews(
    reviews: Sequence[Review], object_ids: Sequence[int], labels: Sequence[str], footprints: Sequence[Any]
) -> tuple[dict[int, Review], list[Review]]:
    """Reviews by the object they belong to now, and those that belong to none.

    Parameters
    ----------
    reviews : sequence of Review
        Of the earlier result.
    object_ids, labels, footprints : sequences of the same length
        The objects now, outlines in the map coordinates of the reviews.
    """
    pairs = []
    tree = shapely.STRtree(list(footprints))
    for number, review in enumerate(reviews):
        if review.footprint is None:
            continue
        for candidate in tree.query(review.footprint, predicate="intersects"):
            iou = _iou(review.footprint, footprints[candidate])
            if labels[candidate] == review.label and iou >= SAME_IOU:
                pairs.append((-iou, number, int(candidate)))
    found: dict[int, Review] = {}
    placed: set[int] = set()
    for _, number, candidate in sorted(pairs):
        if number not in placed and object_ids[candidate] not in found:
            found[object_ids[candidate]] = reviews[number]
            placed.add(number)
    return found, [review for number, review in enumerate(reviews) if number not in placed]


def _is_sqlite(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_SQLITE)) == _SQLITE


def _layer_reviews(path: Path, layer: str, crs_wkt: str | None) -> Iterable[Review]:
    meta, _, shapes, columns = pyogrio.raw.read(path, layer=layer)
    fields = list(meta["fields"])
    if "review_status" not in fields:
        return
    outlines = _moved(shapely.from_wkb(shapes), meta["crs"], crs_wkt)
    for i, outline in enumerate(outlines):
        row = {name: column[i] for name, column in zip(fields, columns, strict=True)}
        review = Review.of_row({**row, "footprint": outline})
        if not review.is_blank:
            yield review


def _moved(outlines: Any, from_crs: str | None, to_wkt: str | None) -> Any:
    if from_crs is None or to_wkt is None:
        return outlines
    old, new = CRS.from_user_input(from_crs), CRS.from_wkt(to_wkt)
    if old.equals(new, ignore_axis_order=True):
        return outlines
    transformer = Transformer.from_crs(old.to_2d(), new.to_2d(), always_xy=True)
    return shapely.transform(outlines, lambda xy: np.column_stack(transformer.transform(xy[:, 0], xy[:, 1])))


def _iou(one: Any, other: Any) -> float:
    shared = shapely.intersection(one, other).area
    joint = one.area + other.area - shared
    return float(shared / joint) if joint > 0 else 0.0
