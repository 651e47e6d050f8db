"""The volume query as published: n passes of projected textures, counts, and read-back.

Sections 3.2, 4.2.4 and 4.4 of Lok, Naik, Whitton and Brooks (2003). Every triangle has a viewport
of its own in one window, a cell of u x u pixels, and is drawn into it seen along its normal, so
that it fills half of it; pixel (i, j) of the cell is sample (i, j). The window is rendered n times,
once with each camera's silhouette as projected texture, and a pixel is counted up where an object
pixel projects onto it. Pixels that reach n are samples inside the hull. Where not all triangles
find room in the window, there are as many rounds of rendering and reading back as it needs.

This engine is kept to measure against, so it does nothing that the paper does not do: no
rejection, no early end of a pixel that has failed a camera. What it does, it does as fast as
OpenGL lets it: one draw call a camera for thousands of cells, meshes and cells kept on the device,
a window sized for the device, read back once a round and only as far as it is filled, while the
next round is drawn.

Two things differ from the paper's programs:

* The counter stands in an 8-bit colour buffer and is incremented by additive blending: moderngl
  offers neither a stencil attachment nor stencil operations. The passes, the fill and the bytes
  read back are the same, and like a stencil with ``GL_INCR`` the counter saturates at 255.
* ``unseen = "keep"``, of which the paper does not speak: a camera that sees a sample on background
  fills the counter, which then says so for good, since it saturates; one that does not see it
  adds nothing, be it outside the image or on a pixel that was not recorded.

Objects on the device are dropped, never released by name: moderngl queues what Python drops, and
``gc()`` releases it in the thread that owns the context (see `hybridve.hull.query.compute`).
"""

import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.jit import compiled
from hybridve.hull.query.device import (
    compile_program,
    make_current,
    open_device,
    renderer_name,
)
from hybridve.hull.query.engine import Closing, Hits, Topology, Triangles
from hybridve.hull.query.silhouettes import Hull, Views

#: Pixels a side of the window, if not told otherwise. The paper had 400 x 400. To a software
#: renderer the size hardly matters: against 400, this takes 6 % more processor time for 200,000
#: viewports of 10 pixels and 10 % less for 720 of 512, which 400 cuts into tiles. It is larger for
#: the sake of hardware, where it was not measured: a sixth of the draw calls.
WINDOW_PX = 1024

#: Rounds are drawn in batches of at most so many pixels and rounds before the first is read back:
#: drivers, the software one before all, wait at a read for whatever has been drawn.
_BATCH_PX, _BATCH_ROUNDS = 1 << 23, 64

#: What the counter of a pixel holds at most.
_FULL = 255

# The same in stencil_cell.vert.glsl, which explains them.
_MAX_ERROR_PX, _MAX_SWELL, _MIN_DEPTH_M = 8e-4, 1e4, 1e-6

#: The shader takes places in single precision where the bound holds; here, where it does not by
#: this factor, so that rounding cannot make the two disagree to the other side.
_STRICTER = 0.99


@dataclass(frozen=True, slots=True)
class _Piece:
    """Cells of one mesh that lie in one window: consecutive ones, and the rows that they fill."""

    start: int
    stop: int
    n_rows: int


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """Where the cells of a mesh lie, as long as its topology and the window stay the same.

    Attributes
    ----------
    triangle : (N,) int32
        The triangle of each cell.
    cells : (N, 4) uint32
        ``row << 16 | column`` of the cell in its piece, first i, first j, viewport.
    pieces : list of _Piece
        They cover the cells.
    is_ascending : bool
        Whether the cells come in the order of their samples.
    """

    triangle: NDArray[np.int32]
    cells: NDArray[np.uint32]
    pieces: list[_Piece]
    is_ascending: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Mesh:
    """What is on the device as long as a mesh and the cameras stay the same.

    Attributes
    ----------
    vertices : dict
        The cells as the programs take them, by whether the program is the precise one.
    needs_double : (P, C) bool
        For which pieces and cameras some cell must be projected in double precision.
    """

    views: Views
    layout: _Layout
    vertices: dict[bool, moderngl.VertexArray]
    needs_double: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Placed:
    """A piece of a mesh, and the row of the window where it begins."""

    mesh: int
    piece: int
    first_row: int


