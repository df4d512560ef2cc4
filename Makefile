# book, test, notebooks, lab and clean; each of the first four makes its own .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# the tests share the cores by processes; threads on top of them only wait
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: book test notebooks lab clean

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

clean:
	rm -rf _build $(VENV) *.egg-info .pytest_cache .ruff_cache .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/ready: requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "pftrack needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.txt
	@touch $@
