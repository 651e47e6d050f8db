# make demo    the whole job on a generated session
# make test    everything that must hold: style, types, import contracts, tests
# make thorough  the tests with all their cases and examples, of which make test asks some
# make quick   under a minute of the tests: of each one that is quick the first case
# make coverage  what share of the lines the tests run; compiled loops are not counted
# make oldest  the quick tests with the oldest dependencies that pyproject.toml allows
# make soak    the property tests with new examples: RUNS=10 times, SEED=1 and up, TESTS=some files
# make bench   the benchmarks at full size, into tests/benchmarks/results.json; ONLY="bench_query" some
# make theory  calibrate generated rigs hundreds of times; their errors beside the least possible
# make hard-cases   the table of hard cases in tests/README.md: what each column makes of each row
# make attack  batches whose workers are killed, runs that are killed, every write made to fail
# make fuzz    nearly right files for every reader: RUNS=2000 a reader, SEED=0, ONLY=some readers
# make lock    renew requirements.lock after a change of pyproject.toml
# make vendor  build what pages bring along (three.js) anew, after a change in .ci/vendor; needs npm

BIN := .venv/bin

# As many processes run as there are cores: threads of linear algebra in each would fight.
pytest thorough quick coverage oldest soak bench theory hard-cases attack fuzz: export OPENBLAS_NUM_THREADS = 1

# Compiled modules are kept whatever the shell says: compiling them anew costs each process 5 s, and
# each command that a test starts its share.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test check pytest thorough quick coverage oldest soak bench theory hard-cases attack fuzz lock vendor setup \
	browser clean

demo: setup
	$(BIN)/hybridve demo -o demo --overwrite

test: check pytest

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	cd build/types && ../../$(BIN)/mypy --config-file ../../pyproject.toml -p hybridve
	cd build/types && ../../$(BIN)/mypy --config-file ../../pyproject.toml ../../tests
	$(BIN)/lint-imports

# Files of tests side by side; one file stays with one process, so that fixtures are made once.
# Property tests are asked the same examples in every run, on every machine.
pytest: setup browser
	$(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder --benchmark-disable

thorough coverage soak: export HYBRIDVE_TESTS = thorough

thorough: setup browser
	$(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder --benchmark-disable

quick: setup
	$(BIN)/pytest -q -n auto --dist loadfile --benchmark-disable --quick

coverage: setup browser
	$(BIN)/pytest -q -n auto --dist loadfile --no-loadscope-reorder --benchmark-disable \
		--cov --cov-report=term
	@printf 'coverage: %s %% of the lines\n' "$$($(BIN)/coverage report --format=total)"

oldest: setup
	@bash .ci/oldest

# New examples, a seed a round: RUNS rounds (1), seeds from SEED up (drawn), of the tests in TESTS
# (all that draw). The first round that is red ends it, and says how to repeat just that round.
soak: setup
	@RUNS="$(RUNS)" SEED="$(SEED)" TESTS="$(TESTS)" bash .ci/soak

bench: setup
	$(BIN)/python tests/benchmarks/results.py $(ONLY)

theory: setup
	$(BIN)/python tests/benchmarks/bench_theory.py --processes 2 \
		-o data/pictures/theory.png

hard-cases: setup
	PYTHONPATH=tests $(BIN)/python -m helpers.hard_cases_table

attack: setup
	PYTHONPATH=tests $(BIN)/python tests/attack.py

fuzz: setup
	PYTHONPATH=tests $(BIN)/python tests/fuzz.py --runs $(or $(RUNS),2000) --seed $(or $(SEED),0) --only "$(ONLY)"

lock: setup
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile pyproject.toml --group dev --universal --generate-hashes --no-header \
		--python-version 3.11 --quiet -o requirements.lock

vendor:
	@bash .ci/vendor/build

setup:
	@bash .ci/setup

# Tests open pages in it; nothing else needs it.
browser:
	@bash .ci/browser

clean:
	rm -rf .venv build demo .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
