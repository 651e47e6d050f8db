"""What is asked of a hard case, one checker a column: each asserts, and says what it measured.

A checker fails where an answer is wrong. Where it returns, its words are true of what it has just
asserted: "exact" (no answer differs from the truth), or by how much the worst one is off.
"""

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from helpers import exact
from helpers.hard_cases import CASES, ENGINES, MIDDLE, Case, Scene
from helpers.hulls import DOUBLE_BAND_PX, EDGE_BAND_PX
from helpers.polytopes import distance_between
from hybridve.calib.errors import HybridveError
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.contact.clearance import ClearanceMeter
from hybridve.hull.contact.detect import Body, Contact, detect_contacts, make_body
from hybridve.hull.contact.respond import Response, ResponseSettings, collision_point, respond
from hybridve.hull.query.certify import COLLIDING, FREE, OPEN, Certifier
from hybridve.hull.query.compute import Compute
from hybridve.hull.query.engine import Engine, Hits
from hybridve.hull.query.native import Native
from hybridve.hull.query.reference import Reference
from hybridve.hull.query.silhouettes import Hull
from hybridve.hull.query.stencil import Stencil
from hybridve.hull.query.viewport import sample_positions

#: What is asked for, in the units of a scene: how far apart the bounds of a clearance may be, and
#: the diameter of the discs that may hide where a certificate leaves a triangle open.
TOLERANCE, OPEN_AT = 1e-4, 1e-3

#: What lengths that are computed in double precision are true to, in the units of a scene.
LENGTH = 1e-9

#: Stretches of a ray shorter than this are rounding's, in the units of a scene.
ROUNDING = 1e-12

#: Distances of polytopes come from solvers that bound their own error; a tenth of the tolerance.
SOLVER = 1e-5

#: Beyond so many units the hull of a scene does not matter to its mesh.
CUT_OFF = 30.0

#: Triangles of a mesh that are clipped exactly, at most.
FEW = 200

#: The share of a scene's samples that may lie in an engine's band of each camera; a band of 1e-3 px
#: to both sides of both edges is 0.004 of a pixel.
NARROW = 0.02

#: What rounding leaves between the bounds of a clearance, in sizes of the mesh.
ROUNDOFF = 1e-12


@dataclass(frozen=True, slots=True)
class Cell:
    """What was found.

    Attributes
    ----------
    text : str
        As the table has it.
    n_samples, n_in_band, n_differing : int
        Of engines: samples compared, of these within the engine's band of a pixel's edge, and of
        these again taken otherwise than is true.
    """

    text: str
    n_samples: int = 0
    n_in_band: int = 0
    n_differing: int = 0


class Tools:
    """Engines and certifiers that serve all cases."""

    def __init__(self) -> None:
        self._engines: dict[tuple[str, int], Engine] = {}
        self._certifiers: dict[tuple[float, int], Certifier] = {}

    def engine(self, name: str, n_threads: int = 2) -> Engine:
        """Return an engine."""
        make: dict[str, Callable[[], Engine]] = {
            "reference": Reference,
            "native": lambda: Native(n_threads),
            "compute": Compute,
            "stencil": Stencil,
        }
        key = (name, n_threads if name == "native" else 0)
        if key not in self._engines:
            self._engines[key] = make[name]()
        return self._engines[key]

    def certifier(self, open_at_m: float, n_threads: int) -> Certifier:
        """Return a certifier."""
        key = (open_at_m, n_threads)
        if key not in self._certifiers:
            self._certifiers[key] = Certifier(open_at_m, n_threads)
        return self._certifiers[key]

    def close(self) -> None:
        """Release all."""
        for engine in self._engines.values():
            engine.close()
        for certifier in self._certifiers.values():
            certifier.close()
        self._engines.clear()
        self._certifiers.clear()


@dataclass(frozen=True, slots=True, eq=False)
class Built:
    """A scene with what is true of it; all columns share it."""

    scene: Scene
    hull: Hull
    true_hull: Hull
    boxes: list[tuple[int, int, int, int]] | None
    samples: exact.Samples | None


