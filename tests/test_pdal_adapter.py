"""The contract of filters.python: exact types, whole columns, contiguous memory, two plain arguments."""

from __future__ import annotations

import inspect
import json
from typing import Any

import numpy as np
import pytest

from loda_pdal.model import dimensions as dims
from loda_pdal.model.errors import LodaError, PipelineError
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey
from loda_pdal.pdal_face import entry
from loda_pdal.pdal_face.adapter import Call, Points, arguments_of, entry_of, pdal_type


def view(n: int = 4, **columns: Any) -> Points:
    ins = {axis: np.arange(n, dtype=float) for axis in "XYZ"} | columns
    return Points("test", ins, {})


def test_a_column_of_a_table_is_written_contiguous() -> None:
    points = view()
    table = np.arange(12.0).reshape(4, 3)
    points.write("Y", table[:, 1])
    assert points.outs["Y"].flags["C_CONTIGUOUS"]
    assert points.outs["Y"].tolist() == [1, 4, 7, 10]


def test_values_take_the_type_of_the_view() -> None:
    points = view(LoD95=np.zeros(4), Epoch=np.zeros(4))
    points.write_dimension(dims.LOD95, np.array([0.1, np.nan, 2, 3]))
    points.write_dimension(dims.EPOCH, np.array([0, 1, 1, 0]))
    assert points.outs["LoD95"].dtype == np.float64
    assert np.isnan(points.outs["LoD95"][1])
    assert points.outs["Epoch"].tolist() == [0, 1, 1, 0]


@pytest.mark.parametrize(
    ("column", "values"),
    [
        (np.zeros(4, np.uint8), np.array([1, 2, 3, 300])),
        (np.zeros(4, np.uint8), np.array([1, 2, -3, 4])),
        (np.zeros(4, np.int32), np.array([0.5, 1, 2, 3])),
        (np.zeros(4, np.int32), np.array([np.nan, 1, 2, 3])),
    ],
)
def test_values_that_do_not_fit_are_refused(column: Any, values: Any) -> None:
    with pytest.raises(PipelineError, match="would lose values") as caught:
        view(Own=column).write("Own", values)
    assert "add_dimension" in caught.value.remedy


def test_half_a_column_is_refused() -> None:
    with pytest.raises(PipelineError, match=r"\(3,\) values"):
        view().write("X", np.zeros(3))


def test_a_missing_dimension_is_named_with_the_way_to_add_it() -> None:
    with pytest.raises(PipelineError, match="LoD95") as caught:
        view().write_dimension(dims.LOD95, np.zeros(4))
    assert '"add_dimension": "LoD95=float"' in caught.value.remedy
    with pytest.raises(PipelineError, match="needs the dimension Epoch"):
        view().column("Epoch")


def test_columns_are_copies() -> None:
    points = view()
    points.column("X")[:] = 9
    assert points.ins["X"].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("dimension", dims.DIMENSIONS, ids=lambda d: d.name)
def test_every_dimension_has_a_pdal_type(dimension: dims.Dimension) -> None:
    assert pdal_type(dimension.dtype) in ("uint8", "uint32", "float", "double")


def test_the_entry_has_exactly_two_plain_arguments() -> None:
    parameters = inspect.signature(entry.bind("lod", {})).parameters.values()
    assert [p.kind for p in parameters] == [inspect.Parameter.POSITIONAL_OR_KEYWORD] * 2


def test_a_call_sees_what_pdal_left_in_the_module_just_before() -> None:
    seen: list[Call] = []
    script: dict[str, Any] = {}
    run = entry_of("test", seen.append, script)
    nested = {
        "name": "root",
        "children": [{"name": "filters.python", "children": [{"name": "loda_before", "value": "W"}]}],
    }
    srs = {"srs": {"wkt": "short", "compoundwkt": "long", "horizontal": "short"}}
    script |= {"pdalargs": {"run": "r"}, "spatialreference": srs, "metadata": nested}
    assert run({axis: np.zeros(2) for axis in "XYZ"}, {}) is True
    assert seen[0].arguments == {"run": "r"}
    assert seen[0].crs_wkt == "long"
    assert seen[0].notes == {"before": "W"}
    seen[0].leave("after", "V")
    assert script["out_metadata"] == {"name": "loda_after", "value": "V", "type": "string"}


def test_an_empty_view_is_left_alone() -> None:
    run = entry_of("test", lambda call: pytest.fail("was called"), {})
    assert run({axis: np.zeros(0) for axis in "XYZ"}, {}) is True


@pytest.mark.parametrize("given", [{"run": "r"}, json.dumps({"run": "r"})])
def test_arguments_may_be_a_table_or_its_text(given: Any) -> None:
    assert arguments_of("test", given) == {"run": "r"}


def test_arguments_that_are_no_table_are_refused() -> None:
    assert arguments_of("test", None) == {}
    for given in ("{run", "[1]", 3):
        with pytest.raises(PipelineError, match="pdalargs of stage test"):
            arguments_of("test", given)


@pytest.mark.parametrize(
    "given",
    [
        {"rum": "x"},
        {"preset": "boat"},
        {"set": {"lod.radius": 1}},
        {"set": ["lod.radius_m=1"]},
        {"set": {"lod.radius_m": -1}},
        {"epsg": "28992"},
    ],
)
def test_wrong_arguments_are_refused(given: Any) -> None:
    with pytest.raises(LodaError):
        entry.check("lod", given)


def test_arguments_choose_the_parameters() -> None:
    from loda_pdal.pdal_face.run import Arguments

    parsed = Arguments.parse({"preset": "aerial", "set": {"lod.radius_m": 1.5}, "epsg": 28992})
    assert parsed.parameters.name == "aerial"
    assert parsed.parameters.lod.radius_m == 1.5
    assert parsed.run is None


def test_auto_takes_the_preset_that_suits_the_points() -> None:
    from loda_pdal.pdal_face.run import Arguments

    even = Survey(np.random.default_rng(0).uniform(0.0, (60.0, 60.0, 8.0), (9000, 3)))
    for choice in ({}, {"preset": "auto"}):
        parsed = Arguments.parse({**choice, "set": {"lod.radius_m": 1.5}})
        chosen = parsed.for_surveys(Pair(even, even))
        assert (chosen.name, chosen.lod.radius_m, chosen.fuse.leaf_m) == ("aerial", 1.5, 0.5)
    assert Arguments.parse({"preset": "street"}).for_surveys(Pair(even, even)).name == "street"


def test_an_unknown_entry_is_named() -> None:
    with pytest.raises(PipelineError, match="no stage 'lods'"):
        entry.bind("lods", {})
