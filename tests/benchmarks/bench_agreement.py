"""Cameras that contradict each other: which faults are named, how sure sizes are, what it costs.

* **table**: sessions spoilt in every way of `helpers.spoils`, each for two cameras. Generated ones
  are calibrated and evaluated into reports, with verdicts as frames say them and as the report
  keeps them; where a camera is late, all silhouettes are true ones with erring outlines, as
  pictures are there for whole frames only. Of real ones every fourth frame is taken, and the
  silhouettes judged; as they are, all frames are.
* **draws**: recordings whose true silhouettes err by a smooth normal error, another one for each
  camera and frame, and one that a camera keeps: clean ones, and such with a camera that is late or
  bumped. How often something is named that is not there, and how often sizes are within the 95 %
  that is stated.
* **cost**: milliseconds a frame with 4, 10 and 20 cameras, and the share of it in `detect`.

Run: OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_agreement.py
         [table|draws|cost] [--sessions boxes horseman ...] [--repeats 25]
"""

import argparse
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.seen import Drawn, Recorded, Recording
from helpers.sessions import ball_mask, ring_matrix
from helpers.spoils import OUTCOMES, Spoil, Told, for_all, spoils, told

from hybridve.calib.camera import Camera
from hybridve.calib.formats.rig_json import write_rig
from hybridve.calib.lens import Undistortion, undistortion
from hybridve.calib.rig import Rig
from hybridve.cli.progress import Terminal
from hybridve.hull import trust
from hybridve.hull.agreement.outlines import outline_of
from hybridve.hull.agreement.record import SessionAgreement
from hybridve.hull.agreement.session import judge_session
from hybridve.hull.batch import DetectSettings, write_report
from hybridve.hull.cad.scene import load_scene
from hybridve.hull.capture.recording import FrameRange, FrameSilhouettes
from hybridve.hull.capture.rig import calibrate_session, has_rig, load_rig
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.chain import Chain, EvaluateSettings, make_chain, rig_views
from hybridve.hull.contact.outline_errors import DoubtSettings
from hybridve.hull.query.silhouettes import Views, make_hull, make_views
from hybridve.hull.report import write
from hybridve.hull.report.read import read_report
from hybridve.hull.report.withdraw import withdrawn
from hybridve.hull.synth.presets import PRESETS
from hybridve.hull.synth.truth import Truth, read_truth
from hybridve.hull.synth.write import write_session
from hybridve.hull.trust import Witness

PROJECT = Path(__file__).parents[2]

GENERATED = tuple(PRESETS)
REAL = ("horseman", "child_rope")

#: Which frames of a real session are spoilt: every so many-th, over all of it.
_STEPS = {"horseman": 4, "child_rope": 4}

#: Cameras of a session that things are done to.
_CAMERAS = (1, -1)


@dataclass
class Row:
    """What was said of one fault, over sessions and cameras."""

    told: list[tuple[str, Spoil, Told]] = field(default_factory=list)
    verdicts: list["Verdicts"] = field(default_factory=list)
    n_trusted: int = 0

    def share(self, *outcomes: str) -> float:
        """Return how many of those asked were named so, from 0 to 1."""
        found = [one.outcome for _, _, one in self.told]
        return sum(one in outcomes for one in found) / len(found)


@dataclass(frozen=True)
class Verdicts:
    """Rows of objects and frames, counted.

    Attributes
    ----------
    n : int
        All.
    free, kept : (int, int)
        Certified free, and kept: as single frames say, and as the report says.
    unsafe : (int, int)
        Either, while the true shapes are in the object.
    held, asked : int
        Of the clearances that the report states at 95 % those that are none too large for the true
        shapes, and all of them, of objects that are not touched.
    is_trusted : bool
        Whether the session is usable.
    """

    n: int
    free: tuple[int, int]
    kept: tuple[int, int]
    unsafe: tuple[int, int]
    held: int
    asked: int
    is_trusted: bool


def judge(recording: Recording, spoil: Spoil) -> SessionAgreement:
    """Return what the cameras say about each other in a spoilt recording."""
    witness = Witness.of(recording.views, recording.lenses, is_still=True)
    frames = [
        witness.look(
            index,
            make_hull(recording.views, recording.undistorted(spoil.masks(recording, index))),
        )[1]
        for index in spoil.frames(recording)
    ]
    names = recording.views.names
    return judge_session(
        recording.views, frames, offset_s=dict.fromkeys(names, 0.0), fps=recording.fps
    )


