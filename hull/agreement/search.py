"""Whether any point that a camera sees through some of its pixels is in the hull: found, or proved.

A rectangle of camera A's pixels and two depths bound a cell of space. Cells are halved, the fullest
first, until a point of the hull is found, or every cell is proved free of the hull. Silhouettes may
be *grown* by a number of pixels each, to all sides: what is proved then holds for whatever the true
outlines are, as long as each is within so many pixels of the recorded one, on either axis.

Cells that reach to infinity
----------------------------
The point at depth d on the ray through A's pixel (u, v) is c + d r, with c the camera's centre and
r = M_A^-1 (u, v, 1). With t = S / (S + d), S some depth, its homogeneous coordinates are
t / S (c, 1) + (1 - t) (r, 0): t = 0 lies at infinity, t = 1 in the centre. So camera B sees it at

    h = (1 - t) H (u, v, 1) + t e,    H = M_B M_A^-1,    e = (M_B c + p_B) / S,

of positive third coordinate where it lies in front of B. h is linear in each of u, v and t, so
h_x - k h_z has its extremes over a cell at the cell's eight corners: where all of them lie in front
of B, the cell projects inside the bounding rectangle of their eight pixels, whatever its size.

What a rectangle proves
-----------------------
As in `hybridve.hull.query.bounds`: the rectangle, grown by the camera's tolerance, that holds no
object pixel proves that B sees none at any point of the cell, though silhouettes were grown by
that: four look-ups, and no grown silhouette is ever made. A camera that *abstains* where it does
not see proves it only where the grown rectangle lies wholly in what it recorded. Besides, so many
cameras as are `needed` must be able to see an object pixel.

Rounding: u and v are counted in image widths from the image's middle, so that the matrix inverted
is well conditioned (a condition number kappa of some 10). H, e and h are then off by at most
256 u kappa B_k, u the unit roundoff and B_k the sum of the sizes of all terms: rectangles are
widened by that, over the smallest depth. So is A's own rectangle, by `_OWN_PX`, as its pixels are
the floor of what was computed. A point is called found only where it keeps `EDGE_PX` from the
edges of its pixels (or of the grown silhouettes' pixels): whoever asks again agrees.
`hybridve.hull.agreement.search_reference` is the specification.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hybridve.hull.jit import ZERO, compiled
from hybridve.hull.query.boxes import (
    ABSTAINS,
    ACCEPTS,
    REJECTS,
    UNDECIDED,
    count_pixels,
    pixel_range,
    rectangle_vote,
)
from hybridve.hull.query.points import EDGE_PX, is_clear, project
from hybridve.hull.query.silhouettes import Hull, Views

#: What a search ends with: no point, proved; a point; neither within the cells allowed.
EMPTY, FOUND, OPEN = 0, 1, 2

#: Points farther from the camera than this, in metres, are not meant: nobody's hands are there, and
#: all rays that are nearly parallel meet somewhere.
FARTHEST_M = 1000.0

#: Cells after which a search gives up: some 20 ms with four cameras.
MOST_CELLS = 50_000

#: Cells that project into less than this, in pixels, are not halved any further.
_FINEST_PX = 2.0**-10

#: A camera's own rectangle is widened by this, in pixels: a thousand times its rounding.
_OWN_PX = 1e-9

#: Depth below which nothing is told from the camera's own plane, in lengths of S.
_SMALLEST_DEPTH = 1e-30

#: Cells that wait to be looked at; each halving adds one.
_MOST_WAITING = 256

#: Of so many cameras is remembered that they see nothing but object pixels of a cell.
_MOST_BITS = 62

#: Depths S are at least this, in metres.
_LEAST_SCALE_M = 0.1


class Pencils(NamedTuple):
    """The rays of all cameras as all cameras see them; made once for the same views.

    Attributes
    ----------
    rays : (C, 3, 3) float64
        The ray, local frame, of depth 1 m, through (u, v, 1) in image widths from the middle.
    centers_local : (C, 3) float64
        The cameras' centres, metres.
    scales_m : (C,) float64
        S of each camera, metres.
    seen : (C, C, 3, 4) float64
        [H | e] of each pair, first the camera whose rays they are.
    pads : (C, C, 3) float64
        By how much h may be off.
    matrices : (C, 12) float64
        Projections in pixels from metres, local frame, row-major.
    sizes : (C, 2) int64
        Width and height of the images, in pixels.
    """

    rays: NDArray[np.float64]
    centers_local: NDArray[np.float64]
    scales_m: NDArray[np.float64]
    seen: NDArray[np.float64]
    pads: NDArray[np.float64]
    matrices: NDArray[np.float64]
    sizes: NDArray[np.int64]


class Images(NamedTuple):
    """The silhouettes of one frame as compiled loops take them, cameras as in the views.

    See `hybridve.hull.query.frame.Frame`.
    """

    integrals: NDArray[np.int32]
    integral_offset: NDArray[np.int64]
    recorded: NDArray[np.int64] | None


@dataclass(frozen=True, slots=True, eq=False)
class Rule:
    """Which points count.

    Attributes
    ----------
    is_asked : (C,) bool
        The cameras that are asked; of the others nothing is believed.
    abstains : (C,) bool
        Whether a camera that cannot see a point says nothing of it; else the point is out.
    needed : int
        How many cameras must see an object pixel.
    tolerance_px : (C,) int64
        By how much each silhouette is grown.
    """

    is_asked: NDArray[np.bool_]
    abstains: NDArray[np.bool_]
    needed: int
    tolerance_px: NDArray[np.int64]

    @classmethod
    def of(cls, views: Views, tolerance_px: NDArray[np.int64] | None = None) -> Self:
        """Return the rule of a session's views."""
        count = len(views)
        keep = views.unseen == "keep"
        return cls(
            np.ones(count, np.bool_),
            np.full(count, keep),
            views.min_cameras if keep else count,
            np.zeros(count, np.int64) if tolerance_px is None else tolerance_px,
        )

    def without(self, *cameras: int) -> "Rule":
        """Return the same rule when some cameras are not asked."""
        is_asked = self.is_asked.copy()
        is_asked[list(cameras)] = False
        return replace(self, is_asked=is_asked, needed=min(self.needed, int(is_asked.sum())))


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What a search ended with.

    Attributes
    ----------
    verdict : int
        `EMPTY`, `FOUND` or `OPEN`.
    point_world : (3,) float64
        The point found, metres; else NaN.
    n_cells : int
        How many cells were looked at.
    """

    verdict: int
    point_world: NDArray[np.float64]
    n_cells: int


def make_pencils(views: Views) -> Pencils:
    """Return the rays of all cameras as all cameras see them."""
    matrices = np.array(views.img_from_local, order="C")  # writable, as compiled code expects
    left, last = matrices[:, :, :3], matrices[:, :, 3]
    # Pixels in image widths from the middle: N^-1 (x, y, 1).
    extents = views.sizes_px.max(axis=1).astype(np.float64)
    middles = views.sizes_px / 2.0
    scaled = matrices.copy()
    scaled[:, :2] -= middles[:, :, None] * matrices[:, 2:3]
    scaled[:, :2] /= extents[:, None, None]
    rays = np.linalg.inv(scaled[:, :, :3])
    centers = -np.einsum("cij,cj->ci", rays, scaled[:, :, 3])
    scales_m = np.maximum(np.abs(last[:, 2]), _LEAST_SCALE_M)
    homographies = np.einsum("bij,ajk->abik", left, rays)
    epipoles = np.einsum("bij,aj->abi", left, centers) + last
    seen = np.concatenate([homographies, (epipoles / scales_m[:, None, None])[..., None]], axis=-1)

    condition = np.linalg.norm(scaled[:, :, :3], axis=(1, 2)) * np.linalg.norm(rays, axis=(1, 2))
    terms = np.einsum("bij,ajk->abi", np.abs(left), np.abs(rays))
    reach = np.einsum(
        "bij,aj->abi", np.abs(left), np.einsum("aij,aj->ai", np.abs(rays), np.abs(scaled[:, :, 3]))
    )
    terms += (reach + np.abs(last)) / scales_m[:, None, None]
    pads = 256.0 * 2.0**-53 * condition[:, None, None] * terms
    return Pencils(
        np.ascontiguousarray(rays),
        centers,
        scales_m,
        np.ascontiguousarray(seen),
        np.ascontiguousarray(pads),
        matrices.reshape(-1, 12),
        np.array(views.sizes_px, order="C"),
    )


def images_of(hull: Hull) -> Images:
    """Return the silhouettes of a frame as compiled loops take them."""
    recorded = None if hull.views.seen is None else hull.recorded_offset
    return Images(hull.integrals_flat, hull.integral_offset, recorded)


def bounding_box(hull: Hull, camera: int, grown_px: int = 0) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of a silhouette grown by some pixels; zeros if empty."""
    integral = hull.integral(camera)
    rows = np.flatnonzero(np.diff(integral[:, -1]))
    columns = np.flatnonzero(np.diff(integral[-1]))
    if len(rows) == 0:
        return 0.0, 0.0, 0.0, 0.0
    return (
        float(columns[0] - grown_px),
        float(columns[-1] + 1 + grown_px),
        float(rows[0] - grown_px),
        float(rows[-1] + 1 + grown_px),
    )


