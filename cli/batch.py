"""``hybridve batch``: sessions by layouts by settings, overnight."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridve.cli import options
from hybridve.cli.progress import Terminal

if TYPE_CHECKING:
    from hybridve.hull.units import Batch, Unit

#: The table of all reports, in their folder.
COMPARISON = "COMPARISON.csv"

#: The folder of what each unit told, in that of the results.
LOGS = "logs"


def _files(values: dict[str, Any]) -> options.Files:
    return options.Files(reads=[values["batch"]])


@click.command(
    cls=options.Command,
    files=_files,
    short_help="Run sessions by layouts by settings, and lose nothing.",
)
@click.argument("batch", metavar="BATCH.toml", type=click.Path(path_type=Path))
@click.option(
    "--list",
    "only_list",
    is_flag=True,
    help="Print what is to be done as command lines, one each, for make, xargs, Snakemake or an "
    "array of jobs.",
)
@click.option(
    "--dry-run",
    is_flag=True,
    help="Tell what would be done, what stands already, and about how long it takes.",
)
@click.option(
    "--workers",
    type=click.IntRange(1),
    help="How many processes work side by side, each on its share of the processors. Default: one "
    "for each two processors.",
)
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Run on a Dask cluster instead: the address of its scheduler (tcp://...), or its "
    "scheduler file; all its workers must see the files under the same names.",
)
@options.overwrite_option
@options.json_option
@options.quiet_progress
def batch(
    batch: Path,
    only_list: bool,
    dry_run: bool,
    workers: int | None,
    cluster: str | None,
    overwrite: bool,
    as_json: bool,
    progress: bool,
) -> None:
    r"""Run `hybridve detect` for every session, layout and setting that BATCH.toml names.

    A report each goes into the batch's output folder, with a line each in MANIFEST.jsonl, what it
    told in logs/, and a table of all in COMPARISON.csv. What fails is told at the end with its
    reason and stops nothing else; the same call again runs what failed or is missing, and leaves
    alone what verifies: by checksum, versions, command and inputs.

    \b
    Example:
      hybridve batch night.toml --dry-run
      hybridve batch night.toml --workers 4
      hybridve batch night.toml --list | xargs -P2 -d '\n' -n1 sh -c
    """
    from hybridve.hull.units import load_batch

    loaded = load_batch(batch)
    _check_lines(loaded)
    if only_list:
        for unit in loaded.units:
            click.echo(_resuming(unit).line)
        return
    night = Night.of(loaded, overwrite=overwrite)
    if dry_run:
        _tell_plan(night, workers, as_json=as_json)
        return
    night.run(workers, cluster, Terminal(enabled=progress))
    _tell(night, as_json=as_json)


def _check_lines(loaded: "Batch") -> None:
    """Parse each command line, so that a wrong option is told before anything runs."""
    from hybridve.calib.errors import SessionError
    from hybridve.cli.detect import detect

    for unit in loaded.units:
        try:
            detect.make_context("detect", list(unit.words[1:])).close()
        except click.ClickException as error:
            raise SessionError(
                f"{loaded.path}: {unit.name}: {error.format_message().rstrip('.')}"
            ) from None


def _resuming(unit: "Unit", how: str = "--resume") -> "Unit":
    from dataclasses import replace

    return replace(unit, words=(*unit.words, how, "--no-progress"))


@dataclass
class Night:
    """A batch that is run.

    Attributes
    ----------
    batch : Batch
        What is asked for.
    made : dict
        Of each unit a checksum of what decides its result.
    standing : dict
        What the manifest says of units, from before and from now.
    verified : set of str
        Units whose results stand and verify.
    overwrite : bool
        Whether even those are made anew.
    """

    batch: "Batch"
    made: dict[str, str]
    standing: dict[str, dict[str, Any]]
    overwrite: bool
    verified: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, batch: "Batch", *, overwrite: bool) -> "Night":
        """Return it, with what stands looked up and verified."""
        from hybridve.hull.manifest import MANIFEST, made_of, read_records, verifies
        from hybridve.hull.report.machine import software_versions

        versions = software_versions()
        made = {
            unit.name: made_of(unit.words, (unit.session_path, unit.scene_path), versions)
            for unit in batch.units
        }
        standing = read_records(batch.output / MANIFEST)
        night = cls(batch, made, standing, overwrite)
        if not overwrite:
            night.verified = {
                unit.name
                for unit in batch.units
                if verifies(standing.get(unit.name), unit.output, made[unit.name])
            }
        return night

    @property
    def missing(self) -> "list[Unit]":
        """Units that are to be run."""
        return [unit for unit in self.batch.units if unit.name not in self.verified]

    def job_line(self, unit: "Unit") -> "Unit":
        """Return a unit with how it begins: anew where what stands is of something else."""
        before = self.standing.get(unit.name)
        is_other = before is not None and before.get("made_of") != self.made[unit.name]
        is_spoilt = before is not None and before.get("outcome") == "done"
        anew = self.overwrite or is_other or is_spoilt
        return _resuming(unit, "--overwrite" if anew else "--resume")

    def run(self, workers: int | None, cluster: str | None, watcher: Terminal) -> None:
        """Run what is missing."""
        from hybridve.calib.errors import ReportError
        from hybridve.calib.holding import holding
        from hybridve.cli.unit import Job
        from hybridve.hull.manifest import MANIFEST

        folder = self.batch.output
        try:
            (folder / LOGS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ReportError(f"{folder}: cannot be made: {error.strerror}") from error
        with holding(folder / MANIFEST, options.command_line()):
            missing = self.missing
            watcher.say(
                f"{folder}: {options.counted(len(self.batch.units), 'unit')}, "
                f"{len(self.verified)} stand already"
            )
            jobs = [
                Job(unit.name, self.job_line(unit).words, str(folder / LOGS / f"{unit.name}.log"))
                for unit in missing
            ]
            if not jobs:
                return
            n_all, n_stand = len(self.batch.units), len(self.verified)
            with watcher.steps("batch", n_all, done=n_stand, unit="unit") as advance:

                def ended(job: Job, answer: Any) -> None:
                    self._keep(job.unit, answer, watcher)
                    advance()

                _work_off(jobs, workers, cluster, ended)

    def _keep(self, name: str, answer: Any, watcher: Terminal) -> None:
        """Write down how a unit ended."""
        from hybridve.hull.manifest import MANIFEST, append_record, checksum
        from hybridve.hull.report.machine import machine_text, software_versions, utc_now

        unit = next(one for one in self.batch.units if one.name == name)
        is_answer = not isinstance(answer, Exception)
        # 3 and 5: what was asked to fail on is a result.
        is_done = is_answer and answer.status in (0, 3, 5)
        record = {
            "unit": name,
            "outcome": "done" if is_done else "failed",
            "status": answer.status if is_answer else None,
            "reason": answer.reason if is_answer else str(answer),
            "line": unit.line,
            "made_of": self.made[name],
            "result": unit.output.name,
            "sha256": checksum(unit.output) if is_done else "",
            "seconds": round(answer.seconds, 3) if is_answer else None,
            "ended_utc": utc_now(),
            "machine": machine_text(),
            "process": answer.pid if is_answer else None,
            "versions": software_versions(),
            "log": f"{LOGS}/{name}.log",
        }
        append_record(self.batch.output / MANIFEST, record)
        self.standing[name] = record
        if is_done:
            self.verified.add(name)
        else:
            watcher.warn(f"error: {name}: {record['reason']}")


def _work_off(jobs: Sequence[Any], workers: int | None, cluster: str | None, ended: Any) -> None:
    from hybridve.cli.unit import run_job

    if cluster is not None:
        from hybridve.cli.cluster import run_on_cluster

        run_on_cluster(cluster, jobs, ended)
        return
    from hybridve.hull.pool import Pool, usable_cpus

    cpus = usable_cpus()
    n_workers = min(_workers(workers, len(cpus)), len(jobs))
    with Pool(n_workers, run_job, cpus) as pool:
        pool.run(jobs, begun=lambda _: None, ended=ended)


def _workers(asked: int | None, n_cpus: int) -> int:
    return asked or max(1, n_cpus // 2)


def _tell_plan(night: Night, workers: int | None, *, as_json: bool) -> None:
    """Print what would be done, and about how long it takes."""
    took = [
        one["seconds"]
        for one in night.standing.values()
        if one.get("outcome") == "done" and isinstance(one.get("seconds"), int | float)
    ]
    n_workers = _workers(workers, os.cpu_count() or 1)
    missing = night.missing
    about_s = sum(took) / len(took) * len(missing) / n_workers if took else None
    rows = [
        {
            "unit": unit.name,
            "stands": unit.name in night.verified,
            "line": night.job_line(unit).line,
        }
        for unit in night.batch.units
    ]
    if as_json:
        click.echo(json.dumps({"units": rows, "seconds": about_s}))
        return
    for row in rows:
        options.tell(f"{'stands' if row['stands'] else 'to do '}  {row['line']}")
    how_long = (
        "how long is told once one is done"
        if about_s is None
        else f"about {about_s / 60:.0f} min with {options.counted(n_workers, 'worker')}"
    )
    options.tell(
        f"{night.batch.output}: {options.counted(len(rows), 'unit')}, {len(night.verified)} stand "
        f"already, {len(missing)} to do; {how_long}"
    )


def _tell(night: Night, *, as_json: bool) -> None:
    """Write and print the table of all reports; then say so if some are missing."""
    from hybridve.calib.errors import HybridveError, ReportError
    from hybridve.cli.detect import print_comparison
    from hybridve.hull.report.compare import Pair, compare, write_comparison
    from hybridve.hull.report.read import read_report
    from hybridve.hull.report.summarize import summarize

    pairs = []
    for unit in night.batch.units:
        layout = f"{unit.layout}, {unit.setting}" if unit.setting else unit.layout
        record = night.standing.get(unit.name, {})
        if unit.name not in night.verified:
            pairs.append(Pair(unit.session, layout, None, str(record.get("reason", ""))))
            continue
        try:
            pairs.append(Pair(unit.session, layout, summarize(read_report(unit.output))))
        except HybridveError as error:
            pairs.append(Pair(unit.session, layout, None, str(error)))
    table = night.batch.output / COMPARISON
    comparison = compare(pairs)
    write_comparison(table, comparison)
    if as_json:
        click.echo(json.dumps({"comparison": str(table), **comparison}))
    else:
        print_comparison(table, comparison)
    failed = night.missing
    for unit in failed:
        record = night.standing.get(unit.name, {})
        options.tell(
            f"  {unit.name}: {record.get('reason', 'was not run')} "
            f"({night.batch.output / LOGS / unit.name}.log)",
            err=True,
        )
    if failed:
        raise ReportError(
            f"{night.batch.output}: {len(failed)} of {len(night.batch.units)} failed, as told "
            "above; the others stand, and the same call again runs the rest"
        )