class Evaluated:
    """A generated recording, to be evaluated again and again with what is wrong with it."""

    def __init__(self, name: str, folder: Path, n_frames: int | None = None) -> None:
        write_session(name, folder, n_frames=n_frames)
        session = load_session(folder)
        calibrated(session)
        settings = EvaluateSettings(clearance_m=1e-4, doubt=DoubtSettings())
        self.chain: Chain = make_chain(session, load_scene(folder / "scene.toml"), settings)
        self._truth: Truth = read_truth(folder)
        self._folder = folder
        names = self.chain.views.names
        believed = tuple(self.chain.rig[one] for one in names)
        by_name = {camera.name: camera for camera in self._truth.cameras}
        same = believed, self.chain.views, self.chain.undistortions
        self.recorded = Recorded(session, *same)
        stage = PRESETS[name].make_stage(**{o.name: o.default for o in PRESETS[name].options})
        true = tuple(by_name[one] for one in names)
        self.drawn = Drawn(stage, true, *same, self.recorded.n_frames, session.fps)

    def evaluate(self, spoil: Spoil) -> tuple[SessionAgreement, Verdicts]:
        """Return what the cameras say about each other, and what becomes of verdicts."""
        recording: Recording = self.drawn if spoil.late else self.recorded

        def silhouettes(*_: Any, **__: Any) -> Generator[FrameSilhouettes]:
            for index in spoil.frames(recording):
                masks = recording.undistorted(spoil.masks(recording, index))
                yield FrameSilhouettes(index, masks, "", 0.0, 0.0)

        before: list[tuple[NDArray[np.str_], NDArray[np.str_]]] = []

        def watched(
            verdict: NDArray[np.str_],
            reason: NDArray[np.str_],
            certificate: NDArray[np.str_],
            wrong: Sequence[str],
        ) -> tuple[NDArray[np.str_], NDArray[np.str_], NDArray[np.str_]]:
            before.append((verdict, certificate))
            return withdrawn(verdict, reason, certificate, wrong)

        path = self._folder / "report.h5"
        with (
            patch("hybridve.hull.chain.silhouettes_of", silhouettes),
            patch.object(write, "withdrawn", watched),
        ):
            settings = DetectSettings(self.chain.settings, overwrite=True)
            write_report(self.chain, path, settings, Terminal(enabled=False))
        report = read_report(path)
        index = report.index.astype(int)
        n, held, asked = 0, 0, 0
        counts = np.zeros((3, 2), int)
        for (name, after), first in zip(report.objects.items(), before, strict=True):
            truth = self._truth.objects[name]
            touches = truth.collides[index]
            n += len(index)
            for side, (verdict, certificate) in enumerate(
                (first, (after.verdict, after.certificate))
            ):
                free, kept = certificate == "free", verdict == "kept"
                counts[:, side] += [one.sum() for one in (free, kept, (free | kept) & touches)]
            at_least_m = after["clearance_at_least_m"]
            is_asked = np.isfinite(at_least_m) & ~touches
            asked += int(is_asked.sum())
            held += int((at_least_m <= truth.clearance_m[index])[is_asked].sum())
        pairs = [(int(one[0]), int(one[1])) for one in counts]
        found = report.agreement
        return found, Verdicts(n, pairs[0], pairs[1], pairs[2], held, asked, found.is_trusted)


def calibrated(session: Session) -> Rig:
    """Return the rig of a session, calibrated if that was not done yet."""
    if not has_rig(session):
        path = session.folder / "rig" / "rig.json"
        path.parent.mkdir(exist_ok=True)
        write_rig(path, calibrate_session(session).rig)
    return load_rig(session)


def real(name: str, step: int) -> Recorded:
    """Return every so many-th frame of a real session."""
    session = load_session(PROJECT / "data" / name)
    rig = calibrated(session)
    views, lenses = rig_views(session, rig)
    cameras = tuple(rig[one] for one in views.names)
    return Recorded(session, cameras, views, lenses, step)


def all_spoils(recording: Recording) -> Iterator[Spoil]:
    """Yield what is done to a recording: to two cameras each, and to all."""
    yield from for_all(recording)
    for number, camera in enumerate(_CAMERAS):
        camera %= len(recording.cameras)
        for spoil in spoils(recording, camera, partner(recording, camera)):
            if number and len(spoil.cameras) == len(recording.cameras):
                continue  # all are inverted once
            if spoil.applies(recording):
                yield spoil


