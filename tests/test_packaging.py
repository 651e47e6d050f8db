"""What is shipped: the wheel holds the package, its shaders, its templates and nothing else.

And what its modules keep to themselves.
"""

import ast
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("wheel")
    # From a copy: setuptools keeps what it built before in the folder it builds from.
    checkout = folder / "checkout"
    checkout.mkdir()
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=PROJECT,
        capture_output=True,
        check=True,
    ).stdout.split(b"\0")
    for name in (part.decode() for part in listed if part):
        if (PROJECT / name).is_file():
            (checkout / name).parent.mkdir(parents=True, exist_ok=True)
            (checkout / name).write_bytes((PROJECT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    command += ["--no-build-isolation", "--wheel-dir", str(folder), str(checkout)]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,) = folder.glob("hybridve-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_beside_it(wheel_names: list[str]) -> None:
    tops = {name.split("/")[0] for name in wheel_names}

    assert {top for top in tops if not top.endswith(".dist-info")} == {"hybridve"}


@pytest.mark.slow
def test_every_file_that_the_package_reads_is_in_the_wheel(wheel_names: list[str]) -> None:
    for folder in ("cli", "hull", "calib"):
        for pattern in ("*.py", "*.glsl", "*.jinja", "*.css", "py.typed"):
            for path in (PROJECT / folder).rglob(pattern):
                name = f"hybridve/{path.relative_to(PROJECT).as_posix()}"
                assert name in wheel_names, f"{name} is missing: list it in pyproject.toml"


def test_a_plain_import_of_the_folders_fails() -> None:
    code = "import importlib.util as u, sys; sys.exit(u.find_spec('hull') is not None)"

    done = subprocess.run([sys.executable, "-c", code], cwd="/", check=False)

    assert done.returncode == 0


def private_names_of_others(source: str) -> list[str]:
    """Return the names with a leading underscore that a module takes from others."""
    tree = ast.parse(source)
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [alias for node in imports for alias in node.names]
    taken = [alias.name for alias in names]
    known = {alias.asname or alias.name for alias in names}
    taken += [
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in known
    ]
    return [name for name in taken if name.startswith("_") and not name.startswith("__")]


def test_a_private_name_of_another_module_is_told() -> None:
    source = "from a import _b, c\nfrom a import d as _d\nimport e\nc._f(e._g, e.h.__doc__, _d.i)"

    assert private_names_of_others(source) == ["_b", "_f", "_g"]


@pytest.mark.slow
def test_no_module_takes_what_another_keeps_to_itself() -> None:
    for folder in ("cli", "hull", "calib"):
        for path in (PROJECT / folder).rglob("*.py"):
            taken = private_names_of_others(path.read_text(encoding="utf-8"))
            assert not taken, f"{path.relative_to(PROJECT)} takes {', '.join(taken)}"
