# From a bare clone: `make demo`, `make test`.  Needs Python >= 3.11, make and a C compiler.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
JOBS ?= 2

.PHONY: help demo test coverage wheel test-wheel lowest lint types docs bench study-impacts study-elastic study-global study-feasible study-flow study-robustness study-real-impacts study-scan study-controller study-sweep reproduction calibration regression
.PHONY: pictures viewer clean

help:
	@echo "make demo        install into .venv, optimize a real robot, leave pictures and C code in demo/"
	@echo "make test        install with the test extras and run the whole suite"
	@echo "make lint types  ruff, import-linter; mypy"
	@echo "make docs        the documentation site in docs/_build/html"
	@echo "make wheel       build sdist and wheel, compare them with git, install, run every command, types"
	@echo "make test-wheel  the same, then the whole suite against the installed wheel"
	@echo "make lowest      the same with the lowest versions that pyproject.toml allows; PYTHON= tries another Python"
	@echo "make bench       speed on this machine: solve times, ticks, the exported kernel and its peers"
	@echo "make coverage    branch coverage of both packages by the suite, for the documentation"
	@echo "make study-impacts  predictions of the objectives against impacts simulated in MuJoCo"
	@echo "make study-elastic  inertia of arms with elastic joints in an impact, against MuJoCo"
	@echo "make study-global   completeness of the global search, and basin hopping against multi-start"
	@echo "make reproduction   the paper's experiments, many seeds, for the documentation (about ten minutes)"
	@echo "make study-feasible  cost of collision constraints, limits at rest and approach speed"
	@echo "make study-flow     rest of the reference flow, from 1,000 random starts of each of four seeds (three minutes)"
	@echo "make study-real-impacts  balls, strikes, taps: rigid model against MuJoCo (some minutes)"
	@echo "make study-robustness  where each controller helps and which targets it keeps (ten minutes; continues after an interruption)"
	@echo "make study-scan     a scan along the redundancy of an arm and of a humanoid, as a picture"
	@echo "make study-controller  the controller in C against Python: equal answers, growth, times (an hour; PART=equality, growth or times; times: 4 minutes on a quiet machine)"
	@echo "make study-sweep    robustness (killed workers and parents, MPI, Slurm jobs) and cost of sweeps"
	@echo "make calibration    restitution of the contact laws in the simulated world"
	@echo "make regression  recompute the committed reference results"
	@echo "make pictures    draw the pictures of the documentation"
	@echo "make viewer      rebuild the script of report.html from its sources; needs npm"
	@echo "make clean       remove all files that make wrote"

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("impact-posture needs Python 3.11 or newer, this is " + sys.version.split()[0] + ": make PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@ $(VENV)/.installed

demo: $(VENV)/.installed
	@rm -f demo/LOOK.txt
	$(BIN)/impact-posture optimize tilthex_arm --frame ee --normal 0 0 1 --out demo --force
	@cp docs/demo.txt demo/LOOK.txt
	@echo
	@cat demo/LOOK.txt
	@echo
	@echo "Open demo/report.html in a browser, or: $(BIN)/impact-posture view demo"

# Tests run some hundred commands.  Where Python may not write bytecode, each of them would compile the package again.
test: $(VENV)/.installed-test
	$(BIN)/python -m compileall -q impact_posture cli robots
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -q

wheel: $(VENV)/.installed-test
	$(BIN)/python -m tests.support.installed_wheel

test-wheel: $(VENV)/.installed-test
	$(BIN)/python -m tests.support.installed_wheel --tests -n $(JOBS) --dist worksteal

lowest: $(VENV)/.installed-test
	$(BIN)/python -m tests.support.installed_wheel --lowest --tests -n $(JOBS) --dist worksteal

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

# mypy does not see mapped packages in an editable install, so it checks what a wheel would install; from there, since it
# would read the sources that lie in the folder where it starts.
types: $(VENV)/.installed-test
	rm -rf build/types build/lib
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target build/types .
	cd build/types && $(CURDIR)/$(BIN)/mypy --config-file $(CURDIR)/pyproject.toml -p impact_posture -p impact_posture_cli -p impact_posture_robots

docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

bench: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies solve loader tsid kernel

coverage: $(VENV)/.installed-test
	$(BIN)/python -m tests.support.coverage_report -n $(JOBS) --dist worksteal

study-impacts: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies impacts --write

study-elastic: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies elastic --write

study-global: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies global --write
	$(BIN)/python -m docs.studies hops --write

study-feasible: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies feasible --write
	$(BIN)/python -m docs.studies approach --write

study-flow: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies flow --jobs $(JOBS) --write

study-controller: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies.controller 10000 $(PART)

study-sweep: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies.sweep
	$(BIN)/python -m docs.studies.sweep_verdicts

reproduction: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies reproduction --write

study-robustness: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies points --jobs $(JOBS)
	$(BIN)/python -m docs.studies robustness --write
	$(BIN)/python -m docs.studies envelope --write

study-scan: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies scan --write

study-real-impacts: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies real-impacts --jobs $(JOBS) --write

calibration: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies restitution --write

regression: $(VENV)/.installed
	$(BIN)/python -m tests.regression.make

# The script of report.html from npm's packages by their lock file, in a folder of its own; VIEWER_OUT= writes elsewhere.
VIEWER := impact_posture/output/report/viewer
VIEWER_OUT ?= $(VIEWER)/viewer.min.js
viewer:
	@rm -rf build/viewer && mkdir -p build/viewer && cp $(VIEWER)/package.json $(VIEWER)/package-lock.json $(VIEWER)/viewer.js build/viewer
	cd build/viewer && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
	cd build/viewer && node_modules/.bin/esbuild viewer.js --bundle --minify --target=es2022 --legal-comments=none --outfile=bundle.js --log-level=warning
	@{ echo '/*! three.js'; cat build/viewer/node_modules/three/LICENSE; echo '*/'; cat build/viewer/bundle.js; } > $(VIEWER_OUT)

pictures: $(VENV)/.installed
	$(BIN)/python docs/pictures.py

clean:
	rm -rf $(VENV) demo docs/_build build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