def partner(recording: Recording, camera: int) -> int | None:
    """Return the next camera that has pictures as large; others are refused in its place."""
    count = len(recording.cameras)
    sizes = [(one.width_px, one.height_px) for one in recording.cameras]
    others = [(camera + 1 + k) % count for k in range(count - 1)]
    return next((other for other in others if sizes[other] == sizes[camera]), None)


def table(asked: argparse.Namespace) -> dict[str, float]:
    """Print what is said of sessions that are spoilt, and return counts."""
    rows: dict[str, Row] = defaultdict(Row)
    for name in asked.sessions:
        with tempfile.TemporaryDirectory() as folder:
            one = Evaluated(name, Path(folder) / name, asked.frames) if name in GENERATED else None
            recording = one.recorded if one else real(name, asked.step or _STEPS[name])
            if one is None and not asked.only:
                whole = judge(real(name, 1), Spoil("none"))
                said = told(whole, Spoil("none"), ())
                row = rows["none, all frames"]
                row.told.append((name, Spoil("none"), said))
                row.n_trusted += whole.is_trusted
                _say(f"{name:10} {'none, all frames':48} {said.outcome:8} {said.text}")
            for spoil in all_spoils(one.drawn if one else recording):
                if asked.only and not any(spoil.name.startswith(each) for each in asked.only):
                    continue
                row = rows[spoil.name]
                if one is not None and not asked.silhouettes:
                    found, verdicts = one.evaluate(spoil)
                    row.verdicts.append(verdicts)
                else:
                    found = judge(one.drawn if one and spoil.late else recording, spoil)
                row.n_trusted += found.is_trusted
                trusted = "trusted" if found.is_trusted else "-"
                said = told(found, spoil, recording.views.names)
                row.told.append((name, spoil, said))
                who = "+".join(recording.views.names[camera] for camera in spoil.cameras)
                _say(f"{name:10} {spoil.name:26} {who:12} {trusted:8} {said.outcome:8} {said.text}")
    return _print_table(rows)


def _print_table(rows: dict[str, Row]) -> dict[str, float]:
    _say(f"\n{'fault':26} {' '.join(f'{one:>8}' for one in OUTCOMES)} trusted  sizes")
    numbers: dict[str, float] = {}
    gross_free = gross_named = n_gross = held = asked = 0
    for name, row in rows.items():
        counts = [sum(one.outcome == each for _, _, one in row.told) for each in OUTCOMES]
        sizes = [
            (spoil.size, one.cause.size)
            for _, spoil, one in row.told
            if one.cause and one.cause.size is not None and np.isfinite(spoil.size)
        ]
        error = [abs(found) - abs(size) for size, found in sizes]
        text = f"{min(error):+.2f} to {max(error):+.2f}" if error else ""
        verdicts = row.verdicts
        if verdicts:
            pairs = [
                [sum(getattr(one, what)[side] for one in verdicts) for side in (0, 1)]
                for what in ("free", "kept", "unsafe")
            ]
            text += "; free {} -> {}, kept {} -> {}, wrongly {} -> {}".format(
                *(one for pair in pairs for one in pair)
            )
            text += f" of {sum(one.n for one in verdicts)}"
        usable = [one for one in verdicts if one.is_trusted]
        held += sum(one.held for one in usable)
        asked += sum(one.asked for one in usable)
        if usable and (n := sum(one.asked for one in usable)):
            text += f"; at least held {sum(one.held for one in usable) / n:.1%} of {n}"
        _say(
            f"{name:26} {' '.join(f'{one:8}' for one in counts)} "
            f"{row.n_trusted:3}/{len(row.told):<3}  {text}"
        )
        if row.told[0][1].is_gross:
            n_gross += len(row.told)
            gross_named += sum(
                one.outcome in ("rightly", "beside", "instead", "cannot") for _, _, one in row.told
            )
            gross_free += sum(one.free[1] for one in verdicts)
        numbers[f"table[{name}].rightly"] = counts[0]
        numbers[f"table[{name}].asked"] = len(row.told)
    numbers["gross.named_or_cannot_tell"] = gross_named
    numbers["gross.asked"] = n_gross
    numbers["gross.certified_free"] = gross_free
    if asked:
        numbers["usable.clearance_at_least_held_share"] = held / asked
    _say(
        f"gross: {gross_named} of {n_gross} named or said not to be told, {gross_free} certified "
        f"free; at least held where usable: {held} of {asked}"
    )
    return numbers


# ---------------------------------------------------------------------------- draws