@functools.lru_cache(maxsize=2)
def built(name: str) -> list[Built]:
    """Return the scenes of a case, made once for the columns that come after one another."""
    case = next(case for case in CASES if case.name == name)
    result = []
    for scene in case.build():
        true_hull = scene.truth.hull()
        hull = true_hull if scene.truth is scene else scene.hull()
        mesh = scene.truth.mesh()
        few = int(mesh.topology.samples_before[-1]) < 1 << 22
        result.append(
            Built(
                scene,
                hull,
                true_hull,
                exact.rectangles(true_hull),
                exact.samples(true_hull, mesh) if few else None,
            )
        )
    return result


def check(case: Case, column: str, tools: Tools) -> Cell:
    """Return a cell of the table, or fail."""
    if case.refusal:
        return _check_refusal(case, column)
    pattern = case.refused.get(column)
    try:
        if column in ENGINES:
            return check_engine(built(case.name), tools, column)
        checker = {
            "certificate": check_certificate,
            "clearance": check_clearance,
            "response": check_response,
        }[column]
        return checker(built(case.name), tools)
    except (HybridveError, ValueError) as error:
        return _refusal(pattern, error)


def _refusal(pattern: str | None, error: Exception) -> Cell:
    if pattern is None or not re.search(pattern, str(error)):
        raise AssertionError(f"refused: {error}") from error
    return Cell("refused by name")


def _check_refusal(case: Case, column: str) -> Cell:
    (scene,) = case.build()
    try:
        if column == "clearance":
            ClearanceMeter(scene.vertices, scene.faces, is_closed=False)
        elif column == "response":
            _body(scene)
        else:
            scene.mesh()
    except (ValueError, HybridveError) as error:
        return _refusal(case.refusal, error)
    raise AssertionError("not refused")


# --- engines ------------------------------------------------------------------------------------


def check_engine(scenes: list[Built], tools: Tools, name: str) -> Cell:
    """Compare an engine's samples with exact arithmetic."""
    n_samples = n_in_band = n_differing = 0
    farthest_px = 0.0
    for one in scenes:
        engine = tools.engine(name, one.scene.n_threads)
        mesh = one.scene.mesh()
        (hits,) = engine.query(one.hull, [mesh])
        if name in ("compute", "stencil"):
            band_px = max(EDGE_BAND_PX, one.scene.band_px)
        else:
            band_px = max(DOUBLE_BAND_PX, one.scene.band_px)
        n_here, n_near = int(mesh.topology.samples_before[-1]), 0
        n_samples += n_here
        if one.samples is None:
            edges_px = _differing_edges(one, hits)
        else:
            found = np.zeros(len(one.samples.inside), np.bool_)
            for start, stop in zip(hits.start, hits.stop, strict=True):
                found[start:stop] = True
            edges_px = one.samples.edge_px[found != one.samples.inside]
            if one.scene.recorded is not None:
                _check_recorded(one.scene, found)
            n_near = int((one.samples.edge_px < band_px).sum())
            n_in_band += n_near
        assert (edges_px <= band_px).all(), (
            f"{(edges_px > band_px).sum()} samples differ, to {edges_px.max():.1e} px from an edge"
        )
        n_differing += len(edges_px)
        if one.scene.is_on_edges:
            assert len(edges_px) == 0, f"{len(edges_px)} samples on edges of pixels differ"
        else:
            narrow = 1.0 - (1.0 - NARROW) ** len(one.scene.masks)
            assert n_near <= 3 + narrow * n_here, f"{n_near} of {n_here} samples are in the band"
        farthest_px = max(farthest_px, float(edges_px.max(initial=0.0)))
    text = f"all but {n_differing}, to {_rounded(farthest_px)} px" if n_differing else "exact"
    return Cell(text, n_samples, n_in_band, n_differing)