class Stencil(Closing):
    """The paper's volume query on an OpenGL device.

    It belongs to the thread that made it.

    Parameters
    ----------
    context : moderngl.Context, optional
        An OpenGL 4.3 context that the caller releases; by default the engine opens its own.
    window_px : int
        Width and height of the window.

    Raises
    ------
    DeviceError
        If there is no OpenGL 4.3 device, or it draws no window of that size.
    """

    name = "stencil"
    any_thread = False

    def __init__(self, context: moderngl.Context | None = None, window_px: int = WINDOW_PX) -> None:
        self._is_closed = False
        self._owns_context = context is None
        self._context = open_device() if context is None else context
        self._window_px = window_px
        try:
            self._open()
        except DeviceError:
            self.close()
            raise

    def _open(self) -> None:
        self.renderer = renderer_name(self._context)
        largest_px = min(
            int(self._context.info["GL_MAX_TEXTURE_SIZE"]),
            *(int(size) for size in self._context.info["GL_MAX_VIEWPORT_DIMS"]),
        )
        window_px = self._window_px
        if not 1 <= window_px <= largest_px:
            raise DeviceError(
                f"{self.renderer} draws windows of 1 to {largest_px} pixels a side, not {window_px}"
            )
        self._programs = {is_precise: self._compile(is_precise) for is_precise in (False, True)}
        # In turn: one batch is read back while the other is drawn.
        self._windows: list[moderngl.Framebuffer] = []
        self._views: Views | None = None
        self._hull: Hull | None = None
        self._increments: list[moderngl.Texture] = []
        self._layouts: weakref.WeakKeyDictionary[Topology, _Layout] = weakref.WeakKeyDictionary()
        self._meshes: weakref.WeakKeyDictionary[Triangles, _Mesh] = weakref.WeakKeyDictionary()
        self._pixels = np.zeros(window_px * window_px, np.uint8)
        # As many runs as a window can hold; zeros that nobody writes take no memory.
        self._runs = np.zeros((2, window_px * window_px), np.int64)

    def _compile(self, is_precise: bool) -> moderngl.Program:
        constants = (
            f"#define PRECISE {int(is_precise)}\n#define WINDOW {self._window_px}\n"
            f"#define MAX_ERROR_PX {_MAX_ERROR_PX}\n#define MAX_SWELL {_MAX_SWELL}\n"
            f"#define MIN_DEPTH_M {_MIN_DEPTH_M}LF\n"
        )
        return compile_program(
            self._context,
            "stencil_cell.vert.glsl",
            "stencil_cell.geom.glsl",
            "stencil_count.frag.glsl",
            constants,
        )

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame.

        Raises
        ------
        DeviceError
            If there are more cameras than the counter of a pixel can count.
        """
        lowest, highest = self._inside_counts(hull.views)
        make_current(self._context)
        self._context.gc()  # what belonged to meshes that are gone
        if hull is not self._hull:
            self._upload_hull(hull)
        uploaded = [self._upload_mesh(hull.views, mesh) for mesh in meshes]
        runs: list[list[NDArray[np.int64]]] = [[np.zeros((2, 0), np.int64)] for _ in meshes]
        for placed, pixels in self._rendered(hull.views, uploaded):
            for place in placed:
                layout = uploaded[place.mesh].layout
                piece = layout.pieces[place.piece]
                n_runs = _find_runs(
                    pixels[place.first_row :],
                    lowest,
                    highest,
                    layout.cells[piece.start : piece.stop],
                    layout.triangle[piece.start : piece.stop],
                    meshes[place.mesh].topology.samples_before,
                    self._runs,
                )
                runs[place.mesh].append(self._runs[:, :n_runs].copy())
        return [
            _ordered_hits(mesh.topology, np.concatenate(found, axis=1), one.layout.is_ascending)
            for mesh, found, one in zip(meshes, runs, uploaded, strict=True)
        ]

    def close(self) -> None:
        """Release what the engine holds on the device, and the device if it opened it."""
        if self._is_closed:
            return
        self._is_closed = True
        make_current(self._context)
        for name in ("_meshes", "_programs", "_windows", "_increments", "_hull", "_views"):
            self.__dict__.pop(name, None)  # some are missing where the constructor failed
        self._context.gc()
        if self._owns_context:
            self._context.release()

    def _inside_counts(self, views: Views) -> tuple[int, int]:
        """Return between which counts a pixel is inside the hull."""
        n_cameras = len(views)
        most = _FULL if views.unseen == "carve" else _FULL - 1  # where full means background
        if n_cameras > most:
            raise DeviceError(
                f"{n_cameras} cameras, but the stencil engine counts to {most} with "
                f'unseen = "{views.unseen}"; take --engine native'
            )
        return (n_cameras, n_cameras) if most == _FULL else (views.min_cameras, most)

    def _upload_hull(self, hull: Hull) -> None:
        """Put the silhouettes of a frame on the device: what each texel adds to a counter."""
        views = hull.views
        if views is not self._views:
            self._increments = [self._bordered(*map(int, size)) for size in views.sizes_px]
            self._views = views
        for camera, texture in enumerate(self._increments):
            width, height = (int(size) for size in views.sizes_px[camera])
            mask, seen = hull.mask(camera), views.seen_mask(camera)
            # 1 stays 1, and 0 becomes 255, but where a camera abstains.
            added = mask if views.unseen == "carve" else mask | (mask - np.uint8(1))
            if seen is not None:
                added *= seen
            texture.write(added, viewport=(1, 1, width, height), alignment=1)
        self._hull = hull

    def _bordered(self, width: int, height: int) -> moderngl.Texture:
        """Return a texture for an image, and around it a border that adds nothing."""
        size = (width + 2, height + 2)
        if max(size) > int(self._context.info["GL_MAX_TEXTURE_SIZE"]):
            raise DeviceError(
                f"{self.renderer} holds no image of {width} x {height} pixels; take --engine native"
            )
        texture = self._context.texture(size, 1, bytes(size[0] * size[1]), alignment=1)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def _upload_mesh(self, views: Views, mesh: Triangles) -> _Mesh:
        uploaded = self._meshes.get(mesh)
        if uploaded is None or uploaded.views is not views:
            layout = self._layouts.get(mesh.topology)
            if layout is None:
                layout = _lay_out(mesh.viewports, self._window_px)
                self._layouts[mesh.topology] = layout
            faces = mesh.faces if layout.is_ascending else mesh.faces[layout.triangle]
            corners_local = (mesh.vertices_world - views.origin_world)[faces]
            vertices = {}
            if len(layout.triangle):  # OpenGL has no empty buffers
                buffers = [
                    (
                        self._context.buffer(corners_local),
                        "3f8 3f8 3f8",
                        "corner_a",
                        "corner_b",
                        "corner_c",
                    ),
                    (self._context.buffer(layout.cells), "4u4", "cell"),
                ]
                vertices = {
                    is_precise: self._context.vertex_array(program, buffers)
                    for is_precise, program in self._programs.items()
                }
            ends = np.array([piece.stop for piece in layout.pieces], np.int64)
            needs_double = np.zeros((len(ends), len(views)), np.bool_)
            _find_imprecise(
                corners_local,
                layout.cells,
                ends,
                views.img_from_local,
                self._window_px,
                needs_double,
            )
            uploaded = _Mesh(views, layout, vertices, needs_double)
            self._meshes[mesh] = uploaded
        return uploaded

    def _rendered(
        self, views: Views, meshes: list[_Mesh]
    ) -> Iterator[tuple[list[_Placed], NDArray[np.uint8]]]:
        """Yield what lies in the window, and its pixels (rows, columns), round after round."""
        rounds = _rounds(meshes, self._window_px)
        size = min(max(1, _BATCH_PX // self._window_px**2), _BATCH_ROUNDS)
        batches = [
            range(start, min(start + size, len(rounds))) for start in range(0, len(rounds), size)
        ]
        for number in range(len(batches) + 1):
            if number < len(batches):
                for turn in batches[number]:
                    self._draw(views, meshes, rounds[turn], turn % (2 * size))
            if number > 0:
                for turn in batches[number - 1]:
                    placed = rounds[turn]
                    yield placed, self._read(turn % (2 * size), _n_rows(placed, meshes))

    def _draw(self, views: Views, meshes: list[_Mesh], placed: list[_Placed], turn: int) -> None:
        """Render one round: every camera's silhouette onto the triangles in the window."""
        context = self._context
        if turn == len(self._windows):
            counters = context.texture((self._window_px, self._window_px), 1)
            self._windows.append(context.framebuffer([counters]))
        window = self._windows[turn]
        with context.scope(window, moderngl.BLEND):  # and puts back what others have set
            context.blend_func = moderngl.ONE, moderngl.ONE
            window.clear(viewport=(self._window_px, _n_rows(placed, meshes)))
            for camera, increments in enumerate(self._increments):
                increments.use(0)
                rows = views.img_from_local[camera].tobytes()
                for program in self._programs.values():
                    matrix: Any = program["img_from_local"]  # whose stub allows for other members
                    matrix.write(rows)
                for place in placed:
                    mesh = meshes[place.mesh]
                    piece = mesh.layout.pieces[place.piece]
                    for is_precise, vertices in mesh.vertices.items():
                        if is_precise and not mesh.needs_double[place.piece, camera]:
                            continue
                        self._programs[is_precise]["first_row"] = place.first_row
                        vertices.render(
                            moderngl.POINTS,
                            vertices=piece.stop - piece.start,
                            first=piece.start,
                        )
            context.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA  # as it begins

    def _read(self, turn: int, n_rows: int) -> NDArray[np.uint8]:
        """Return the pixels of one window, as far as it is filled."""
        pixels = self._pixels[: n_rows * self._window_px]
        self._windows[turn].read_into(
            pixels, viewport=(0, 0, self._window_px, n_rows), components=1, alignment=1
        )
        return pixels.reshape(n_rows, self._window_px)


