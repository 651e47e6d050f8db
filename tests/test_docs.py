"""The examples in docstrings are true."""

import doctest
import importlib
import pkgutil
from types import ModuleType

import numpy as np
import pytest

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