def search(
    hull: Hull,
    pencils: Pencils,
    camera: int,
    rule: Rule,
    box: tuple[float, float, float, float] | None = None,
    most_cells: int = MOST_CELLS,
) -> Search:
    """Look for a point of the hull on the rays through a rectangle of a camera's pixels.

    Parameters
    ----------
    hull : Hull
        The visual hull of one frame.
    pencils : Pencils
        Those of its views.
    camera : int
        Along whose rays to look. It must see the point, up to `FARTHEST_M` away, on an object
        pixel of its grown silhouette, asked or not.
    rule : Rule
        Which points count.
    box : (left, right, top, bottom), optional
        The rectangle, pixels; by default the bounding box of the camera's grown silhouette.
    most_cells : int
        When to give up.
    """
    if box is None:
        box = bounding_box(hull, camera, int(rule.tolerance_px[camera]))
    verdict, n_cells, x, y, z = search_cells(
        pencils,
        images_of(hull),
        camera,
        box[0],
        box[1],
        box[2],
        box[3],
        rule.is_asked,
        rule.abstains,
        int(rule.needed),
        rule.tolerance_px,
        most_cells,
    )
    return Search(int(verdict), np.array([x, y, z]) + hull.views.origin_world, int(n_cells))


def search_hull(hull: Hull, pencils: Pencils, rule: Rule, most_cells: int = MOST_CELLS) -> Search:
    """Look for any point of the hull.

    A point that so many cameras see on an object pixel as are needed is seen by one of any
    ``asked - needed + 1`` of them: the rays of the smallest silhouettes are searched.
    """
    asked = np.flatnonzero(rule.is_asked)
    areas = np.array([int(hull.integral(camera)[-1, -1]) for camera in asked.tolist()])
    n_searched = len(asked) - rule.needed + 1
    verdict, n_cells = EMPTY, 0
    for camera in asked[np.argsort(areas, kind="stable")][:n_searched]:
        found = search(hull, pencils, int(camera), rule, None, most_cells)
        n_cells += found.n_cells
        if found.verdict == FOUND:
            return replace(found, n_cells=n_cells)
        if found.verdict == OPEN:
            verdict = OPEN
    return Search(verdict, np.full(3, np.nan), n_cells)


