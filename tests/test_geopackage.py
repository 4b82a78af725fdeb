"""The GeoPackage: layers, columns, NULLs, geometry and styles, as GDAL, SQLite and QGIS see them."""

from __future__ import annotations

import sqlite3
import xml.etree.ElementTree as ET
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pyogrio.raw
import pytest
import shapely
from io_samples import make_result, make_surveys, square
from pyproj import CRS

from loda_pdal.io.colours import LABEL_COLOURS, rgb
from loda_pdal.io.geopackage import run_rows, to_map_polygons, write_geopackage
from loda_pdal.io.qml import change_style
from loda_pdal.io.qml_review import ALIASES
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult

LAYERS = {
    "changes": "MultiPolygon",
    "objects": "MultiPolygon",
    "ground_changes": "MultiPolygon",
    "instances_before": "MultiPolygon",
    "instances_after": "MultiPolygon",
    "blocks": "Polygon",
    "run": None,
}
OBJECT_COLUMNS = [
    "object_id",
    "parent_id",
    "label",
    "label_code",
    "object_class",
    "confidence",
    "confidence_raw",
    "observability",
    "height_before_m",
    "height_after_m",
    "dh_m",
    "volume_before_m3",
    "volume_after_m3",
    "dv_m3",
    "dv_ratio",
    "iou_3d",
    "shift_m",
    "d_perp_m",
    "lod95_m",
    "points_before",
    "points_after",
    "z_min_m",
    "z_max_m",
    "reason",
    "review_status",
    "reviewer",
    "reviewed_at",
    "review_note",
]
TYPES = {
    "object_id": "MEDIUMINT|INTEGER",
    "parent_id": "INTEGER",
    "label": "TEXT",
    "label_code": "MEDIUMINT",
    "object_class": "TEXT",
    "points_before": "INTEGER",
    "points_after": "INTEGER",
    "reason": "TEXT",
    "review_status": "TEXT",
    "reviewer": "TEXT",
    "reviewed_at": "DATETIME",
    "review_note": "TEXT",
}
RUN = {"program": {"name": "loda-pdal", "version": "0.1.0"}, "warnings": ["one", "two"], "none": None, "flag": True}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ChangeResult:
    return make_result(make_surveys(tmp_path_factory.mktemp("in")))


@pytest.fixture(scope="module")
def frame() -> LocalFrame:
    return LocalFrame((634_000, 4_831_000, 0), crs_wkt=CRS.from_user_input("EPSG:32617+5703").to_wkt())


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory, result: ChangeResult, frame: LocalFrame) -> Path:
    path = tmp_path_factory.mktemp("out") / "changes.gpkg"
    write_geopackage(path, result, frame, RUN)
    return path


