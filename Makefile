# make demo   render a real photograph focused near, middle and far; pictures go to out/
# make test   run the tests
# Both need only Python 3.11 and make: the first run makes .venv and installs what constraints.txt pins.

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test install check clean

demo: $(INSTALLED)
	$(BIN)/python examples/demo.py --data examples/data/motorcycle --out out

test: $(INSTALLED)
	$(BIN)/python -m pytest

install: $(INSTALLED)

# Style and types. Types are checked on a copy that is installed, not editable:
# only there do checkers find fit/ as torchdof.fit and export/ as torchdof.export.
check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build/typecheck build/lib build/bdist.*
	$(BIN)/pip install --quiet --no-deps --target build/typecheck .
	MYPYPATH=build/typecheck $(BIN)/mypy -p torchdof
	MYPYPATH=build/typecheck $(BIN)/mypy tests examples

$(INSTALLED): pyproject.toml constraints.txt
	@echo "installing into $(VENV); the first time this takes a minute or two"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf build out *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
