"""One recording, and what the effects of a scene make of it, frame by frame.

::

    session -> silhouettes -+
    rig --------------------+-> Hull (one frame) -> instants -> effects -> SimulatedFrame -> file
    scene -> effects -------+

Time goes on from frame to frame. The first frame with a hull shows the state that the scene gives;
each later one what the steps since the frame before made of it. A frame without a hull, or in which
a part that moves has no pose, is a pause: nothing goes on, and the hull of the next, with all parts
that move, is taken to have been there all along.
"""

import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError, SessionError, ask_all
from hybridve.calib.pose import compose, invert, placed
from hybridve.hull.about import about_rig, local_origin_m, resolved_settings
from hybridve.hull.agreement.frame import judge_frame
from hybridve.hull.agreement.outlines import FrameOutlines
from hybridve.hull.cad.motion import Motion
from hybridve.hull.cad.scene import Scene, SceneObject, load_scene
from hybridve.hull.capture.inspection import opened_session
from hybridve.hull.chain import (
    Chain,
    EvaluateSettings,
    FrameHull,
    count_frames,
    hulls,
    make_chain,
)
from hybridve.hull.effects.effect import (
    COMMON,
    Effect,
    Entry,
    Instant,
    Onlooker,
    Placed,
    Quantity,
    Setting,
    UnstableError,
)
from hybridve.hull.effects.instants import HullMode, instants
from hybridve.hull.effects.kinds import make_effects, read_entries, software_of
from hybridve.hull.query.choose import open_engine
from hybridve.hull.query.engine import Engine, EngineName
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.threads import Threads
from hybridve.hull.report.machine import Run
from hybridve.hull.report.result_file import refuse_other
from hybridve.hull.report.simulation_data import (
    Group,
    Shown,
    SimulatedFrame,
    SimulationHeader,
    Variable,
)
from hybridve.hull.report.simulation_file import SimulationWriter, read_settings
from hybridve.hull.report.write import refuse_result
from hybridve.hull.trust import Witness, judge_cameras
from hybridve.hull.watcher import Watcher


@dataclass(frozen=True, slots=True)
class SimulateSettings:
    """How a recording is simulated.

    Attributes
    ----------
    evaluation : EvaluateSettings
        Which frames, cameras, and how many samples a triangle.
    step_s : float
        The longest step.
    hull : "interpolate" or "hold"
        What the hull is between two frames.
    seed : int
        Of what is drawn at random.
    engine : str
        What answers the volume query.
    resume, overwrite : bool
        What may become of what stands there.
    command : str
        What was called, for the file.
    """

    evaluation: EvaluateSettings = field(default_factory=EvaluateSettings)
    step_s: float = 0.002
    hull: HullMode = "interpolate"
    seed: int = 0
    engine: EngineName = "auto"
    resume: bool = False
    overwrite: bool = False
    command: str = ""


def simulate_one(
    session: Path, scene: Path, output: Path, settings: SimulateSettings, watcher: Watcher
) -> None:
    """Simulate the effects of a scene beside a recording, into a file.

    Raises
    ------
    HybridveError
        If recording, rig and scene do not fit together, the scene names no effect, or the file
        cannot be written.
    """
    _, loaded, opened = ask_all(
        lambda: refuse_result(output, resume=settings.resume, overwrite=settings.overwrite),
        lambda: _scene_with_effects(scene),
        lambda: opened_session(session, settings.evaluation.drop_cameras),
    )
    chain = make_chain(opened, loaded, settings.evaluation, watcher.stage)
    with open_engine(settings.engine) as engine:
        simulation = Simulation.of(chain, engine, settings)
        header = simulation.header(settings, engine)
        if settings.resume and output.exists() and not settings.overwrite:
            refuse_other(output, read_settings(output), (header.settings, header.rig))
            watcher.say(f"{output}: stands already, finished with these settings")
            return
        with SimulationWriter(
            output, header, resume=settings.resume, overwrite=settings.overwrite
        ) as writer:
            if not writer.stopped:
                run = simulation.run(
                    skip=writer.n_done, state=writer.state(), progress=watcher.stage
                )
                with (
                    closing(run) as frames,
                    watcher.steps("simulate", count_frames(chain), done=writer.n_done) as advance,
                ):
                    for frame in frames:
                        writer.append(frame, simulation.state)
                        advance()
            watcher.say(f"writing {output}")
            seen = writer.outlines(simulation.state)
            is_still = not chain.tracks
            writer.finish(
                judge_cameras(
                    chain.session,
                    chain.views,
                    seen,
                    chain.room,
                    lenses=chain.undistortions,
                    is_still=is_still,
                )
            )


