"""What the silhouettes of one frame say together: a hull, nothing at all, or contradictions.

An empty hull is not an empty room. It may rest on one camera that saw nothing, on outlines that
miss each other by less than they err, or on silhouettes that contradict each other: every camera
sees something, and no point of space is in all of them. `judge_frame` tells these apart, and proves
each that it names:

* ``"agreed"``: a point of the hull is shown;
* ``"nobody"``: no camera saw anything;
* ``"silent"``: the hull is empty, and some cameras saw nothing: the emptiness rests on them;
* ``"within error"``: the hull is empty, but not if silhouettes are grown by their errors;
* ``"elsewhere"``: the hull of grown silhouettes is empty, too, but what each camera saw may be
  partly outside of the others' images (``unseen = "carve"`` only);
* ``"contradiction"``: it is empty, and some camera saw something wholly that no other place
  explains: some silhouette is wrong, or some camera is not where the rig has it, by more than the
  errors stated;
* ``"open"``: neither a point was found nor a proof; nothing is claimed.

What may be elsewhere
---------------------
A point that one camera does not see is out of the hull, though a real thing may be there. Where no
silhouette reaches the border of its image, all things that were seen were seen wholly, and a
camera's silhouette is taken to be explained by a point on it that all others see but one, at most,
outside of whose image it is. Where some silhouette is cut off by the border, the thing's parts may
be seen by different cameras: then two cameras are enough, and a silhouette that is cut off needs no
explanation itself. It is a contradiction only if a camera is proved to lack that explanation. Still
it is one by assumption: a thing that stands where a single camera looks looks like one.

How far silhouettes are grown (`stated_error_px`) decides between an error and a contradiction:
three standard deviations of the outline, so that straight outlines pass it once in 370.

Who is guilty cannot be proved: the hull of the others is empty, too, if two are wrong, and may hold
a point by chance. So all are *suspects* without whom the others agree: the hull of the rest,
grown, holds a point, and at least half of the rays that were tried of the rest's silhouettes meet
the hull of the rest as it is (an estimate). If none is, all such pairs. Those are named that leave
the others in the best agreement, or nearly so; with few cameras left, chance agrees, too.

`coherence` looks closer where there is a hull: for large pieces of a silhouette that others deny.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.agreement.blocks import find_blocks
from hybridve.hull.agreement.search import (
    EMPTY,
    FOUND,
    OPEN,
    Pencils,
    Rule,
    Search,
    bounding_box,
    images_of,
    make_pencils,
    search,
    search_hull,
)
from hybridve.hull.query.silhouettes import Hull, Views, hull_of
from hybridve.hull.query.walk import spans_of_rays

Kind = Literal["agreed", "nobody", "silent", "within error", "elsewhere", "contradiction", "open"]

#: By how much silhouettes are grown where nobody says otherwise, in pixels: `stated_error_px` of
#: what `hybridve.hull.contact.outline_errors` assumes of outlines and rigs that tell nothing.
DEFAULT_ERROR_PX = 5

#: So many standard deviations are an error; beyond them is a contradiction.
_DEVIATIONS = 3.0

#: Rays of each other camera that are asked whether a suspect's absence explains them.
_EXPLAINED_RAYS = 16

#: The others agree if at least this share of their rays is explained.
_AGREED_SHARE = 0.5

#: Suspects whose share is this much below the best one's are let go.
_AS_GOOD = 0.1

#: How far these rays are followed, in depths of the local origin.
_REACH = 4.0

#: A picture of which more than this share is object is cut into so many squares at most.
_MOST_OBJECT, _MOST_SQUARES = 0.5, 400

#: A silhouette of less area than so many squares is cut into smaller ones.
_FEW_SQUARES = 32

#: Cells after which the search for what confirms a square of pixels is given up.
_BLOCK_CELLS = 1000

#: Cells after which a pair of suspects is let go.
_PAIR_CELLS = 5000


@dataclass(frozen=True, slots=True)
class Suspect:
    """Cameras without which the others agree.

    Attributes
    ----------
    cameras : tuple of str
        One, or a pair.
    explained : float
        Share of the others' silhouettes that the hull without them explains; an estimate.
    """

    cameras: tuple[str, ...]
    explained: float


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """What the silhouettes of one frame say together.

    Attributes
    ----------
    kind : str
        See the module.
    error_px : (C,) int64
        By how much each silhouette may be off.
    point_world : (3,) float64
        A point of the hull ("agreed"), of the grown hull ("within error"), or one that all others
        see outside of the images of silent cameras; metres. NaN where there is none.
    silent : tuple of str
        The cameras that saw nothing, whatever the kind.
    is_outside : bool or None
        Of "silent": whether a point that all others see is outside of the silent cameras' images.
        If not, these deny all that the others could mean. None where neither was proved.
    suspects : tuple of Suspect
        Of "contradiction": who may be wrong, likeliest first; empty where no camera and no pair
        alone explains it: then all are suspect.
    is_empty : bool
        Whether the hull, silhouettes as they are, is proved empty.
    """

    kind: Kind
    error_px: NDArray[np.int64]
    point_world: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.nan))
    silent: tuple[str, ...] = ()
    is_outside: bool | None = None
    suspects: tuple[Suspect, ...] = ()
    is_empty: bool = False

    @property
    def is_sound(self) -> bool:
        """Whether what the hull says may be believed: a point is shown, or nobody saw anything."""
        return self.kind in {"agreed", "nobody"}

    @property
    def is_contradictory(self) -> bool:
        """Whether silhouettes cannot all be right, be it that a camera saw nothing at all."""
        return self.kind == "contradiction" or (self.kind == "silent" and self.is_outside is False)

    @property
    def is_believed(self) -> bool:
        """Whether the hull may be taken for what was there, be it that nothing was.

        It is not where outlines miss each other, by however little: something was there.
        """
        if self.kind == "silent":
            return self.is_outside is True
        return self.kind in {"agreed", "nobody", "elsewhere"}

    @property
    def reason(self) -> str:
        """What is wrong with the frame, in words; empty where it is sound."""
        silent = ", ".join(self.silent)
        most_px = int(self.error_px.max(initial=0))
        if self.is_sound:
            return ""
        if self.kind == "silent":
            if self.is_outside is None:
                return f"{silent} saw nothing, while others did"
            if self.is_outside:
                where = "what they saw may be outside of its image"
            else:
                where = "no place that they could mean is outside of its image"
            if len(self.silent) > 1:
                where = where.replace("its image", "their images")
            return f"{silent} saw nothing, while others did: {where}"
        if self.kind == "within error":
            return f"no point is in all silhouettes, unless they are off by up to {most_px} px"
        if self.kind == "elsewhere":
            return (
                "no point is in all silhouettes; what the cameras saw may be outside of each "
                "other's images"
            )
        if self.kind == "open":
            return "neither a point of the hull was found, nor that there is none"
        who = " or ".join(" with ".join(suspect.cameras) for suspect in self.suspects)
        who = f"without {who} the others agree" if who else "no two cameras alone explain it"
        return (
            f"the silhouettes contradict each other: no point is in all of them, "
            f"off by up to {most_px} px each; {who}"
        )


@dataclass(frozen=True, slots=True)
class Dispute:
    """A piece of one camera's silhouette that is denied.

    Attributes
    ----------
    camera : str
        Who sees it.
    area_px : int
        Area of the squares that are proved to be denied.
    share : float
        That, of all such squares of its silhouette.
    box_px : (left, top, right, bottom)
        Around them all.
    denied_by : tuple of str
        The cameras without which most of it is confirmed by the others. None: no camera alone.
    """

    camera: str
    area_px: int
    share: float
    box_px: tuple[int, int, int, int]
    denied_by: tuple[str, ...]


def stated_error_px(
    sigma_px: NDArray[np.float64], shift_px: NDArray[np.float64] | float = 0.0
) -> NDArray[np.int64]:
    """Return how far each outline may be off, in whole pixels.

    Parameters
    ----------
    sigma_px : (C,) float64
        Standard deviation of where each camera's outline is, across it, all errors of the outline,
        the lens and the rig together; not finite where unknown, which counts as the default.
    shift_px : (C,) float64 or float
        What comes on top, as a bound: of undistorting the silhouettes.
    """
    error_px = np.ceil(_DEVIATIONS * np.asarray(sigma_px, np.float64) + shift_px)
    return np.where(np.isfinite(error_px), error_px, DEFAULT_ERROR_PX).astype(np.int64)


def judge_frame(
    hull: Hull,
    error_px: NDArray[np.int64] | int = DEFAULT_ERROR_PX,
    pencils: Pencils | None = None,
) -> Agreement:
    """Tell what the silhouettes of one frame say together.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    error_px : (C,) int64 or int
        By how many pixels, to all sides, each silhouette may be off.
    pencils : Pencils, optional
        Those of the hull's views, where they were made already.
    """
    views = hull.views
    count = len(views)
    errors = np.broadcast_to(np.asarray(error_px, np.int64), (count,)).copy()
    if (errors < 0).any():
        raise ValueError(f"error_px is {errors.tolist()}, expected no negative number")
    areas = np.array([int(hull.integral(camera)[-1, -1]) for camera in range(count)])
    silent = np.flatnonzero(areas == 0)
    told = Agreement("open", errors, silent=_names(views, silent))
    if len(silent) == count:
        return replace(told, kind="nobody", is_empty=True)
    pencils = make_pencils(views) if pencils is None else pencils
    plain = search_hull(hull, pencils, Rule.of(views))
    if plain.verdict == FOUND:
        return replace(told, kind="agreed", point_world=plain.point_world)
    told = replace(told, is_empty=plain.verdict == EMPTY)
    rule = Rule.of(views, errors)
    if len(silent):
        if plain.verdict == OPEN:
            return told
        apart = _apart(hull, pencils, rule, silent)
        return replace(
            told,
            kind="silent",
            is_outside=None if apart.verdict == OPEN else apart.verdict == FOUND,
            point_world=apart.point_world,
        )
    grown = search_hull(hull, pencils, rule)
    if grown.verdict == FOUND and told.is_empty:
        return replace(told, kind="within error", point_world=grown.point_world)
    if grown.verdict != EMPTY:
        return told
    told = replace(told, is_empty=True)
    elsewhere = _elsewhere(hull, pencils, rule)
    if elsewhere != EMPTY:
        return replace(told, kind="elsewhere") if elsewhere == FOUND else told
    return replace(told, kind="contradiction", suspects=_suspects(hull, pencils, rule))


def _names(views: Views, cameras: Sequence[int] | NDArray[np.int64]) -> tuple[str, ...]:
    return tuple(views.names[camera] for camera in cameras)


def _apart(hull: Hull, pencils: Pencils, rule: Rule, silent: NDArray[np.int64]) -> Search:
    """Look for a point that the others see, outside of the images of silent cameras."""
    abstains = rule.abstains.copy()
    abstains[silent] = True
    # Where cameras abstain by the session's rule, the silent ones have done so already.
    needed = rule.needed if hull.views.unseen == "keep" else rule.needed - len(silent)
    return search_hull(hull, pencils, replace(rule, abstains=abstains, needed=needed))


def _elsewhere(hull: Hull, pencils: Pencils, rule: Rule) -> int:
    """Tell whether what each camera saw may be outside of others' images.

    `EMPTY` if a camera that saw something wholly is proved to have no such explanation.
    """
    views = hull.views
    count = len(views)
    if views.unseen == "keep":
        return EMPTY
    is_cut = [
        _reaches_border(hull, camera, int(rule.tolerance_px[camera])) for camera in range(count)
    ]
    needed = 2 if any(is_cut) else max(2, count - 1)
    anywhere = replace(rule, abstains=np.ones(count, np.bool_), needed=needed)
    verdict = FOUND
    for camera in range(count):
        if is_cut[camera]:
            continue
        found = search(hull, pencils, camera, anywhere).verdict
        if found == EMPTY:
            return EMPTY
        if found == OPEN:
            verdict = OPEN
    return verdict


def _reaches_border(hull: Hull, camera: int, grown_px: int) -> bool:
    """Tell whether a silhouette, grown, reaches the border of its image."""
    left, right, top, bottom = bounding_box(hull, camera, grown_px)
    width, height = hull.views.sizes_px[camera].tolist()
    return left <= 0 or top <= 0 or right >= width or bottom >= height


def _suspects(hull: Hull, pencils: Pencils, rule: Rule) -> tuple[Suspect, ...]:
    """Return the cameras, or else the pairs, without which the others agree, likeliest first."""
    count = len(hull.views)
    found: list[Suspect] = []
    for size in (1, 2):
        if found or count - size < 1:
            break
        for group in itertools.combinations(range(count), size):
            without = rule.without(*group)
            rest = search_hull(hull, pencils, without, _PAIR_CELLS)
            if rest.verdict == FOUND:
                explained = _explained(hull, pencils, group)
                if explained >= _AGREED_SHARE:
                    found.append(Suspect(_names(hull.views, group), explained))
    best = max((suspect.explained for suspect in found), default=0.0)
    likely = [suspect for suspect in found if suspect.explained >= best - _AS_GOOD]
    return tuple(sorted(likely, key=lambda suspect: -suspect.explained))


def _explained(hull: Hull, pencils: Pencils, group: tuple[int, ...]) -> float:
    """Return which share of the others' silhouettes the hull without a group explains."""
    rest = [camera for camera in range(len(hull.views)) if camera not in group]
    if len(rest) < 2:
        return 1.0
    views = hull.views
    alone = hull_of(hull, np.array(rest))
    n_rays, n_met = 0, 0
    for camera in rest:
        pixels = object_pixels(hull, camera, _EXPLAINED_RAYS)
        scaled = (pixels - views.sizes_px[camera] / 2.0) / views.sizes_px[camera].max()
        directions = np.column_stack([scaled, np.ones(len(pixels))]) @ pencils.rays[camera].T
        origins = np.broadcast_to(
            pencils.centers_local[camera] + views.origin_world, directions.shape
        )
        reach_m = _REACH * float(pencils.scales_m[camera])
        spans = spans_of_rays(alone, origins, directions, reach_m)
        n_met += sum(len(span) > 0 for span in spans)
        n_rays += len(spans)
    return n_met / n_rays


