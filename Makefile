# Needs Python 3.11 or later and make; everything else goes into .venv, pinned by constraints.txt.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: demo test slow lint types bench docs words dist wheels clean

demo: $(VENV)/run
	$(BIN)/alidade demo
	@echo "To go on: source $(BIN)/activate, which makes the command alidade of $(BIN)/alidade."

test: $(VENV)/dev
	$(BIN)/python -m pytest -q -n auto --dist worksteal

slow: $(VENV)/dev
	$(BIN)/python -m pytest -q -n auto --dist worksteal -m slow --durations 25

lint: $(VENV)/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/dev
	$(BIN)/mypy alidade datasets benchmarks tests docs/examples/gyro_pair docs/_site

bench: $(VENV)/dev
	$(BIN)/python -m benchmarks

# Wheel and sdist, each installed into an environment of its own, away from the checkout; then a new user's path through
# README, quick start, the page of each method and the how-to guides that take long, typed there.
dist: $(VENV)/dev
	rm -rf build/smoke dist
	$(BIN)/python -m build --outdir dist > build.log 2>&1 || { cat build.log; exit 1; }
	rm build.log
	$(BIN)/python -m twine check --strict dist/*
	for made in dist/*.whl dist/*.tar.gz; do \
	  rm -rf build/smoke && $(PYTHON) -m venv build/smoke && \
	  build/smoke/bin/python -m pip install --quiet --disable-pip-version-check $$made -c constraints.txt && \
	  cp tests/install/smoke.py tests/install/walk.py build/smoke/ && (cd build/smoke && bin/python smoke.py) || exit 1; \
	done
	cd build/smoke && bin/python walk.py $(CURDIR)/README.md $(CURDIR)/docs/quickstart.md $(CURDIR)/docs/methods/*.md \
	  $(CURDIR)/docs/howto/compass.md $(CURDIR)/docs/howto/follow.md $(CURDIR)/docs/howto/plan.md $(CURDIR)/docs/howto/python.md

# A wheel of every pinned run-time dependency for Linux x86-64 and aarch64 and macOS arm64, Python 3.11 to 3.14.
wheels: $(VENV)/dev
	$(BIN)/python tests/install/wheels.py

# The site; tests/applications/test_docs.py and `make dist` run what its pages show.
docs: $(VENV)/dev
	$(BIN)/python -m sphinx -q -W --keep-going -d build/doctrees docs build/docs
	@echo "The site: build/docs/index.html"

# Words of the documentation by group of pages, and dialect that is left in pages, screens and code.
words: $(VENV)/dev
	$(BIN)/python -m docs._site.words

# Two stamps: people who try the command need none of what tests need.
$(VENV)/run: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed, this is " + sys.version.split()[0] + ": make PYTHON=python3.12")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) -e . -c constraints.txt
	touch $@

$(VENV)/dev: $(VENV)/run
	$(INSTALL) -e '.[dev]' -c constraints.txt
	touch $@

clean:
	rm -rf $(VENV) build dist alidade-demo
