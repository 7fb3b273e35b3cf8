# make demo   in a new .venv: install palpate, let a simulated arm weigh something, print where the report is
# make test   everything that must hold; make help lists the rest
# Needs python3 >= 3.11, make and a C++20 compiler. PYTHON=python3.12 chooses another Python.

PYTHON ?= python3
VENV ?= .venv
export CMAKE_BUILD_PARALLEL_LEVEL ?= 2
export PIP_DISABLE_PIP_VERSION_CHECK := 1
ifeq ($(shell uname),Linux)
# Pictures without a display; MUJOCO_GL=osmesa or glfw overrides.
export MUJOCO_GL ?= egl
endif

BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet
SOURCES := $(sort $(shell find src core/include core/src session/include bindings cmake -type f \
             -not -name '*.pyc' -not -name '_core.*' 2>/dev/null)) \
           CMakeLists.txt core/CMakeLists.txt session/CMakeLists.txt pyproject.toml README.md

.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help demo test test-slow cpp-test cpp-package lint docs bench wheel sanitize sanitize-thread format dev clean FORCE

help:
	@echo "make demo        install into $(VENV) and weigh something in simulation"
	@echo "make test        C++ tests, lint, types, layers, docs, wheel, Python tests"
	@echo "make test-slow   the tests that take minutes"
	@echo "make cpp-test    only the C++ tests;  make sanitize: the same under ASan and UBSan;"
	@echo "                 make sanitize-thread: those of the session under TSan"
	@echo "make lint        ruff, mypy, import layers, include layers"
	@echo "make docs        the manual, into build/docs"
	@echo "make bench       benchmarks, with the rivals in the same run"
	@echo "make wheel       dist/palpate-*.whl, checked"
	@echo "make format      reformat Python and C++"
	@echo "make dev         editable install for working on palpate"
	@echo "make clean       remove $(VENV), build and dist"

demo: $(VENV)/.all
	$(BIN)/palpate weigh

test: debian cpp-test cpp-package lint docs wheel pytest

# --- environment -------------------------------------------------------------------------------------------------

.PHONY: debian
debian:
	@scripts/install-debian.sh

# The build tools live in the environment, so that pip reuses build/<tag> and compiles only what changed.
$(VENV)/.tools: pyproject.toml scripts/check_host.py
	@$(PYTHON) scripts/check_host.py
	@test -x $(BIN)/python || { echo "making $(VENV)"; $(PYTHON) -m venv $(VENV); }
	@$(BIN)/python -c 'import tomllib; \
	  print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], "cmake>=3.26", "ninja>=1.11", sep="\n")' \
	  > $(VENV)/build-requirements.txt
	@$(PIP_INSTALL) -r $(VENV)/build-requirements.txt
	@touch $@

# Names of all sources, rewritten when one comes or goes: a deleted file must leave the installed package too.
$(VENV)/.sources: FORCE | $(VENV)/.tools
	@echo '$(SOURCES)' | cmp -s - $@ || echo '$(SOURCES)' > $@

# A real install, not an editable one: what is tested is what users get, a forgotten data file included.
install = @echo "installing palpate[$(1)]" && PATH="$(abspath $(BIN)):$$PATH" \
  $(PIP_INSTALL) --no-build-isolation --config-settings=build-dir='build/{wheel_tag}$(3)' $(2) ".[$(1)]"
$(VENV)/.all: $(SOURCES) $(VENV)/.sources | $(VENV)/.tools
	$(call install,all)
	@touch $@
$(VENV)/.test: $(SOURCES) $(VENV)/.sources | $(VENV)/.tools
	$(call install,all$(comma)test,$(strict),-strict)
	@cp $$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("platlib"))')/palpate/_core.pyi src/palpate/
	@touch $@ $(VENV)/.all
$(VENV)/.bench: $(VENV)/.all
	$(call install,bench)
	@touch $@
comma := ,
strict = --config-settings=cmake.define.PALPATE_WERROR=ON

dev: $(VENV)/.tools
	$(call install,dev,$(strict) --editable,-strict)
	@rm -f $(VENV)/.all $(VENV)/.test

# --- checks ------------------------------------------------------------------------------------------------------

.PHONY: pytest
pytest: $(VENV)/.test
	$(BIN)/python -m pytest -m "not slow" $(PYTEST)

test-slow: sanitize-thread $(VENV)/.test
	$(BIN)/python -m pytest -m slow --timeout=1800 $(PYTEST)

cpp = @$(BIN)/cmake -S . -B build/$(1) -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN))/ninja \
        -DPALPATE_BUILD_TESTS=ON -DPALPATE_WERROR=ON $(2) --log-level=WARNING \
      >/dev/null && $(BIN)/cmake --build build/$(1) -- --quiet \
      && $(BIN)/ctest --test-dir build/$(1) --output-on-failure
cpp-test: $(VENV)/.tools
	$(call cpp,cpp)
sanitize: $(VENV)/.tools
	$(call cpp,sanitize,-DPALPATE_SANITIZE=ON)

# The session's threads and wait-free buffers under the thread sanitizer.
sanitize-thread: $(VENV)/.tools
	@$(BIN)/cmake -S . -B build/sanitize-thread -G Ninja -DCMAKE_MAKE_PROGRAM=$(abspath $(BIN))/ninja \
	  -DPALPATE_BUILD_TESTS=ON -DPALPATE_WERROR=ON -DPALPATE_SANITIZE_THREAD=ON --log-level=WARNING >/dev/null
	@$(BIN)/cmake --build build/sanitize-thread --target session_tests -- --quiet
	$(BIN)/ctest --test-dir build/sanitize-thread/session --output-on-failure

# The README's lines for C++ users, as typed: what `cmake --install` leaves must be enough for another project.
cpp-package: $(VENV)/.tools
	@rm -rf build/home build/example
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python scripts/run_page.py README.md "In C++"

lint: $(VENV)/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python scripts/check_includes.py

docs: $(VENV)/.test
	$(BIN)/sphinx-build -W --keep-going -q -b html docs build/docs

wheel: $(VENV)/.test
	@rm -rf dist
	@PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation \
	  --config-settings=build-dir='build/{wheel_tag}-strict' $(strict) -w dist .
	$(BIN)/python scripts/check_wheel.py dist/*.whl

bench: $(VENV)/.bench
	$(BIN)/palpate bench speed --out build/bench/results

format: $(VENV)/.test
	$(PIP_INSTALL) "clang-format>=18"
	$(BIN)/ruff check --fix-only
	$(BIN)/ruff format
	find core session bindings benchmarks examples -name '*.[ch]pp' -exec $(BIN)/clang-format -i {} +

clean:
	rm -rf $(VENV) build dist src/palpate/_core.pyi docs/_build .pytest_cache .mypy_cache .ruff_cache .hypothesis \
	  .import_linter_cache
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
