# `make demo` and `make test` need Python 3.11 or newer, git and make; everything else goes into .venv.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
# A folder in the checkout.
VENV ?= .venv
# Versions of all dependencies, so that a new release breaks nobody's installation; empty: the newest that pip finds.
CONSTRAINTS ?= constraints.txt
# Debian's packages libllvm19 (rendering) and chromium (tests) are installed where no password is needed; no: never.
SYSTEM ?= yes

BIN := $(VENV)/bin
READY := $(VENV)/ready
DOCS_READY := $(VENV)/docs-ready
# One thread for linear algebra: the matrices are small, and on busy cores waiting threads take minutes for seconds.
TESTS := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

.PHONY: demo test test-slow test-all matrix figures docs check bench constraints setup llvm browser clean

demo: setup
	$(BIN)/ommatid run scenes/tile19.toml scenes/photo.toml -o out
	@echo "Look at out/photo/report.html; overview.png beside it is a picture of it, run.json has the numbers."

test: setup browser
	$(TESTS)

# The tests that take long and that `make test` leaves out, and both together.
test-slow: setup browser
	$(TESTS) -m 'slow and not figures'

test-all: setup browser
	$(TESTS) -m 'not figures'

# `make test` with every version of Python that is installed here, and with the lowest and newest dependencies.
matrix: setup
	$(BIN)/nox

# Figures of the pages that take minutes to compute anew; `make test` checks all others.
figures: setup
	$(TESTS) -m figures tests/test_figures.py

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

# The newest versions of all dependencies for each version of Python. No hashes, so that mirrors serve them, too.
constraints: setup
	$(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --extra dev --extra docs --no-annotate \
		--no-emit-index-url --no-emit-find-links --custom-compile-command "make constraints" \
		pyproject.toml --output-file constraints.txt

setup: $(READY) llvm

INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check $(addprefix --constraint ,$(CONSTRAINTS))

$(READY): pyproject.toml $(CONSTRAINTS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"; exit 1; }
	@# An environment that somebody made by hand keeps its Python: another one over it leaves a mixture.
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	$(INSTALL) --editable '.[dev]'
	@# Python before 3.13 reads this file in the locale's encoding, which may not have all letters of the folder's name.
	@echo ../../../.. >$$(echo $(VENV)/lib/python3*/site-packages)/_ommatid.pth
	@touch $(READY)

$(DOCS_READY): $(READY)
	$(INSTALL) --editable '.[docs]'
	@touch $(DOCS_READY)

# $(call package,NAME,PURPOSE) installs a package of Debian with what it requires, and upgrades nothing.
ROOT := $(if $(filter no,$(SYSTEM)),,$(shell if [ "$$(id -u)" = 0 ]; then echo env; elif sudo -n true 2>/dev/null; then echo sudo -n; fi))
package = if [ -n "$(ROOT)" ] && command -v apt-get >/dev/null; then \
	echo "Installing Debian's $(1) for $(2); log: $(VENV)/$(1).log"; \
	{ $(ROOT) apt-get update && $(ROOT) env DEBIAN_FRONTEND=noninteractive \
		apt-get install -y --no-install-recommends --no-upgrade $(1); } >$(VENV)/$(1).log 2>&1 || true; fi

# Without LLVM 17 or newer everything that pinholes need works on the slow backend.
FAST := $(BIN)/python -c 'import sys; from ommatid.simulate.renderer.variant import unusable_reason; sys.exit(bool(unusable_reason("llvm_ad_mono")))'

llvm: $(READY)
	@$(FAST) || { $(call package,libllvm19,fast rendering); }
	@$(FAST) || echo "No LLVM 17 or newer here: rendering will be slow; $(BIN)/ommatid doctor says how to mend it."

# Reports are tested in a browser; without one those tests are skipped.
BROWSER := command -v chromium || command -v chromium-browser || command -v google-chrome

browser: $(READY)
	@{ $(BROWSER); } >/dev/null || { $(call package,chromium,the tests of reports); }
	@{ $(BROWSER); } >/dev/null || echo "No chromium here: tests of reports in a browser are skipped."

clean:
	rm -rf .venv* out build
