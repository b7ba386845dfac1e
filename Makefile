# The only list of commands. Nothing is assumed but Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV := $(shell command -v uv 2>/dev/null || echo .uv/bin/uv)
STAMP := $(VENV)/.installed

DEV := $(VENV)/.installed-dev

.PHONY: setup dev demo test check bench tables pins clean

setup: $(STAMP)

dev: $(DEV)

demo: setup
	$(BIN)/retrim demo

test: dev
	$(BIN)/pytest

check: dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: setup
	$(BIN)/retrim bench

tables: dev
	$(BIN)/retrim reproduce hover --out docs/results
	$(BIN)/retrim reproduce reversing --out docs/results
	$(BIN)/retrim reproduce tracking --out docs/results
	$(BIN)/retrim reproduce vision --out docs/results
	$(BIN)/retrim reproduce plants --out docs/results
	$(BIN)/retrim reproduce model --out docs/results

# uv, in a private folder where there is none.
.uv/bin/uv:
	$(PYTHON) -m venv .uv
	.uv/bin/python -m pip install --quiet uv==0.13.8

$(STAMP): pyproject.toml constraints.txt | $(UV)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "retrim needs Python 3.11 or newer; set PYTHON=...")'
	$(UV) venv --quiet --clear --python $(PYTHON) $(VENV)
	$(UV) pip install --quiet --python $(VENV) --constraints constraints.txt --editable .
	@touch $@

# The developers' tools, and the independent plants that the tests fly.
$(DEV): $(STAMP)
	$(UV) pip install --quiet --python $(VENV) --constraints constraints.txt --group dev --editable '.[plants]'
	@touch $@

# After a change of dependencies in pyproject.toml: names, versions and markers only.
pins: | $(UV)
	$(UV) pip compile --quiet --upgrade --universal --all-extras --group dev --python-version 3.11 \
		--no-header --no-annotate pyproject.toml --output-file constraints.txt

clean:
	rm -rf $(VENV) .uv runs .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
