"""Reviews outlive a new run: on the object where it is still the same, in a layer of their own where it is not."""

from __future__ import annotations

import dataclasses
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import shapely.affinity
from io_samples import explain, make_result, make_surveys, square
from pyproj import CRS

from loda_pdal.io.geopackage import write_geopackage
from loda_pdal.io.outputs import write_outputs
from loda_pdal.io.reviews import SAME_IOU, Review, match_reviews, read_reviews
from loda_pdal.model.errors import OutputError
from loda_pdal.model.frame import LocalFrame
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import ChangeResult
from loda_pdal.model.survey import Survey

UTM_WKT = CRS.from_epsg(32617).to_wkt()


@pytest.fixture
def surveys(tmp_path: Path) -> Pair[Survey]:
    (tmp_path / "in").mkdir()
    return make_surveys(tmp_path / "in")


def note_down(folder: Path, number: int, status: str, note: str | None, layer: str = "changes") -> None:
    """Edit a review as QGIS would, leaving the file in write-ahead mode as QGIS does."""
    with closing(sqlite3.connect(folder / "changes.gpkg")) as database, database:
        for name in ("ST_IsEmpty", "ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY"):  # the index's triggers name them
            database.create_function(name, 1, lambda geometry: 0)
        database.execute("PRAGMA journal_mode = WAL")
        done = database.execute(
            f"UPDATE {layer} SET review_status = ?, reviewer = 'A. de Vries', "
            "reviewed_at = '2025-03-01T10:30:00.000Z', review_note = ? WHERE object_id = ?",
            (status, note, number),
        )
        assert done.rowcount == 1


def reviews_in(folder: Path, layer: str = "changes") -> dict[int, tuple[Any, ...]]:
    """Review columns of those rows that have been reviewed, by object_id."""
    with closing(sqlite3.connect(folder / "changes.gpkg")) as database:
        found = database.execute(
            f"SELECT object_id, review_status, reviewer, reviewed_at, review_note FROM {layer} "
            "WHERE review_status <> 'unreviewed' OR review_note IS NOT NULL"
        ).fetchall()
    return {row[0]: row[1:] for row in found}


def has_layer(folder: Path, layer: str) -> bool:
    return layer in {str(name) for name, _ in pyogrio.list_layers(folder / "changes.gpkg")}


def moved(result: ChangeResult, by_m: float, number_from: int = 100, **values: Any) -> ChangeResult:
    """The same objects, found a little further east under other numbers."""
    objects = [
        dataclasses.replace(
            o, object_id=number_from + o.object_id, footprint=shapely.affinity.translate(o.footprint, by_m), **values
        )
        for o in result.objects
    ]
    return dataclasses.replace(result, objects=objects)


SAID = ("A. de Vries", "2025-03-01T10:30:00.000Z")


def test_a_new_run_keeps_the_reviews_of_objects_that_are_still_the_same(tmp_path: Path, surveys: Pair[Survey]) -> None:
    result, out = make_result(surveys), tmp_path / "out"
    write_outputs(result, surveys, out)
    note_down(out, 3, "confirmed", "Seen on the photo.")
    note_down(out, 4, "unreviewed", "Look again in May.")
    note_down(out, 2, "rejected", "It did change.", layer="objects")  # an Unchanged one is no change
    write_outputs(moved(result, 0.5), surveys, out, overwrite=True)
    assert reviews_in(out) == {
        103: ("confirmed", *SAID, "Seen on the photo."),
        104: ("unreviewed", *SAID, "Look again in May."),
    }
    assert reviews_in(out, "objects") == {102: ("rejected", *SAID, "It did change.")}
    assert not has_layer(out, "earlier_reviews")
    assert "confirmed (A. de Vries, 2025-03-01): Seen on the photo." in (out / "report.html").read_text("utf-8")


def test_a_note_whose_object_is_gone_stays_in_a_layer_and_comes_back(
    tmp_path: Path, surveys: Pair[Survey], caplog: pytest.LogCaptureFixture
) -> None:
    result, out = make_result(surveys), tmp_path / "out"
    write_outputs(result, surveys, out)
    note_down(out, 3, "confirmed", "Seen on the photo.")
    others = moved(result, 500.0)
    for _ in range(2):  # and does not multiply
        write_outputs(others, surveys, out, overwrite=True)
        assert reviews_in(out) == {}
        assert reviews_in(out, "earlier_reviews") == {3: ("confirmed", *SAID, "Seen on the photo.")}
    assert "1 of 1 earlier reviews match no object" in caplog.text
    write_outputs(result, surveys, out, overwrite=True)
    assert reviews_in(out) == {3: ("confirmed", *SAID, "Seen on the photo.")}
    assert not has_layer(out, "earlier_reviews")


