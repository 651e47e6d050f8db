"""``hybridve doctor``: what this machine has, and what it lacks."""

import ctypes.util
import json
import sys
import time
from typing import Any

import click

from hybridve.cli import options

#: Shared libraries that the packages load, and the Debian packages that bring them.
_LIBRARIES = {
    "usb-1.0": "libusb-1.0-0",
    "GL": "libgl1",
    "EGL": "libegl1",
    "gomp": "libgomp1",
}


@click.command(short_help="Tell what this machine has.")
@click.option(
    "--prepare", is_flag=True, help="Compile for this machine now what the first detect would."
)
@options.json_option
def doctor(prepare: bool, as_json: bool) -> None:
    """Tell what this machine has: OpenGL renderer, threads, versions, and what is missing.

    With --prepare, the loops of the query are compiled, if they are not yet: some ten seconds that
    the first detect need not wait. They are kept in ~/.cache/hybridve, or where HYBRIDVE_CACHE
    says.

    Leaves with status 1 if something that detect needs is missing.
    """
    prepare_s = _prepare() if prepare else None
    found = examine() | {"prepare_s": prepare_s}
    if as_json:
        click.echo(json.dumps(found))
    else:
        click.echo(f"machine    {found['machine']}")
        click.echo(f"opengl     {found['opengl'] or 'none: ' + found['opengl_problem']}")
        click.echo(f"engine     {found['engine']} (what --engine auto takes here)")
        ready = "compiled" if found["compiled"] else "compiled in the first detect, or by --prepare"
        click.echo(f"query      {ready}" + (f" ({prepare_s:.1f} s)" if prepare_s else ""))
        for package, number in found["versions"].items():
            click.echo(f"{package:24}{number}")
        for problem in found["problems"]:
            click.echo(f"problem    {problem}")
        if not found["problems"]:
            click.echo("nothing is missing")
    if found["problems"]:
        sys.exit(1)


def _prepare() -> float:
    """Compile what detect needs, and return how many seconds that took."""
    from hybridve.hull.prepare import prepare_kernels

    started = time.perf_counter()
    prepare_kernels()
    return time.perf_counter() - started


def examine() -> dict[str, Any]:
    """Return what the machine has, as plain JSON values."""
    from hybridve.calib.errors import DeviceError
    from hybridve.hull.prepare import is_prepared
    from hybridve.hull.query.choose import open_engine
    from hybridve.hull.query.device import open_device
    from hybridve.hull.report.machine import machine_text, n_threads, software_versions

    problems = []
    missing = [
        package
        for library, package in _LIBRARIES.items()
        if ctypes.util.find_library(library) is None
    ]
    if missing:
        problems.append(f"missing system libraries: apt-get install {' '.join(missing)}")
    renderer, gl_version, opengl_problem = "", "", ""
    try:
        with open_device() as device:
            renderer = str(device.info["GL_RENDERER"])
            gl_version = str(device.info["GL_VERSION"])
    except DeviceError as error:
        opengl_problem = str(error)
        problems.append(opengl_problem)
    with open_engine("auto") as engine:
        chosen = engine.name
    return {
        "machine": machine_text(),
        "threads": n_threads(),
        "opengl": f"{renderer}, {gl_version}" if renderer else "",
        "opengl_problem": opengl_problem,
        "engine": chosen,
        "compiled": is_prepared(),
        "versions": software_versions(),
        "problems": problems,
    }
