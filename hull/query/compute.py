"""The volume query in OpenGL 4.3 compute shaders.

Two passes for each mesh, with nothing read back in between: ``volume_reject.comp.glsl`` keeps the
triangles that the rectangles of `hybridve.hull.query.bounds` do not prove free, and
``volume_sample.comp.glsl`` samples only these. All meshes of a frame append to one buffer of hits,
and only the hits are read back. What does not change from frame to frame (meshes, cameras) stays
on the device.

Buffers for survivors and hits grow when a frame overflows them, and the frame is asked again.
Buffers are dropped, never released by name: moderngl queues what Python drops, and ``gc()``
releases it in the thread that owns the context (an object released twice breaks that queue).
"""

import weakref
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.query.bounds import ROUNDOFF_FLOAT32, rectangle_pads
from hybridve.hull.query.device import (
    compile_compute,
    is_software_renderer,
    load_shader,
    open_device,
    renderer_name,
)
from hybridve.hull.query.engine import Hits, Triangles
from hybridve.hull.query.silhouettes import Hull, Views

#: Edge in samples of the blocks that the second pass takes: BLOCK in the shaders.
_BLOCK = 32
#: Invocations of a work group: GROUP in the shaders. Mesa's software renderer takes 8 in one
#: instruction, and switching between several such packs at a barrier costs it more than the work.
_GROUP_SIZE, _SOFTWARE_GROUP_SIZE = 64, 8
#: Work groups that every device takes in one dispatch; more are strided over.
_MAX_GROUPS = 65_535
#: Samples of one batch of launches: their counters are 32-bit.
_MAX_SAMPLES = 1 << 31
#: Bytes that the buffers of survivors and of hits begin with.
_FIRST_SIZE = 1 << 19

