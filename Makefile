# The developer's commands. `make` alone lists them.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALLED := .venv/.installed

# One thread for BLAS: air and ground run side by side, and small matrices gain nothing from more.
export OPENBLAS_NUM_THREADS := 1

.PHONY: help install demo test test-slow fuzz lint bench clean

help: ## list these commands
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

install: $(INSTALLED) ## create .venv and install Luojia with the pinned versions

demo: install ## simulate a flight and watch its map grow in the browser; Ctrl-C ends it
	@PYTHON="$(CURDIR)/$(BIN)/python" exec sh deploy/demo.sh

test: install ## run the quick tests
	$(BIN)/pytest -n 2 --dist loadfile

test-slow: install ## run the tests that take more than half a minute each
	$(BIN)/pytest -m slow

fuzz: install ## feed damaged bytes to every reader, SECONDS=600 each
	$(BIN)/python tests/fuzzing.py --seconds $(or $(SECONDS),600)

lint: install ## check style, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: install ## print the tables of BENCHMARKS.md
	@for bench in tests/benchmarks/bench_*.py; do echo "== $$bench"; $(BIN)/python $$bench || exit 1; done

clean: ## remove .venv and everything that tools left behind
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Luojia needs Python 3.11 or newer; name one: make install PYTHON=/path/to/python3.11" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[air,ground,dev]' -c constraints.txt
	@touch $@