def drawn(name: str, n_frames: int, std_px: float, constant_px: float) -> Drawn:
    """Return a generated recording without lens distortion, whose rig is the true one."""
    preset = PRESETS[name]
    stage = preset.make_stage(**{one.name: one.default for one in preset.options})
    cameras = tuple(
        replace(camera, model="PINHOLE", params=camera.params[:4]) for camera in stage.cameras
    )
    lenses = [undistortion(camera) for camera in cameras]
    views = _views(cameras, lenses)
    return Drawn(stage, cameras, cameras, views, lenses, n_frames, preset.fps, std_px, constant_px)


def _views(cameras: Sequence[Camera], lenses: Sequence[Undistortion]) -> Views:
    return make_views(
        tuple(camera.name for camera in cameras),
        np.array([(lens.width_px, lens.height_px) for lens in lenses], np.int64),
        np.array(
            [
                lens.img_from_cam @ camera.cam_from_world
                for lens, camera in zip(lenses, cameras, strict=True)
            ]
        ),
    )


@dataclass
class Draws:
    """What draws of one fault say of its size.

    Attributes
    ----------
    n : int
        How many there were.
    outcomes : dict of str to int
        How it was named.
    errors : list of float
        Of sizes that were told, those named or not.
    pulls : list of float
        Those errors by the standard errors stated.
    within, named : int
        Of those named, how many were within the interval stated; all of them.
    """

    n: int = 0
    outcomes: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    errors: list[float] = field(default_factory=list)
    pulls: list[float] = field(default_factory=list)
    within: int = 0
    named: int = 0

    def add(self, said: Told, size: float) -> None:
        """Count one."""
        self.n += 1
        self.outcomes[said.outcome] += 1
        cause = said.cause
        if cause is not None and cause.low is not None and cause.high is not None:
            self.named += 1
            self.within += cause.low <= size <= cause.high

    def text(self) -> str:
        """Return it in words."""
        named = ", ".join(f"{count} {what}" for what, count in sorted(self.outcomes.items()))
        text = f"{self.n}: {named}; within the interval of the cause {self.within} of {self.named}"
        if self.errors:
            inside = int((np.abs(self.pulls) <= 1.96).sum())
            text += (
                f"; of the camera's own {inside} of {len(self.pulls)} "
                f"({inside / len(self.pulls):.1%}), error rms "
                f"{np.sqrt(np.mean(np.square(self.errors))):.3f}, largest "
                f"{np.abs(self.errors).max():.2f}"
            )
        return text


def draws(asked: argparse.Namespace) -> dict[str, float]:
    """Print how often something is named that is not there, and how sure sizes are."""
    clean, late, bumped = Draws(), defaultdict[str, Draws](Draws), defaultdict[str, Draws](Draws)
    n_alarms, seed = 0, 0
    for name in asked.sessions:
        if name not in GENERATED:
            continue
        n_frames = asked.frames or PRESETS[name].n_frames
        recording = drawn(name, n_frames, asked.mask_std_px, asked.constant_std_px)
        names = recording.views.names
        of_late, of_bumped = Draws(), Draws()
        for _ in range(asked.repeats):
            seed += 1
            rng = np.random.default_rng([asked.seed, seed])
            recording.seed, recording.moved_px = seed, np.zeros((len(names), 2))
            found = judge(recording, Spoil("none"))
            said = told(found, Spoil("none"), names)
            clean.add(said, np.nan)
            if said.outcome != "rightly":
                n_alarms += 1
                _tell(f"{name}, clean", seed, said)
            for of_camera in names:
                _own(clean, found, of_camera, 0.0, np.zeros(2))
            camera = int(rng.integers(2))
            size = float(rng.choice([-1.0, 1.0]) * rng.choice([0.3, 1.0, 2.5, 6.0]))
            spoil = Spoil("late", "late", (camera,), late=size)
            if spoil.applies(recording):
                found = judge(recording, spoil)
                said = told(found, spoil, names)
                for each in (of_late, late[f"{abs(size):g}"]):
                    each.add(said, size)
                    _own(each, found, names[camera], size, None)
                if said.outcome != "rightly" and abs(size) >= 1.0:
                    _tell(f"{name}, {names[camera]} late {size:g}", seed, said)
            angle, px = rng.uniform(0.0, 2.0 * np.pi), float(rng.choice([1.0, 3.0, 6.0, 20.0]))
            shift = px * np.array([np.cos(angle), np.sin(angle)])
            recording.moved_px[camera] = shift
            spoil = Spoil("bumped", "bumped", (camera,), moved_px=shift)
            found = judge(recording, spoil)
            said = told(found, spoil, names)
            for each in (of_bumped, bumped[f"{px:g}"]):
                each.add(said, px)
                _own(each, found, names[camera], None, shift)
            if said.outcome != "rightly" and px >= 3.0:
                _tell(f"{name}, {names[camera]} bumped {shift.round(1)}", seed, said)
            recording.moved_px[camera] = 0.0
        _say(f"{name}: late {of_late.text()}\n{name}: bumped {of_bumped.text()}")
    _say(f"clean {clean.text()}; alarms {n_alarms}")
    numbers: dict[str, float] = {"draws.clean": clean.n, "draws.false_alarms": n_alarms}
    for what, by_size in (("late", late), ("bumped", bumped)):
        for size_text, one in sorted(by_size.items(), key=lambda pair: float(pair[0])):
            _say(f"{what} {size_text}: {one.text()}")
            key = f"draws.{what}[{size_text}]"
            numbers[f"{key}.asked"] = one.n
            numbers[f"{key}.rightly"] = one.outcomes["rightly"]
            if one.pulls:
                numbers[f"{key}.within_95_share"] = float(np.mean(np.abs(one.pulls) <= 1.96))
                numbers[f"{key}.error_rms"] = float(np.sqrt(np.mean(np.square(one.errors))))
    return numbers


