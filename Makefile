# Everything a newcomer needs, each from a fresh clone: `make train`, `make test`. `make` alone prints this list.
VENV ?= .venv
PYTHON ?= python3
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
MODELS := pose_pf pixel_pf patch_pf cnn_patch downsized dense_coordinates keypoints rotation_grid

.DEFAULT_GOAL := help
.PHONY: help setup train test test-all coverage check format smoke bench methods board report tour pictures weights docs tables clean

help: ## print this list
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP) ## make the virtual environment and install the project (once)

$(STAMP): pyproject.toml
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

train: $(STAMP) ## render scenes if there are none, train on them, test, print the table
	$(PY) train.py $(ARGS)

test: $(STAMP) ## run the tests but for the slow ones, two at a time, one thread each
	OMP_NUM_THREADS=1 $(PY) -m pytest --numprocesses 2 --dist worksteal -m "not slow" $(ARGS)

test-all: $(STAMP) ## run all tests, also those of whole workflows
	OMP_NUM_THREADS=1 $(PY) -m pytest --numprocesses 2 --dist worksteal $(ARGS)

coverage: $(STAMP) ## run them once more, and tell which lines of src none of them reaches (twice the time)
	OMP_NUM_THREADS=1 $(PY) -m coverage erase
	OMP_NUM_THREADS=1 $(PY) -m coverage run -m pytest -m "not slow" $(ARGS)
	$(PY) -m coverage combine --quiet
	$(PY) -m coverage report

check: $(STAMP) ## check format, lint, types and import floors
	.ci/check $(VENV)/bin

format: $(STAMP) ## put the code into its format
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

smoke: $(STAMP) ## run every method but parts_pf, which is for tools, the whole way at toy size
	rm -rf outputs/smoke
	for model in $(MODELS); do $(PY) train.py debug=smoke model=$$model console=json out=outputs/smoke/$$model || exit 1; done

bench: $(STAMP) ## measure: does training wait for the loader? how fast is the filter beside peers? see bench/peers.py
	$(PY) bench/loader.py
	$(PY) bench/peers.py filters $(ARGS)

methods: $(STAMP) ## run (or go on with) every run behind docs/results, and write its tables
	$(PY) bench/methods.py $(ARGS)

tables: $(STAMP) ## write the tables of docs/ from docs/results/runs.csv
	$(PY) bench/tables.py

docs: $(STAMP) ## build the site with the reference into outputs/site
	$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build

board: $(STAMP) ## show every run in TensorBoard
	$(VENV)/bin/tensorboard --logdir outputs

report: $(STAMP) ## explain a run on one page: make report RUN=outputs/runs/... (or SWEEP=outputs/sweeps/...)
	@test -n "$(RUN)$(SWEEP)" || { echo "give RUN=outputs/runs/... or SWEEP=outputs/sweeps/..."; exit 2; }
	$(PY) report.py "$(if $(SWEEP),sweep=$(SWEEP),run=$(RUN))"

tour: $(STAMP) ## run the commands of docs/tour.md: from a mesh to a trained filter
	$(PY) docs/run_tour.py

pictures: $(STAMP) ## make the pictures of README.md, and of docs/tour.md where it was run: ARGS="--checkpoint FILE --meshes DIR"
	$(PY) docs/make_pictures.py $(ARGS)

weights: $(STAMP) ## strip a run to what ships: make weights RUN=outputs/runs/... NAME=carton
	@test -n "$(RUN)" -a -n "$(NAME)" || { echo "give RUN=outputs/runs/... and NAME=..."; exit 2; }
	$(PY) export.py checkpoint=$(RUN)/checkpoints/best.ckpt out=weights/$(NAME).ckpt

clean: ## remove the environment and caches; outputs stay
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis src/*.egg-info
