"""How steady the list of clashes is: generated recordings, seen again with errors.

The preset "payload", four participants in three layouts each, as ready masks of the true shapes
(`helpers.drawn_task`). Told are

* clashes of a session, and how many contacts of single frames they were gathered from;
* of these clashes, how many have the same id in another run: the same again, every other frame,
  masks whose outlines err by a normal error of one pixel (smooth along the outline, another one in
  each frame and camera), the layout moved by 1 mm along each axis; with the ledger of the first run
  beside the report, as it is when a report is made anew, and without any;
* how many clashes of another participant in the same layout have an id that the ledger had, if they
  share one and it knows a clash of the same object;
* `diff`: of noisy repeats of one layout, each beside the one before, how many show any change; of
  the layout moved by 5 mm, how many show that it is worse, of the same masks and of masks that err.

Run: OPENBLAS_NUM_THREADS=1 python tests/benchmarks/bench_ledger.py [ids] [diff --repeats 200]
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.drawn_task import DrawnTask

from hybridve.hull.batch import DetectSettings, detect_one
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.chain import EvaluateSettings
from hybridve.hull.contact.outline_errors import DoubtSettings
from hybridve.hull.report.changes import Compared, compare_reports
from hybridve.hull.report.clashes import gather_clashes
from hybridve.hull.report.ledger import Ledger, Listed, look_up
from hybridve.hull.report.read import read_report

#: Heights of the gap of the three layouts, mm.
GAPS_MM = (110.0, 150.0, 190.0)

#: The layout that `diff` is asked about, and by how much it is changed: payload A comes lower.
_DIFF_GAP_MM, _LOWER_MM = 150.0, 5.0


class _Silent:
    """Watches and says nothing."""

    def stage(self, what: str, done: int, total: int) -> None: ...
    def say(self, text: str) -> None: ...
    def warn(self, text: str) -> None: ...

    def steps(self, what: str, total: int, *, done: int = 0, unit: str = "frame") -> "_Steps":
        return _Steps()


class _Steps:
    def __enter__(self) -> "_Steps":
        return self

    def __exit__(self, *about: object) -> None: ...
    def __call__(self, n: int = 1) -> None: ...


def detect(session: Path, scene: Path, report: Path, frames: FrameRange | None = None) -> Path:
    """Evaluate a session as the ledger needs it: contacts, clearance and doubt."""
    settings = EvaluateSettings(
        frames=frames or FrameRange(), clearance_m=1e-4, doubt=DoubtSettings()
    )
    detect_one(session, scene, report, DetectSettings(settings, overwrite=True), _Silent())
    return report


def listed(report: Path, ledger: Ledger | None = None) -> tuple[Ledger, tuple[Listed, ...]]:
    """Return the clashes of a report by their ids; in an empty ledger without one."""
    loaded = read_report(report)
    found = gather_clashes(loaded)
    return look_up(ledger or Ledger(report.with_suffix(".toml")), found.clashes, loaded)


def ids_of(report: Path, ledger: Ledger | None = None) -> set[str]:
    return {one.entry.id for one in listed(report, ledger)[1]}


@dataclass
class Tally:
    """How many clashes have the same id in another run, are not in it, or only in it."""

    same: Counter[str] = field(default_factory=Counter)
    gone: Counter[str] = field(default_factory=Counter)
    new: Counter[str] = field(default_factory=Counter)

    def add(self, what: str, before: set[str], after: set[str]) -> None:
        self.same[what] += len(before & after)
        self.gone[what] += len(before - after)
        self.new[what] += len(after - before)

    def lines(self) -> Iterator[str]:
        for what in self.same:
            yield (
                f"  {what}: {self.same[what]} the same, {self.gone[what]} gone, "
                f"{self.new[what]} new\n"
            )


def ids(asked: argparse.Namespace) -> dict[str, float]:
    """Print how many ids are the same in another run, and return it."""
    tally, counts, contacts = Tally(), [], 0
    shared: dict[float, Ledger] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for participant in asked.participants:
            task = DrawnTask("payload", asked.frames, shrink=asked.shrink, participant=participant)
            session = task.write_session(folder / f"p{participant}")
            noisy = task.write_session(folder / f"p{participant} noisy", 1.0, seed=participant)
            for gap_mm in asked.gaps:
                layout = DrawnTask("payload", 2, participant=participant, gap_mm=gap_mm)
                scene = layout.write_scene(folder / "layout")
                moved = layout.write_scene(folder / "layout", (1.0, 1.0, 1.0), "moved.toml")
                report = detect(session, scene, folder / "base.h5")
                loaded = read_report(report)
                found = gather_clashes(loaded)
                ledger, first = listed(report)
                before = {one.entry.id for one in first}
                counts.append(len(first))
                contacts += found.n_patches
                for one in first:
                    sys.stdout.write(
                        f"    p{participant} {gap_mm:g}: {one.entry.id} {one.clash.kind} "
                        f"{len(one.clash.frames)} frames {one.clash.worst.clearance_m}\n"
                    )
                again = {
                    "the same again": detect(session, scene, folder / "again.h5"),
                    "every other frame": detect(
                        session, scene, folder / "half.h5", FrameRange(0, None, 2)
                    ),
                    "outlines off by a pixel": detect(noisy, scene, folder / "noisy.h5"),
                    "moved by 1 mm": detect(session, moved, folder / "moved.h5"),
                }
                for what, other in again.items():
                    tally.add(f"{what}, with the ledger", before, ids_of(other, ledger))
                    tally.add(f"{what}, without", before, ids_of(other))
                ledger = shared.get(gap_mm, Ledger(folder / "shared.toml"))
                known = {entry.id for entry in ledger.entries}
                objects = {entry.object for entry in ledger.entries}
                shared[gap_mm], now = listed(report, ledger)
                asked_of = {one.entry.id for one in now if one.clash.name in objects}
                tally.add("another participant, shared ledger", known & asked_of, asked_of)
    sys.stdout.write(
        f"{len(counts)} sessions: clashes {counts}, of {contacts} contacts of single frames\n"
    )
    sys.stdout.writelines(tally.lines())
    told: dict[str, float] = {
        "clashes_most": max(counts),
        "clashes_mean": sum(counts) / len(counts),
    }
    for what in tally.same:
        for kind, count in (("same", tally.same), ("gone", tally.gone), ("new", tally.new)):
            told[f"{what}.{kind}"] = count[what]
    return told


@dataclass
class Told:
    """What `diff` told, of how many that it was asked."""

    repeats: int = 0
    changed: int = 0
    real: int = 0
    found: int = 0
    allowed: int = 0
    found_of_allowed: int = 0

    def text(self) -> str:
        return (
            f"diff: {self.changed} of {self.repeats} noisy repeats show a change; payload A lower "
            f"by {_LOWER_MM:g} mm is found in {self.found} of {self.real} of the same masks, and "
            f"in {self.found_of_allowed} of {self.allowed} of masks that err, where what is stated "
            "is less than that\n"
        )


def diff(asked: argparse.Namespace) -> dict[str, float]:
    """Print how often `diff` tells a change of noisy repeats, and of a real one."""
    told = Told()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        task = DrawnTask(
            "payload", asked.few_frames, shrink=asked.shrink, participant=2, gap_mm=_DIFF_GAP_MM
        )
        scene = task.write_scene(folder / "layout")
        lower = task.write_scene(
            folder / "layout", (0.0, 0.0, -_LOWER_MM), "lower.toml", only="payload_a"
        )
        before = None
        for seed in range(asked.repeats + 1):
            session = task.write_session(folder / "session", 1.0, seed=seed)
            # The one before is still read from its file.
            now = read_report(detect(session, scene, folder / f"{seed % 2}.h5"))
            if before is not None:
                compared = compare_reports(before, now)
                told.repeats += 1
                changes = [(one.id, one.change) for one in compared.clashes if is_change(one)]
                told.changed += bool(changes)
                if changes:
                    sys.stdout.write(f"  repeat {seed}: {changes}\n")
            if seed % asked.every == 0:
                near = read_report(detect(session, lower, folder / "lower.h5"))
                told.real += 1
                told.found += compare_reports(now, near).is_worse
                if before is not None:
                    other = compare_reports(before, near)
                    of_part = [one for one in other.clashes if one.id.startswith("payload_a")]
                    if any(one.beyond_m < _LOWER_MM / 1e3 for one in of_part):
                        told.allowed += 1
                        told.found_of_allowed += other.is_worse
                sys.stdout.write(told.text())
                sys.stdout.flush()
            before = now
    sys.stdout.write(told.text())
    return {f"diff.{key}": value for key, value in vars(told).items()}


def is_change(one: Compared) -> bool:
    return one.change not in ("same", "unclear")


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Run what is asked for, and return its counts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("kinds", nargs="*", help="ids, diff; both if left out")
    parser.add_argument("--frames", type=int, default=48, help="of a session")
    parser.add_argument("--few-frames", type=int, default=16, help="of a session for diff")
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--every", type=int, default=10, help="a real change so many repeats")
    parser.add_argument("--participants", type=int, nargs="*", default=[1, 2, 3, 4])
    parser.add_argument("--gaps", type=float, nargs="*", default=list(GAPS_MM))
    parser.add_argument("--shrink", type=int, default=1, help="so many times fewer pixels each way")
    parser.add_argument("--smallest", action="store_true", help="once, few frames, small pictures")
    asked = parser.parse_args(arguments)
    if asked.smallest:
        asked.frames, asked.repeats, asked.participants, asked.gaps = 4, 1, [1], [110.0]
        asked.few_frames, asked.every, asked.shrink = 2, 2, 4
    kinds = asked.kinds or ["ids", "diff"]
    told: dict[str, float] = {}
    if "ids" in kinds:
        told |= ids(asked)
    if "diff" in kinds:
        told |= diff(asked)
    return told


if __name__ == "__main__":
    main()