def _tell(what: str, seed: int, said: Told) -> None:
    _say(f"{what}, seed {seed}, {said.outcome}: {said.text}")


def _own(
    tally: Draws,
    found: SessionAgreement,
    camera: str,
    late: float | None,
    moved_px: NDArray[np.float64] | None,
) -> None:
    """Count what is stated of a camera, whether it is named or not."""
    one = found.cameras[camera]
    if late is not None and one.late_frames is not None and one.late_se_frames:
        tally.errors.append(one.late_frames - late)
        tally.pulls.append(tally.errors[-1] / one.late_se_frames)
    if moved_px is not None and one.moved_px is not None and one.moved_se_px is not None:
        for value, true, error in zip(one.moved_px, moved_px, one.moved_se_px, strict=True):
            tally.errors.append(value - float(true))
            tally.pulls.append(tally.errors[-1] / max(error, 1e-9))


# ---------------------------------------------------------------------------- cost


def cost(asked: argparse.Namespace) -> dict[str, float]:
    """Print what it takes, and return it."""
    n_frames = asked.frames or 48
    numbers: dict[str, float] = {}
    for n_cameras in (4, 10, 20):
        matrices = np.array([ring_matrix(camera, n_cameras) for camera in range(n_cameras)])
        moments = np.linspace(0.0, 2.0 * np.pi, n_frames)
        centres = 0.2 * np.column_stack([np.cos(moments), np.sin(moments), np.sin(2 * moments)])
        masks = [[ball_mask(one, centre) for one in matrices] for centre in centres]
        sizes_px = np.array([masks[0][0].shape[::-1]] * n_cameras, np.int64)
        names = tuple(f"cam{camera}" for camera in range(n_cameras))
        views = make_views(names, sizes_px, matrices)
        numbers |= _cost_of(f"balls, {n_cameras} cameras", views, masks)
    if not asked.smallest:
        for name in REAL:
            recording = real(name, _STEPS[name])
            frames = [
                recording.undistorted(recording.frame(index)) for index in range(recording.n_frames)
            ]
            numbers |= _cost_of(f"{name}, {len(frames[0])} cameras", recording.views, frames)
        views, masks_of_person = dome_person()
        numbers |= _cost_of("dome_person, 20 cameras", views, [masks_of_person] * 24)
        numbers |= _cost_in_detect()
    return numbers


def _cost_of(what: str, views: Views, masks: list[list[NDArray[np.uint8]]]) -> dict[str, float]:
    lenses = [
        Undistortion(width, height, np.eye(3), None, None)
        for width, height in views.sizes_px.tolist()
    ]
    witness = Witness.of(views, lenses, is_still=True)
    hulls = [make_hull(views, frame) for frame in masks]
    witness.look(0, hulls[0])  # compiled
    taken_s, outlines_s, frames = [], [], []
    for index, hull in enumerate(hulls):
        started = time.perf_counter()
        frames.append(witness.look(index, hull)[1])
        taken_s.append(time.perf_counter() - started)
        started = time.perf_counter()
        for camera in range(len(views)):
            outline_of(hull.mask(camera))
        outlines_s.append(time.perf_counter() - started)
    offset_s = dict.fromkeys(views.names, 0.0)
    judge_session(views, frames, offset_s=offset_s, fps=25.0)  # compiled
    started = time.perf_counter()
    judge_session(views, frames, offset_s=offset_s, fps=25.0)
    judged_s = (time.perf_counter() - started) / len(frames)
    found = {
        "look_ms": 1e3 * float(np.median(taken_s)),
        "outlines_ms": 1e3 * float(np.median(outlines_s)),
        "judge_ms": 1e3 * judged_s,
    }
    _say(
        f"{what}: look {found['look_ms']:.1f} ms a frame, of which outlines "
        f"{found['outlines_ms']:.1f}; judge {found['judge_ms']:.1f} ms a frame of {len(frames)}"
    )
    return {f"cost[{what}].{key}": value for key, value in found.items()}


