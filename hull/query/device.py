"""The one door to OpenGL: a headless context, and the shaders shipped with the package."""

from functools import cache
from importlib.resources import files
from typing import Any

import moderngl

from hybridve.calib.errors import DeviceError

#: What the engines need: compute shaders, and double precision in them.
_GL_VERSION = 430

#: Renderers that are programs on the CPU.
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software", "swiftshader")


def open_device(device_index: int | None = None) -> moderngl.Context:
    """Open a headless OpenGL 4.3 context through EGL; its owner releases it.

    The context belongs to the thread that opened it: use it nowhere else, and open it after a
    fork, never before.

    Parameters
    ----------
    device_index : int, optional
        Which of the machine's EGL devices to take; by default the one that EGL prefers.

    Raises
    ------
    DeviceError
        If there is no EGL device that offers OpenGL 4.3.
    """
    create: Any = moderngl.create_context  # whose stub takes each backend setting for a dict
    settings = {} if device_index is None else {"device_index": device_index}
    try:
        context: moderngl.Context = create(
            require=_GL_VERSION, standalone=True, backend="egl", **settings
        )
    except Exception as error:  # moderngl raises plain Exception
        wanted = "EGL" if device_index is None else f"EGL device {device_index}"
        raise DeviceError(
            f"no OpenGL 4.3 through {wanted} ({error}); expected a graphics driver or software "
            "rendering: install libegl1 and libgl1-mesa-dri "
            "(apt-get install libegl1 libgl1-mesa-dri); detect does without: --engine native"
        ) from error
    context.gc_mode = "context_gc"  # what Python drops is released by context.gc(), by the owner
    return context


def make_current(context: moderngl.Context) -> None:
    """Take the thread's OpenGL commands for a context; another one may have had them since.

    Not left again at the end: through EGL, that would leave none current, and so break who does
    not ask.
    """
    enter: Any = context  # whose stub leaves its methods of this kind untyped
    enter.__enter__()


def renderer_name(context: moderngl.Context) -> str:
    """Return what draws, as OpenGL names it."""
    return str(context.info["GL_RENDERER"])


def is_software_renderer(renderer: str) -> bool:
    """Tell whether the CPU does the work of the renderer that OpenGL names so."""
    return any(software in renderer.lower() for software in _SOFTWARE)


@cache
def load_shader(name: str) -> str:
    """Return the source of a shader in ``hull/query/shaders``."""
    return (files("hybridve.hull.query") / "shaders" / name).read_text(encoding="utf-8")


def compile_compute(context: moderngl.Context, name: str, *parts: str) -> moderngl.ComputeShader:
    """Return the compute program `name`, with `parts` (other shader sources) before its body.

    A shader file begins with ``#version`` and may hold one line ``// INSERT``, where the parts go.

    Raises
    ------
    DeviceError
        If the driver does not compile it.
    """
    try:
        return context.compute_shader(_assembled(name, parts))
    except moderngl.Error as error:
        raise _does_not_compile(context, name, error) from error


def compile_program(
    context: moderngl.Context, vertex: str, geometry: str, fragment: str, *parts: str
) -> moderngl.Program:
    """Return the program of three shader files, with `parts` before the body of each.

    Raises
    ------
    DeviceError
        If the driver does not compile it.
    """
    try:
        return context.program(
            vertex_shader=_assembled(vertex, parts),
            geometry_shader=_assembled(geometry, parts),
            fragment_shader=_assembled(fragment, parts),
        )
    except moderngl.Error as error:
        raise _does_not_compile(context, f"{vertex} with {fragment}", error) from error


def _assembled(name: str, parts: tuple[str, ...]) -> str:
    return load_shader(name).replace("// INSERT\n", "\n".join(parts) + "\n")


def _does_not_compile(context: moderngl.Context, name: str, error: Exception) -> DeviceError:
    complaint = " ".join(str(error).split())
    return DeviceError(
        f"{renderer_name(context)} does not compile {name} ({complaint}); expected OpenGL 4.3 "
        "with double precision: update the graphics driver, or take --engine native"
    )