@compiled
def counts(
    x: float,
    y: float,
    z: float,
    pencils: Pencils,
    images: Images,
    is_asked: NDArray[np.bool_],
    abstains: NDArray[np.bool_],
    needed: int,
    tolerance_px: NDArray[np.int64],
) -> bool:
    """Tell whether a point, local frame, counts by a rule, clear of all edges of pixels."""
    matrices, sizes = pencils.matrices, pencils.sizes
    integrals, integral_offset = images.integrals, images.integral_offset
    n_seen = 0
    for camera in range(len(matrices)):
        if not is_asked[camera]:
            continue
        width, height, grown = sizes[camera, 0], sizes[camera, 1], tolerance_px[camera]
        depth_m, pixel_x, pixel_y = project(x, y, z, matrices[camera])
        far = grown + EDGE_PX
        if (
            not depth_m > 0.0
            or not -far < pixel_x < width + far
            or not -far < pixel_y < height + far
        ):
            if not abstains[camera]:
                return False
            continue
        if not is_clear(pixel_x, pixel_y, EDGE_PX):
            return False
        column, row = np.int64(np.floor(pixel_x)), np.int64(np.floor(pixel_y))
        vote = rectangle_vote(
            column - grown,
            column + grown,
            row - grown,
            row + grown,
            width,
            height,
            integral_offset[camera],
            integrals,
            abstains[camera],
            camera,
            images.recorded,
        )
        if vote == REJECTS:
            return False
        n_seen += vote in (ACCEPTS, UNDECIDED)
    return n_seen >= needed


