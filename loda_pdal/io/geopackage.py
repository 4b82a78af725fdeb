"""changes.gpkg: what was found as layers that QGIS draws in colour when it opens them.

GeoPackage 1.2 without a write-ahead log, in the map coordinates of the after epoch. Unknown is NULL, never 0.
"""

from __future__ import annotations

import logging
import sqlite3
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely

from loda_pdal.io.plain import to_plain
from loda_pdal.io.qml import change_style, class_style, ground_style, label_style, outline_style
from loda_pdal.io.reviews import EARLIER_LAYER, STATUSES, Review, match_reviews
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.records import ChangeResult, GroundChangeRecord, InstanceRecord, ObjectRecord

logger = logging.getLogger(__name__)

VERSION = "1.2"

_DTYPES = {"int": "int64", "code": "int32", "float": "float64", "text": "object", "time": "datetime64[ms]"}
_UTC = 100  # in GDAL's count of time zones


class Column(NamedTuple):
    """One attribute: its name, type (int, code, float, text, time), and how a record answers it (None is NULL)."""

    name: str
    kind: str
    value: Callable[[Any], Any]


def _field(name: str, kind: str) -> Column:
    return Column(name, kind, lambda record: getattr(record, name))


_LABEL = (
    Column("label", "text", lambda record: record.label.title),
    Column("label_code", "code", lambda record: int(record.label)),
)
_CLASS = Column("object_class", "text", lambda record: record.object_class.title)

OBJECT_COLUMNS: tuple[Column, ...] = (
    _field("object_id", "int"),
    _field("parent_id", "int"),
    *_LABEL,
    _CLASS,
    _field("confidence", "float"),
    _field("confidence_raw", "float"),
    _field("observability", "float"),
    _field("height_before_m", "float"),
    _field("height_after_m", "float"),
    _field("dh_m", "float"),
    _field("volume_before_m3", "float"),
    _field("volume_after_m3", "float"),
    _field("dv_m3", "float"),
    _field("dv_ratio", "float"),
    _field("iou_3d", "float"),
    _field("shift_m", "float"),
    _field("d_perp_m", "float"),
    _field("lod95_m", "float"),
    _field("points_before", "int"),
    _field("points_after", "int"),
    _field("z_min_m", "float"),
    _field("z_max_m", "float"),
    _field("reason", "text"),
)
"""Columns of the layers changes and objects, in order; four more are for whoever checks the result."""

EARLIER_COLUMNS: tuple[Column, ...] = (
    _field("object_id", "int"),
    _field("label", "text"),
    _field("object_class", "text"),
    Column("review_status", "text", lambda review: review.status),
    _field("reviewer", "text"),
    _field("reviewed_at", "time"),
    Column("review_note", "text", lambda review: review.note),
)
"""Columns of the layer earlier_reviews."""

GROUND_COLUMNS: tuple[Column, ...] = (
    _field("ground_change_id", "int"),
    *_LABEL,
    _field("dz_m", "float"),
    _field("lod95_m", "float"),
    _field("area_m2", "float"),
    _field("volume_m3", "float"),
    _field("reason", "text"),
)

INSTANCE_COLUMNS: tuple[Column, ...] = (
    _field("instance_id", "int"),
    _field("object_id", "int"),
    _CLASS,
    Column("class_code", "code", lambda record: int(record.object_class)),
    _field("n_points", "int"),
    _field("height_m", "float"),
    _field("volume_m3", "float"),
    _field("z_min_m", "float"),
    _field("z_max_m", "float"),
)

BLOCK_COLUMNS: tuple[Column, ...] = (
    Column("block_id", "int", lambda block: 1),
    Column("area_m2", "float", lambda block: block["area_m2"]),
    Column("points_before", "int", lambda block: block["points_before"]),
    Column("points_after", "int", lambda block: block["points_after"]),
    Column("n_objects", "int", lambda block: block["n_objects"]),
    Column("n_changes", "int", lambda block: block["n_changes"]),
)

RUN_COLUMNS: tuple[Column, ...] = (
    Column("key", "text", lambda entry: entry[0]),
    Column("value", "text", lambda entry: entry[1]),
)