def _scene_with_effects(path: Path) -> Scene:
    """Return a scene with effects, all of which can be read."""
    scene = load_scene(path)
    if not scene.effects:
        raise SceneError(
            f"{path}: names no effect, so there is nothing to simulate; add an [[effect]] table"
        )
    read_entries(scene)
    return scene


@dataclass(slots=True, eq=False)
class Simulation:
    """The effects of a scene beside a recording.

    Attributes
    ----------
    chain : Chain
        The recording.
    effects : list of (Effect, names)
        What is simulated together, with the names of its entries.
    entries : tuple of Entry
        All entries of the scene.
    step_s, hull
        As in `SimulateSettings`.
    software : mapping
        The libraries that the numbers depend on, and their versions.
    has_begun : bool
        Whether a frame had a hull yet.
    threads : Threads
        Make the hulls between frames.
    """

    chain: Chain
    effects: list[tuple[Effect, tuple[str, ...]]]
    entries: tuple[Entry, ...]
    step_s: float
    hull: HullMode
    software: Mapping[str, str]
    has_begun: bool = False
    threads: Threads = field(default_factory=Threads)

    @classmethod
    def of(cls, chain: Chain, engine: Engine, settings: SimulateSettings) -> "Simulation":
        """Return the effects of a chain's scene, at their beginning."""
        found = read_entries(chain.scene)
        claimed = frozenset(name for entry, _ in found for name in entry.table.claimed)
        setting = Setting(
            scene=chain.scene,
            claimed=claimed,
            views=chain.views,
            engine=engine,
            step_s=settings.step_s,
            frame_s=chain.settings.frames.step / chain.session.fps,
            viewport=chain.settings.viewport or 10,
            seed=settings.seed,
        )
        return cls(
            chain,
            [
                (effect, tuple(entry.name for entry in entries))
                for effect, entries in make_effects(found, setting)
            ],
            tuple(entry for entry, _ in found),
            settings.step_s,
            settings.hull,
            software_of(found),
        )

    def run(
        self,
        *,
        frames: Generator[FrameHull] | None = None,
        skip: int = 0,
        state: Mapping[str, NDArray[Any]] | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Generator[SimulatedFrame]:
        """Yield what became of every frame; to be closed where it is left before its end.

        Parameters
        ----------
        frames : generator of FrameHull, optional
            The recording's, where they are at hand; by default they are read.
        skip : int
            How many frames at the start are done already. The last of them is looked at again.
        state : mapping, optional
            What `state` gave after them.
        progress : callable, optional
            Told ``(what, done, total)`` while the backgrounds are learnt.

        Raises
        ------
        SessionError
            If the recording has none of the frames asked for.
        """
        if state:
            self._restore(state)
        row = first = max(skip - 1, 0)
        before: FrameHull | None = None
        is_still = not self.chain.tracks
        witness = Witness.of(self.chain.views, self.chain.undistortions, None, is_still=is_still)
        if frames is None:
            frames = hulls(self.chain, skip=first, progress=progress)
        with closing(frames):
            for frame in frames:
                seen, outlines = self._judged(frame, witness)
                if row >= skip:
                    told = self._frame(before, seen, outlines)
                    yield told
                    if told.blew_up:
                        return
                before = seen
                row += 1
        if row == 0:
            raise SessionError(
                f"{self.chain.session.path}: the recording has none of the frames "
                f"{self.chain.settings.frames}; it may be empty or shorter"
            )

    def state(self) -> dict[str, NDArray[Any]]:
        """Return all that decides how the simulation goes on."""
        state: dict[str, NDArray[Any]] = {"has_begun": np.array(self.has_begun)}
        for number, (effect, _) in enumerate(self.effects):
            for key, value in effect.state().items():
                state[f"{number}/{key}"] = np.asarray(value)
        return state

    def _restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.has_begun = bool(state["has_begun"])
        for number, (effect, _) in enumerate(self.effects):
            head = f"{number}/"
            effect.restore(
                {
                    key.removeprefix(head): value
                    for key, value in state.items()
                    if key.startswith(head)
                }
            )

    def _judged(self, frame: FrameHull, witness: Witness) -> tuple[FrameHull, FrameOutlines]:
        """Return the frame, without its hull if its silhouettes cannot all be right."""
        if frame.hull is None:
            return frame, FrameOutlines.unread(frame.index, len(self.chain.views))
        agreement = judge_frame(frame.hull, witness.error_px, witness.pencils)
        _, kept = witness.look(frame.index, frame.hull)
        if agreement.is_contradictory:
            frame = replace(frame, hull=None, reason=agreement.reason)
        return frame, replace(kept, is_contradictory=agreement.is_contradictory)

    def _frame(
        self, before: FrameHull | None, frame: FrameHull, outlines: FrameOutlines
    ) -> SimulatedFrame:
        """Go on to a frame, and return what stands there."""
        stage_s = {"decode": frame.decode_s, "segment": frame.segment_s, "between": frame.hull_s}
        seconds = [0.0] * len(self.effects)
        n_steps = n_hulls = 0
        blew_up = ""
        if frame.hull is not None and self.has_begun:
            for steps in _timed(self._instants(before, frame, frame.hull), stage_s):
                n_hulls += 1
                n_steps += len(steps)
                step_s = steps[0].elapsed_s / len(steps)
                for number, (effect, names) in enumerate(self.effects):
                    started = time.perf_counter()
                    try:
                        for instant in steps:
                            effect.advance(instant, step_s)
                    except UnstableError as error:
                        blew_up = f"frame {frame.index}: {', '.join(names)}: {error}"
                        break
                    finally:
                        seconds[number] += time.perf_counter() - started
                if blew_up:
                    break
        elif frame.hull is not None:
            self.has_begun = True
        values: dict[str, dict[str, NDArray[Any]]] = {}
        there = self._driven(frame.index)
        # Who looks on comes last: what the others move has its place by then.
        for number in sorted(range(len(self.effects)), key=self._looks_on):
            effect, names = self.effects[number]
            started = time.perf_counter()
            if isinstance(effect, Onlooker):
                effect.see_objects(there)
            told = effect.values(frame.hull)
            seconds[number] += time.perf_counter() - started
            for name in names:
                values[name] = {**told[name], "step_s": np.array(seconds[number])}
                there |= self._simulated(effect, name, told[name])
        return SimulatedFrame(
            index=frame.index,
            time_s=frame.time_s,
            reason=frame.reason,
            n_steps=n_steps,
            n_hulls=n_hulls,
            stage_s=stage_s,
            values=values,
            outlines=outlines,
            blew_up=blew_up,
            poses={
                one.name: compose(pose, one.world_from_mesh)
                for one in self.chain.scene.objects
                if one.motion is not None
                and (pose := one.motion.world_from_rest(frame.index)) is not None
            },
        )

    def _looks_on(self, number: int) -> bool:
        return isinstance(self.effects[number][0], Onlooker)

    @property
    def _motions(self) -> dict[str, Motion]:
        """How the objects move that do so as files say, by name."""
        return {one.name: one.motion for one in self.chain.scene.objects if one.motion is not None}

    def _driven(self, index: int) -> dict[str, Placed]:
        """Return where the objects are in a frame that move as files say."""
        found = {}
        for one in self.chain.scene.objects:
            if one.motion is not None:
                pose = one.motion.last_known(index)
                found[one.name] = Placed(one.at(pose).vertices_world, pose)
        return found

    def _simulated(
        self, effect: Effect, name: str, values: Mapping[str, NDArray[Any]]
    ) -> dict[str, Placed]:
        """Return where the object is that an entry moves, by what is told of it."""
        drawn = effect.told[name].drawn
        (entry,) = (one for one in self.entries if one.name == name)
        moved = [one for one in self.chain.scene.objects if one.name in entry.table.claimed]
        if drawn is None or not drawn.column or len(moved) != 1:
            return {}
        (one,), there = moved, values[drawn.column]
        if there.shape not in ((3, 4), one.vertices_world.shape):
            return {}
        return {one.name: _placed(one, there)}

    def _instants(
        self, before: FrameHull | None, frame: FrameHull, hull: Hull
    ) -> Iterator[Sequence[Instant]]:
        step = self.chain.settings.frames.step
        elapsed_s = step / self.chain.session.fps
        is_known = before is not None and before.hull is not None
        return instants(
            None if before is None else before.hull,
            hull,
            start_s=frame.time_s - elapsed_s,
            elapsed_s=elapsed_s,
            frame=frame.index,
            step_s=self.step_s,
            mode=self.hull,
            motions=self._motions,
            since=before.index if before is not None and is_known else None,
            threads=self.threads,
        )

    def header(self, settings: SimulateSettings, engine: Engine) -> SimulationHeader:
        """Return what the file says of itself as a whole."""
        chain = self.chain
        resolved = resolved_settings(chain)
        about = {key: resolved[key] for key in _KEPT} | {
            "viewport": chain.settings.viewport or 10,
            "step_s": settings.step_s,
            "hull": settings.hull,
            "seed": settings.seed,
            "solvers": dict(self.software),
        }
        groups = []
        for effect, names in self.effects:
            for entry in self.entries:
                if entry.name in names:
                    groups.append(_group(entry, effect, names))
        return SimulationHeader(
            run=Run.now(settings.command),
            settings=about,
            rig=about_rig(chain),
            engine=engine.name,
            renderer=engine.renderer,
            groups=tuple(groups),
            local_origin_m=local_origin_m(chain),
            standing=tuple(
                (one.name, one.vertices_world, one.faces)
                for one in chain.scene.objects
                if one.motion is None
                and not any(one.name in entry.table.claimed for entry in self.entries)
            ),
            moving=tuple(
                (one.name, _mesh_of(one), one.faces)
                for one in chain.scene.objects
                if one.motion is not None
            ),
        )


#: What is kept of the settings of an evaluation.
_KEPT = (
    "session",
    "session_sha256",
    "scene",
    "scene_sha256",
    "cameras",
    "frames",
    "unseen",
    "min_cameras",
    "mask_threshold",
    "mask_channel",
    "rig_check",
    "segmentation",
    "silhouettes",
    "local_origin_m",
)


def _mesh_of(one: SceneObject) -> NDArray[np.float64]:
    """Return the vertices (V, 3) of an object in the frame of its mesh, metres."""
    return one.vertices_world if one.vertices_mesh is None else one.vertices_mesh


def _placed(one: SceneObject, told: NDArray[Any]) -> Placed:
    """Return where an object is, of its world_from_mesh (3, 4) or its vertices (V, 3)."""
    if told.shape == (3, 4):
        world_from_rest = compose(told, invert(one.world_from_mesh))
        return Placed(placed(_mesh_of(one), told), world_from_rest)
    return Placed(np.asarray(told, np.float64), None)


def _timed(
    found: Iterator[Sequence[Instant]], stage_s: dict[str, float]
) -> Iterator[Sequence[Instant]]:
    """Yield what comes, and add the seconds it takes to come to the stage "between"."""
    while True:
        started = time.perf_counter()
        one = next(found, None)
        stage_s["between"] += time.perf_counter() - started
        if one is None:
            return
        yield one


#: What the driver tells of each entry.
_STEP_S = Quantity(
    "step_s",
    "s",
    "exact",
    "seconds that the steps to this frame took, and what is told of it, of all entries that are "
    "simulated together",
)


def _group(entry: Entry, effect: Effect, together: Sequence[str]) -> Group:
    """Return what the file says of an entry."""
    told = effect.told[entry.name]
    drawn = told.drawn
    about = {
        "kind": entry.table.kind,
        "table": entry.table.model_dump(mode="json"),
        "together_with": [name for name in together if name != entry.name],
        **told.about,
    }
    return Group(
        name=entry.name,
        kind=entry.table.kind,
        about=about,
        variables=tuple(_variable(one) for one in (_STEP_S, *COMMON, *told.columns)),
        constants=tuple(
            (_variable(quantity), value) for quantity, value in told.constants.values()
        ),
        shown=None
        if drawn is None
        else Shown(drawn.column, drawn.vertices, drawn.faces, drawn.cell_columns),
    )


def _variable(one: Quantity) -> Variable:
    return Variable(
        one.name,
        one.unit,
        one.trust,
        one.description,
        shape=one.shape,
        dtype=one.dtype,
        is_place=one.is_place,
    )
