.DEFAULT_GOAL := help
.PHONY: help demo test check venv pdal qgis plugin clean

BIN := .venv/bin

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-6s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: venv  ## simulate two surveys, detect the changes, score them against the known truth
	@$(BIN)/loda-pdal bench simulate --seed 7 --plain --overwrite demo/input
	@$(BIN)/loda-pdal detect demo/input/before.laz demo/input/after.laz -o demo/result --overwrite
	@$(BIN)/loda-pdal bench score demo/result demo/input/truth.json
	@printf '\nlayers for QGIS: demo/result/changes.gpkg\npoint cloud:     demo/result/changes.laz\nreport:          demo/result/report.html\n'

test: venv  ## formatting, lint, types and all tests; with PDAL and QGIS where they can be had
	@scripts/install_pdal.sh --if-possible
	@scripts/install_qgis.sh --if-possible
	@$(MAKE) --no-print-directory check
	@$(BIN)/python -m pytest
	@if [ -x .qgis/bin/python ]; then .qgis/bin/python -m pytest -c tests/qgis/pytest.ini tests/qgis; fi

check: venv  ## formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

pdal: venv  ## a private PDAL with its Python plugin in .pdal (Debian 12, root)
	@scripts/install_pdal.sh

qgis: venv  ## QGIS from bookworm-backports and the environment of its tests (Debian 12, root)
	@scripts/install_qgis.sh

plugin: venv  ## the QGIS plugin as a zip in dist, with the parameters of this engine
	@$(BIN)/python qgis_plugin/package.py

clean:  ## remove everything that make has made, except .venv, .pdal and .qgis
	rm -rf demo build dist .mypy_cache .ruff_cache */.ruff_cache */*/.ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -not -path './.qgis/*' -prune -exec rm -rf {} +

venv:
	@scripts/setup_venv.sh
