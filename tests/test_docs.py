"""The examples in docstrings are true, and what the pages name is there."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

PROJECT = Path(__file__).resolve().parent.parent
PACKAGES = ("hybridve.calib", "hybridve.hull", "hybridve.cli")


def modules() -> list[str]:
    names = []
    for package in PACKAGES:
        paths = importlib.import_module(package).__path__
        names += [found.name for found in pkgutil.walk_packages(paths, prefix=f"{package}.")]
    return [name for name in names if not name.endswith("__main__")]


@pytest.mark.parametrize("name", modules())
def test_examples_are_true(name: str) -> None:
    module: ModuleType = importlib.import_module(name)

    result = doctest.testmod(module, extraglobs={"np": np}, verbose=False)

    assert result.failed == 0


def test_there_are_examples() -> None:
    finder = doctest.DocTestFinder()
    examples = [
        test
        for name in modules()
        for test in finder.find(importlib.import_module(name))
        if test.examples
    ]

    assert len(examples) >= 4


@pytest.mark.parametrize("page", ["README.md", "tests/README.md", "data/README.md"])
def test_tests_and_benchmarks_that_a_page_names_exist(page: str) -> None:
    text = (PROJECT / page).read_text(encoding="utf-8")

    named = set(re.findall(r"((?:property/)?test_\w+\.py|bench_\w+\.py)", text)) - {"test_x.py"}

    for name in named:
        folders = ["tests/benchmarks"] if name.startswith("bench_") else ["tests", "tests/property"]
        assert any((PROJECT / folder / name).is_file() for folder in folders), name
    assert named or page == "data/README.md"
