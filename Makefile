# book, test, notebooks, lab, bench and clean; each but the last makes its own environment first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# the tests share the cores by processes; threads on top of them only wait
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: book test notebooks lab bench clean

book: $(VENV)/ready
	rm -rf _build/html
	$(BIN)/jupyter-book build . -W -n --keep-going -q
	$(BIN)/python book/check.py _build/html
	@echo "The book is built. Open this page in a browser:"
	@echo "  $(CURDIR)/_build/html/index.html"

test: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pytest -q -n 2 --dist loadfile --cov=pftrack --cov-report=term $(ARGS)

notebooks: $(VENV)/ready
	$(BIN)/python notebooks/execute.py $(ARGS)

lab: $(VENV)/ready
	$(BIN)/jupyter lab notebooks

bench: benchmarks/.venv/ready
	PYTHONPATH=. benchmarks/.venv/bin/python benchmarks/speed.py $(ARGS)
	PYTHONPATH=. benchmarks/.venv/bin/python benchmarks/clustering.py
	PYTHONPATH=. benchmarks/.venv/bin/python benchmarks/association.py --published

clean:
	rm -rf _build $(VENV) benchmarks/.venv *.egg-info .pytest_cache .ruff_cache .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/ready: requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "pftrack needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.txt
	@touch $@

benchmarks/.venv/ready: benchmarks/requirements.txt
	$(PYTHON) -m venv benchmarks/.venv
	benchmarks/.venv/bin/pip install --quiet --disable-pip-version-check --no-deps -r $<
	@touch $@
