"""``hybridve doctor``: what this machine has, and what it lacks."""

import ctypes.util
import json
import sys
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
@options.json_option
def doctor(as_json: bool) -> None:
    """Tell what this machine has: OpenGL renderer, threads, versions, and what is missing.

    Leaves with status 1 if something that detect needs is missing.
    """
    found = examine()
    if as_json:
        click.echo(json.dumps(found))
    else:
        click.echo(f"machine    {found['machine']}")
        click.echo(f"opengl     {found['opengl'] or 'none: ' + found['opengl_problem']}")
        click.echo(f"engine     {found['engine']} (what --engine auto takes here)")
        for package, number in found["versions"].items():
            click.echo(f"{package:24}{number}")
        for problem in found["problems"]:
            click.echo(f"problem    {problem}")
        if not found["problems"]:
            click.echo("nothing is missing")
    if found["problems"]:
        sys.exit(1)


def examine() -> dict[str, Any]:
    """Return what the machine has, as plain JSON values."""
    from hybridve.calib.errors import DeviceError
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
        "versions": software_versions(),
        "problems": problems,
    }