#: One camera, as `struct Camera` in rectangle.glsl lays it out.
_CAMERA = np.dtype(
    [
        ("img_from_local", np.float32, 12),
        ("width", np.uint32),
        ("height", np.uint32),
        ("first_mask_word", np.uint32),
        ("first_integral", np.uint32),
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class _Cameras:
    """What is on the device as long as the cameras stay the same."""

    views: Views
    buffer: moderngl.Buffer
    precise: moderngl.Buffer
    mask_words: NDArray[np.int64]  # where each camera's mask starts, in camera order
    n_mask_words: int


@dataclass(frozen=True, slots=True, eq=False)
class _Mesh:
    """What is on the device as long as a mesh and the cameras stay the same."""

    views: Views
    vertices_local: moderngl.Buffer
    faces: moderngl.Buffer
    viewports: moderngl.Buffer
    pads: moderngl.Buffer
    samples_before: NDArray[np.int64]  # (T + 1,) samples of all triangles before each


@dataclass(frozen=True, slots=True)
class _Launch:
    """Some triangles of one mesh: one dispatch of each pass."""

    mesh: int
    start: int
    stop: int


class Compute:
    """The volume query on an OpenGL device.

    It belongs to the thread that made it.

    Parameters
    ----------
    context : moderngl.Context, optional
        An OpenGL 4.3 context that the caller releases; by default the engine opens its own.

    Raises
    ------
    DeviceError
        If there is no OpenGL 4.3 device.
    """

    name = "compute"

    def __init__(self, context: moderngl.Context | None = None) -> None:
        self._is_closed = False
        self._owns_context = context is None
        self._context = open_device() if context is None else context
        self.renderer = renderer_name(self._context)
        self._largest = int(self._context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
        self._group_size = (
            _SOFTWARE_GROUP_SIZE if is_software_renderer(self.renderer) else _GROUP_SIZE
        )
        self._programs: dict[int, tuple[moderngl.ComputeShader, moderngl.ComputeShader]] = {}
        self._cameras: _Cameras | None = None
        self._hull: Hull | None = None
        self._meshes: weakref.WeakKeyDictionary[Triangles, _Mesh] = weakref.WeakKeyDictionary()
        self._order = self._reserve(4)
        self._masks = self._reserve(4)
        self._integrals = self._reserve(4)
        self._items = self._reserve(_FIRST_SIZE)
        self._hits = self._reserve(_FIRST_SIZE)
        self._counters = self._reserve(4)

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame."""
        self._context.gc()  # what belonged to meshes that are gone
        if hull is not self._hull:
            self._upload_hull(hull)
        uploaded = [self._upload_mesh(hull.views, mesh) for mesh in meshes]
        # Triangles of all meshes are numbered through, so that one sort puts all hits in order.
        starts = np.concatenate([[0], np.cumsum([len(mesh) for mesh in meshes])]).astype(np.int64)
        if starts[-1] >= 1 << 32:
            raise ValueError(f"{starts[-1]} triangles, expected fewer than 2^32")
        batches = [
            self._run(hull.views, uploaded, starts, batch) for batch in _batches(uploaded, meshes)
        ]
        keys = np.concatenate([np.zeros(0, np.uint64), *batches])
        keys.sort()
        cuts = np.searchsorted(keys, starts.astype(np.uint64) << np.uint64(32))
        return [
            Hits.from_samples(
                mesh.topology,
                ((keys[cut:next_cut] >> np.uint64(32)) - np.uint64(start)).astype(np.uint32),
                keys[cut:next_cut].astype(np.uint32),  # the low half
            )
            for mesh, cut, next_cut, start in zip(
                meshes, cuts[:-1], cuts[1:], starts[:-1], strict=True
            )
        ]

    def close(self) -> None:
        """Release what the engine holds on the device, and the device if it opened it."""
        if self._is_closed:
            return
        self._is_closed = True
        self._meshes.clear()
        self._programs.clear()
        self._cameras, self._hull = None, None
        del self._order, self._masks, self._integrals
        del self._items, self._hits, self._counters
        self._context.gc()
        if self._owns_context:
            self._context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _reserve(self, size: int) -> moderngl.Buffer:
        return self._context.buffer(reserve=size, dynamic=True)

    def _upload(self, array: NDArray[Any], what: str) -> moderngl.Buffer:
        if array.nbytes > self._largest:
            raise DeviceError(
                f"{what} takes {array.nbytes} bytes, more than the {self._largest} that "
                f"{self.renderer} holds in one buffer; take --engine native"
            )
        if array.nbytes == 0:  # OpenGL has no empty buffers
            return self._reserve(4)
        return self._context.buffer(np.ascontiguousarray(array))

    def programs_for(self, n_cameras: int) -> tuple[moderngl.ComputeShader, moderngl.ComputeShader]:
        """Return both passes, compiled with room for `n_cameras` in shared memory.

        A query does so by itself; asked beforehand, it tells whether the driver compiles them.

        Raises
        ------
        DeviceError
            If the driver does not.
        """
        room = _room(n_cameras)
        if room not in self._programs:
            constants = (
                f"#define BLOCK {_BLOCK}u\n#define N_CAMERAS {room}\n"
                f"#define GROUP {self._group_size}\n"
            )
            rectangle = load_shader("rectangle.glsl")
            self._programs[room] = (
                compile_compute(self._context, "volume_reject.comp.glsl", constants, rectangle),
                compile_compute(self._context, "volume_sample.comp.glsl", constants, rectangle),
            )
        return self._programs[room]

    def _upload_hull(self, hull: Hull) -> None:
        """Put the silhouettes of a frame on the device, masks as one bit a pixel."""
        views = hull.views
        # The camera that sees the smallest silhouette rejects most: ask it first.
        ends = hull.integral_offset + (views.sizes_px + 1).prod(axis=1) - 1
        order = np.argsort(hull.integrals_flat[ends] / views.sizes_px.prod(axis=1), kind="stable")
        cameras = self._cameras
        if cameras is None or cameras.views is not views:
            cameras = self._upload_cameras(hull)
        turns = np.zeros(_room(len(views)), np.uint32)
        turns[: len(views)] = order
        words = np.zeros(cameras.n_mask_words, "<u4")
        packed = words.view(np.uint8)
        for camera in range(len(views)):
            bits = np.packbits(hull.mask(camera).reshape(-1), bitorder="little")
            first = 4 * int(cameras.mask_words[camera])
            packed[first : first + len(bits)] = bits
        self._masks = self._rewrite(self._masks, words, "the masks of a frame")
        self._integrals = self._rewrite(
            self._integrals, hull.integrals_flat, "the integral images of a frame"
        )
        self._order = self._rewrite(self._order, turns, "the cameras")
        self._cameras, self._hull = cameras, hull

    def _upload_cameras(self, hull: Hull) -> _Cameras:
        views = hull.views
        n_words = -(-views.sizes_px.prod(axis=1) // 32)
        mask_words = np.concatenate([[0], np.cumsum(n_words)]).astype(np.int64)
        table = np.zeros(_room(len(views)), _CAMERA)
        used = table[: len(views)]
        used["img_from_local"] = views.img_from_local.reshape(-1, 12)
        used["width"], used["height"] = views.sizes_px.T
        used["first_mask_word"] = mask_words[:-1]
        used["first_integral"] = hull.integral_offset
        return _Cameras(
            views,
            self._upload(table.view(np.uint8), "the cameras"),
            self._upload(views.img_from_local, "the cameras"),
            mask_words[:-1],
            int(mask_words[-1]),
        )

    def _rewrite(self, buffer: moderngl.Buffer, array: NDArray[Any], what: str) -> moderngl.Buffer:
        """Write an array into a buffer, replaced where the size differs."""
        if buffer.size != array.nbytes:
            return self._upload(array, what)
        buffer.write(np.ascontiguousarray(array))
        return buffer

    def _upload_mesh(self, views: Views, mesh: Triangles) -> _Mesh:
        uploaded = self._meshes.get(mesh)
        if uploaded is None or uploaded.views is not views:
            vertices_local = mesh.vertices_world - views.origin_world
            reach_m = np.abs(vertices_local).max(axis=0, initial=0.0)
            pads = np.zeros((_room(len(views)), 4), np.float32)
            pads[: len(views), :3] = rectangle_pads(views, reach_m, ROUNDOFF_FLOAT32)
            n_samples = mesh.viewports.astype(np.int64)
            n_samples = n_samples * (n_samples + 1) // 2
            uploaded = _Mesh(
                views,
                self._upload(vertices_local, f"a mesh of {len(vertices_local)} vertices"),
                self._upload(mesh.faces, f"a mesh of {len(mesh)} triangles"),
                self._upload(mesh.viewports, f"a mesh of {len(mesh)} triangles"),
                self._upload(pads, "the cameras"),
                np.concatenate([[0], np.cumsum(n_samples)]).astype(np.int64),
            )
            self._meshes[mesh] = uploaded
        return uploaded

    def _run(
        self,
        views: Views,
        meshes: list[_Mesh],
        starts: NDArray[np.int64],
        launches: list[_Launch],
    ) -> NDArray[np.uint64]:
        """Return the hits of some launches, unordered, each ``triangle << 32 | sample``."""
        while True:
            n_items, n_hits = self._dispatch(views, meshes, starts, launches)
            if 8 * n_items <= self._items.size and 8 * n_hits <= self._hits.size:
                return np.frombuffer(self._hits.read(8 * n_hits), "<u8") if n_hits else _NO_HITS
            if 8 * max(n_items, n_hits) > self._largest:
                halves = _halved(launches)
                if halves is None:
                    raise DeviceError(
                        f"triangle {launches[0].start} has {n_hits} samples in the hull, more than "
                        f"{self.renderer} holds in one buffer; take a smaller viewport, or "
                        "--engine native"
                    )
                return np.concatenate([self._run(views, meshes, starts, half) for half in halves])
            self._items = self._grown(self._items, 8 * n_items)
            self._hits = self._grown(self._hits, 8 * n_hits)

    def _grown(self, buffer: moderngl.Buffer, needed: int) -> moderngl.Buffer:
        if needed <= buffer.size:
            return buffer
        return self._reserve(min(self._largest, 1 << (needed - 1).bit_length()))

    def _dispatch(
        self,
        views: Views,
        meshes: list[_Mesh],
        starts: NDArray[np.int64],
        launches: list[_Launch],
    ) -> tuple[int, int]:
        """Run both passes of some launches; return how many items and hits they have."""
        assert self._cameras is not None
        reject, sample = self.programs_for(len(views))
        # Four counters a launch: the groups of its second pass (x, y, z), and its items. One more:
        # the hits of all.
        counters = np.zeros(4 * len(launches) + 1, np.uint32)
        counters[1:-1:4] = counters[2:-1:4] = 1
        self._counters = self._rewrite(self._counters, counters, "the counters")
        self._cameras.buffer.bind_to_uniform_block(0)
        self._order.bind_to_uniform_block(2)
        self._integrals.bind_to_storage_buffer(0)
        self._items.bind_to_storage_buffer(6)
        self._counters.bind_to_storage_buffer(7)
        self._hits.bind_to_storage_buffer(8)
        self._masks.bind_to_storage_buffer(9)
        self._cameras.precise.bind_to_storage_buffer(10)
        for program in (reject, sample):
            _set(
                program,
                n_cameras=len(views),
                keep=int(views.unseen == "keep"),
                min_cameras=views.min_cameras,
                item_capacity=self._items.size // 8,
                hit_capacity=self._hits.size // 8,
                hit_counter=4 * len(launches),
            )
        for number, launch in enumerate(launches):
            mesh = meshes[launch.mesh]
            mesh.pads.bind_to_uniform_block(1)
            mesh.vertices_local.bind_to_storage_buffer(3)
            mesh.faces.bind_to_storage_buffer(4)
            mesh.viewports.bind_to_storage_buffer(5)
            _set(reject, first_triangle=launch.start, stop_triangle=launch.stop, launch=number)
            _set(sample, launch=number, triangle_number=int(starts[launch.mesh]))
            n_groups = -(-(launch.stop - launch.start) // self._group_size)
            reject.run(min(n_groups, _MAX_GROUPS))
            self._context.memory_barrier(
                self._context.SHADER_STORAGE_BARRIER_BIT | self._context.COMMAND_BARRIER_BIT
            )
            sample.run_indirect(self._counters, 16 * number)
            self._context.memory_barrier(
                self._context.SHADER_STORAGE_BARRIER_BIT | self._context.BUFFER_UPDATE_BARRIER_BIT
            )
        counters = np.frombuffer(self._counters.read(), np.uint32)
        return int(counters[3:-1:4].max(initial=0)), int(counters[-1])


def _room(n_cameras: int) -> int:
    """Return for how many cameras the programs that serve `n_cameras` are compiled."""
    return 1 << max(3, (n_cameras - 1).bit_length())


_NO_HITS = np.zeros(0, np.uint64)


def _set(program: moderngl.ComputeShader, **values: int) -> None:
    """Set uniforms; the compiler may have dropped one that a pass does not use."""
    for name, value in values.items():
        if name in program:
            program[name] = value


def _batches(uploaded: list[_Mesh], meshes: list[Triangles]) -> list[list[_Launch]]:
    """Return launches that cover all triangles, in batches whose samples 32 bits can count."""
    batches: list[list[_Launch]] = []
    room = 0
    for number, mesh in enumerate(meshes):
        before = uploaded[number].samples_before
        start = 0
        while start < len(mesh):
            if before[start + 1] - before[start] > room:
                batches.append([])
                room = _MAX_SAMPLES
            stop = int(np.searchsorted(before, before[start] + room, side="right")) - 1
            stop = min(stop, len(mesh))
            batches[-1].append(_Launch(number, start, stop))
            room -= int(before[stop] - before[start])
            start = stop
    return batches


def _halved(launches: list[_Launch]) -> tuple[list[_Launch], list[_Launch]] | None:
    """Return launches in two halves, or None for a single triangle."""
    if len(launches) > 1:
        middle = len(launches) // 2
        return launches[:middle], launches[middle:]
    launch = launches[0]
    if launch.stop - launch.start < 2:
        return None
    middle = (launch.start + launch.stop) // 2
    return (
        [_Launch(launch.mesh, launch.start, middle)],
        [_Launch(launch.mesh, middle, launch.stop)],
    )
