"""How much room a recorded task needs: one replay of the recording, for all shifts at once."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import SceneError, SessionError, ask_all
from hybridve.hull.about import resolved_settings
from hybridve.hull.agreement.frame import judge_frame
from hybridve.hull.agreement.outlines import FrameOutlines
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.cad.motion import Motion
from hybridve.hull.cad.scene import Scene, SceneObject, load_scene
from hybridve.hull.capture.inspection import opened_sessions
from hybridve.hull.chain import (
    Chain,
    EvaluateSettings,
    count_frames,
    hulls,
    make_chain,
    make_doubter,
)
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.components import grown
from hybridve.hull.contact.spacing import (
    METER_SHARE,
    NOTHING,
    BlockedShifts,
    Move,
    MovedObject,
    blocked_shifts,
    covers,
    free_of,
    tightest_at,
    union,
    verdict_at,
    without,
)
from hybridve.hull.contact.spacing_doubt import UnsureShifts, unsure_shifts
from hybridve.hull.contact.uncertainty import Doubter, FrameDoubts
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.report.machine import Run
from hybridve.hull.report.spacing_file import (
    Binding,
    SessionSpacing,
    Spacing,
    SpacingCurve,
    SpacingDoubt,
    SpacingFrames,
    make_stretches,
)
from hybridve.hull.trust import Witness, judge_cameras
from hybridve.hull.watcher import Watcher

#: Points of a curve at most; what a frame blocks is known for all shifts anyway.
_MOST_POINTS = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """What is moved, what stays, and whereto; it serves for several recordings.

    Attributes
    ----------
    move : Move
        Whereto.
    moved, standing : tuple of MovedObject
        The objects that are moved, and all others of the scene. Those that move by themselves are
        so in the frames of a recording (see `at`).
    moved_names, standing_names : tuple of str
        Their names.
    motions : mapping of str to Motion
        How those move that do, by name.
    """

    move: Move
    moved: tuple[MovedObject, ...]
    standing: tuple[MovedObject, ...]
    moved_names: tuple[str, ...]
    standing_names: tuple[str, ...]
    motions: Mapping[str, Motion] = field(default_factory=dict)

    def at(self, index: int) -> "Layout":
        """Return the layout as it is in a frame in which no object lacks a pose."""
        if not self.motions:
            return self

        def there(name: str, one: MovedObject) -> MovedObject:
            if name not in self.motions:
                return one
            return replace(one, meter=one.meter.at(self.motions[name].poses[index]))

        return replace(
            self,
            moved=tuple(map(there, self.moved_names, self.moved)),
            standing=tuple(map(there, self.standing_names, self.standing)),
        )

    @classmethod
    def of(
        cls, scene: Scene, names: Sequence[str], move: Move, clearance_m: float | None = None
    ) -> Self:
        """Return the layout of a scene of which the objects with these names are moved.

        Parameters
        ----------
        scene : Scene
            All objects.
        names : sequence of str
            Which are moved.
        move : Move
            Whereto.
        clearance_m : float, optional
            What all moved objects require; by default each what the scene says of it.

        Raises
        ------
        SceneError
            If the scene has no such object, or a name is given twice.
        """
        known = [one.name for one in scene.objects]
        for number, name in enumerate(names):
            if name not in known:
                raise SceneError(
                    f"{scene.path}: there is no object {name!r} to move; the scene has "
                    f"{', '.join(known)}"
                )
            if name in names[:number]:
                raise SceneError(f"{scene.path}: object {name!r} is to move twice; name it once")

        def measured(one: SceneObject, required_m: float) -> MovedObject:
            meter = ClearanceMeter(
                one.vertices_world,
                one.faces,
                is_closed=one.is_closed,
                solid_faces=one.solid_faces,
                tolerance_m=METER_SHARE * move.tolerance_m,
            )
            # Distances are to the triangles, from which the part may be this far.
            return MovedObject(meter, required_m + one.tessellation_error_m)

        moved = [one for one in scene.objects if one.name in names]
        standing = [one for one in scene.objects if one.name not in names]
        return cls(
            move,
            tuple(
                measured(one, one.required_clearance_m if clearance_m is None else clearance_m)
                for one in moved
            ),
            tuple(measured(one, one.required_clearance_m) for one in standing),
            tuple(one.name for one in moved),
            tuple(one.name for one in standing),
            {one.name: one.motion for one in scene.objects if one.motion is not None},
        )


def shifts_of(move: Move, step_m: float | None = None) -> NDArray[np.float64]:
    """Return the shifts (S,) of a curve in metres: both ends of the range, and steps between.

    Raises
    ------
    SceneError
        If these were too many.
    """
    length_m = move.stop_m - move.start_m
    step_m = length_m / 200.0 if step_m is None else step_m
    n_steps = length_m / step_m
    if n_steps > _MOST_POINTS:
        raise SceneError(
            f"a curve of {n_steps:.0f} steps of {1e3 * step_m:g} mm: at most {_MOST_POINTS}; take "
            "longer steps"
        )
    steps_m = move.start_m + step_m * np.arange(int(np.ceil(n_steps)))
    return np.append(steps_m[steps_m < move.stop_m], move.stop_m)


@dataclass(frozen=True, slots=True)
class SpacingRequest:
    """What is asked of all recordings.

    Attributes
    ----------
    moved : tuple of str
        The objects that are moved.
    move : Move
        Whereto.
    clearance_m : float or None
        What they require; None for what the scene says of each.
    grow_px : int
        By how many pixels all silhouettes are grown.
    step_m : float or None
        Steps of the curve; None for a two hundredth of the range.
    evaluation : EvaluateSettings
        Which frames, and what is assumed of outlines.
    """

    moved: tuple[str, ...]
    move: Move
    clearance_m: float | None
    grow_px: int
    step_m: float | None
    evaluation: EvaluateSettings


def find_spacing(
    sessions: Mapping[str, Path],
    scene_path: Path,
    asked: SpacingRequest,
    command: str,
    watcher: Watcher,
) -> Spacing:
    """Return how much room the tasks of recordings need, each replayed once.

    Parameters
    ----------
    sessions : mapping of str to Path
        The recordings, by what they are called.
    scene_path : Path
        The layout.
    asked : SpacingRequest
        What is moved, and how.
    command : str
        What was called, for the file.
    watcher : Watcher
        Told how far it is.

    Raises
    ------
    HybridveError
        If recordings, rig and scene do not fit together, or no frame can be evaluated.
    """
    shifts_m = shifts_of(asked.move, asked.step_m)
    (scene, layout), opened = ask_all(
        lambda: _laid_out(scene_path, asked),
        lambda: opened_sessions(sessions, asked.evaluation.drop_cameras),
    )
    chains = {
        name: make_chain(session, scene, asked.evaluation) for name, session in opened.items()
    }
    found = []
    for name, chain in chains.items():
        with watcher.steps(f"spacing {name}", count_frames(chain)) as advance:
            found.append(
                replay(
                    name,
                    chain,
                    layout,
                    shifts_m,
                    grow_px=asked.grow_px,
                    progress=watcher.stage,
                    advance=advance,
                )
            )
    move, doubt = asked.move, asked.evaluation.doubt
    return Spacing(
        run=Run.now(command),
        settings={
            "scene": str(scene.path),
            "scene_sha256": scene.checksum,
            "move": list(layout.moved_names),
            "required_m": [one.clearance_m for one in layout.moved],
            "direction": move.direction.tolist(),
            "start_m": move.start_m,
            "stop_m": move.stop_m,
            "tolerance_m": move.tolerance_m,
            "grow_px": asked.grow_px,
            "doubt": None if doubt is None else asdict(doubt),
            "frames": str(asked.evaluation.frames),
        },
        sessions=tuple(found),
    )


def _laid_out(path: Path, asked: SpacingRequest) -> tuple[Scene, Layout]:
    """Return a scene, and its layout of which some objects are moved."""
    scene = load_scene(path)
    return scene, Layout.of(scene, asked.moved, asked.move, asked.clearance_m)


def replay(
    name: str,
    chain: Chain,
    layout: Layout,
    shifts_m: NDArray[np.float64],
    *,
    grow_px: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    advance: Callable[[], object] = lambda: None,
) -> SessionSpacing:
    """Return how much room the task of one recording needs; each frame is looked at once.

    Parameters
    ----------
    name : str
        What the session is called.
    chain : Chain
        The recording, with the scene of the layout. What its settings assume of outlines makes the
        doubt; where they assume nothing, nothing is doubted.
    layout : Layout
        What is moved.
    shifts_m : (S,) float64
        Where to count the frames that violate, ascending.
    grow_px : int
        By how many pixels all silhouettes are grown: the answer then holds for any outlines that
        are no farther out.
    progress : callable, optional
        Told ``(what, done, total)`` while the backgrounds are learnt.
    advance : callable
        Told after each frame.

    Raises
    ------
    SessionError
        If none of the frames can be evaluated.
    """
    doubter = make_doubter(chain)
    tally = _Tally(layout, is_doubted=doubter is not None)
    sigma_px = None if doubter is None else doubter.errors.sigma_px
    is_still = not chain.tracks
    witness = Witness.of(chain.views, chain.undistortions, sigma_px, is_still=is_still)
    seen = []
    with closing(hulls(chain, progress=progress)) as frames:
        for frame in frames:
            if frame.hull is None:
                seen.append(FrameOutlines.unread(frame.index, len(chain.views)))
                tally.leave_out(frame.index, frame.time_s, frame.reason)
            else:
                agreement = judge_frame(frame.hull, witness.error_px, witness.pencils)
                _, kept = witness.look(frame.index, frame.hull)
                seen.append(replace(kept, is_contradictory=agreement.is_contradictory))
                if agreement.is_contradictory:  # its hull is empty, its room is not
                    tally.leave_out(frame.index, frame.time_s, agreement.reason)
                    advance()
                    continue
                hull = grown(frame.hull, grow_px) if grow_px else frame.hull
                doubts = None
                if doubter is not None:
                    doubts = doubter.frame(hull, chain.tracks.at(frame.index))
                tally.look(frame.index, frame.time_s, hull, doubts)
            advance()
    trust = judge_cameras(
        chain.session,
        chain.views,
        seen,
        chain.room,
        lenses=chain.undistortions,
        is_still=is_still,
    )
    if not tally.n_valid:
        why = f": {trust.distrust}" if trust.distrust else ""
        raise SessionError(
            f"{chain.session.path}: none of the frames {chain.settings.frames} can be evaluated"
            f"{why}; choose others with --frames"
        )
    settings = resolved_settings(chain)
    about = {key: settings[key] for key in _KEPT}
    return tally.answer(name, about | _about_errors(doubter), shifts_m, trust)


#: What is kept of the settings of a session.
_KEPT = (
    "session",
    "session_sha256",
    "cameras",
    "frames",
    "unseen",
    "min_cameras",
    "silhouettes",
    "doubt",
)


def _about_errors(doubter: Doubter | None) -> dict[str, object]:
    """Return what is said of the errors that were reckoned with, as plain JSON values."""
    if doubter is None:
        return {}
    errors = doubter.errors
    return {
        "outline_std_px": errors.sigma_px.tolist(),
        "calibration": "covariance"
        if errors.rig is not None
        else ["measured" if known else "assumed" for known in errors.is_measured.tolist()],
    }


class _Tally:
    """What the frames that were looked at say together. No hull is kept."""

    def __init__(self, layout: Layout, *, is_doubted: bool) -> None:
        self._layout = layout
        self._is_doubted = is_doubted
        self._index: list[int] = []
        self._time_s: list[float] = []
        self._reason: list[str] = []
        self._blocked: list[BlockedShifts] = []
        self._unsure: list[UnsureShifts] = []
        self._measure_s: list[float] = []
        self._together = NOTHING
        self._at_end: dict[float, Binding] = {}
        self._standing = np.zeros((len(layout.standing), 2), np.int64)

    @property
    def n_valid(self) -> int:
        """How many frames were looked at."""
        return sum(not reason for reason in self._reason)

    def leave_out(self, index: int, time_s: float, reason: str) -> None:
        """Take note of a frame that cannot be evaluated."""
        unsure = UnsureShifts(NOTHING, np.nan, np.nan, 0)
        self._note(index, time_s, reason, BlockedShifts(NOTHING, NOTHING, 0), unsure, 0.0)

    def look(self, index: int, time_s: float, hull: Hull, doubts: FrameDoubts | None) -> None:
        """Find out what a frame blocks, and what it is that does where that may be the answer.

        `doubts` are those of the hull, if it is to be doubted.
        """
        layout = self._layout.at(index)
        started = time.perf_counter()
        blocked = blocked_shifts(hull, layout.moved, layout.move)
        mine = union(blocked.violated_m, blocked.undecided_m)
        self._together = union(self._together, mine)
        ends = set(mine[:, 1].tolist()).intersection(self._together[:, 1].tolist())
        for shift_m in ends:
            # At the end of the range the worst frame is kept; elsewhere there is but one.
            found = self._binding(layout, index, time_s, hull, shift_m)
            known = self._at_end.get(shift_m)
            if known is None or _spare_m(found) < _spare_m(known):
                self._at_end[shift_m] = found
        for number, one in enumerate(layout.standing):
            verdict = verdict_at(hull, one, layout.move, 0.0)
            self._standing[number] += (verdict == "violates", verdict == "undecided")
        unsure = UnsureShifts(NOTHING, np.nan, np.nan, 0)
        if doubts is not None:
            unsure = unsure_shifts(doubts, layout.moved, layout.move, blocked)
        self._note(index, time_s, "", blocked, unsure, time.perf_counter() - started)

    def _note(
        self,
        index: int,
        time_s: float,
        reason: str,
        blocked: BlockedShifts,
        unsure: UnsureShifts,
        measure_s: float,
    ) -> None:
        self._index.append(index)
        self._time_s.append(time_s)
        self._reason.append(reason)
        self._blocked.append(blocked)
        self._unsure.append(unsure)
        self._measure_s.append(measure_s)

    def _binding(
        self, layout: Layout, index: int, time_s: float, hull: Hull, shift_m: float
    ) -> Binding:
        number, clearance = tightest_at(hull, layout.moved, layout.move, shift_m)
        return Binding(
            frame=index,
            time_s=time_s,
            object_name=layout.moved_names[number],
            shift_m=shift_m,
            on_hull_world=clearance.on_hull_world,
            on_object_world=clearance.on_object_world,
            clearance_m=np.array(clearance.signed_m),
            required_m=layout.moved[number].clearance_m,
        )

    def answer(
        self,
        name: str,
        settings: dict[str, object],
        shifts_m: NDArray[np.float64],
        agreement: SessionAgreement,
    ) -> SessionSpacing:
        """Return what all frames say together."""
        move = self._layout.move
        whole = np.array([[move.start_m, move.stop_m]])
        free_m = free_of(move, self._together)
        maybe_m = without(whole, union(*(one.violated_m for one in self._blocked)))
        shift_m = float(free_m[0, 0]) if len(free_m) else np.nan
        # What decides ends where the free begins; if nothing is free, it is what is worst at last.
        binding = self._at_end.get(shift_m if len(free_m) else move.stop_m)
        violated, undecided = self._counts(shifts_m)
        at_zero = None
        if move.start_m <= 0 <= move.stop_m:
            counts = self._counts(np.zeros(1))
            at_zero = (int(counts[0][0]), int(counts[1][0]))
        return SessionSpacing(
            name=name,
            settings=settings,
            shift_m=shift_m,
            at_least_m=float(maybe_m[0, 0]) if len(maybe_m) else np.nan,
            binding=binding,
            free_m=free_m,
            curve=SpacingCurve(shifts_m, violated, undecided),
            at_zero=at_zero,
            frames=SpacingFrames(
                index=np.array(self._index, np.uint32),
                time_s=np.array(self._time_s),
                reason=tuple(self._reason),
                violated=make_stretches([one.violated_m for one in self._blocked]),
                undecided=make_stretches([one.undecided_m for one in self._blocked]),
                n_measured=np.array(
                    [
                        one.n_measured + other.n_measured
                        for one, other in zip(self._blocked, self._unsure, strict=True)
                    ],
                    np.uint32,
                ),
                measure_s=np.array(self._measure_s),
            ),
            standing={
                one: (violates, unknown)
                for one, (violates, unknown) in zip(
                    self._layout.standing_names, self._standing.tolist(), strict=True
                )
            },
            doubt=self._doubt() if self._is_doubted else None,
            agreement=agreement,
        )

    def _doubt(self) -> SpacingDoubt:
        """Return the shift that suffices at 95 %, and which frame keeps it from being smaller."""
        move = self._layout.move
        free_m = free_of(move, union(*(one.unsure_m for one in self._unsure)))
        shift_m = float(free_m[0, 0]) if len(free_m) else np.nan
        frame, std_m = None, np.nan
        end_m = shift_m if len(free_m) else move.stop_m
        for index, one in zip(self._index, self._unsure, strict=True):
            if (one.unsure_m[:, 1] == end_m).any() and not std_m >= one.std_m:
                frame, std_m = index, one.std_m
        return SpacingDoubt(
            shift_m=shift_m,
            frame=frame,
            std_m=std_m,
            unsure=make_stretches([one.unsure_m for one in self._unsure]),
            std_by_frame_m=np.array([one.std_m for one in self._unsure]),
        )

    def _counts(
        self, shifts_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Return how many frames violate at shifts (S,), and of how many that is not known."""
        violated = np.zeros(len(shifts_m), np.uint32)
        undecided = np.zeros(len(shifts_m), np.uint32)
        for one in self._blocked:
            certain = covers(one.violated_m, shifts_m)
            violated += certain
            undecided += covers(one.undecided_m, shifts_m) & ~certain
        return violated, undecided


def _spare_m(binding: Binding) -> float:
    return float(binding.clearance_m[1]) - binding.required_m