def rows(path: Path, sql: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(sql).fetchall()


def geometries(path: Path, layer: str) -> Any:
    return shapely.from_wkb(pyogrio.raw.read(path, layer=layer)[2])


def test_layers_and_their_geometry(package: Path) -> None:
    found = {name: kind for name, kind in pyogrio.list_layers(package).tolist() if name != "layer_styles"}
    assert found == LAYERS


def test_is_version_1_2_without_a_write_ahead_log(package: Path) -> None:
    assert rows(package, "PRAGMA application_id")[0][0] == 0x47504B47
    assert rows(package, "PRAGMA user_version")[0][0] == 10_200
    assert rows(package, "PRAGMA journal_mode")[0][0] == "delete"
    assert rows(package, "PRAGMA integrity_check") == [("ok",)]
    assert rows(package, "PRAGMA foreign_key_check") == []
    assert [p.name for p in package.parent.glob("changes.gpkg*")] == ["changes.gpkg"]


@pytest.mark.parametrize("layer", ["changes", "objects"])
def test_columns_are_the_promised_ones_with_their_types(package: Path, layer: str) -> None:
    columns = {row[1]: row[2] for row in rows(package, f"PRAGMA table_info({layer})")}
    assert list(columns) == ["fid", "geom", *OBJECT_COLUMNS]
    for name in OBJECT_COLUMNS:
        assert columns[name] in TYPES.get(name, "REAL").split("|"), name


def test_empty_layers_have_the_same_columns_and_types(
    tmp_path: Path, result: ChangeResult, package: Path, frame: LocalFrame
) -> None:
    nothing = replace(result, objects=[], ground_changes=[], instances=Pair([], []), block=None)
    empty = tmp_path / "empty.gpkg"
    write_geopackage(empty, nothing, frame, {})
    for layer in LAYERS:
        assert rows(empty, f"SELECT count(*) FROM {layer}") == [(0,)]
        assert rows(empty, f"PRAGMA table_info({layer})") == rows(package, f"PRAGMA table_info({layer})")
    assert {name: kind for name, kind in pyogrio.list_layers(empty).tolist() if name != "layer_styles"} == LAYERS


def test_changes_are_all_objects_but_the_unchanged(package: Path) -> None:
    assert rows(package, "SELECT object_id, label, label_code FROM objects ORDER BY object_id") == [
        (1, "Undetermined", 0),
        (2, "Unchanged", 1),
        (3, "Added", 2),
        (4, "Removed", 3),
        (5, "Increased", 4),
        (6, "Decreased", 5),
        (7, "Increased", 4),
    ]
    assert [row[0] for row in rows(package, "SELECT object_id FROM changes ORDER BY object_id")] == [1, 3, 4, 5, 6, 7]


def test_unknown_is_null_and_zero_is_zero(package: Path) -> None:
    known = "parent_id, confidence, dh_m, dv_ratio, d_perp_m, points_before, points_after, z_max_m"
    assert rows(package, f"SELECT {known} FROM objects WHERE object_id = 7") == [(3, 0.91, 3.0, 0.5, 0.0, 410, 0, 84.0)]
    assert rows(package, f"SELECT {known} FROM objects WHERE object_id = 3") == [(None,) * 8]
    review = "review_status, reviewer, reviewed_at, review_note"
    assert rows(package, f"SELECT DISTINCT {review} FROM changes") == [("unreviewed", None, None, None)]
    assert rows(package, "SELECT height_m, object_id, class_code FROM instances_after") == [(None, None, 65)]


def test_unknown_written_as_nan_is_null_too(tmp_path: Path, result: ChangeResult, frame: LocalFrame) -> None:
    strange = replace(result, objects=[replace(result.objects[6], dh_m=float("nan"), confidence=float("inf"))])
    write_geopackage(tmp_path / "nan.gpkg", strange, frame, RUN)
    assert rows(tmp_path / "nan.gpkg", "SELECT dh_m, confidence FROM objects") == [(None, None)]


def test_ground_changes_and_blocks(package: Path) -> None:
    assert rows(package, "SELECT label, dz_m, lod95_m, area_m2, volume_m3 FROM ground_changes") == [
        ("Decreased", -0.4, 0.07, 36.0, -14.4)
    ]
    assert rows(package, "SELECT area_m2, points_before, points_after, n_objects, n_changes FROM blocks") == [
        (3600.0, 2000, 1500, 7, 6)
    ]


def test_run_holds_keys_and_values(package: Path) -> None:
    assert rows(package, "SELECT key, value FROM run") == [
        ("program.name", "loda-pdal"),
        ("program.version", "0.1.0"),
        ("warnings", "one; two"),
        ("none", None),
        ("flag", "true"),
    ]
    assert run_rows({"a": {}, "b": [], "c": 1.5}) == [("a", "{}"), ("b", ""), ("c", "1.5")]


def test_footprints_stand_in_map_coordinates(package: Path) -> None:
    added = geometries(package, "objects")[2]
    assert added.bounds == (634_138.0, 4_831_215.0, 634_142.0, 4_831_219.0)
    two = geometries(package, "objects")[6]
    assert len(two.geoms) == 2 and two.area == pytest.approx(32.0)


def test_footprints_are_valid_and_right_handed(package: Path) -> None:
    for layer in LAYERS:
        if LAYERS[layer] is None:
            continue
        for geometry in geometries(package, layer):
            assert geometry.is_valid and geometry.geom_type == LAYERS[layer]
            for part in shapely.get_parts(geometry):
                assert part.exterior.is_ccw and not any(ring.is_ccw for ring in part.interiors)


def test_footprints_in_feet_and_with_holes_and_with_flaws() -> None:
    frame = LocalFrame((1000, 2000, 0), 0.3048, 1.0)
    holed = shapely.MultiPolygon([square(0, 0, 3.048).geoms[0].difference(shapely.box(1, 1, 2, 2))])
    found = to_map_polygons(holed, frame)
    np.testing.assert_allclose(found.bounds, (1000, 2000, 1010, 2010), rtol=0, atol=1e-9)
    assert found.area == pytest.approx(holed.area / 0.3048**2)
    assert found.geoms[0].exterior.is_ccw and not found.geoms[0].interiors[0].is_ccw
    bow_tie = shapely.MultiPolygon([shapely.Polygon([(0, 0), (2, 2), (2, 0), (0, 2)])])
    mended = to_map_polygons(bow_tie, LocalFrame((0, 0, 0)))
    assert mended.is_valid and mended.area == pytest.approx(2.0)
    assert to_map_polygons(square(0, 0).geoms[0], LocalFrame((0, 0, 0))).geom_type == "MultiPolygon"


def test_crs_is_that_of_the_after_epoch_with_its_heights(package: Path, result: ChangeResult, tmp_path: Path) -> None:
    found = CRS.from_user_input(pyogrio.read_info(package, layer="changes")["crs"])
    assert found.is_compound and [part.to_epsg() for part in found.sub_crs_list] == [32617, 5703]
    write_geopackage(tmp_path / "plain.gpkg", result, LocalFrame((0, 0, 0)), RUN)
    assert pyogrio.read_info(tmp_path / "plain.gpkg", layer="changes")["crs"] is None


def test_every_layer_with_geometry_has_one_default_style(package: Path) -> None:
    found = rows(
        package,
        "SELECT f_table_name, f_geometry_column, f_table_catalog, f_table_schema, useAsDefault FROM layer_styles",
    )
    assert sorted(found) == sorted((layer, "geom", "", "", 1) for layer, kind in LAYERS.items() if kind)
    assert rows(package, "SELECT data_type FROM gpkg_contents WHERE table_name = 'layer_styles'") == [("attributes",)]


def test_styles_give_every_label_the_colour_of_the_one_table(package: Path) -> None:
    qml = dict(rows(package, "SELECT f_table_name, styleQML FROM layer_styles"))
    for layer, labels in (("changes", set(ChangeLabel) - {ChangeLabel.UNCHANGED}), ("objects", set(ChangeLabel))):
        renderer = ET.fromstring(qml[layer]).find("renderer-v2")
        assert renderer is not None and renderer.get("attr") == "label"
        symbols = {symbol.get("name"): symbol for symbol in renderer.findall("symbols/symbol")}
        categories = {c.get("value"): symbols[c.get("symbol")] for c in renderer.findall("categories/category")}
        assert set(categories) == {label.title for label in labels}
        for label in labels:
            colours = {o.get("value", "").rsplit(",", 1)[0] for o in categories[label.title].iter("Option")}
            assert ",".join(map(str, rgb(LABEL_COLOURS[label]))) in colours, label
        kinds = {title: [part.get("class") for part in symbol.findall("layer")] for title, symbol in categories.items()}
        assert kinds["Undetermined"] == ["LinePatternFill", "SimpleLine"] and kinds["Added"] == ["SimpleFill"]
        assert kinds.get("Unchanged", ["SimpleLine"]) == ["SimpleLine"]
    assert "confidence" in qml["changes"] and "confidence" not in qml["objects"]


def test_the_form_names_every_column_once() -> None:
    assert sorted([*ALIASES, "label_code"]) == sorted(OBJECT_COLUMNS)
    fields = ET.fromstring(change_style()).iter("attributeEditorField")
    assert sorted(field.get("name", "") for field in fields) == sorted(ALIASES)


def test_all_styles_are_well_formed(package: Path) -> None:
    for layer, qml in rows(package, "SELECT f_table_name, styleQML FROM layer_styles"):
        assert ET.fromstring(qml).tag == "qgis", layer
