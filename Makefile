# The commands that people and CI run; `make` alone lists them.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# what the demonstration needs, which is what users install; the rest, if it is there, will do as well
PRODUCT := $(or $(wildcard $(STAMP)),$(VENV)/.product)
CODE := src tests benchmarks scripts
TYPES := $(BIN)/python -m mypy --strict src

.DEFAULT_GOAL := help
.PHONY: help install demo test test-all test-processor world lint style format figures pictures docs sbom clean
.DELETE_ON_ERROR:

help:           ## list the targets
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)/  make \1\t\2/p' Makefile | expand -t 18

install: $(STAMP)  ## make .venv with servoscope, editable, and what its tests need

demo: $(PRODUCT)  ## simulate a rig, break it, diagnose it; the report goes to demo-output/
	$(BIN)/servoscope demo -o demo-output

test: style     ## what must pass before a commit: format, lint, types, all tests but the slow ones
test-all: style  ## the same with the slow ones: browsers, Spark, kills and chaos (REQUIRE_ALL=1: no test may skip)

test: SELECTION := -m "not slow"
test: WORKERS := 2
test-all: WORKERS := 3  # the slow ones wait for servers and browsers about as long as they compute
# a busy machine may be late for what waits for servers and browsers: what failed has one more try, with nothing beside it
test-all: AGAIN := --last-failed --last-failed-no-failures none
# types are checked beside the first tests, on what these leave of two cores; what mypy says stands below their results
test test-all:
	@mkdir -p .cache; $(TYPES) >.cache/types.log 2>&1 & types=$$!; \
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(SELECTION); tests=$$?; \
	if [ $$tests = 1 ] && [ -n "$(AGAIN)" ]; then $(BIN)/python -m pytest -n 0 $(AGAIN); tests=$$?; fi; \
	wait $$types; types=$$?; echo '$(TYPES)'; cat .cache/types.log; exit $$((tests || types))

# diagnoses must not hang on the last bits, which differ from one processor to the next
NUMERICAL := tests/isolation tests/detection tests/diagnosis/test_last_bits.py tests/learning/test_likelihood.py tests/learning/test_learning.py
test-processor: $(STAMP)  ## the numerical tests with the arithmetic of another processor
	$(BIN)/python scripts/other_processor.py $(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow" $(NUMERICAL)

world: $(STAMP)  ## four minutes of the service in a simulated world, with faults from new seeds
	$(BIN)/python benchmarks/chaos.py simulated --minutes 4

lint: style     ## format and lint of the whole tree, and types, without changing a file
	$(TYPES)

style: $(STAMP)
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m ruff check .

format: $(STAMP)  ## put the code into shape
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

figures: $(STAMP)  ## run the programs behind the figures of the documents, and print what differs (half an hour)
	$(BIN)/python scripts/figures.py --run

pictures: $(STAMP)  ## the pictures of README and docs, with the record of what they show (half an hour)
	$(BIN)/servoscope demo -o demo-output
	$(BIN)/python scripts/screenshot.py demo-output/report.html docs/images/report.png
	$(BIN)/python benchmarks studies/steps demo-output -o docs/images/steps
	$(BIN)/python benchmarks public/overview --picture docs/images/benchmarks.svg
	$(BIN)/python benchmarks accuracy/run --render
	$(BIN)/python benchmarks accuracy/nonlinear --figure docs/images/nonlinear-rig.png
	$(BIN)/python benchmarks accuracy/cylinder_plants --picture docs/images/cylinder.png
	$(BIN)/servoscope reproduce --seeds 20 -o build/paper && cp build/paper/*.png docs/images/paper
	$(BIN)/python scripts/hand_over.py --write
	$(BIN)/python scripts/pictures.py --record
	SCREENSHOTS=docs/images/pages $(BIN)/python -m pytest -n 0 tests/web/test_web_pages.py tests/web/test_web_action.py tests/web/test_web_files.py

docs: $(STAMP)     ## the site of docs/, as wheels have it: servoscope docs opens it
	$(BIN)/python -m sphinx -q -W -E -d build/docs docs src/servoscope/site

sbom: $(STAMP)     ## of a release: the bill of materials (CycloneDX), and what advisories mean for it (OpenVEX)
	$(BIN)/python scripts/sbom.py -o servoscope.cdx.json
	$(BIN)/python scripts/audit.py --vex servoscope.openvex.json

clean:          ## remove what the other targets made
	rm -rf $(VENV) demo-output .cache .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist src/servoscope/site
	find $(CODE) -name __pycache__ -type d -prune -exec rm -rf {} +

# Done again only when one of the two files has changed; .venv itself is kept then, unless its Python is gone.
$(STAMP): EXTRAS := [dev]
$(STAMP) $(VENV)/.product: pyproject.toml requirements-dev.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "servoscope needs Python 3.11 or newer, and '$(PYTHON)' is $$($(PYTHON) --version 2>&1):" \
	       "install one and name it, as in 'make PYTHON=python3.12'" >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV) || { \
	  echo "no virtual environment could be made: on Debian and its kin, install python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements-dev.lock -e '.$(EXTRAS)'
	@touch $@