def dome_person() -> tuple[Views, list[NDArray[np.uint8]]]:
    """Return one instant of a person, seen by 20 cameras."""
    folder = Path(os.environ.get("HYBRIDVE_DATA", PROJECT.parent / "shared/data")) / "dome_person"
    values = np.array((folder / "calibParamsI.txt").read_text(encoding="utf-8").split(), float)
    sizes, matrices, masks, names = [], [], [], []
    for number, *rest in values.reshape(-1, 24):
        matrix = np.array(rest[:9]).reshape(3, 3)
        pose = np.array(rest[11:]).reshape(3, 4)
        name = f"WD2_{int(number)}_00020_segmented.png"
        image = cv2.imread(str(folder / "masks" / name), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        bent = np.array([rest[9], rest[10], 0.0, 0.0])
        mask = np.asarray(cv2.undistort(image, matrix, bent) > 127, np.uint8)
        centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        sizes.append(mask.shape[::-1])
        matrices.append(centre @ matrix @ pose)
        masks.append(mask)
        names.append(f"cam{int(number)}")
    return make_views(tuple(names), np.array(sizes, np.int64), np.array(matrices)), masks


def _cost_in_detect() -> dict[str, float]:
    """Return which share of `detect` on horseman outlines and their judgement take."""
    folder = PROJECT / "data/horseman"
    settings = EvaluateSettings(
        FrameRange(0, 100), clearance_m=1e-4, doubt=DoubtSettings(), response=None
    )
    session = load_session(folder)
    calibrated(session)
    chain = make_chain(session, load_scene(folder / "scene.toml"), settings)
    spent_s = [0.0]

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            started = time.perf_counter()
            try:
                return function(*given, **named)
            finally:
                spent_s[0] += time.perf_counter() - started

        return call

    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        stack.enter_context(patch("hybridve.hull.trust.outline_of", timed(outline_of)))
        stack.enter_context(patch("hybridve.hull.batch.judge_cameras", timed(trust.judge_cameras)))
        started = time.perf_counter()
        write_report(chain, Path(place) / "r.h5", DetectSettings(settings), Terminal(enabled=False))
        all_s = time.perf_counter() - started
    _say(f"detect, 100 frames of horseman: {all_s:.1f} s, of which {spent_s[0]:.2f} s for this")
    return {"cost[detect].share_percent": 100.0 * spent_s[0] / (all_s - spent_s[0])}


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, float]]] = {
    "table": table,
    "draws": draws,
    "cost": cost,
}


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Run what is asked for, and return its numbers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--sessions", nargs="+", choices=GENERATED + REAL, default=GENERATED + REAL)
    parser.add_argument("--repeats", type=int, default=25, help="draws of each generated session")
    parser.add_argument("--mask-std-px", type=float, default=1.0, help="of draws, in each frame")
    parser.add_argument("--constant-std-px", type=float, default=0.5, help="all the time")
    parser.add_argument("--frames", type=int, help="of generated sessions")
    parser.add_argument("--only", nargs="+", help="faults whose names begin so")
    parser.add_argument("--step", type=int, help="every which frame of real sessions is spoilt")
    parser.add_argument("--silhouettes", action="store_true", help="write no reports")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smallest", action="store_true", help="one draw, no table")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"there is no part {', '.join(sorted(unknown))}; one of {', '.join(PARTS)}")
    cv2.setNumThreads(1)
    parts = asked.parts or list(PARTS)
    if asked.smallest:
        asked.repeats, asked.frames, asked.sessions, parts = 1, 12, ["ball"], ["draws", "cost"]
    numbers: dict[str, float] = {}
    for part in parts:
        numbers |= PARTS[part](asked)
    return numbers


if __name__ == "__main__":
    main()
