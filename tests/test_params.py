"""Parameters: presets, strict loading and dumping, ranges."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import pytest

from loda_pdal.model.errors import ParameterError
from loda_pdal.params import PRESETS, STAGES, Parameters


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_toml_and_json(name: str, tmp_path: Path) -> None:
    preset = Parameters.preset(name)
    toml, plain = tmp_path / "p.toml", tmp_path / "p.json"
    toml.write_text(preset.to_toml(), encoding="utf-8")
    plain.write_text(json.dumps(preset.to_dict()), encoding="utf-8")
    assert Parameters.load(toml) == preset
    assert Parameters.load(plain) == preset
    assert Parameters.from_dict(preset.to_dict()) == preset


def test_the_paper_preset_has_the_papers_numbers() -> None:
    p = Parameters.preset("paper")
    assert (p.outliers.k, p.outliers.std_multiplier) == (20, 1.0)
    assert p.icp.leaves_m == (1.0, 0.5, 0.25)
    assert p.icp.radii_m == (1.5, 0.75, 0.35)
    assert p.icp.max_iterations == (60, 40, 30)
    assert (p.icp.tukey_m, p.icp.sigma0_m, p.icp.max_normal_angle_deg) == (0.30, 0.02, 30.0)
    assert (p.lod.radius_m, p.lod.min_points, p.lod.low_observability_m) == (1.0, 30, 0.50)
    assert (p.proxies.voxel_m, p.proxies.min_voxels, p.proxies.histogram_bins) == (0.5, 200, 10)
    a = p.association
    assert (a.gate_m, a.gate_iou, a.unmatched_cost) == (2.0, 0.10, 3.0)
    assert (a.weight_position, a.weight_box, a.weight_histogram) == (1.0, 2.0, 0.5)
    assert (p.superpoints.k, p.superpoints.max_edge_m, p.superpoints.beta) == (20, 1.2, 0.8)
    assert (p.changes.lod_factor, p.changes.min_samples, p.changes.query_radius_m) == (1.10, 50, 0.6)
    assert (p.ground_changes.min_dz_m, p.ground_changes.min_area_m2) == (0.15, 25.0)


def test_every_parameter_says_what_it_is() -> None:
    for entry in Parameters().describe():
        assert entry.doc, f"{entry.stage}.{entry.name} has no meaning"
        if entry.name.endswith("_m"):
            assert entry.unit == "m", f"{entry.stage}.{entry.name} has no unit"
        if isinstance(entry.value, (int, float)) and not isinstance(entry.value, bool):
            assert entry.low is not None and entry.high is not None, f"{entry.stage}.{entry.name} has no range"


@pytest.mark.parametrize(
    ("setting", "code", "named"),
    [
        ("lod.radius_m=-1", "parameter-range", "radius_m"),
        ("lod.radius=1", "parameter-unknown", "radius_m"),
        ("lot.radius_m=1", "parameter-unknown", "lod"),
        ("lod.pose_term=half", "parameter-range", "translation"),
        ("lod.min_points=3.5", "parameter-invalid", "whole number"),
        ("changes.use_lod=1", "parameter-invalid", "true or false"),
        ("icp.radii_m=[1, 2]", "parameter-invalid", "one of each"),
        ("lod.radius_m", "parameter-invalid", "stage.key=value"),
    ],
)
def test_a_wrong_setting_is_refused_and_explained(setting: str, code: str, named: str) -> None:
    with pytest.raises(ParameterError) as caught:
        Parameters().with_setting(setting)
    assert caught.value.code == code
    assert named in str(caught.value)


def test_a_setting_changes_one_value() -> None:
    changed = Parameters().with_setting("lod.radius_m=1.5")
    assert changed.lod.radius_m == 1.5
    assert [s for s in STAGES if getattr(changed, s) != getattr(Parameters(), s)] == ["lod"]


def test_a_file_with_an_unknown_key_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text("[lod]\nradious_m = 1.0\n", encoding="utf-8")
    with pytest.raises(ParameterError, match="radious_m"):
        Parameters.load(path)
    path.write_text("[lod\n", encoding="utf-8")
    with pytest.raises(ParameterError, match="not valid TOML"):
        Parameters.load(path)
    with pytest.raises(ParameterError, match="cannot be read"):
        Parameters.load(tmp_path / "none.toml")


def test_neighbourhoods_grow_with_the_spacing_and_nothing_else_does() -> None:
    aerial = Parameters.preset("aerial")
    assert aerial.for_spacing(0.3) == aerial
    sparse = aerial.for_spacing(1.5)
    assert sparse.lod.radius_m == pytest.approx(3.0 * aerial.lod.radius_m)
    assert sparse.icp.radii_m == pytest.approx([3.0 * r for r in aerial.icp.radii_m])
    for stage in STAGES:
        for item in fields(getattr(aerial, stage)):
            if not item.metadata["is_length"]:
                assert getattr(getattr(sparse, stage), item.name) == getattr(getattr(aerial, stage), item.name)
    assert Parameters.preset("street").for_spacing(1.5) == Parameters.preset("street")
    assert aerial.for_spacing(100.0) == aerial.for_spacing(2.0)
