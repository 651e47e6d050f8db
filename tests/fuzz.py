"""Nearly right files for every reader, each kind in a process that may die: ``make fuzz``.

Prints, by reader: how many were read or refused in one line, and what else came of any; the file of
the first is kept beside. ``RUNS`` is how many a reader. With ``--atheris READER``, where that is
installed, files are led by what they reach in our own code.
"""

import argparse
import json
import multiprocessing
import sys
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path

#: Bytes of memory for each process.
_MEMORY_B = 8 << 30


def _work(name: str, count: int, seed: int, keep: str, told: Connection) -> None:
    import logging
    import os

    from helpers.fuzzing import bound_memory, readers, tried

    logging.disable(logging.CRITICAL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries complain at length
    with tempfile.TemporaryDirectory() as folder:
        reader = next(one for one in readers(Path(folder)) if one.name == name)
        bound_memory(_MEMORY_B)
        found: dict[str, int] = {}
        number = 0
        for content, problem in tried(reader, Path(folder), count, seed):
            number += 1
            if problem:
                kind = problem.partition(":")[0]
                if kind not in found:
                    (Path(keep) / f"{name}.{kind.replace(' ', '_')}").write_bytes(content)
                    told.send(("found", problem))
                found[kind] = found.get(kind, 0) + 1
            if number % 50 == 0:
                told.send(("done", number))
        told.send(("end", number))


def fuzz(name: str, count: int, seed: int, keep: Path) -> dict[str, object]:
    """Try files on a reader; return how many, what came of them, and how often the process died."""
    context = multiprocessing.get_context("spawn")
    deaths, done, problems = 0, 0, set()
    while done < count and deaths < 20:
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_work, args=(name, count - done, seed + deaths, str(keep), theirs)
        )
        process.start()
        theirs.close()
        last = 0
        try:
            while True:
                what, value = ours.recv()
                if what == "found":
                    problems.add(value)
                else:
                    last = value
                if what == "end":
                    break
        except EOFError:
            deaths += 1
        process.join()
        done += max(last, 1)
    return {"reader": name, "files": done, "crashes": deaths, "problems": sorted(problems)}


def _atheris(name: str) -> None:
    import atheris

    with atheris.instrument_imports(include=["hybridve"]):
        from helpers.fuzzing import complaint, readers

    with tempfile.TemporaryDirectory() as folder:
        reader = next(one for one in readers(Path(folder)) if one.name == name)
        place = Path(folder) / reader.name

        def one(data: bytes) -> None:
            place.write_bytes(data)
            if problem := complaint(reader, place):
                raise AssertionError(problem)

        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        (corpus / "seed").write_bytes(reader.seed)
        atheris.Setup([sys.argv[0], str(corpus), "-max_total_time=600"], one)
        atheris.Fuzz()


def main() -> None:
    """Fuzz every reader, or one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--keep", type=Path, default=Path("build/fuzz"))
    parser.add_argument("--atheris", metavar="READER")
    asked = parser.parse_args()
    if asked.atheris:
        _atheris(asked.atheris)
        return
    from helpers.fuzzing import readers

    asked.keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        names = [one.name for one in readers(Path(folder))]
    total = 0
    for name in names:
        if asked.only in name:
            found = fuzz(name, asked.runs, asked.seed, asked.keep)
            total += int(str(found["files"]))
            print(json.dumps(found), flush=True)  # noqa: T201
    print(json.dumps({"files": total}))  # noqa: T201


if __name__ == "__main__":
    main()