def _check_recorded(scene: Scene, found: NDArray[np.bool_]) -> None:
    """Check samples against the images as they were recorded."""
    assert scene.recorded is not None
    mesh = scene.mesh()
    counts = np.diff(mesh.topology.samples_before)
    triangle = np.repeat(np.arange(len(mesh)), counts)
    number = np.arange(len(triangle)) - mesh.topology.samples_before[triangle]
    points = sample_positions(
        mesh.corners_world[triangle], mesh.viewports[triangle], number.astype(np.uint32)
    )
    told = scene.recorded(points)
    assert (told == 1).any(), "the recorded images leave nothing in the hull"
    n_lost, n_kept = int((~found & (told == 1)).sum()), int((found & (told == -1)).sum())
    assert n_lost == 0, f"{n_lost} samples on every recorded silhouette are not in the hull"
    assert n_kept == 0, f"{n_kept} samples that a recorded image denies are in the hull"


def _differing_edges(one: Built, hits: Hits) -> NDArray[np.float64]:
    """Return how near a pixel's edge the samples are that differ, of more than can be asked."""
    assert one.boxes is not None
    mesh = one.scene.truth.mesh()
    true = exact.runs_inside(one.true_hull, one.boxes, mesh)
    ends = np.concatenate([hits.start, hits.stop, true[:, 0], true[:, 1]])
    change = np.concatenate([np.ones_like(hits.start), -np.ones_like(hits.stop)])
    change = np.concatenate([change, -np.ones(len(true), np.int64), np.ones(len(true), np.int64)])
    order = np.argsort(ends, kind="stable")
    ends, level = ends[order], np.cumsum(change[order])
    numbers = [
        np.arange(ends[k], ends[k + 1])
        for k in np.flatnonzero(level[:-1] != 0)
        if ends[k + 1] > ends[k]
    ]
    assert len(true), "no sample is inside: nothing was compared"
    return exact.samples(
        one.true_hull, mesh, np.concatenate([np.zeros(0, np.int64), *numbers])
    ).edge_px


# --- certificate --------------------------------------------------------------------------------


