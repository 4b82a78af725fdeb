"""Imports point one way: kernels and model <- stages <- pipeline <- faces; io sees what lies below the stages."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "loda_pdal"

# Part of the package -> the parts it may import (itself included). Faces do not know each other, except that the
# command line has a verb for each; they reach for the kernels only to set the number of threads.
MAY_IMPORT = {
    "model": {"model", "kernels", "params"},
    "params": {"model"},
    "kernels": {"kernels", "model"},
    "stages": {"stages", "kernels", "model", "params"},
    "io": {"io", "kernels", "model", "params"},
    "assembly": {"stages", "model"},
    "preset_choice": {"model"},
    "pipeline": {"assembly", "preset_choice", "stages", "kernels", "model", "params"},
    "warmup": {"pipeline", "kernels", "io", "model", "params"},
    "pdal_face": {"pdal_face", "pipeline", "preset_choice", "assembly", "stages", "kernels", "io", "model", "params"},
    "benchmark": {"benchmark", "warmup", "pipeline", "stages", "kernels", "io", "model", "params"},
    "cli": {"cli", "benchmark", "pdal_face", "warmup", "pipeline", "preset_choice", "kernels", "io", "model", "params"},
    "__main__": {"cli"},
    "__init__": {"pipeline", "preset_choice", "io", "model", "params"},
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported_names(path: Path) -> set[str]:
    """Dotted names of all modules that a file imports, wherever in the file."""
    names: set[str] = set()
    package = ("loda_pdal", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            source = ".".join((*base, node.module)) if node.module else ".".join(base)
            names |= {f"{source}.{alias.name}" for alias in node.names} if source == "loda_pdal" else {source}
    return names


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_one_way(path: Path) -> None:
    ours = {name.split(".")[1] for name in imported_names(path) if name.startswith("loda_pdal.")}
    assert ours <= MAY_IMPORT[part_of(path)], f"{path.name} looks the wrong way"


@pytest.mark.parametrize("name", ["params.py", "model/errors.py"])
def test_other_interpreters_can_load_the_parameters(name: str) -> None:
    """PDAL's and QGIS's interpreters load these with nothing but the standard library."""
    outside = {full.split(".")[0] for full in imported_names(PACKAGE / name)} - {"loda_pdal"}
    assert outside <= sys.stdlib_module_names
    ours = {full for full in imported_names(PACKAGE / name) if full.startswith("loda_pdal")}
    assert ours <= {"loda_pdal.model.errors"}


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_method_knows_no_faces(path: Path) -> None:
    """Only faces know command line, progress bars and files of points; kernels only loop."""
    outside = {full.split(".")[0] for full in imported_names(path)}
    if part_of(path) in ("model", "params", "kernels", "stages", "assembly", "preset_choice", "pipeline"):
        assert not outside & {"click", "rich", "laspy", "geopandas", "pyogrio", "rasterio", "pdal", "qgis"}
    if part_of(path) == "kernels":
        assert not outside & {"scipy", "shapely", "logging"}
