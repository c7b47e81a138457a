# `make demo` and `make test` need Python 3.11 or newer, git and make; everything else goes into .venv.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
READY := .venv/ready
DOCS_READY := .venv/docs-ready

.PHONY: demo test test-slow test-all matrix figures docs check bench setup llvm browser clean

demo: setup
	$(BIN)/ommatid run scenes/tile19.toml scenes/photo.toml -o out
	@echo "Look at out/photo/report.html; overview.png beside it is a picture of it, run.json has the numbers."

# One thread for linear algebra: the matrices are small, and on busy cores waiting threads take minutes for seconds.
test: setup browser
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

# The tests that `make test` leaves out because they take long, and both together.
test-slow: setup browser
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m 'slow and not figures'

test-all: setup browser
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m 'not figures'

# Every version of Python that is installed here, each in an environment of its own; others are skipped.
matrix: setup
	$(BIN)/nox

# Figures of the pages that take minutes to compute anew; `make test` checks all others.
figures: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m figures tests/test_figures.py

# The documentation as a site with search, which works from its files and without a network. mkdocs.yml says why MkDocs.
docs: setup $(DOCS_READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo "Open build/site/index.html."

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: setup
	$(BIN)/python -m tests.benchmarks

setup: $(READY) llvm

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $(READY)

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $(DOCS_READY)

# The fast backend wants LLVM 17 or newer; Debian's libllvm19 is installed where that can be done without asking.
# Where it cannot, everything works on the slow backend, and `ommatid doctor` names the one command that mends it.
FAST := $(BIN)/python -c 'import sys; from ommatid.simulate.renderer.variant import unusable_reason; sys.exit(bool(unusable_reason("llvm_ad_mono")))'
ROOT := $(shell if [ "$$(id -u)" = 0 ]; then echo env; elif sudo -n true 2>/dev/null; then echo sudo -n; fi)

llvm: $(READY)
	@$(FAST) || { [ -n "$(ROOT)" ] && command -v apt-get >/dev/null && echo "Installing libllvm19 ..." && \
		$(ROOT) apt-get update -qq && $(ROOT) apt-get install -y -qq libllvm19; } >&2 2>/dev/null || true
	@$(FAST) || echo "No LLVM 17 or newer here: rendering will be slow; .venv/bin/ommatid doctor says how to mend it."

# Reports are tested in a browser; Debian's chromium is installed where that can be done without asking, else those
# tests are skipped.
BROWSER := command -v chromium || command -v chromium-browser || command -v google-chrome

browser:
	@{ $(BROWSER); } >/dev/null || { [ -n "$(ROOT)" ] && command -v apt-get >/dev/null && \
		echo "Installing chromium ..." && $(ROOT) apt-get update -qq && \
		$(ROOT) apt-get install -y -qq chromium; } >&2 2>/dev/null || true
	@{ $(BROWSER); } >/dev/null || echo "No chromium here: tests of reports in a browser are skipped."

clean:
	rm -rf .venv out build