def check_certificate(scenes: list[Built], tools: Tools) -> Cell:
    """Compare verdicts with the exact part of each triangle in the hull, or with its samples."""
    n_open = n_triangles = 0
    for one in scenes:
        scene, mesh = one.scene, one.scene.mesh()
        certifier = tools.certifier(OPEN_AT * scene.unit, scene.n_threads)
        found = certifier.certify(one.hull, mesh)
        whole = certifier.certify_mesh(one.hull, mesh)
        assert whole.verdict == found.verdict.max(initial=FREE)
        n_triangles += len(mesh)
        verdicts = found.verdict.tolist()
        n_open += int((found.verdict == OPEN).sum())
        for number in range(0, len(mesh), 1 + len(mesh) // FEW):
            verdict = verdicts[number]
            truth = _truth_of_triangle(one, number)
            if verdict == FREE:
                assert truth != "in", f"triangle {number} is called free, and is not"
            elif verdict == COLLIDING:
                assert truth != "out", f"triangle {number} is said to collide, and does not"
            elif one.boxes is not None:
                assert not _holds_disc(one, number, found.open_at_m[number])
        collides = found.verdict == COLLIDING
        witnesses = found.witness_world[collides]
        at = exact.contains(one.hull, witnesses)
        assert (at.inside | (at.edge_px < scene.band_px)).all(), "a witness is outside"
        faces = mesh.faces[collides]
        for witness, face in list(zip(witnesses, faces, strict=True))[:FEW]:
            off = exact.distance(witness, mesh.vertices_world, face[None])
            size = np.abs(mesh.vertices_world[face]).max()
            assert off <= 1e-14 * max(size, scene.unit), f"a witness is {off} off its triangle"
    return Cell("exact" if n_open == 0 else f"sound, {n_open} of {n_triangles} open")


def _truth_of_triangle(one: Built, number: int) -> str:
    """Return "in" (a point is), "out" (proved), or "" where neither is known."""
    truth = one.scene.truth
    if one.boxes is not None:
        planes = exact.half_spaces(one.true_hull, one.boxes)
        polygon, is_well_in = exact.clipped(
            one.true_hull, planes, truth.vertices[truth.faces[number]]
        )
        return "in" if is_well_in else "" if polygon else "out"
    assert one.samples is not None
    count = truth.viewport * (truth.viewport + 1) // 2
    chosen = slice(number * count, (number + 1) * count)
    well_in = one.samples.inside[chosen] & (one.samples.edge_px[chosen] > one.scene.band_px)
    return "in" if well_in.any() else ""


def _holds_disc(one: Built, number: int, diameter_m: float) -> bool:
    """Tell whether the part of a triangle in a polytope has more area than a disc."""
    assert one.boxes is not None
    truth = one.scene.truth
    corners = truth.vertices[truth.faces[number]]
    planes = exact.half_spaces(one.true_hull, one.boxes)
    polygon, _ = exact.clipped(one.true_hull, planes, corners)
    if len(polygon) < 3 or not np.isfinite(diameter_m):
        return False
    points = np.array(polygon, np.float64) @ corners
    fan = np.cross(points[1:-1] - points[0], points[2:] - points[0])
    area = np.linalg.norm(fan.sum(axis=0)) / 2
    return bool(area > np.pi / 4 * (diameter_m / one.scene.unit) ** 2)


# --- clearance ----------------------------------------------------------------------------------


def check_clearance(scenes: list[Built], tools: Tools) -> Cell:
    """Compare bounds with distances of polytopes and of points of the hull, and check witnesses."""
    off = 0.0
    for one in scenes:
        scene = one.scene
        meter = ClearanceMeter(
            scene.vertices,
            scene.faces,
            is_closed=scene.is_inside is not None,
            tolerance_m=TOLERANCE * scene.unit,
        )
        for apart in (np.zeros(3), scene.apart):
            off = max(off, _check_measured(one, meter, apart) / scene.unit)
    return Cell("exact" if off == 0 else f"to {_rounded(off)} m")


def _check_measured(one: Built, meter: ClearanceMeter, apart: NDArray[np.float64]) -> float:
    """Check the clearance of a mesh that is moved, and return how far the bounds are off."""
    scene, length = one.scene, LENGTH * one.scene.unit
    shift = scene.unit * apart
    found = meter.measure(one.hull, shift)
    vertices = scene.vertices + shift
    assert 0 <= found.lower_m <= found.upper_m, f"from {found.lower_m} to {found.upper_m} m"
    is_solid = scene.is_inside is not None
    assert is_solid == np.isfinite(found.depth_lower_m) == np.isfinite(found.depth_upper_m)
    lowest_m = found.lower_m if not found.depth_upper_m > 0 else -found.depth_upper_m
    if np.isfinite(found.upper_m):
        at = exact.contains(one.hull, found.on_hull_world[None])
        assert at.inside[0], "the point of the hull is not in it"
        away_m = exact.distance(found.on_hull_world, vertices, scene.faces)
        is_in = scene.is_inside is not None and bool(
            scene.is_inside((found.on_hull_world - shift)[None])[0]
        )
        said_m = found.depth_lower_m if is_in else found.upper_m
        rounding = max(length, 4 * np.spacing(np.abs(vertices).max()))
        # The bound is wider than the point's distance by what that may be off.
        assert abs(away_m - said_m) <= rounding + meter.error_m, f"{said_m} m is {away_m} m"
        assert not is_in or found.upper_m == 0, "a point in the solid is called outside of it"
        on_m = exact.distance(found.on_object_world, vertices, scene.faces)
        assert on_m <= rounding, f"the point of the object is {on_m} m off it"
    for point in _points_of_hull(one):
        away_m = exact.distance(point, vertices, scene.faces)
        if scene.is_inside is not None and scene.is_inside((point - shift)[None])[0]:
            away_m = -away_m
        assert away_m >= lowest_m - max(length, 4 * np.spacing(np.abs(vertices).max())), (
            f"a point of the hull is {away_m} m away, said to be {lowest_m} at least"
        )
    width_m = found.upper_m - found.lower_m
    if np.isfinite(found.upper_m):
        most_m = TOLERANCE * scene.unit * (1 + 1e-6) + ROUNDOFF * float(np.ptp(scene.vertices))
        most_m += 2 * meter.error_m
        assert width_m <= most_m, f"bounds are {width_m} m apart"
    true = _true_distance(one, apart)
    if true is None or (is_solid and found.depth_upper_m > 0):
        depth_m = found.depth_upper_m - found.depth_lower_m if is_solid else 0.0
        return max(depth_m, width_m if np.isfinite(width_m) else 0.0)
    low, high = true
    assert np.isfinite(found.upper_m), "no hull was found"
    slack = (SOLVER + scene.band_px) * scene.unit
    assert found.lower_m <= scene.unit * high + slack, f"{found.lower_m} m for {high} at most"
    assert found.upper_m >= scene.unit * low - slack, f"{found.upper_m} m for {low} at least"
    return float(width_m)


@functools.lru_cache(maxsize=4)
def _shape(one: Built) -> NDArray[np.float64] | None:
    """Return the corners (N, 3) of a bounded hull of rectangles, in the likeness's frame."""
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection

    if one.boxes is None:
        return None
    planes = np.array(
        [
            [float(x / max(map(abs, plane[:3]))) for x in plane]
            for plane in exact.half_spaces(one.true_hull, one.boxes)
        ]
    )
    # A hull without end is cut off, where nothing is near.
    planes = np.concatenate([planes, np.eye(4)[:3], -np.eye(4)[:3]])
    planes[-6:, 3] = CUT_OFF
    planes /= np.linalg.norm(planes[:, :3], axis=1)[:, None]
    found = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([-planes[:, :3], np.ones(len(planes))]),
        b_ub=planes[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    if found.status != 0 or found.x[3] < 1e-4:
        return None
    corners = HalfspaceIntersection(-planes, found.x[:3]).intersections
    return np.asarray(np.unique(corners, axis=0) + one.true_hull.views.origin_world)


def _true_distance(one: Built, apart: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return bounds of the distance of a polytope and a moved mesh, in units; None if unknown."""
    corners, truth = _shape(one), one.scene.truth
    if corners is None:
        return None
    low, high = np.inf, np.inf
    triangles = truth.vertices[truth.faces] + apart
    beyond = np.maximum(triangles.min(axis=1) - corners.max(axis=0), 0)
    beyond += np.maximum(corners.min(axis=0) - triangles.max(axis=1), 0)
    at_least = np.linalg.norm(beyond, axis=1)
    # Most likely nearest first: next to the hull's middle.
    middle = np.linalg.norm(triangles.mean(axis=1) - corners.mean(axis=0), axis=1)
    for number in np.argsort(at_least + 1e-3 * middle):
        if at_least[number] > high or high == 0:
            continue
        triangle = triangles[number]
        lower, upper = distance_between(corners, triangle)
        low, high = min(low, lower), min(high, upper)
    return low, high


def _points_of_hull(one: Built) -> NDArray[np.float64]:
    """Return some points that are exactly in the hull, world."""
    rng = np.random.default_rng(0)
    corners = _shape(one)
    if corners is not None:
        shares = rng.dirichlet(np.full(len(corners), 0.2), 30)
        points = shares @ corners
    else:
        points = MIDDLE + rng.normal(size=(4000, 3)) * rng.choice([0.03, 0.1, 0.4], (4000, 1))
    points = one.scene.unit * points + one.scene.shift
    return points[exact.contains(one.hull, points).inside][:30]


# --- response -----------------------------------------------------------------------------------


def _body(scene: Scene) -> Body:
    scene_object = SceneObject(
        "part", Path("part.stl"), scene.vertices, scene.faces, 0.0, np.zeros(3), None
    )
    return make_body(scene_object, viewport=scene.viewport)


def check_response(scenes: list[Built], tools: Tools) -> Cell:
    """Compare CP_obj with the farthest sample that is inside, D_rec with exact crossings."""
    off = 0.0
    n_answers = 0
    for one in scenes:
        scene = one.scene
        engine = tools.engine("native", scene.n_threads)
        (contact,) = detect_contacts(one.hull, [_body(scene)], engine)
        if one.samples is not None:
            assert (
                contact.collides
                or not (one.samples.inside & (one.samples.edge_px > scene.band_px)).any()
            )
        settings = ResponseSettings(height_m=0.05 * scene.unit, reach_m=2.0 * scene.unit)
        ways: list[tuple[NDArray[np.float64], NDArray[np.float64] | None]] = [
            (np.array([0.5, 0.1, 0.4]), None),
            (np.array([-0.2, 0.3, -0.6]), None),
            (np.array([0.1, 0.1, 0.1]), np.array([0.2, -3.0, 1.0])),
            *((reference, None) for reference in scene.references),
        ]
        for reference, direction in ways[: 1 if len(scene.masks) > 20 else None]:
            at = scene.unit * reference + scene.shift
            if contact.collides:
                start = None
                _check_collision_point(one, contact, at)
            else:
                start = scene.vertices.mean(axis=0) if len(scene.vertices) else at + scene.unit
            answer = respond(
                one.hull,
                contact,
                reference_point_world=at,
                recovery_direction=direction,
                settings=settings,
                cp_obj_world=start,
            )
            n_answers += 1
            off = max(off, _check_answer(one.hull, answer, settings, scene) / scene.unit)
    return Cell("exact" if off == 0 else f"to {_rounded(off)} m")


def _check_collision_point(one: Built, contact: Contact, reference: NDArray[np.float64]) -> None:
    """Check CP_obj against the farthest sample that is exactly inside."""
    scene = one.scene
    if one.samples is None:
        return
    mesh = scene.truth.mesh()
    numbers = np.flatnonzero(one.samples.inside & (one.samples.edge_px > scene.band_px))
    if len(numbers) == 0:
        return
    before = mesh.topology.samples_before
    triangle = np.searchsorted(before, numbers, side="right") - 1
    points = sample_positions(
        mesh.corners_world[triangle],
        mesh.viewports[triangle],
        (numbers - before[triangle]).astype(np.uint32),
    )
    local = (reference - scene.shift) / scene.unit
    farthest = np.linalg.norm(points - local, axis=1).max()
    found = (collision_point(contact, reference) - scene.shift) / scene.unit
    # Collision points are kept in single precision.
    rounding = 2.0**-22 * max(1.0, np.abs(points).max())
    away = np.linalg.norm(found - local)
    assert abs(away - farthest) <= rounding, f"CP_obj is {away - farthest} units off"
    assert np.linalg.norm(points - found, axis=1).min() <= rounding, "CP_obj is no sample"


def _check_answer(hull: Hull, answer: Response, settings: ResponseSettings, scene: Scene) -> float:
    """Check a response against exact crossings, and return how far D_rec is off, metres."""
    if answer.status == "no direction":
        raise AssertionError("no direction")
    true = exact.leaves_at(
        hull,
        answer.cp_obj_world,
        answer.v_rec,
        settings.height_m,
        settings.reach_m,
        ROUNDING * scene.unit,
    )
    length = max(LENGTH * scene.unit, 4 * np.spacing(np.abs(answer.cp_obj_world).max()))
    if true is None or true <= length:
        assert answer.status == "outside" or answer.d_rec_m <= length, answer.status
        return float(answer.d_rec_m)
    distance_m = true
    if distance_m >= settings.reach_m:
        assert answer.status == "no exit", f"{answer.status} at {answer.d_rec_m}, expected no exit"
        return 0.0
    assert answer.status in ("", "no normal"), f"{answer.status}, expected {distance_m} m"
    off_m = abs(answer.d_rec_m - distance_m)
    assert off_m <= length, f"D_rec is {answer.d_rec_m} m, expected {distance_m}"
    exit_world = answer.cp_obj_world + distance_m * answer.v_rec
    assert np.linalg.norm(answer.cp_hull_world - exit_world) <= 2 * length
    if answer.status == "":
        assert abs(np.linalg.norm(answer.n_hull) - 1) < 1e-12
        assert answer.n_hull @ answer.v_rec > 0
    if answer.status_paper in ("", "no normal"):
        step_m = settings.height_m / settings.window
        assert -step_m * (1 + 1e-6) <= answer.difference_m <= length
    return off_m


def _rounded(value: float) -> str:
    """Return a number rounded up to one digit: what is off by less than it says."""
    if value == 0:
        return "0"
    exponent = int(np.floor(np.log10(value)))
    digit = int(np.ceil(value / 10.0**exponent - 1e-9))
    return f"{digit}e{exponent}" if digit < 10 else f"1e{exponent + 1}"
