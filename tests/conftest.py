"""What all tests share: the real `pdal` program, the real point clouds, and when their absence is a failure."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from loda_pdal.pdal_face.program import find_pdal

ROOT = Path(__file__).resolve().parent.parent
IN_CI = os.environ.get("CI", "").lower() in ("1", "true")
NO_PDAL = "no pdal program whose filters.python can import loda_pdal (make pdal, or docs/pdal.md)"

collect_ignore = ["qgis"]  # those run in QGIS's own Python, see tests/qgis/conftest.py

settings.register_profile("loda", deadline=None, derandomize=True, max_examples=25, database=None)
settings.load_profile("loda")


def _data_folder() -> Path | None:
    folder = Path(os.environ.get("LODA_TEST_DATA") or ROOT.parent / "shared" / "data")
    return folder if folder.is_dir() else None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests marked `data` skip without the real point clouds; those marked `pdal` skip without PDAL, but fail in CI."""
    if item.get_closest_marker("data") and _data_folder() is None:
        pytest.skip("no folder of real point clouds (LODA_TEST_DATA names one)")
    if item.get_closest_marker("pdal") and find_pdal() is None:
        if IN_CI:
            pytest.fail(NO_PDAL)
        pytest.skip(NO_PDAL)


@pytest.fixture(scope="session")
def compiled_kernels(tmp_path_factory: pytest.TempPathFactory) -> None:
    """For tests of what a run says or how long it takes: with a cold cache it would compile first."""
    from loda_pdal.kernels import is_cache_warm
    from loda_pdal.warmup import compile_kernels

    if not is_cache_warm():
        compile_kernels(tmp_path_factory.mktemp("warmup"))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real point clouds; for tests marked `data`."""
    folder = _data_folder()
    assert folder is not None, "mark the test with @pytest.mark.data"
    return folder


@pytest.fixture(scope="session")
def pdal_program() -> Path:
    """The real `pdal`; for tests marked `pdal`."""
    program = find_pdal()
    assert program is not None, "mark the test with @pytest.mark.pdal"
    return program


@pytest.fixture(scope="session")
def pipelines_dir() -> Path:
    """The folder of the project's PDAL pipelines."""
    return ROOT / "pipelines"