def review_columns(reviews: Mapping[int, Review | None]) -> tuple[Column, ...]:
    """The four columns of a review, by ``object_id`` of the record; blank where it has none."""

    def field(name: str, kind: str, attribute: str, blank: str | None = None) -> Column:
        def value(record: Any) -> Any:
            review = reviews.get(record.object_id)
            return blank if review is None else getattr(review, attribute)

        return Column(name, kind, value)

    return (
        field("review_status", "text", "status", STATUSES[0]),
        field("reviewer", "text", "reviewer"),
        field("reviewed_at", "time", "reviewed_at"),
        field("review_note", "text", "note"),
    )


def write_geopackage(
    path: Path,
    result: ChangeResult,
    frame: LocalFrame,
    run: Mapping[str, Any],
    earlier: Sequence[Review] = (),
) -> dict[int, Review]:
    """Write all layers and their styles.

    Parameters
    ----------
    path : Path
        A file that does not exist yet.
    result : ChangeResult
        What was found, in local metres.
    frame : LocalFrame
        From local metres to map coordinates, and the CRS.
    run : mapping
        What run.json holds; becomes the rows of layer ``run``.
    earlier : sequence of Review
        Reviews of the result that this one replaces, outlines in map coordinates.

    Returns
    -------
    dict of int to Review
        Those that were carried over, by object_id. The others are in layer ``earlier_reviews``.
    """
    outlines = dict(zip((o.object_id for o in result.objects), _footprints(result.objects, frame), strict=True))
    labels = [o.label.title for o in result.objects]
    carried, unmatched = match_reviews(earlier, list(outlines), labels, list(outlines.values()))
    with _unhurried():
        _write_objects(path, result, outlines, carried, frame)
        _write_layers(path, result, frame, run)
        if unmatched:
            logger.warning(
                "%d of %d earlier reviews match no object of this result; layer %s keeps them.",
                len(unmatched),
                len(earlier),
                EARLIER_LAYER,
            )
            _write_layer(path, EARLIER_LAYER, EARLIER_COLUMNS, unmatched, [r.footprint for r in unmatched], frame)
    _embed_styles(path)
    return carried


def _write_objects(
    path: Path, result: ChangeResult, outlines: Mapping[int, Any], reviews: Mapping[int, Review], frame: LocalFrame
) -> None:
    """Layers changes and objects. A change is reviewed in ``changes``, so ``objects`` says it of the others only."""
    of_unchanged = {o.object_id: reviews.get(o.object_id) for o in result.objects if o.label is ChangeLabel.UNCHANGED}
    for layer, objects, known in (("changes", result.changes, reviews), ("objects", result.objects, of_unchanged)):
        columns = (*OBJECT_COLUMNS, *review_columns(known))
        _write_layer(path, layer, columns, objects, [outlines[o.object_id] for o in objects], frame)


def _write_layers(path: Path, result: ChangeResult, frame: LocalFrame, run: Mapping[str, Any]) -> None:
    ground = result.ground_changes
    _write_layer(path, "ground_changes", GROUND_COLUMNS, ground, _footprints(ground, frame), frame)
    for layer, instances in (
        ("instances_before", result.instances.before),
        ("instances_after", result.instances.after),
    ):
        _write_layer(path, layer, INSTANCE_COLUMNS, instances, _footprints(instances, frame), frame)
    blocks = _blocks(result)
    outlines = [_largest(to_map_polygons(block["outline"], frame)) for block in blocks]
    _write_layer(path, "blocks", BLOCK_COLUMNS, blocks, outlines, frame, "Polygon")
    _write_layer(path, "run", RUN_COLUMNS, run_rows(run), None, frame)


@contextmanager
def _unhurried() -> Iterator[None]:
    """No waiting for the disk after each layer (ten times faster): who puts the file in place flushes it once."""
    import pyogrio

    option = "OGR_SQLITE_SYNCHRONOUS"
    old = pyogrio.get_gdal_config_option(option)
    pyogrio.set_gdal_config_options({option: "OFF"})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({option: old})


def to_map_polygons(footprint: Any, frame: LocalFrame) -> Any:
    """A footprint in local metres as a valid MultiPolygon in map coordinates, outer rings counter-clockwise."""

    def to_map(xy: Any) -> Any:
        return frame.to_map(np.column_stack([xy, np.zeros(len(xy))]))[:, :2]

    moved = shapely.transform(footprint, to_map)
    if not moved.is_valid:
        moved = shapely.make_valid(moved)
    polygons = [part for part in shapely.get_parts(shapely.get_parts([moved])) if part.geom_type == "Polygon"]
    rings = [shapely.geometry.polygon.orient(part, 1.0) for part in polygons if not part.is_empty]
    return shapely.MultiPolygon(rings)