def test_another_label_is_another_finding(tmp_path: Path, surveys: Pair[Survey]) -> None:
    result, out = make_result(surveys), tmp_path / "out"
    write_outputs(result, surveys, out)
    note_down(out, 3, "rejected", "A tarpaulin.")
    write_outputs(moved(result, 0.0, label=ChangeLabel.DECREASED), surveys, out, overwrite=True)
    assert reviews_in(out) == {}
    assert reviews_in(out, "earlier_reviews") == {3: ("rejected", *SAID, "A tarpaulin.")}


def test_the_best_overlap_wins_and_every_review_goes_to_one_object() -> None:
    def review(number: int, x: float) -> Review:
        return Review(number, "Added", "building", "confirmed", footprint=square(x, 0.0))

    reviews = [review(1, 0.0), review(2, 0.8)]
    found, left = match_reviews(reviews, [7, 8, 9], ["Added", "Added", "Removed"], [square(x, 0) for x in (0.7, 9, 0)])
    assert found == {7: reviews[1]} and left == [reviews[0]]


def test_half_an_overlap_is_the_limit() -> None:
    side = 4.0
    at_limit = side * (1 - SAME_IOU) / (1 + SAME_IOU)  # two squares shifted by d share (s - d) / (s + d)
    review = Review(1, "Added", "building", "confirmed", footprint=square(0.0, 0.0, side))
    for shift, is_same in ((at_limit - 1e-6, True), (at_limit + 1e-6, False)):
        found, _ = match_reviews([review], [5], ["Added"], [square(shift, 0.0, side)])
        assert bool(found) is is_same


def test_reviews_follow_into_another_crs(tmp_path: Path, surveys: Pair[Survey]) -> None:
    frame = surveys.after.frame
    write_geopackage(tmp_path / "changes.gpkg", make_result(surveys), frame, {})
    note_down(tmp_path, 3, "confirmed", None)
    (here,) = read_reviews(tmp_path / "changes.gpkg", frame.crs_wkt)
    (there,) = read_reviews(tmp_path / "changes.gpkg", CRS.from_epsg(4326).to_wkt())
    assert there.footprint.centroid.x == pytest.approx(-79.3, abs=0.1)
    assert here.footprint.centroid.x == pytest.approx(frame.origin[0] + 140.0, abs=1.0)


def test_no_file_and_no_geopackage_hold_no_reviews(tmp_path: Path) -> None:
    assert read_reviews(tmp_path / "none.gpkg", UTM_WKT) == []
    (tmp_path / "text.gpkg").write_text("no database")
    assert read_reviews(tmp_path / "text.gpkg", UTM_WKT) == []


def test_a_damaged_file_is_not_replaced(tmp_path: Path, surveys: Pair[Survey]) -> None:
    result, out = make_result(surveys), tmp_path / "out"
    write_outputs(result, surveys, out)
    package = out / "changes.gpkg"
    package.write_bytes(package.read_bytes()[:6000])
    with pytest.raises(OutputError) as caught:
        write_outputs(result, surveys, out, overwrite=True)
    assert "reviews" in explain(caught.value) and package.stat().st_size == 6000


def test_sentences() -> None:
    assert Review(1, "Added", "building", "unsure").sentence == "unsure"
    at = np.datetime64("2025-03-01T10:30")
    assert Review(1, "Added", "building", "confirmed", None, at, "fine").sentence == "confirmed (2025-03-01): fine"
    assert Review(1, "Added", "building", "unreviewed").is_blank


def test_objects_without_a_crs(tmp_path: Path, surveys: Pair[Survey]) -> None:
    frame = LocalFrame(surveys.after.frame.origin)
    write_geopackage(tmp_path / "changes.gpkg", make_result(surveys), frame, {})
    note_down(tmp_path, 3, "confirmed", "as it is")
    (review,) = read_reviews(tmp_path / "changes.gpkg", None)
    carried = write_geopackage(tmp_path / "next.gpkg", make_result(surveys), frame, {}, [review])
    assert {number: r.note for number, r in carried.items()} == {3: "as it is"}
