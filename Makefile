# make demo       render a photograph focused near, middle and far, and a portrait; pictures go to out/
# make test       run the tests, two at a time
# make oldest     run the tests on the oldest supported versions (constraints-oldest.txt, Python 3.10), a download of 3 GB
# make docs       build the site of the documentation into build/site/, links checked
# make pictures   render the pictures of the documentation anew into docs/pictures/
# make sweep      run the hard tests at full length: whole frames instead of strips, up to twenty times as many examples
# make wheel      build the wheel for this machine into dist/ and try it, and installation, without a compiler
# make sanitize   run the compiled engine's tests under AddressSanitizer and ThreadSanitizer; needs GCC
# make fuzz       changed files to every reader, for an hour (SECONDS=3600); lists what it finds
# All but oldest need only make and Python 3.11 or newer: the first run makes .venv and installs what constraints.txt
# pins. PYTHON=/path/to/python chooses the Python.
# Where there is a C++ compiler the engine is compiled too.

PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13 python3.14 python3.11; do \
	$$p -c 'import ensurepip, sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && break; done; echo $$p)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
FOR_DEMO := $(VENV)/.installed-for-demo

# For what is installed, and for what builds it.
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_BUILD_CONSTRAINT := $(PIP_CONSTRAINT)

# Some containers set it. Each process that a test starts would compile the modules of PyTorch anew, for ten seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test oldest docs pictures sweep install check style types package wheel sanitize fuzz clean

demo: $(FOR_DEMO)
	$(BIN)/python examples/demo.py --data examples/data/motorcycle --out out

test: $(INSTALLED)
	$(BIN)/python -m pytest -n 2 --dist worksteal

oldest:
	test -x build/venv-oldest/bin/python || python3.10 -m venv build/venv-oldest
	PIP_CONSTRAINT=$(CURDIR)/constraints-oldest.txt PIP_BUILD_CONSTRAINT=$(CURDIR)/constraints-oldest.txt \
		build/venv-oldest/bin/pip install --quiet --editable '.[test]'
	build/venv-oldest/bin/python -m pytest -n 2 --dist worksteal

docs: $(INSTALLED) package
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir build/site

pictures: $(INSTALLED)
	$(BIN)/python examples/gallery.py --out docs/pictures

sweep: $(INSTALLED)
	HYPOTHESIS_PROFILE=many $(BIN)/python -m pytest -n 2 --dist worksteal -m "hard or sweep"

install: $(INSTALLED)

check: style types

style: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror torchdof/native/*.h torchdof/native/src/* tests/native/*.cpp
	! command -v $(CXX) >/dev/null || $(CXX) -std=c++17 -fsyntax-only -Wall -Wextra -Werror -Wno-psabi \
		-Itorchdof/native -Ibuild torchdof/native/src/*.cpp tests/native/*.cpp

types: $(INSTALLED) package
	MYPYPATH=build/package $(BIN)/mypy -p torchdof
	MYPYPATH=build/package $(BIN)/mypy tests examples

# The package with the folders of an installation: only there do checkers of types and of names find fit/ as
# torchdof.fit and export/ as torchdof.export.
package:
	rm -rf build/package
	mkdir -p build/package
	cp -r torchdof build/package/
	cp -r fit export build/package/torchdof/

wheel: $(INSTALLED)
	tests/packaging/wheel.sh $(BIN)/python

sanitize: $(INSTALLED)
	tests/native/sanitize.sh $(BIN)/python

SECONDS := 3600
fuzz: $(INSTALLED)
	FUZZ_SECONDS=$(SECONDS) $(BIN)/python -m pytest -n 1 -m hard tests/fuzz

INSTALLS_FROM := pyproject.toml constraints.txt CMakeLists.txt $(wildcard torchdof/native/src/*) build/modules \
	build/constants/checksum.h

# --no-compile: Python compiles a module when it first imports it; most of the 11,000 are never imported.
$(INSTALLED): $(INSTALLS_FROM)
	@echo "installing into $(VENV) all that development needs; the first time this takes minutes"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --editable '.[dev]'
	touch $(FOR_DEMO) $@

$(FOR_DEMO): $(INSTALLS_FROM)
	@echo "installing into $(VENV); the first time this takes a minute"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --editable .
	touch $@

# An editable installation knows where each module lies: after one has moved it must be made again.
build/modules: always
	@mkdir -p $(@D); find torchdof fit export -name '*.py' | sort >$@.new; cmp -s $@.new $@ || cp $@.new $@

# The engine is compiled with the constants of Python modules; the headers are written only where they change.
build/constants/checksum.h: always
	@$(PYTHON) cmake/constants.py $(@D)

.PHONY: always

clean:
	rm -rf build dist out *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