def _n_rows(placed: list[_Placed], meshes: list[_Mesh]) -> int:
    last = placed[-1]
    return last.first_row + meshes[last.mesh].layout.pieces[last.piece].n_rows


def _rounds(meshes: list[_Mesh], window_px: int) -> list[list[_Placed]]:
    """Return what to draw in each round: pieces of all meshes, one above the other."""
    rounds: list[list[_Placed]] = []
    row = window_px
    for number, mesh in enumerate(meshes):
        for index, piece in enumerate(mesh.layout.pieces):
            if row + piece.n_rows > window_px:
                rounds.append([])
                row = 0
            rounds[-1].append(_Placed(number, index, row))
            row += piece.n_rows
    return rounds


def _lay_out(viewports: NDArray[np.int32], window_px: int) -> _Layout:
    """Return where the cells of T triangles lie in windows.

    A triangle whose viewport is larger than the window is cut into tiles of the window's size,
    those beyond its diagonal left out, each a piece of its own. The cells of all others stand side
    by side in shelves, the largest first, so that little of a shelf's height is wasted.
    """
    order = np.argsort(-viewports, kind="stable").astype(np.int32)
    n_tiled = int((viewports > window_px).sum())
    triangles: list[NDArray[np.int32]] = []
    cells: list[NDArray[np.uint32]] = []
    pieces: list[_Piece] = []
    for number in order[:n_tiled]:
        size = int(viewports[number])
        tiles = [
            (0, i, j, size)
            for j in range(0, size, window_px)
            for i in range(0, size - j, window_px)
        ]
        first = pieces[-1].stop if pieces else 0
        pieces += [
            _Piece(first + k, first + k + 1, min(window_px, size - j))
            for k, (_, _, j, _) in enumerate(tiles)
        ]
        triangles.append(np.full(len(tiles), number, np.int32))
        cells.append(np.array(tiles, np.uint32))

    shelved = order[n_tiled:]
    cell = np.zeros((len(shelved), 4), np.uint32)
    cell[:, 3] = viewports[shelved]
    piece = np.zeros(len(shelved), np.int64)
    _fill_shelves(cell, piece, window_px)
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    first = pieces[-1].stop if pieces else 0
    stops = np.append(starts[1:], len(shelved))[: len(starts)]
    for start, stop in zip(starts, stops, strict=True):
        # The last shelf is the topmost one, and its first cell the highest in it.
        rows = cell[start:stop, 0] >> 16
        n_rows = int((rows + cell[start:stop, 3]).max())
        pieces.append(_Piece(first + int(start), first + int(stop), n_rows))
    triangle = np.concatenate([*triangles, shelved])
    return _Layout(
        triangle,
        np.concatenate([*cells, cell]),
        pieces,
        bool((np.diff(triangle) > 0).all()),
    )


