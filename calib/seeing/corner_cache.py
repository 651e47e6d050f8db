"""What was found in pictures of boards, kept beside the session so that it is found once.

An answer is named after everything that it depends on: the *content* of the files that were
looked at, the question (which board, how much effort), the code that answers it, and OpenCV's
version. A picture that changed, a board that was measured anew, or a newer program therefore ask
again; a session that was copied or renamed does not.

A file's content is a SHA-256, and reading gigabytes only to learn that nothing changed would take
longer than all else. Path, size and the times of the last change of content and of the file's
entry (mtime and ctime, in ns) therefore stand for a content that was read before. Two files that
share all of them and differ do not occur by copying or by restoring an older version, which set
the latter time. Files that changed less than two seconds ago are read whatever the times say,
because some file systems count in steps of that.

The cache only saves time. What comes from it is to the bit what would be found without it; what is
damaged is as good as none; a folder that cannot be written to is left alone; files appear whole or
not at all. Of two programs that run at once on one session, one may have to ask again.
"""

import hashlib
import io
import json
import logging
import os
import threading
import time
import zipfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.cache import cache_key
from hybridve.calib.files import appearing

_log = logging.getLogger(__name__)

#: An answer: plain JSON values, and points (N, 2) in pixels where there are any.
Answer = tuple[dict[str, Any], NDArray[np.float64] | None]

#: Answers kept at most, those used least lately go first: sixty cameras with 500 pictures each.
LIMIT = 30_000

#: Pictures kept at most.
LIMIT_PICTURES = 64

_FORMAT = 1

#: Answers are written to disk at least that often, so that work that is cut short is not lost.
_SAVE_EVERY_S = 10.0

#: Times of files may be as coarse as this, in ns.
_COARSE_NS = 2_000_000_000