def object_pixels(hull: Hull, camera: int, count: int) -> NDArray[np.float64]:
    """Return the centres (N, 2) of at most `count` object pixels of a camera, evenly chosen."""
    integral = hull.integral(camera)
    area = int(integral[-1, -1])
    ranks = ((np.arange(min(count, area)) + 0.5) * (area / max(1, min(count, area)))).astype(
        np.int64
    )
    rows = np.searchsorted(integral[:, -1], ranks, side="right") - 1
    columns = [
        np.searchsorted(integral[row + 1] - integral[row], rank - integral[row, -1], side="right")
        - 1
        for row, rank in zip(rows, ranks, strict=True)
    ]
    return np.column_stack([columns, rows]) + 0.5 if area else np.zeros((0, 2))


def deniers(found: Sequence[Dispute]) -> tuple[str, ...]:
    """Return the cameras that deny pieces of two others' silhouettes at least.

    One camera may see too much, a shadow or a reflection; what two see and one denies is more
    likely lacking in that one.
    """
    named = [name for dispute in found for name in dispute.denied_by]
    return tuple(sorted({name for name in named if named.count(name) > 1}))


@dataclass(frozen=True, slots=True, eq=False)
class Coherence:
    """How the silhouettes of one frame support and deny each other, square by square.

    Attributes
    ----------
    supported_share : (C,) float64
        Of each camera's squares of object pixels, the share of which it is not proved that the
        others deny them; NaN where it has none, or there are too few cameras to tell.
    denies_share : (C,) float64
        Of the others' squares, the share that this camera alone denies; NaN likewise.
    disputes : tuple of Dispute
        Where squares are denied.
    deniers : tuple of str
        The cameras that deny pieces of two others' silhouettes at least: what two see and one
        denies is more likely lacking in that one, or that one is not where the rig has it.
    """

    supported_share: NDArray[np.float64]
    denies_share: NDArray[np.float64]
    disputes: tuple[Dispute, ...] = ()
    deniers: tuple[str, ...] = ()

    def alone_px(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the box (C, 4) of what each camera sees and all others deny; NaN without.

        Left, top, right and bottom in pixels.
        """
        boxes = np.full((len(names), 4), np.nan)
        for one in self.disputes:
            if not one.denied_by:
                boxes[list(names).index(one.camera)] = one.box_px
        return boxes

    @property
    def reason(self) -> str:
        """What is wrong with the frame, in words; empty where nobody denies what others see."""
        if not self.deniers:
            return ""
        verb = "denies" if len(self.deniers) == 1 else "deny"
        seen_by = [one.camera for one in self.disputes if set(one.denied_by) & set(self.deniers)]
        return f"{', '.join(self.deniers)} {verb} what {', '.join(seen_by)} see"


def coherence(
    hull: Hull,
    error_px: NDArray[np.int64] | int = DEFAULT_ERROR_PX,
    pencils: Pencils | None = None,
    sides_px: NDArray[np.int64] | int | None = None,
) -> Coherence:
    """Return how the silhouettes of one frame support and deny each other, beyond stated errors.

    A square of object pixels is denied where it is proved that no point of its rays is seen on an
    object pixel by so many cameras as are needed, and on background by none: by all but one with
    ``unseen = "carve"`` (what one camera does not see is no contradiction), else by the session's
    minimum and by three at least. Of two cameras each may see what the other does not; nothing is
    said of them.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    error_px : (C,) int64 or int
        By how many pixels, to all sides, each silhouette may be off.
    pencils : Pencils, optional
        Those of the hull's views, where they were made already.
    sides_px : (C,) int64 or int, optional
        The squares' sides. By default four times the error and four pixels more, and so at least
        twice as wide as what an outline's errors to both sides may put there; half of that, and so
        still wider, in silhouettes that are too small for more than a few of those.
    """
    views = hull.views
    count = len(views)
    needed = count - 1 if views.unseen == "carve" else max(views.min_cameras, 3)
    if count < 3 or needed >= count:
        return Coherence(np.full(count, np.nan), np.full(count, np.nan))
    errors = np.broadcast_to(np.asarray(error_px, np.int64), (count,)).copy()
    if sides_px is None:
        sides_px = _sides_px(hull, errors)
    sides = np.broadcast_to(np.asarray(sides_px, np.int64), (count,)).copy()
    blocks = find_blocks(
        make_pencils(views) if pencils is None else pencils,
        images_of(hull),
        np.ones(count, np.bool_),
        np.ones(count, np.bool_),
        needed,
        errors,
        sides,
        _BLOCK_CELLS,
    )
    n_unconfirmed = np.bincount(blocks.unconfirmed[:, 0], minlength=count)
    found = []
    for camera in np.flatnonzero(n_unconfirmed).tolist():
        mine = blocks.unconfirmed[blocks.unconfirmed[:, 0] == camera, 1:]
        side = int(sides[camera])
        left, top = mine.min(axis=0).tolist()
        right, bottom = (mine.max(axis=0) + side).tolist()
        by = np.flatnonzero(2 * blocks.n_denied[camera] > blocks.n_asked[camera])
        found.append(
            Dispute(
                views.names[camera],
                len(mine) * side * side,
                len(mine) / int(blocks.n_blocks[camera]),
                (left, top, right, bottom),
                _names(views, by),
            )
        )
    # Of the squares of which it was asked who denies them, as of all that are denied.
    weights = n_unconfirmed / np.maximum(blocks.n_asked, 1)
    denied = (blocks.n_denied * weights[:, None]).sum(axis=0)
    others = blocks.n_blocks.sum() - blocks.n_blocks
    with np.errstate(invalid="ignore", divide="ignore"):
        return Coherence(
            1.0 - n_unconfirmed / blocks.n_blocks, denied / others, tuple(found), deniers(found)
        )


def _sides_px(hull: Hull, errors: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the sides (C,) of the squares that silhouettes are cut into."""
    sides = np.maximum(4 * errors + 4, 8)
    shares, sizes_px = hull.object_shares(), hull.views.sizes_px
    sides = np.where(shares * sizes_px.prod(axis=1) < _FEW_SQUARES * sides**2, sides // 2, sides)
    # What is mostly object is no silhouette: of thousands of squares each would be looked for.
    large = np.sqrt(sizes_px.prod(axis=1) / _MOST_SQUARES).astype(np.int64)
    return np.where(shares > _MOST_OBJECT, np.maximum(large, sides), sides)


def disputes(
    hull: Hull,
    error_px: NDArray[np.int64] | int = DEFAULT_ERROR_PX,
    pencils: Pencils | None = None,
    sides_px: NDArray[np.int64] | int | None = None,
) -> tuple[Dispute, ...]:
    """Return the large pieces of silhouettes that others deny, beyond the stated error.

    Parameters are those of `coherence`.
    """
    return coherence(hull, error_px, pencils, sides_px).disputes
