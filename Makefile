# The whole project from a fresh clone: `make demo` and `make test`. Everything lives in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALLED := $(VENV)/.installed

.PHONY: help setup demo test test-all check proto clean

help:
	@echo "make demo      install, then map a generated flat with three agents and write a report"
	@echo "make test      install, then run the tests (under 10 minutes on 2 cores)"
	@echo "make test-all  the tests, the slow ones included"
	@echo "make setup     only install into .venv"
	@echo "make check     linters, types, import rules, contract"
	@echo "make proto     regenerate the gRPC stubs from proto/"

setup: $(INSTALLED)

# torch goes first and pinned: an unpinned one pulls gigabytes of CUDA that nothing here needs.
$(INSTALLED): pyproject.toml constraints.txt scripts/system-packages
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "magic-slam needs Python 3.11 or newer; $(PYTHON) is older. Try: make PYTHON=python3.12"; exit 1; }
	@scripts/system-packages
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet "$$(grep '^torch==' constraints.txt)"
	$(PIP) install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: setup
	$(BIN)/magic demo

test: setup
	$(BIN)/python -m pytest

test-all: setup
	$(BIN)/python -m pytest -m "not gpu"

check: setup
	scripts/check

proto: setup
	scripts/generate-protos

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .cache