@compiled
def _fill_shelves(cells: NDArray[np.uint32], piece: NDArray[np.int64], window_px: int) -> None:
    """Place cells, the largest first, and tell in which of several windows each is.

    Parameters
    ----------
    cells : (N, 4) uint32
        As in `_Layout`; the place is written, the viewport is read.
    piece : (N,) int64
        What else is written.
    window_px : int
        The window's size.
    """
    left, top, height, number = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for k in range(len(cells)):
        size = np.int64(cells[k, 3])
        if left + size > window_px or k == 0:
            left, top, height = np.int64(0), top + height, size
            if top + size > window_px:
                top, number = np.int64(0), number + 1
        cells[k, 0] = np.uint32(top << 16 | left)
        piece[k] = number
        left += size


def _ordered_hits(topology: Topology, runs: NDArray[np.int64], is_ascending: bool) -> Hits:
    if not is_ascending:
        runs = runs[:, np.argsort(runs[0])]
    return Hits(topology, runs[0].copy(), runs[1].copy())


@compiled
def _find_runs(
    pixels: NDArray[np.uint8],
    lowest: int,
    highest: int,
    cells: NDArray[np.uint32],
    triangle: NDArray[np.int32],
    samples_before: NDArray[np.int64],
    runs: NDArray[np.int64],
) -> int:
    """Write the runs of samples whose count is within bounds, and return how many there are.

    Parameters
    ----------
    pixels : (H, W) uint8
        Counters, from the row on where the cells begin.
    lowest, highest : int
        Counts of a sample inside.
    cells : (N, 4) uint32
        As in `_Layout`.
    triangle : (N,) int32
        The triangle of each cell.
    samples_before : (T + 1,) int64
        Of the mesh.
    runs : (2, R) int64
        What is written: start and stop of each run.
    """
    window_px = pixels.shape[1]
    n_runs = 0
    for k in range(len(cells)):
        top, left = np.int64(cells[k, 0] >> np.uint32(16)), np.int64(cells[k, 0] & np.uint32(65535))
        i, j, u = np.int64(cells[k, 1]), np.int64(cells[k, 2]), np.int64(cells[k, 3])
        before = samples_before[triangle[k]]
        for dj in range(min(window_px, u - i - j)):
            row = j + dj
            first = before + row * u - row * (row - 1) // 2 + i
            line = pixels[top + dj]
            for di in range(min(window_px, u - i - row)):
                count = line[left + di]
                if count < lowest or count > highest:
                    continue
                number = first + di
                if n_runs > 0 and runs[1, n_runs - 1] == number:
                    runs[1, n_runs - 1] = number + 1
                else:
                    runs[0, n_runs] = number
                    runs[1, n_runs] = number + 1
                    n_runs += 1
    return n_runs


