.DEFAULT_GOAL := help
.PHONY: help demo test check venv pdal clean

BIN := .venv/bin

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-6s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: venv  ## simulate two surveys, detect the changes, score them against the known truth
	@$(BIN)/loda-pdal bench simulate --seed 7 --overwrite demo/input
	@$(BIN)/loda-pdal detect demo/input/before.laz demo/input/after.laz -o demo/result --overwrite
	@$(BIN)/loda-pdal bench score demo/result demo/input/truth.json
	@printf '\nlayers for QGIS: demo/result/changes.gpkg\npoint cloud:     demo/result/changes.laz\nreport:          demo/result/report.html\n'

test: venv  ## formatting, lint, types and all tests; with PDAL where it can be had
	@scripts/install_pdal.sh --if-possible
	@$(MAKE) --no-print-directory check
	@$(BIN)/python -m pytest

check: venv  ## formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

pdal: venv  ## a private PDAL with its Python plugin in .pdal (Debian 12, root)
	@scripts/install_pdal.sh

clean:  ## remove everything that make has made, except .venv and .pdal
	rm -rf demo build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +

venv:
	@scripts/setup_venv.sh
