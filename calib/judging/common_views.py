"""What several cameras saw of boards at once: located, and listed alike."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.board import Board, Sighting, is_seen
from hybridve.calib.errors import CalibrationError
from hybridve.calib.image_io import natural_order
from hybridve.calib.pose import Pose, compose
from hybridve.calib.rig import Rig
from hybridve.calib.solving.locate import locate_board

#: Placements that are used of each two cameras, at least if there are as many: more change nothing.
_PAIR_PLACEMENTS = 40


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One board in one image: where it lies as this camera alone sees it."""

    camera: str
    moment: tuple[int, int]  # instant and board
    pixels: NDArray[np.float64]
    cam_from_board: Pose
    look: int = 0  # in which the list is read that was found


def locate_common(
    rig: Rig, boards: Sequence[Board], sightings: Mapping[str, Sequence[Sighting]]
) -> tuple[dict[tuple[int, int], list[View]], list[str]]:
    """Return by moment the views of two cameras or more, and the cameras that see a board."""
    known = {camera.name for camera in rig.cameras if camera.name not in rig.mounts}
    seen: dict[tuple[int, int], dict[str, NDArray[np.float64]]] = {}
    for name in sorted(known & set(sightings), key=natural_order):
        for sighting in sightings[name]:
            if sighting.instant is not None and is_seen(sighting.pixels).sum() >= 4:
                seen.setdefault((sighting.instant, sighting.board), {})[name] = sighting.pixels
    seeing = sorted({name for views in seen.values() for name in views}, key=natural_order)
    found: dict[tuple[int, int], list[View]] = {}
    failed: Counter[str] = Counter()
    n_views: Counter[str] = Counter()
    for moment in _enough(seen):
        board = boards[moment[1]]
        views = []
        for name, pixels in seen[moment].items():
            n_views[name] += 1
            located = locate_board(rig[name], board.points_board, pixels, refine=False)
            if located is None:
                failed[name] += 1
            else:
                views.append(View(name, moment, pixels, located[0]))
        if len(views) > 1:
            found[moment] = views
    for name, count in n_views.items():
        if failed[name] == count:
            raise CalibrationError(
                f"camera {name!r}: its lens cannot have seen the board's corners; "
                "check the image size and the unit of its parameters"
            )
    return found, seeing


def _enough(
    seen: Mapping[tuple[int, int], Mapping[str, NDArray[np.float64]]],
) -> list[tuple[int, int]]:
    """Return moments from which each two cameras are compared often enough, spread over all."""
    moments = sorted(moment for moment, views in seen.items() if len(views) > 1)
    used: Counter[tuple[str, str]] = Counter()
    chosen = []
    # By the bits of their numbers, reversed: any first few are spread over the whole clip.
    n_bits = max(1, (len(moments) - 1).bit_length())
    order = sorted(range(len(moments)), key=lambda number: f"{number:0{n_bits}b}"[::-1])
    for number in order:
        pairs = list(combinations(sorted(seen[moments[number]]), 2))
        if any(used[pair] < _PAIR_PLACEMENTS for pair in pairs):
            used.update(pairs)
            chosen.append(moments[number])
    return sorted(chosen)


def largest_group(found: Mapping[tuple[int, int], Sequence[View]]) -> set[str]:
    """Return the cameras that common boards hold together, the most."""
    groups: list[set[str]] = []
    for views in found.values():
        joined = {view.camera for view in views}
        apart = [group for group in groups if not group & joined]
        for group in groups:
            if group & joined:
                joined |= group
        groups = [*apart, joined]
    return max(groups, key=lambda group: (len(group), min(group)))


def listed_alike(rig: Rig, views: Sequence[View], board: Board) -> list[View]:
    """Return views of one placement with the corners of a symmetric board in one order.

    The looks are those under which the cameras of the rig agree on the board's orientation best,
    which does not depend on the rig's scale.
    """
    if len(board.looks) == 1:
        return list(views)
    turned = [
        [compose(view.cam_from_board, board.board_from_turned(look)) for look in range(n_looks)]
        for view in views
        for n_looks in [len(board.looks)]
    ]
    in_world = np.array(
        [
            [rig[view.camera].cam_from_world[:, :3].T @ pose[:, :3] for pose in poses]
            for view, poses in zip(views, turned, strict=True)
        ]
    )  # (K, L, 3, 3)
    alike = np.einsum("ilab,jmab->iljm", in_world, in_world)
    best, best_total = np.zeros(len(views), np.intp), -np.inf
    for reference in range(len(views)):
        looks = alike[reference, 0].argmax(axis=1)
        looks[reference] = 0
        rows = alike[np.arange(len(views)), looks]
        total = float(rows[:, np.arange(len(views)), looks].sum())
        if total > best_total + 1e-9:
            best, best_total = looks, total
    return [
        replace(
            view,
            pixels=view.pixels[board.looks[look]],
            cam_from_board=poses[look],
            look=int(look),
        )
        for view, poses, look in zip(views, turned, best, strict=True)
    ]
