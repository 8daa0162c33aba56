# `make demo` and `make test` set up the environment themselves on the first run.
PYTHON ?= $(firstword $(foreach p,python3 python3.13 python3.12 python3.11,$(shell command -v $(p) >/dev/null 2>&1 && $(p) -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo $(p))))
BIN := .venv/bin
.DEFAULT_GOAL := help
.PHONY: help setup everything peers walk docs notebooks clean-room wheel demo test checked-tests check test-fast coverage test-slow test-long tier long machine mutations soak faults bench lock deb deb-trial arm64 install uninstall clean
PREFIX ?= /usr/local
# Tests start hundreds of processes: where no bytecode may be kept, each of them compiles all modules anew.
unexport PYTHONDONTWRITEBYTECODE
# Three tests on two cores: a third of the time of tests is waiting for sockets and processes.
BESIDE = -n $(shell echo $$(( ($$(nproc) * 3 + 1) / 2 ))) --dist worksteal

help: ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

setup: ## create the environment in .venv (the other targets do it if needed)
	@test -n "$(PYTHON)" || { echo "dappled needs Python 3.11 or newer on PATH" >&2; exit 1; }
	@$(PYTHON) tools/bootstrap.py

everything: ## .venv with all extras, and what slow tests and notebooks need (the targets that need it do it)
	@test -n "$(PYTHON)" || { echo "dappled needs Python 3.11 or newer on PATH" >&2; exit 1; }
	@$(PYTHON) tools/bootstrap.py everything

peers: ## MAVSDK, MAVProxy and pycolmap, which long tests talk to, in .venv-peers (done by test-long when needed)
	@test -n "$(PYTHON)" || { echo "dappled needs Python 3.11 or newer on PATH" >&2; exit 1; }
	@$(PYTHON) tools/bootstrap.py peers

demo: setup ## fly eight simulated frames through the whole daemon, and draw the last one
	@tools/demo

LINT = $(BIN)/ruff check -q . && $(BIN)/ruff format -q --check . && $(BIN)/lint-imports
# Types of the tests take as long again as those of the source: `make check` and test-slow look at both.
CHECKS = $(LINT) && $(BIN)/mypy src
# glibc keeps what arrays leave free: given back, each page comes anew from the kernel, which clears it.
KEEPS = MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=1073741824
# Slow tests keep their files on a disk: what a file system does is theirs.
TESTS = $(KEEPS) $(BIN)/python tools/in_memory.py $(BIN)/pytest -q --no-header $(BESIDE) -m "not slow" --durations=25
# Prints what was taken of so many seconds and CPU-seconds (docs/tests.md).
BUDGET = $(BIN)/python tools/budget.py

test: setup ## lint, types, import contracts, and the default tests
	@$(BUDGET) "make test" 240 400 $(MAKE) -s checked-tests

# The checks take a core for a minute: beside the tests, not before them. pytest's own bytecode of the tests is made once, in
# a new clone, and not by each worker.
checked-tests:
	@failed=; { $(CHECKS); } & checks=$$!; \
	[ -d tests/__pycache__ ] || $(BIN)/pytest -q --collect-only >/dev/null; \
	$(TESTS) || failed=tests; \
	wait $$checks || { echo "the checks failed: see what they say above, or run make check" >&2; failed=checks; }; \
	[ -z "$$failed" ]

check: setup ## lint, format, types (of tests and tools too), import contracts
	@$(LINT) && $(BIN)/mypy

test-fast: setup
	@$(TESTS)

coverage: setup ## run the default tests and report which lines they reach (a third slower)
	@$(BIN)/coverage erase
	@$(BIN)/pytest -q --no-header -n auto --dist worksteal -m "not slow" --cov --cov-report=term

# The files where tests of a tier stand: a process that need not read all others begins a quarter of a minute sooner.
MARKED = $$(grep -rlE "mark\.($(1))\b" --include="test_*.py" tests)

test-slow: everything ## types of all else, and the tests at real seams; those that watch a clock run with no other beside them
	@$(BUDGET) "make test-slow" 700 1300 $(MAKE) -s tier OF="slow and not long"

test-long: everything peers ## soaks, sweeps, matrices and benchmarks, and properties over many examples
	@$(BUDGET) "make test-long" 2400 4800 $(MAKE) -s tier OF=long PROPERTIES=many

tier:
	@failed=0; \
	$(BIN)/mypy & types=$$!; \
	$(BIN)/pytest -q --no-header -m "$(OF) and not alone" --durations=25 $(BESIDE) $(call MARKED,slow|long) || failed=1; \
	wait $$types || failed=1; \
	$(BIN)/pytest -q --no-header -m "$(OF) and alone" --durations=15 $(call MARKED,alone) || failed=1; \
	[ -z "$(PROPERTIES)" ] || $(BIN)/pytest -q --no-header -m "hypothesis and not slow" --hypothesis-profile $(PROPERTIES) $(BESIDE) || failed=1; \
	exit $$failed

long: ## what is too long for each change: the long tests, arm64, the README in both bare roots; as root
	@CUTS=$${CUTS:-100} .ci/run arm64 test-long mutations clean-room

