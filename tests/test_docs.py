"""The examples in docstrings are true, and what the pages name is there."""

import dataclasses
import doctest
import importlib
import pkgutil
import re
import tomllib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pydantic import BaseModel

from hybridve.calib.boards.corner_files import COLUMNS
from hybridve.hull.cad.scene import HingeTable, ObjectTable, TrackTable
from hybridve.hull.capture.segment import SegmentSettings
from hybridve.hull.capture.session_tables import TARGETS, CameraTable, SessionTable, WorldPoint
from hybridve.hull.plan.example import EXAMPLE
from hybridve.hull.plan.tables import PLAN_TABLES

PROJECT = Path(__file__).resolve().parent.parent
PACKAGES = ("hybridve.calib", "hybridve.hull", "hybridve.cli")
MAKEFILE = (PROJECT / "Makefile").read_text(encoding="utf-8")


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


README = PROJECT / "README.md"
ROOMS = ("calib", "cli", "data", "hull", "tests")

#: Every page, as its path in the project.
PAGES = sorted(
    page.relative_to(PROJECT).as_posix()
    for page in [
        *PROJECT.glob("*.md"),
        *(p for room in ROOMS for p in (PROJECT / room).rglob("*.md")),
    ]
)


def links_of(page: Path) -> list[tuple[Path, str]]:
    """Return what a page links to or shows in the project: the file, and the place in it or ""."""
    targets = re.findall(
        r"\]\(([^)\s]+)(?: \"[^\"]*\")?\)", without_code(page.read_text(encoding="utf-8"))
    )
    inside = [target for target in targets if not re.match(r"[a-z]+:", target)]
    parts = [target.partition("#") for target in inside]
    return [((page.parent / name).resolve() if name else page, at) for name, _, at in parts]


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def places_in(page: Path) -> set[str]:
    """Return the names that headings have as places to link to."""
    heads = re.findall(r"^#+ (.+)$", without_code(page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_links_to_is_there(page: str) -> None:
    for target, at in links_of(PROJECT / page):
        assert target.exists(), f"{page} links to {target}"
        assert not at or at in places_in(target), f"{page} links to {target}#{at}"


def test_every_page_is_one_click_from_the_readme() -> None:
    linked = {target for target, _ in links_of(README)}

    assert {PROJECT / page for page in PAGES} - linked == {README}


@pytest.mark.parametrize("package", ["calib", "hull"])
def test_the_page_of_a_package_tells_of_each_of_its_rooms(package: str) -> None:
    text = (PROJECT / package / "README.md").read_text(encoding="utf-8").split("## Rooms")[1]

    rooms = {path.parent.name for path in (PROJECT / package).glob("*/__init__.py")}

    assert {name for name in rooms if f"\n  {name}/" not in text} == set()


def test_the_readme_is_a_face_and_not_the_whole() -> None:
    assert README.stat().st_size <= 13_000


@pytest.mark.parametrize("page", PAGES)
def test_files_and_targets_that_a_page_names_are_there(page: str) -> None:
    text = (PROJECT / page).read_text(encoding="utf-8")

    tests = set(re.findall(r"((?:property/)?test_\w+\.py|bench_\w+\.py)", text)) - {"test_x.py"}
    paths = set(re.findall(r"`((?:calib|cli|data|hull|tests)/[\w/.]+)`", text))
    targets = set(re.findall(r"`make ([\w-]+)", text))

    for name in tests:
        folders = ["tests/benchmarks"] if name.startswith("bench_") else ["tests", "tests/property"]
        assert any((PROJECT / folder / name).is_file() for folder in folders), name
    for name in paths:
        assert (PROJECT / name).exists(), name
    for name in targets:
        assert re.search(rf"^{name}:", MAKEFILE, re.MULTILINE), f"make {name}"


TABLES: list[tuple[type[BaseModel], str]] = [
    *((table, "data/README.md") for table in (SessionTable, CameraTable, WorldPoint)),
    *((table, "data/README.md") for table in (ObjectTable, HingeTable, TrackTable)),
    *((table, "calib/README.md") for table in TARGETS.values()),
]


@pytest.mark.parametrize(("table", "page"), TABLES, ids=[table.__name__ for table, _ in TABLES])
def test_a_page_names_every_key_of_a_table(table: type[BaseModel], page: str) -> None:
    named = (PROJECT / page).read_text(encoding="utf-8")

    keys = {field.alias or name for name, field in table.model_fields.items()} - {"point"}

    assert {key for key in keys if not re.search(rf"\b{key}\b( =|`|\]|\W*=)", named)} == set()


def test_the_page_of_the_files_tells_every_default_of_the_segmentation() -> None:
    text = (PROJECT / "data/README.md").read_text(encoding="utf-8")
    told: dict[str, str] = {}
    for names, defaults in re.findall(
        r"^\| (`\w+`(?:, `\w+`)*) \| ([\d., ]+) \|", text, re.MULTILINE
    ):
        told |= dict(zip(re.findall(r"\w+", names), defaults.split(", "), strict=True))

    for field in dataclasses.fields(SegmentSettings):
        assert float(told[field.name]) == field.default, field.name


def test_the_page_of_boards_tells_every_column_of_a_corner_file() -> None:
    text = (PROJECT / "calib/README.md").read_text(encoding="utf-8").split("## Corners found")[1]

    assert {name for name in COLUMNS if f"`{name}`" not in text.split("\n## ")[0]} == set()


def test_the_example_of_a_plan_says_every_key_with_its_default() -> None:
    text = re.sub(r"^# (?=\w+ = |\[)", "", EXAMPLE.partition("[volume]")[2], flags=re.MULTILINE)
    told = tomllib.loads("[volume]" + text)

    for name, table in PLAN_TABLES.items():
        said = told[name][0] if isinstance(told[name], list) else told[name]
        keys = table.model_fields
        assert set(keys) - set(said) <= {"size_px", "across_deg"}, name
        for key, field in keys.items():
            if key in said and not field.is_required() and field.default is not None:
                value = tuple(said[key]) if isinstance(said[key], list) else said[key]
                assert value == field.default, f"{name}.{key}"