@compiled
def _find_imprecise(
    corners_local: NDArray[np.float64],
    cells: NDArray[np.uint32],
    ends: NDArray[np.int64],
    img_from_local: NDArray[np.float64],
    window_px: int,
    needs_double: NDArray[np.bool_],
) -> None:
    """Tell for which pieces and cameras single precision does not do: stencil_cell.vert.glsl.

    Parameters
    ----------
    corners_local : (N, 3, 3) float64
        Vertices of each cell's triangle, metres about the views' origin.
    cells : (N, 4) uint32
        As in `_Layout`.
    ends : (P,) int64
        Where each piece ends.
    img_from_local : (C, 3, 4) float64
        Projections.
    window_px : int
        The window's size.
    needs_double : (P, C) bool
        What is written.
    """
    a, ab, ac = np.zeros(3), np.zeros(3), np.zeros(3)
    at, along, up = np.zeros(3), np.zeros(3), np.zeros(3)
    n_cameras = len(img_from_local)
    piece, n_flagged = 0, 0
    for k in range(len(cells)):
        if k == ends[piece]:
            piece, n_flagged = piece + 1, 0
        if n_flagged == n_cameras:
            continue
        i, j, u = np.int64(cells[k, 1]), np.int64(cells[k, 2]), np.int64(cells[k, 3])
        if u == 1:
            i_m = j_m = 1.0 / 3.0
            per_edge = 1.0
        else:
            per_edge = 1.0 / (u - 1.0)
            i_m, j_m = i * per_edge, j * per_edge
        rest = u - 1 - i - j
        near = min(window_px - 1.0, rest * 1.0)
        beside = min(near, rest - near)
        for m in range(3):
            a[m] = corners_local[k, 0, m]
            ab[m] = corners_local[k, 1, m] - a[m]
            ac[m] = corners_local[k, 2, m] - a[m]
            a[m] += i_m * ab[m] + j_m * ac[m]
            ab[m] *= per_edge
            ac[m] *= per_edge
        for camera in range(n_cameras):
            if needs_double[piece, camera]:
                continue
            for axis in range(3):
                x, y, z = (
                    img_from_local[camera, axis, 0],
                    img_from_local[camera, axis, 1],
                    img_from_local[camera, axis, 2],
                )
                at[axis] = x * a[0] + y * a[1] + z * a[2] + img_from_local[camera, axis, 3]
                along[axis] = x * ab[0] + y * ab[1] + z * ab[2]
                up[axis] = x * ac[0] + y * ac[1] + z * ac[2]
            depth_min_m = at[2] + min(
                min(0.0, near * min(along[2], up[2])),
                min(near * along[2] + beside * up[2], beside * along[2] + near * up[2]),
            )
            is_single = depth_min_m > _MIN_DEPTH_M / _STRICTER
            if is_single:
                per_depth, per_smallest = 1.0 / at[2], at[2] / depth_min_m
                extent_px = 0.0
                for axis in range(2):
                    pixel = at[axis] * per_depth
                    is_single &= abs(pixel) < 1e6 * _STRICTER
                    steps_px = abs(along[axis] - pixel * along[2]) + abs(up[axis] - pixel * up[2])
                    extent_px = max(extent_px, near * steps_px * per_depth * per_smallest)
                swell = 1.0 + near * (abs(along[2]) + abs(up[2])) * per_depth
                swell *= per_smallest
                error_px = 5.97e-8 * (extent_px * (12.0 + 6.0 * swell) + 3.0)
                is_single &= error_px < _MAX_ERROR_PX * _STRICTER
                is_single &= swell < _MAX_SWELL * _STRICTER
            if not is_single:
                needs_double[piece, camera] = True
                n_flagged += 1
