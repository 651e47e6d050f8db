"""The volume query in OpenGL 4.3 compute shaders.

Three passes for each mesh, with nothing read back in between. ``volume_cluster.comp.glsl`` asks
the box around each cluster, a run of consecutive triangles; ``volume_reject.comp.glsl`` asks the
triangles of the clusters that stay open; ``volume_sample.comp.glsl`` samples the triangles that
stay open. In the first two the rectangles of `hybridve.hull.query.bounds` decide, so that the work
follows the surface near the hull and not the size of the mesh. All meshes of a frame append to one
buffer of hits, and only the hits are read back. A hit is four numbers:

    triangle, first sample, how many samples, mesh       a run of samples of one triangle
    triangle, WHOLE, how many triangles, mesh            all samples of a run of triangles

What does not change from frame to frame (meshes, cameras, what these recorded of their images)
stays on the device. Of a mesh that
moves, only the vertices are sent again, into the buffers of the vertices they replace;
``volume_round.comp.glsl`` and ``volume_bounds.comp.glsl`` then compute there what the passes need
of them.

Buffers for survivors and hits grow when a frame overflows them, and the frame is asked again.
Buffers are dropped, never released by name: moderngl queues what Python drops, and ``gc()``
releases it in the thread that owns the context (an object released twice breaks that queue).
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.query.bounds import ROUNDOFF_FLOAT32, rectangle_pads
from hybridve.hull.query.device import (
    compile_compute,
    is_software_renderer,
    load_shader,
    make_current,
    open_device,
    renderer_name,
)
from hybridve.hull.query.engine import Closing, Hits, Topology, Triangles
from hybridve.hull.query.silhouettes import Hull, Views

#: Triangles of a cluster: CLUSTER in the shaders, a multiple of their GROUP. Of 32, 64, 128 and 256
#: the fastest for a million triangles on a software renderer, and one work group of hardware. All
#: clusters of 4 million triangles are asked in 3.5 ms there: clusters of clusters would save less.
_CLUSTER = 64
#: Edge in samples of the blocks that the last pass takes: BLOCK in the shaders, where the rows of
#: a block are the bits of a word.
_BLOCK = 32
#: Invocations of a work group: GROUP in the shaders. Mesa's software renderer takes 8 in one
#: instruction, and switching between several such packs at a barrier costs it more than the work.
_GROUP_SIZE, _SOFTWARE_GROUP_SIZE = 64, 8
#: Work groups of one dispatch; more are strided over. Every device takes 65535. To start one costs
#: Mesa's software renderer some 70 ns, as much as a few lines of shader.
_MAX_GROUPS, _SOFTWARE_MAX_GROUPS = 65_535, 4096
#: Cameras that a work group's memory has room for: see volume_sample.comp.glsl.
_MOST_CAMERAS = 256
#: Mesa's software renderer leaves all loops of an invocation for good once they have turned 65,535
#: times together, without a word: what is behind is never asked. So no invocation may have more
#: turns than this, with room to spare, and launches are cut accordingly.
_SOFTWARE_MAX_TURNS = 60_000
#: Samples of one batch of launches: their counters are 32-bit.
_MAX_SAMPLES = 1 << 31
#: Bytes that the buffers of survivors and of hits begin with.
_FIRST_SIZE = 1 << 19
#: What stands for the first sample where all are meant: WHOLE in the shaders.
_WHOLE = 0xFFFFFFFF
#: Bytes of an item, and of a hit.
_ITEM_SIZE, _HIT_SIZE = 8, 16
#: Counters of a launch: the groups of the second pass (x, y, z) and its clusters, the groups of
#: the third and its items. One more at the end counts the hits of all launches.
_LAUNCH_COUNTERS = np.array([0, 1, 1, 0, 0, 1, 1, 0], np.uint32)

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
    pad_rows: moderngl.Buffer
    precise: moderngl.Buffer
    recorded: moderngl.Buffer
    mask_words: NDArray[np.int64]  # where each camera's mask starts, in camera order
    n_mask_words: int
    seen_words: NDArray[np.uint32]  # what was recorded: it follows the masks of a frame


@dataclass(frozen=True, slots=True, eq=False)
class _Placement:
    """The vertices of a mesh on the device, and what follows from them."""

    mesh: weakref.ref[Triangles]
    views: Views
    vertices_world: moderngl.Buffer
    vertices_local: moderngl.Buffer
    boxes: moderngl.Buffer


@dataclass(slots=True, eq=False)
class _Surface:
    """What is on the device of all meshes that differ in nothing but their vertices.

    `spare` are the placements of meshes that are gone: the next vertices go into their buffers.
    `blocks_before` are the blocks of the triangles before each, (T + 1,).
    """

    faces: moderngl.Buffer
    viewports: moderngl.Buffer
    n_triangles: int
    largest_viewport: int
    blocks_before: NDArray[np.int64]
    placements: list[_Placement]
    spare: list[_Placement]

    @property
    def n_clusters(self) -> int:
        return -(-self.n_triangles // _CLUSTER)

    def find_spare(self) -> None:
        """Note which meshes are gone; spares that were not taken up since are dropped."""
        self.spare = [placement for placement in self.placements if placement.mesh() is None]
        self.placements = [
            placement for placement in self.placements if placement.mesh() is not None
        ]


@dataclass(frozen=True, slots=True)
class _Launch:
    """Some triangles of one mesh: one dispatch of each pass."""

    mesh: int
    start: int
    stop: int


@dataclass(frozen=True, slots=True, eq=False)
class _Programs:
    """The passes, compiled with room for some number of cameras."""

    cluster: moderngl.ComputeShader
    reject: moderngl.ComputeShader
    sample: moderngl.ComputeShader


class Compute(Closing):
    """The volume query on an OpenGL device.

    It belongs to the thread that made it.

    Parameters
    ----------
    context : moderngl.Context, optional
        An OpenGL 4.3 context that the caller releases; by default the engine opens its own.
    reject : bool
        Whether rectangles decide before samples are taken. The result is the same without.

    Raises
    ------
    DeviceError
        If there is no OpenGL 4.3 device.
    """

    name = "compute"
    any_thread = False

    def __init__(self, context: moderngl.Context | None = None, *, reject: bool = True) -> None:
        self._is_closed = False
        self._owns_context = context is None
        self._context = open_device() if context is None else context
        self.renderer = renderer_name(self._context)
        self._largest = int(self._context.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])
        self._is_software = is_software_renderer(self.renderer)
        self._group_size = _SOFTWARE_GROUP_SIZE if self._is_software else _GROUP_SIZE
        self._max_groups = _SOFTWARE_MAX_GROUPS if self._is_software else _MAX_GROUPS
        self._reject = reject
        self._programs: dict[tuple[int, bool], _Programs] = {}
        self._placing: tuple[moderngl.ComputeShader, moderngl.ComputeShader] | None = None
        self._cameras: _Cameras | None = None
        self._hull: Hull | None = None
        self._surfaces: weakref.WeakKeyDictionary[Topology, _Surface] = weakref.WeakKeyDictionary()
        self._placements: weakref.WeakKeyDictionary[Triangles, _Placement] = (
            weakref.WeakKeyDictionary()
        )
        self._order = self._reserve(4)
        self._masks = self._reserve(4)
        self._integrals = self._reserve(4)
        self._open_clusters = self._reserve(4)
        self._items = self._reserve(_FIRST_SIZE)
        self._hits = self._reserve(_FIRST_SIZE)
        self._counters = self._reserve(4)

    def query(self, hull: Hull, meshes: list[Triangles]) -> list[Hits]:
        """Return for each mesh its samples inside the hull of this frame."""
        make_current(self._context)
        for surface in self._surfaces.values():
            surface.find_spare()
        self._context.gc()  # what belonged to meshes that are gone
        if hull is not self._hull:
            self._upload_hull(hull)
        for mesh in meshes:
            self._place(hull.views, mesh)
        batches = _batches(
            [mesh.topology.samples_before for mesh in meshes],
            [self._launch_ends(hull.views, mesh.topology) for mesh in meshes],
        )
        hits = np.concatenate(
            [np.zeros((0, 4), np.uint32), *(self._run(hull.views, meshes, b) for b in batches)]
        )
        if len(meshes) == 1:
            return [_runs(meshes[0].topology, hits)]
        hits = hits[np.argsort(hits[:, 3], kind="stable")]
        cuts = np.searchsorted(hits[:, 3], np.arange(len(meshes) + 1))
        return [
            _runs(mesh.topology, hits[cut:next_cut])
            for mesh, cut, next_cut in zip(meshes, cuts[:-1], cuts[1:], strict=True)
        ]

    def close(self) -> None:
        """Release what the engine holds on the device, and the device if it opened it."""
        if self._is_closed:
            return
        self._is_closed = True
        make_current(self._context)
        self._surfaces.clear()
        self._placements.clear()
        self._programs.clear()
        self._placing, self._cameras, self._hull = None, None, None
        del self._order, self._masks, self._integrals
        del self._open_clusters, self._items, self._hits, self._counters
        self._context.gc()
        if self._owns_context:
            self._context.release()

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

    def programs_for(self, n_cameras: int, *, has_gaps: bool = False) -> _Programs:
        """Return the passes, compiled with room for `n_cameras` in shared memory.

        With `has_gaps` for cameras that did not record all of their images: a software renderer
        would take the look-ups that this needs for all others, too.

        A query does so by itself; asked beforehand, it tells whether the driver compiles them.

        Raises
        ------
        DeviceError
            If the driver does not, or there are more cameras than a work group has room for.
        """
        if n_cameras > _MOST_CAMERAS:
            raise DeviceError(
                f"{n_cameras} cameras, but the compute engine has room for {_MOST_CAMERAS}; "
                "take --engine native"
            )
        make_current(self._context)
        room = _room(n_cameras)
        if (room, has_gaps) not in self._programs:
            constants = f"#define N_CAMERAS {room}\n#define GAPS {int(has_gaps)}\n"
            rectangle = constants + load_shader("rectangle.glsl")
            self._programs[room, has_gaps] = _Programs(
                self._compile("volume_cluster.comp.glsl", rectangle),
                self._compile("volume_reject.comp.glsl", rectangle),
                self._compile("volume_sample.comp.glsl", rectangle),
            )
        return self._programs[room, has_gaps]

    def _compile(self, name: str, *parts: str) -> moderngl.ComputeShader:
        constants = (
            f"#define BLOCK {_BLOCK}u\n#define CLUSTER {_CLUSTER}u\n"
            f"#define GROUP {self._group_size}u\n#define WHOLE {_WHOLE}u\n"
            f"#define MAX_GROUPS {self._max_groups}u\n#define REJECT {int(self._reject)}\n"
        )
        return compile_compute(self._context, name, constants, *parts)

    def _upload_hull(self, hull: Hull) -> None:
        """Put the silhouettes of a frame on the device, masks as one bit a pixel.

        The integral images are sent as they are. Of four images of 720 x 486 this takes 0.4 ms on
        a software renderer, and cv2 computed them in 0.25 ms; to sum them up there, in one pass
        over the rows and one over the columns, takes 6.4 ms.
        """
        views = hull.views
        # The camera that sees the smallest silhouette rejects most: ask it first.
        order = np.argsort(hull.object_shares(), kind="stable")
        cameras = self._cameras
        if cameras is None or cameras.views is not views:
            cameras = self._upload_cameras(hull)
        turns = np.zeros(_room(len(views)), np.uint32)
        turns[: len(views)] = order
        images = [hull.mask(camera) for camera in range(len(views))]
        words = _packed(images, cameras.mask_words, cameras.n_mask_words)
        words = np.concatenate([words, cameras.seen_words])
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
        recorded = np.zeros((_room(len(views)), 4), np.uint32)
        seen_words = np.zeros(0, np.uint32)
        if views.seen is not None:
            some = np.flatnonzero(views.seen.mask_offset >= 0)
            starts = np.concatenate([[0], np.cumsum(n_words[some])]).astype(np.int64)
            images = [image for k in some if (image := views.seen_mask(int(k))) is not None]
            seen_words = _packed(images, starts[:-1], int(starts[-1]))
            recorded[some, 0] = mask_words[-1] + starts[:-1]
            recorded[some, 1] = hull.recorded_offset[some]
            recorded[some, 2] = 1
        pad_rows = np.zeros((_room(len(views)), 2, 4), np.float32)
        pad_rows[: len(views)] = _pad_rows(views)
        precise = np.concatenate([views.origin_world, views.img_from_local.reshape(-1)])
        return _Cameras(
            views,
            self._upload(table.view(np.uint8), "the cameras"),
            self._upload(pad_rows, "the cameras"),
            self._upload(precise, "the cameras"),
            self._upload(recorded, "the cameras"),
            mask_words[:-1],
            int(mask_words[-1]),
            seen_words,
        )

    def _rewrite(self, buffer: moderngl.Buffer, array: NDArray[Any], what: str) -> moderngl.Buffer:
        """Write an array into a buffer, replaced where the size differs."""
        if buffer.size != array.nbytes:
            return self._upload(array, what)
        buffer.write(np.ascontiguousarray(array))
        return buffer

    def _launch_ends(self, views: Views, topology: Topology) -> NDArray[np.int64]:
        """Return at which triangles a launch of a mesh must end, ascending, the last one its end.

        Raises
        ------
        DeviceError
            If a triangle is too large for the software renderer.
        """
        surface = self._surfaces[topology]
        n_cameras, viewport = len(views), surface.largest_viewport
        if not self._is_software:
            return np.array([len(topology)])
        n_lanes, n_edge = self._group_size, -(-viewport // _BLOCK)
        # Second pass, a part: the cameras, and the items of its largest triangle, row by row.
        part_turns = 2 * n_cameras + n_edge + n_edge * (n_edge + 1) // 2 + 8
        # Third pass, an item: the cameras' corners, the samples, of each the cameras, and the runs.
        n_samples = min(_BLOCK * _BLOCK, viewport * (viewport + 1) // 2)
        item_turns = 8 * -(-n_cameras // n_lanes) + 128
        item_turns += -(-n_samples // n_lanes) * (n_cameras + 1)
        if part_turns > _SOFTWARE_MAX_TURNS:
            triangle = int(topology.viewports.argmax())
            raise DeviceError(
                f"triangle {triangle} has a viewport of {viewport}, more than {self.renderer}, a "
                "software renderer, samples in one go; take a smaller viewport, or --engine native"
            )
        most_items = self._max_groups * max(1, _SOFTWARE_MAX_TURNS // item_turns)
        most_parts = self._max_groups * (_SOFTWARE_MAX_TURNS // part_turns)
        most_triangles = max(_CLUSTER, (most_parts * n_lanes // _CLUSTER - 1) * _CLUSTER)
        before = surface.blocks_before
        ends = [0]
        while ends[-1] < len(topology):
            start = ends[-1]
            stop = int(np.searchsorted(before, before[start] + most_items, side="right")) - 1
            ends.append(max(start + 1, min(stop, start + most_triangles)))
        return np.array(ends[1:], np.int64)

    def _place(self, views: Views, mesh: Triangles) -> None:
        """Put a mesh on the device, as far as it is not there."""
        topology = mesh.topology
        surface = self._surfaces.get(topology)
        if surface is None:
            what = f"a mesh of {len(mesh)} triangles"
            surface = _Surface(
                self._upload(topology.faces, what),
                self._upload(topology.viewports, what),
                len(topology),
                int(topology.viewports.max(initial=1)),
                np.concatenate([[0], np.cumsum(_n_blocks(topology.viewports))]),
                [],
                [],
            )
            self._surfaces[topology] = surface
        placement = self._placements.get(mesh)
        if placement is None or placement.views is not views:
            if placement is not None:
                surface.placements.remove(placement)
                surface.spare.append(placement)
            placement = self._place_vertices(views, mesh, surface)
            self._placements[mesh] = placement
            surface.placements.append(placement)

    def _place_vertices(self, views: Views, mesh: Triangles, surface: _Surface) -> _Placement:
        """Send the vertices of a mesh; round them, and bound its clusters, on the device."""
        vertices = mesh.vertices_world
        what = f"a mesh of {len(vertices)} vertices"
        if surface.spare:  # of the same sizes, since the topology is the same
            spare = surface.spare.pop()
            placement = _Placement(
                weakref.ref(mesh),
                views,
                self._rewrite(spare.vertices_world, vertices, what),
                spare.vertices_local,
                spare.boxes,
            )
        else:
            placement = _Placement(
                weakref.ref(mesh),
                views,
                self._upload(vertices, what),
                self._reserve(max(4, 12 * len(vertices))),
                self._reserve(max(4, 24 * surface.n_clusters)),
            )
        if surface.n_triangles == 0:
            return placement
        assert self._cameras is not None
        if self._placing is None:
            self._placing = (
                self._compile("volume_round.comp.glsl"),
                self._compile("volume_bounds.comp.glsl"),
            )
        round_vertices, bound = self._placing
        placement.boxes.bind_to_storage_buffer(1)
        placement.vertices_world.bind_to_storage_buffer(3)
        surface.faces.bind_to_storage_buffer(4)
        self._cameras.precise.bind_to_storage_buffer(10)
        placement.vertices_local.bind_to_storage_buffer(11)
        _set(round_vertices, n_coordinates=vertices.size)
        _set(bound, n_triangles=surface.n_triangles, n_clusters=surface.n_clusters)
        round_vertices.run(min(-(-vertices.size // self._group_size), self._max_groups))
        self._context.memory_barrier(self._context.SHADER_STORAGE_BARRIER_BIT)
        bound.run(min(surface.n_clusters, self._max_groups))
        self._context.memory_barrier(self._context.SHADER_STORAGE_BARRIER_BIT)
        return placement

    def _run(
        self, views: Views, meshes: list[Triangles], launches: list[_Launch]
    ) -> NDArray[np.uint32]:
        """Return the hits of some launches, (N, 4), unordered; see above what they say."""
        while True:
            n_items, n_hits = self._dispatch(views, meshes, launches)
            needed_items, needed_hits = _ITEM_SIZE * n_items, _HIT_SIZE * n_hits
            if needed_items <= self._items.size and needed_hits <= self._hits.size:
                read = self._hits.read(needed_hits) if n_hits else b""
                return np.frombuffer(read, np.uint32).reshape(-1, 4)
            if max(needed_items, needed_hits) > self._largest:
                halves = _halved(launches)
                if halves is None:
                    raise DeviceError(
                        f"triangle {launches[0].start} has {n_hits} runs of samples in the hull, "
                        f"more than {self.renderer} holds in one buffer; take a smaller viewport, "
                        "or --engine native"
                    )
                return np.concatenate([self._run(views, meshes, half) for half in halves])
            self._items = self._grown(self._items, needed_items)
            self._hits = self._grown(self._hits, needed_hits)

    def _grown(self, buffer: moderngl.Buffer, needed: int) -> moderngl.Buffer:
        if needed <= buffer.size:
            return buffer
        return self._reserve(min(self._largest, 1 << (needed - 1).bit_length()))

    def _dispatch(
        self, views: Views, meshes: list[Triangles], launches: list[_Launch]
    ) -> tuple[int, int]:
        """Run the passes of some launches; return how many items and hits they have."""
        assert self._cameras is not None
        programs = self.programs_for(len(views), has_gaps=views.seen is not None)
        counters = np.append(np.tile(_LAUNCH_COUNTERS, len(launches)), np.uint32(0))
        self._counters = self._rewrite(self._counters, counters, "the counters")
        most_clusters = max((x.stop - x.start for x in launches), default=0) // _CLUSTER + 2
        self._open_clusters = self._grown(self._open_clusters, 4 * most_clusters)
        self._cameras.buffer.bind_to_uniform_block(0)
        self._cameras.pad_rows.bind_to_uniform_block(1)
        self._order.bind_to_uniform_block(2)
        self._cameras.recorded.bind_to_uniform_block(3)
        self._integrals.bind_to_storage_buffer(0)
        self._open_clusters.bind_to_storage_buffer(2)
        self._items.bind_to_storage_buffer(6)
        self._counters.bind_to_storage_buffer(7)
        self._hits.bind_to_storage_buffer(8)
        self._masks.bind_to_storage_buffer(9)
        self._cameras.precise.bind_to_storage_buffer(10)
        for program in (programs.cluster, programs.reject, programs.sample):
            _set(
                program,
                n_cameras=len(views),
                keep=int(views.unseen == "keep"),
                min_cameras=views.min_cameras,
                item_capacity=self._items.size // _ITEM_SIZE,
                hit_capacity=self._hits.size // _HIT_SIZE,
                hit_counter=len(counters) - 1,
            )
        barrier = self._context.SHADER_STORAGE_BARRIER_BIT
        for number, launch in enumerate(launches):
            mesh = meshes[launch.mesh]
            surface, placement = self._surfaces[mesh.topology], self._placements[mesh]
            placement.boxes.bind_to_storage_buffer(1)
            placement.vertices_world.bind_to_storage_buffer(3)
            surface.faces.bind_to_storage_buffer(4)
            surface.viewports.bind_to_storage_buffer(5)
            placement.vertices_local.bind_to_storage_buffer(11)
            _set(
                programs.cluster,
                first_triangle=launch.start,
                stop_triangle=launch.stop,
                n_clusters=surface.n_clusters,
                launch=number,
                mesh=launch.mesh,
            )
            _set(
                programs.reject,
                first_triangle=launch.start,
                stop_triangle=launch.stop,
                launch=number,
                mesh=launch.mesh,
            )
            _set(programs.sample, launch=number, mesh=launch.mesh)
            n_clusters = -(-launch.stop // _CLUSTER) - launch.start // _CLUSTER
            programs.cluster.run(min(-(-n_clusters // self._group_size), self._max_groups))
            self._context.memory_barrier(barrier | self._context.COMMAND_BARRIER_BIT)
            start = number * _LAUNCH_COUNTERS.nbytes
            programs.reject.run_indirect(self._counters, start)
            self._context.memory_barrier(barrier | self._context.COMMAND_BARRIER_BIT)
            programs.sample.run_indirect(self._counters, start + _LAUNCH_COUNTERS.nbytes // 2)
            self._context.memory_barrier(barrier | self._context.BUFFER_UPDATE_BARRIER_BIT)
        counters = np.frombuffer(self._counters.read(), np.uint32)
        return int(counters[7:-1:8].max(initial=0)), int(counters[-1])


def _packed(
    images: Sequence[NDArray[np.uint8]], first_word: NDArray[np.int64], n_words: int
) -> NDArray[np.uint32]:
    """Return images of 0 and 1 as one bit a pixel, each from a word of its own on."""
    words = np.zeros(n_words, "<u4")
    packed = words.view(np.uint8)
    for image, word in zip(images, first_word.tolist(), strict=True):
        bits = np.packbits(image.reshape(-1), bitorder="little")
        packed[4 * word : 4 * word + len(bits)] = bits
    return words


def _pad_rows(views: Views) -> NDArray[np.float64]:
    """Return the pads in x and y of a set by its reach, (C, 2, 4): see rectangle.glsl.

    They are linear in the reach: what each axis adds, and what is there without any.
    """
    reaches_m = np.concatenate([np.eye(3), np.zeros((1, 3))])
    pads = rectangle_pads(views, reaches_m, ROUNDOFF_FLOAT32)[..., :2]  # (4, C, 2)
    pads[:3] -= pads[3]
    rows: NDArray[np.float64] = pads.transpose(1, 2, 0)
    return rows


def _runs(topology: Topology, hits: NDArray[np.uint32]) -> Hits:
    """Return what the device found of one mesh, in order."""
    before = topology.samples_before
    triangle, first, count, _ = hits.T.astype(np.int64)
    is_whole = first == _WHOLE
    start = before[triangle] + np.where(is_whole, 0, first)
    stop = np.where(is_whole, before[np.where(is_whole, triangle + count, 0)], start + count)
    # Runs do not overlap: in whatever order they come, the n-th start belongs to the n-th stop.
    start.sort()
    stop.sort()
    is_apart = np.ones(len(hits) + 1, np.bool_)  # before each run, and after the last
    is_apart[1:-1] = start[1:] != stop[:-1]
    return Hits(topology, start[is_apart[:-1]], stop[is_apart[1:]])


def _room(n_cameras: int) -> int:
    """Return for how many cameras the programs that serve `n_cameras` are compiled."""
    return 1 << max(3, (n_cameras - 1).bit_length())


def _set(program: moderngl.ComputeShader, **values: int) -> None:
    """Set uniforms; the compiler may have dropped one that a pass does not use."""
    for name, value in values.items():
        if name in program:
            program[name] = value


def _n_blocks(viewports: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return into how many blocks the samples of triangles are cut, (T,)."""
    n_edge = -(-viewports.astype(np.int64) // _BLOCK)
    return np.asarray(n_edge * (n_edge + 1) // 2)


def _batches(
    samples_before: list[NDArray[np.int64]], ends: list[NDArray[np.int64]]
) -> list[list[_Launch]]:
    """Return launches that cover all triangles, in batches whose samples 32 bits can count.

    No launch reaches beyond one of the ends of its mesh, ascending, the last one that of the mesh.
    """
    batches: list[list[_Launch]] = []
    room = 0
    for number, before in enumerate(samples_before):
        start, n_triangles = 0, len(before) - 1
        while start < n_triangles:
            if before[start + 1] - before[start] > room:
                batches.append([])
                room = _MAX_SAMPLES
            stop = int(np.searchsorted(before, before[start] + room, side="right")) - 1
            stop = min(stop, int(ends[number][np.searchsorted(ends[number], start, side="right")]))
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
