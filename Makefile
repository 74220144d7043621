# Needs Python 3.11 or later and make; everything else goes into .venv, pinned by constraints.txt.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test slow lint types bench docs dist clean

demo: $(VENV)/installed
	$(BIN)/alidade demo

test: $(VENV)/installed
	$(BIN)/python -m pytest -q -n auto --dist worksteal

slow: $(VENV)/installed
	$(BIN)/python -m pytest -q -n auto -m slow

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/installed
	$(BIN)/mypy alidade factors pipelines datasets benchmarks tests docs/examples/gyro_pair

bench: $(VENV)/installed
	$(BIN)/python -m benchmarks

# Wheel and sdist, each installed into an environment of its own, away from the checkout.
dist: $(VENV)/installed
	rm -rf build dist
	$(BIN)/python -m build --outdir dist > build.log 2>&1 || { cat build.log; exit 1; }
	rm build.log
	for made in dist/*.whl dist/*.tar.gz; do \
	  rm -rf build/smoke && $(PYTHON) -m venv build/smoke && \
	  build/smoke/bin/python -m pip install --quiet --disable-pip-version-check $$made -c constraints.txt && \
	  cp tests/smoke.py build/smoke/ && (cd build/smoke && bin/python smoke.py) || exit 1; \
	done

docs: $(VENV)/installed
	$(BIN)/python -m pytest -q tests/test_docs.py

$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed, this is " + sys.version.split()[0] + ": make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' -c constraints.txt
	touch $@

clean:
	rm -rf $(VENV) build dist alidade-demo