class CornerCache:
    """Answers about pictures, kept in a folder; safe to be asked by several threads.

    Parameters
    ----------
    folder : Path or None
        Where they are kept, made when there is something to keep. None: only in memory, for this
        object's life.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._answers: dict[str, Answer] = {}
        self._digests: dict[str, tuple[list[int], str]] = {}
        self._is_changed = False
        self._saved_s = time.monotonic()
        if folder is not None:
            self._load(folder / "answers.zip")

    def identify(self, paths: Iterable[Path]) -> str:
        """Return a text that is the same for files of the same content in the same order.

        Without a folder, the paths themselves: files do not change while one program runs.

        Raises
        ------
        OSError
            If a file cannot be read.
        """
        if self._folder is None:
            return cache_key(*map(str, paths))
        return cache_key(*map(self._digest, paths))

    def recall(self, question: tuple[str | float, ...], find_out: Callable[[], Answer]) -> Answer:
        """Return the answer to a question, found out only if it is not known yet.

        Parameters
        ----------
        question : tuple of str or numbers
            All that the answer depends on, but OpenCV.
        find_out : callable
            Returns the answer; what it raises passes through, and nothing is kept.
        """
        known = self.known(question)
        if known is None:
            known = find_out()
            self.keep(question, known)
        return known

    def known(self, question: tuple[str | float, ...]) -> Answer | None:
        """Return the answer to a question if it is known."""
        key = cache_key(cv2.__version__, *question)
        with self._lock:
            answer = self._answers.pop(key, None)
            if answer is not None:
                self._answers[key] = answer  # to the end: the last that was used
            return answer

    def keep(self, question: tuple[str | float, ...], answer: Answer) -> None:
        """Keep the answer to a question."""
        key = cache_key(cv2.__version__, *question)
        with self._lock:
            self._answers[key] = answer
            self._is_changed = True
            if time.monotonic() - self._saved_s > _SAVE_EVERY_S:
                self._save()

    def recall_picture(
        self, question: tuple[str | float, ...], find_out: Callable[[], NDArray[Any]]
    ) -> NDArray[Any]:
        """Return a picture, computed only if it is not kept; in memory none is."""
        if self._folder is None:
            return find_out()
        path = self._folder / f"{cache_key(cv2.__version__, *question)}.zip"
        members = _read_members(path, ("picture.npy",))
        if members is not None:
            with suppress(ValueError):
                picture: NDArray[Any] = np.lib.format.read_array(
                    io.BytesIO(members[0]), allow_pickle=False
                )
                with suppress(OSError):  # a folder that may only be read serves as well
                    os.utime(path)
                return picture
        picture = find_out()
        packed = io.BytesIO()
        np.lib.format.write_array(packed, picture, allow_pickle=False)
        if _write_members(path, {"picture.npy": packed.getvalue()}):
            self._drop_pictures()
        return picture

    def save(self) -> None:
        """Write to disk what is not there yet."""
        with self._lock:
            self._save()

    def _digest(self, path: Path) -> str:
        found = path.stat()
        state = [found.st_size, found.st_mtime_ns, found.st_ctime_ns]
        name = str(path.resolve())
        with self._lock:
            seen = self._digests.get(name)
        if seen is not None and seen[0] == state:
            return seen[1]
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if time.time_ns() - max(state[1:]) > _COARSE_NS:
            with self._lock:
                self._digests[name] = (state, digest)
                self._is_changed = True
        return digest

    def _load(self, path: Path) -> None:
        members = _read_members(path, ("answers.json", "points.npy"))
        if members is None:
            return
        try:
            told = json.loads(members[0])
            points = np.lib.format.read_array(io.BytesIO(members[1]), allow_pickle=False)
            if told["format"] != _FORMAT or points.dtype != np.float64 or points.ndim != 2:
                return
            answers: dict[str, Answer] = {}
            start = 0
            for key, facts, count in told["answers"]:
                array = None if count is None else points[start : start + count]
                start += count or 0
                answers[key] = (facts, array)
            self._digests = {
                name: (state, digest) for name, (state, digest) in told["files"].items()
            }
            self._answers = answers
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            _log.info("%s: cannot be used, found anew: %s", path, error)

    def _save(self) -> None:
        self._saved_s = time.monotonic()
        if self._folder is None or not self._is_changed:
            return
        kept = list(self._answers.items())[-LIMIT:]
        arrays = [points for _, (_, points) in kept if points is not None]
        packed = io.BytesIO()
        np.lib.format.write_array(packed, np.concatenate([np.zeros((0, 2)), *arrays]))
        told = {
            "format": _FORMAT,
            "files": {name: list(seen) for name, seen in self._digests.items()},
            "answers": [
                (key, facts, None if points is None else len(points))
                for key, (facts, points) in kept
            ],
        }
        members = {"answers.json": json.dumps(told).encode(), "points.npy": packed.getvalue()}
        if _write_members(self._folder / "answers.zip", members):
            self._is_changed = False

    def _drop_pictures(self) -> None:
        assert self._folder is not None
        pictures = []
        for path in self._folder.glob("[0-9a-f]" * 64 + ".zip"):
            with suppress(OSError):
                pictures.append((path.stat().st_mtime_ns, path))
        for _, path in sorted(pictures)[:-LIMIT_PICTURES]:
            with suppress(OSError):
                path.unlink()


def _read_members(path: Path, names: tuple[str, ...]) -> list[bytes] | None:
    """Return members of a zip file, read whole so that their checksums are compared; or None."""
    try:
        with zipfile.ZipFile(path) as archive:
            return [archive.read(name) for name in names]
    except FileNotFoundError:
        return None
    except Exception as error:  # damage has many names, and finding it anew mends them all
        _log.info("%s: cannot be used, found anew: %s", path, error)
        return None


def _write_members(path: Path, members: dict[str, bytes]) -> bool:
    """Write a zip file whole or not at all; return whether it was written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (
            appearing(path, is_contended=True) as partial,
            zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        ):
            for name, content in members.items():
                archive.writestr(name, content)
    except OSError as error:
        _log.info("%s: not kept for the next run: %s", path, error)
        return False
    return True