@compiled
def search_cells(
    pencils: Pencils,
    images: Images,
    camera: int,
    left_px: float,
    right_px: float,
    top_px: float,
    bottom_px: float,
    is_asked: NDArray[np.bool_],
    abstains: NDArray[np.bool_],
    needed: int,
    tolerance_px: NDArray[np.int64],
    most_cells: int,
) -> tuple[int, int, float, float, float]:
    """Do what `search` does; return the verdict, the number of cells, and the point, local."""
    sizes, seen, pads = pencils.sizes, pencils.seen[camera], pencils.pads[camera]
    rays, center, scale_m = pencils.rays[camera], pencils.centers_local[camera], pencils.scales_m
    integrals, integral_offset = images.integrals, images.integral_offset
    n_cameras = len(sizes)
    own_width, own_height = sizes[camera, 0], sizes[camera, 1]
    own_grown, depth_m = tolerance_px[camera], scale_m[camera]
    extent_px = float(max(own_width, own_height))
    middle_x, middle_y = 0.5 * own_width, 0.5 * own_height
    waiting = np.zeros((_MOST_WAITING, 6))
    # Bit b: camera b is known to see object pixels wherever it looks at this cell.
    accepted = np.zeros(_MOST_WAITING, np.int64)
    # Who freed the last cell is asked first about the next one.
    order = np.arange(n_cameras)
    waiting[0, 0], waiting[0, 1], waiting[0, 2], waiting[0, 3] = (
        left_px,
        right_px,
        top_px,
        bottom_px,
    )
    waiting[0, 4], waiting[0, 5] = depth_m / (depth_m + FARTHEST_M), 1.0
    n_waiting = 1
    if not (left_px < right_px and top_px < bottom_px):
        n_waiting = 0
    xs, ys, zs = np.zeros(8), np.zeros(8), np.zeros(8)
    n_cells = 0
    is_open = False
    while n_waiting > 0:
        n_waiting -= 1
        n_cells += 1
        if n_cells > most_cells:
            return OPEN, n_cells, np.nan, np.nan, np.nan
        left, right = waiting[n_waiting, 0], waiting[n_waiting, 1]
        top, bottom = waiting[n_waiting, 2], waiting[n_waiting, 3]
        far, near = waiting[n_waiting, 4], waiting[n_waiting, 5]
        n_own = count_pixels(
            int(np.floor(left)) - own_grown,
            int(np.ceil(right)) - 1 + own_grown,
            int(np.floor(top)) - own_grown,
            int(np.ceil(bottom)) - 1 + own_grown,
            own_width,
            own_height,
            integral_offset[camera],
            integrals,
        )
        if n_own == 0:
            continue
        across_x, across_y, along = right - left, bottom - top, 0.0
        n_possible = 1 if is_asked[camera] else 0
        is_free = False
        accepts = accepted[n_waiting]
        u0 = (left - _OWN_PX - middle_x) / extent_px
        u1 = (right + _OWN_PX - middle_x) / extent_px
        v0 = (top - _OWN_PX - middle_y) / extent_px
        v1 = (bottom + _OWN_PX - middle_y) / extent_px
        for place in range(n_cameras):
            other = order[place]
            if other == camera or not is_asked[other]:
                continue
            if other < _MOST_BITS and accepts >> other & 1:
                n_possible += 1
                continue
            m = seen[other]
            width, height, grown = sizes[other, 0], sizes[other, 1], tolerance_px[other]
            z_min, z_max = np.inf, -np.inf
            for corner in range(8):
                u = u1 if corner & 1 else u0
                v = v1 if corner & 2 else v0
                t = near if corner & 4 else far
                s = 1.0 - t
                xs[corner] = s * (m[0, 0] * u + m[0, 1] * v + m[0, 2]) + t * m[0, 3]
                ys[corner] = s * (m[1, 0] * u + m[1, 1] * v + m[1, 2]) + t * m[1, 3]
                zs[corner] = s * (m[2, 0] * u + m[2, 1] * v + m[2, 2]) + t * m[2, 3]
                z_min, z_max = min(z_min, zs[corner]), max(z_max, zs[corner])
            pad_x, pad_y, pad_z = pads[other, 0], pads[other, 1], pads[other, 2]
            # Where depths are this large, a pixel within twice the image is off by little.
            least = 16.0 * pad_z + _SMALLEST_DEPTH
            vote = ABSTAINS if abstains[other] else REJECTS  # as if it never saw the cell
            if z_max <= -least:
                pass
            elif z_min >= least:
                x_min, x_max, y_min, y_max = np.inf, -np.inf, np.inf, -np.inf
                for corner in range(8):
                    xs[corner] /= zs[corner]
                    ys[corner] /= zs[corner]
                    x_min, x_max = min(x_min, xs[corner]), max(x_max, xs[corner])
                    y_min, y_max = min(y_min, ys[corner]), max(y_max, ys[corner])
                pad_px_x = 2.0 * (pad_x + max(abs(x_min), abs(x_max)) * pad_z) / z_min
                pad_px_y = 2.0 * (pad_y + max(abs(y_min), abs(y_max)) * pad_z) / z_min
                x0, x1 = pixel_range(x_min - pad_px_x, x_max + pad_px_x, width, grown)
                y0, y1 = pixel_range(y_min - pad_px_y, y_max + pad_px_y, height, grown)
                vote = rectangle_vote(
                    x0,
                    x1,
                    y0,
                    y1,
                    width,
                    height,
                    integral_offset[other],
                    integrals,
                    abstains[other],
                    other,
                    images.recorded,
                )
                if vote == ACCEPTS:
                    if other < _MOST_BITS:
                        accepts |= 1 << other
                elif x1 >= 0 and y1 >= 0 and x0 < width and y0 < height:
                    for corner in range(8):
                        if not corner & 1:
                            across_x = max(
                                across_x,
                                abs(xs[corner + 1] - xs[corner]),
                                abs(ys[corner + 1] - ys[corner]),
                            )
                        if not corner & 2:
                            across_y = max(
                                across_y,
                                abs(xs[corner + 2] - xs[corner]),
                                abs(ys[corner + 2] - ys[corner]),
                            )
                        if not corner & 4:
                            along = max(
                                along,
                                abs(xs[corner + 4] - xs[corner]),
                                abs(ys[corner + 4] - ys[corner]),
                            )
            else:
                # The cell is cut by the camera's own plane: beside the image, or anywhere.
                left_most, right_most = -np.inf, -np.inf
                top_most, bottom_most = -np.inf, -np.inf
                for corner in range(8):
                    left_most = max(left_most, xs[corner] + grown * zs[corner])
                    right_most = max(right_most, (width + grown) * zs[corner] - xs[corner])
                    top_most = max(top_most, ys[corner] + grown * zs[corner])
                    bottom_most = max(bottom_most, (height + grown) * zs[corner] - ys[corner])
                slack_x = 2.0 * (pad_x + (width + grown) * pad_z)
                slack_y = 2.0 * (pad_y + (height + grown) * pad_z)
                if (
                    left_most >= -slack_x
                    and right_most >= -slack_x
                    and top_most >= -slack_y
                    and bottom_most >= -slack_y
                ):
                    vote = rectangle_vote(
                        ZERO - 1,
                        width,
                        ZERO - 1,
                        height,
                        width,
                        height,
                        integral_offset[other],
                        integrals,
                        abstains[other],
                        other,
                        images.recorded,
                    )
                    by_x, by_y, by_t = 0.0, 0.0, 0.0
                    for corner in range(8):
                        if not corner & 1:
                            by_x = max(by_x, abs(zs[corner + 1] - zs[corner]))
                        if not corner & 2:
                            by_y = max(by_y, abs(zs[corner + 2] - zs[corner]))
                        if not corner & 4:
                            by_t = max(by_t, abs(zs[corner + 4] - zs[corner]))
                    total = by_x + by_y + by_t
                    if total > 0.0:
                        across_x = max(across_x, width * by_x / total)
                        across_y = max(across_y, width * by_y / total)
                        along = max(along, width * by_t / total)
            if vote == REJECTS:
                is_free = True
                for k in range(place, 0, -1):
                    order[k] = order[k - 1]
                order[0] = other
                break
            n_possible += vote in (ACCEPTS, UNDECIDED)
        if is_free or n_possible < needed:
            continue

        u = (0.5 * (left + right) - middle_x) / extent_px
        v = (0.5 * (top + bottom) - middle_y) / extent_px
        t = 0.5 * (far + near)
        away_m = depth_m * (1.0 - t) / t
        x = center[0] + away_m * (rays[0, 0] * u + rays[0, 1] * v + rays[0, 2])
        y = center[1] + away_m * (rays[1, 0] * u + rays[1, 1] * v + rays[1, 2])
        z = center[2] + away_m * (rays[2, 0] * u + rays[2, 1] * v + rays[2, 2])
        if counts(x, y, z, pencils, images, is_asked, abstains, needed, tolerance_px):
            return FOUND, n_cells, x, y, z

        if max(across_x, max(across_y, along)) < _FINEST_PX or n_waiting + 2 > _MOST_WAITING:
            is_open = True
            continue
        for part in range(2):
            for k in range(6):
                waiting[n_waiting + part, k] = waiting[n_waiting, k]
            accepted[n_waiting + part] = accepts
        if along >= across_x and along >= across_y:
            waiting[n_waiting, 5] = waiting[n_waiting + 1, 4] = 0.5 * (far + near)
        elif across_x >= across_y:
            middle = 0.5 * (left + right)
            if right - left > 1.0:
                middle = np.floor(middle)
            waiting[n_waiting, 1] = waiting[n_waiting + 1, 0] = middle
        else:
            middle = 0.5 * (top + bottom)
            if bottom - top > 1.0:
                middle = np.floor(middle)
            waiting[n_waiting, 3] = waiting[n_waiting + 1, 2] = middle
        n_waiting += 2
    return OPEN if is_open else EMPTY, n_cells, np.nan, np.nan, np.nan
