# In a fresh clone, run `make demo` or `make test`.  Both need Python >= 3.11, make and a C compiler.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
JOBS ?= 2

.PHONY: help demo test test-long coverage wheel test-wheel lowest lint types docs bench bench-gpu study-impacts study-elastic study-hits study-global study-feasible study-flow study-robustness study-strikes study-real-impacts study-verdict study-robots study-scan study-controller study-sweep study-hostile reproduction calibration regression
.PHONY: pictures viewer clean

help:
	@echo "make demo        install into .venv, optimize a posture of a real robot, write pictures and C code into demo/"
	@echo "make test        install with the test extras and run the tests"
	@echo "make test-long   all tests, also parameters that repeat a check with another robot, objective or controller"
	@echo "make lint types  check the code with ruff and import-linter; check the types with mypy"
	@echo "make docs        build the documentation site in docs/_build/html"
	@echo "make wheel       build sdist and wheel, compare their files with git, install the wheel, run every command, check types"
	@echo "make test-wheel  the steps of `make wheel`, then all tests with the installed wheel"
	@echo "make lowest      the steps of `make test-wheel` with the lowest versions that pyproject.toml allows; PYTHON= selects the Python"
	@echo "make bench       measure solve times, ticks, and the exported kernel against other implementations"
	@echo "make bench-gpu   measure the CUDA export on this GPU beside all cores and frax, and calls from CuPy, PyTorch and JAX (four minutes)"
	@echo "make coverage    measure the branch coverage of both packages by the tests, for the documentation"
	@echo "make study-impacts  compare predictions of the objectives with impacts simulated in MuJoCo"
	@echo "make study-elastic  compare the predicted inertia of arms with elastic joints with MuJoCo"
	@echo "make study-hits     predict recorded hits of an arm; DATA= is the folder of the recordings (three minutes)"
	@echo "make study-global   measure how complete the global search is, and how often the default search reaches the best known posture (an hour; the first time some hours)"
	@echo "make reproduction   run the experiments of the paper with many seeds, for the documentation (about ten minutes)"
	@echo "make study-feasible  measure the effect of collision constraints, limits at rest and approach speed"
	@echo "make study-flow     run the reference flow from 1,000 random starts for each of four seeds (three minutes)"
	@echo "make study-strikes  simulate planned strikes beside strikes from other postures (an hour)"
	@echo "make study-real-impacts  compare the rigid model with MuJoCo for throws, strikes and taps (some minutes)"
	@echo "make study-verdict  simulate the impacts of verdicts, and compare each number (some minutes)"
	@echo "make study-robustness  measure where each controller helps and which targets it meets (ten minutes; can continue after an interruption)"
	@echo "make study-robots   inspect, draft and optimize every robot model at hand (some minutes)"
	@echo "make study-scan     scan postures of an arm and of a humanoid, and draw the results"
	@echo "make study-controller  compare the controllers in C and Python: equal answers, growth of memory, times (an hour; PART=equality, growth or times runs one part; times needs 4 minutes on a quiet machine)"
	@echo "make study-sweep    measure the robustness (killed workers and parents, MPI, Slurm jobs) and the speed of sweeps"
	@echo "make study-hostile  try hostile inputs at length, and count them by test file (an hour)"
	@echo "make calibration    measure the restitution of the contact laws in the simulated world"
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

# Compile the packages first.  Tests run some hundred commands, and if Python may not write bytecode, each command would
# compile the packages again.
test: $(VENV)/.installed-test
	$(BIN)/python -m compileall -q impact_posture cli robots
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -q

test-long: $(VENV)/.installed-test
	$(BIN)/python -m compileall -q impact_posture cli robots
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -q --long

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

# In an editable install, mypy does not find packages whose folders are renamed.  So mypy checks the files that a wheel
# installs.  It must start in their folder, because otherwise it reads the sources in the current folder.
types: $(VENV)/.installed-test
	rm -rf build/types build/lib
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target build/types .
	cd build/types && $(CURDIR)/$(BIN)/mypy --config-file $(CURDIR)/pyproject.toml -p impact_posture -p impact_posture_cli -p impact_posture_robots

docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

bench: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies solve loader tsid kernel

bench-gpu: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies gpu

coverage: $(VENV)/.installed-test
	$(BIN)/python -m tests.support.coverage_report -n $(JOBS) --dist worksteal --long

study-impacts: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies impacts --write

study-elastic: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies elastic --write

study-hits: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies hits --data "$(DATA)" --write

study-global: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies global --write
	$(BIN)/python -m docs.studies search --seed 1 --write
	$(BIN)/python -m docs.studies screening --write

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

study-hostile: $(VENV)/.installed-test
	$(BIN)/python -m pytest tests/hostile -n $(JOBS) --dist worksteal -q --hostile-full --hostile-table

reproduction: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies reproduction --write

study-robustness: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies points --jobs $(JOBS)
	$(BIN)/python -m docs.studies robustness --write
	$(BIN)/python -m docs.studies envelope --write

study-robots: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies robots --jobs $(JOBS) --write

study-scan: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies scan --write

study-strikes: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies strikes --jobs $(JOBS) --write
	$(BIN)/python -m docs.studies landing --jobs $(JOBS) --write
	$(BIN)/python -m docs.studies strike-instants --jobs $(JOBS) --write

study-real-impacts: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies real-impacts --jobs $(JOBS) --write

study-verdict: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies verdict --jobs $(JOBS) --write

calibration: $(VENV)/.installed-test
	$(BIN)/python -m docs.studies restitution --write

regression: $(VENV)/.installed
	$(BIN)/python -m tests.regression.make

# Build the script of report.html in a separate folder, from the npm packages of the lock file.  VIEWER_OUT= selects
# the output file.
VIEWER := impact_posture/output/report/viewer
VIEWER_OUT ?= $(VIEWER)/viewer.min.js
viewer:
	@rm -rf build/viewer && mkdir -p build/viewer && cp $(VIEWER)/package.json $(VIEWER)/package-lock.json $(VIEWER)/viewer.js build/viewer
	cd build/viewer && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
	cd build/viewer && node_modules/.bin/esbuild viewer.js --bundle --minify --target=es2022 --legal-comments=none --outfile=bundle.js --log-level=warning
	@{ echo '/*! three.js'; cat build/viewer/node_modules/three/LICENSE; echo '*/'; cat build/viewer/bundle.js; } > $(VIEWER_OUT)

pictures: $(VENV)/.installed-test
	$(BIN)/python docs/pictures.py
	$(BIN)/python docs/strike_picture.py

clean:
	rm -rf $(VENV) demo docs/_build build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