def run_rows(run: Mapping[str, Any], before: str = "") -> list[tuple[str, str | None]]:
    """Rows of layer ``run``: nested keys joined by dots, lists as text, None as NULL."""
    rows: list[tuple[str, str | None]] = []
    for key, value in to_plain(run).items():
        if isinstance(value, dict) and value:
            rows += run_rows(value, f"{before}{key}.")
        else:
            rows.append((f"{before}{key}", _text(value)))
    return rows


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    return "; ".join(str(item) for item in value) if isinstance(value, list) else str(value)


def _blocks(result: ChangeResult) -> list[dict[str, Any]]:
    if result.block is None or result.block.is_empty:
        return []
    return [
        {
            "outline": result.block,
            "area_m2": float(result.block.area),
            "points_before": len(result.points.before),
            "points_after": len(result.points.after),
            "n_objects": len(result.objects),
            "n_changes": len(result.changes),
        }
    ]


def _largest(polygons: Any) -> Any:
    return max(polygons.geoms, key=lambda part: part.area)


def _footprints(records: Iterable[ObjectRecord | GroundChangeRecord | InstanceRecord], frame: LocalFrame) -> list[Any]:
    return [to_map_polygons(record.footprint, frame) for record in records]


def _write_layer(
    path: Path,
    layer: str,
    columns: Sequence[Column],
    records: Sequence[Any],
    geometries: list[Any] | None,
    frame: LocalFrame,
    geometry_type: str = "MultiPolygon",
) -> None:
    """One layer; typed columns even where it has no rows or all of a column is NULL."""
    import pyogrio.raw

    values = [[column.value(record) for record in records] for column in columns]
    masks = [np.array([_is_unknown(value) for value in column], dtype=bool) for column in values]
    data = [_array(c.kind, v, m) for c, v, m in zip(columns, values, masks, strict=True)]
    with warnings.catch_warnings():
        if frame.crs_wkt is None:  # said to the user already, when the surveys were read
            warnings.filterwarnings("ignore", message="'crs' was not provided", category=UserWarning)
        pyogrio.raw.write(
            path,
            None if geometries is None else np.array([shapely.to_wkb(g) for g in geometries], dtype=object),
            data,
            [column.name for column in columns],
            field_mask=masks,
            layer=layer,
            driver="GPKG",
            geometry_type=None if geometries is None else geometry_type,
            crs=None if geometries is None else frame.crs_wkt,
            gdal_tz_offsets={c.name: np.full(len(records), _UTC, dtype=np.int8) for c in columns if c.kind == "time"},
            dataset_options=None if path.exists() else {"VERSION": VERSION},
        )


def _is_unknown(value: Any) -> bool:
    return value is None or (isinstance(value, float) and not np.isfinite(value))


def _array(kind: str, values: list[Any], is_null: Any) -> Any:
    """The values as one array of the column's type; what stands where ``is_null`` is masked and never written."""
    if kind == "time":
        return np.array(["NaT" if null else v for v, null in zip(values, is_null, strict=True)], dtype=_DTYPES[kind])
    filler: Any = None if kind == "text" else 0
    return np.array([filler if null else v for v, null in zip(values, is_null, strict=True)], dtype=_DTYPES[kind])


_STYLE_TABLE = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    f_table_catalog TEXT(256), f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256),
    styleName TEXT(30), styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30),
    ui TEXT(30), update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
)
"""


def _embed_styles(path: Path) -> None:
    """The table from which QGIS takes the default style of each layer."""
    by_class = class_style()
    styles = {
        "changes": change_style(),
        "objects": label_style(),
        "ground_changes": ground_style(),
        "instances_before": by_class,
        "instances_after": by_class,
        "blocks": outline_style(),
    }
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA synchronous = OFF")
        columns = dict(connection.execute("SELECT table_name, column_name FROM gpkg_geometry_columns"))
        connection.execute(_STYLE_TABLE)
        connection.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('layer_styles', 'attributes', "
            "'layer_styles')"
        )
        connection.executemany(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, "
            "styleQML, styleSLD, useAsDefault, description, owner) VALUES ('', '', ?, ?, ?, ?, '', 1, ?, '')",
            [
                (layer, columns[layer], f"loda {layer}", qml, "Default style of loda-pdal")
                for layer, qml in styles.items()
            ],
        )