machine: everything ## the package in a whole machine: systemd as PID 1, 512 MB, a read-only disk, the plug pulled (CUTS=n times), USB; as root
	@$(BIN)/pytest -v --no-header -m "machine and long" --durations=0 tests/machine

mutations: setup ## break the code in one place at a time: the default tests must catch each; ONE=word for some
	@$(BIN)/python tools/mutations.py $(ONE)

walk: setup ## the modules that a command and a frame pass, traced anew and written into docs/modules.md with the list of all modules
	@$(BIN)/python -m tests.architecture.walk --write

clean-room: ## the README's commands in bare Debian roots (SUITES="bookworm trixie", RUN="make demo && make test"); as root
	@for suite in $(or $(SUITES),bookworm trixie); do tools/clean-room $$suite "$${RUN:-make demo && make test}" || exit 1; done

wheel: ## the wheel in bare environments of Python 3.11 to 3.14: installs, flies a frame, opens its light field; as root
	@for suite in bookworm noble trixie forky; do tools/clean-room $$suite "python3 tools/wheel_trial.py" || exit 1; done

docs: setup ## build the documents' site in build/site: strict, links checked, nothing fetched by its pages
	@test -n "$(PYTHON)" || { echo "dappled needs Python 3.11 or newer on PATH" >&2; exit 1; }
	@$(PYTHON) tools/bootstrap.py docs
	@NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build -q
	@echo "build/site/index.html, $$(du -sh build/site | cut -f1)"

notebooks: everything ## run the notebooks of docs/notebooks, and keep what they print and draw
	@$(BIN)/python tools/notebooks.py --write

soak: setup ## fly half an hour in which something goes wrong every few seconds; MINUTES=n for another time
	@$(BIN)/python -m tests.soak --minutes $(or $(MINUTES),30)

faults: setup ## run every camera fault against the daemon in 20 rounds; ROUNDS=n for another number
	@for round in $$(seq $(or $(ROUNDS),20)); do echo "== round $$round"; \
	  $(BIN)/pytest -q -p no:cacheprovider -m "" tests/system/test_camera_faults.py || exit 1; done

bench: everything ## run the benchmarks, print one table with the limits, write docs/performance.md; REPEATS=n
	@$(BIN)/python benchmarks/table.py --page --repeats $(or $(REPEATS),5)

lock: setup ## resolve the locks anew from pyproject.toml: everything, what demo and default tests need, the peers of tests, the documents, what flies, what builds it, and uv
	@uv=$$(command -v uv || echo .tools/bin/uv); $$uv pip compile -q --universal --python-version 3.11 --generate-hashes \
	  --no-header --no-annotate --all-extras --group dev --group whole pyproject.toml -o requirements-everything.lock; \
	$$uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header -c requirements-everything.lock \
	  --no-annotate --extra ground --extra ros --group dev pyproject.toml -o requirements.lock; \
	$$uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --group peers \
	  -o requirements-peers.lock; \
	$$uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --group docs \
	  -o requirements-docs.lock; \
	$$uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header -c requirements.lock \
	  --no-annotate pyproject.toml -o requirements-onboard.lock; \
	echo hatchling | $$uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header -c requirements.lock \
	  --no-annotate - -o requirements-build.lock; \
	echo uv | $$uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
	  --upgrade - -o requirements-uv.lock

deb: setup ## build Debian packages for amd64 and arm64 in build/deb (SUITE=trixie for Debian 13)
	@$(BIN)/python tools/deb.py --suite $(or $(SUITE),bookworm) $(foreach a,$(ARCH),--arch $(a))

deb-trial: ## the packages in bare Debian roots: installed, flown, purged (SUITE=bookworm, ARCH="amd64 arm64"); as root
	@$(MAKE) -s deb
	@for arch in $(or $(ARCH),amd64 arm64); do deb=$$(ls build/deb/dappled_*+$(or $(SUITE),bookworm)_$$arch.deb) || exit 1; \
	  ARCH=$$arch BRING=$$deb tools/clean-room $(or $(SUITE),bookworm) "tools/deb-trial /root/$$(basename $$deb)" || exit 1; done

arm64: setup ## check that the onboard part installs on a Raspberry Pi, and print its size
	@$(BIN)/python tools/arm64.py

install: ## install the service under PREFIX (default /usr/local): environment, unit, udev rule, settings
	@$(PYTHON) tools/install.py install --prefix $(PREFIX) $(if $(DESTDIR),--destdir $(DESTDIR)) $(if $(SYSCONFDIR),--sysconfdir $(SYSCONFDIR))

uninstall: ## remove the service; settings and flights stay
	@$(PYTHON) tools/install.py uninstall --prefix $(PREFIX) $(if $(DESTDIR),--destdir $(DESTDIR)) $(if $(SYSCONFDIR),--sysconfdir $(SYSCONFDIR))

clean: ## remove what setup and tests made
	rm -rf .venv .venv-peers .venv-docs .cache .tools build .coverage* htmlcov .mypy_cache .ruff_cache .pytest_cache .hypothesis
