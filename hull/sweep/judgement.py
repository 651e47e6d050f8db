"""What the answers of one row of a sweep are worth: what they missed, and how far off they are."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.cad.scene import SceneObject
from hybridve.hull.contact.detect import Body, collision_points, make_body
from hybridve.hull.query.engine import Hits
from hybridve.hull.report.sweep_data import TruthSettings
from hybridve.hull.sweep.frames import HullFrame
from hybridve.hull.sweep.room import EngineRoom
from hybridve.hull.sweep.truth import (
    COLLIDING,
    FINER,
    FREE,
    BodyTruth,
    Certify,
    affordable_spacing,
    certify_body,
    dense_mesh,
    longest_edges,
    nearest_distances,
    sample_body,
)

#: Points of the truth kept of one object in one frame, beside the witnesses.
TRUTH_POINTS = 50_000


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One way to lay the scene into viewports.

    Attributes
    ----------
    viewport : int
        Samples along every edge; 0 where `accuracy_m` gives each triangle its own.
    accuracy_m : float
        The largest spacing of samples along an edge; NaN where `viewport` is given.
    bodies : list of Body
        The objects.
    """

    viewport: int
    accuracy_m: float
    bodies: list[Body]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The truth of all frames, per frame a `BodyTruth` of each body that is near."""

    frames: list[dict[int, BodyTruth]]
    settings: TruthSettings
    certify_s: NDArray[np.float64]
    sample_s: NDArray[np.float64]
    near_triangles: list[NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """What one engine's answer to one row is worth, over all frames.

    The last two are the distances of the truth's witnesses and of its dense samples.
    """

    n_points: int
    triangles_missed: int
    objects_missed: int
    triangles_against_proof: int
    witness_m: NDArray[np.float64]
    dense_m: NDArray[np.float64]

    @property
    def distances_m(self) -> NDArray[np.float64]:
        """Of all true points to the nearest reported ones."""
        return np.concatenate([self.witness_m, self.dense_m])


def make_rows(
    objects: Sequence[SceneObject], viewports: Sequence[int], accuracy_m: float
) -> list[Row]:
    """Return a row for each viewport, and last the one of an accuracy.

    Raises
    ------
    ValueError
        If the accuracy needs a viewport too large.
    """
    rows = [
        Row(viewport, np.nan, [make_body(one, viewport=viewport) for one in objects])
        for viewport in viewports
    ]
    chosen = [make_body(one, accuracy_m=accuracy_m) for one in objects]
    return [*rows, Row(0, accuracy_m, chosen)]


def samples_asked(frames: Sequence[HullFrame], rows: Sequence[Row]) -> int:
    """Return how many samples an engine that rejects nothing looks at to answer all rows once."""
    return sum(
        int(body.triangles.topology.samples_before[-1])
        for frame in frames
        for row in rows
        for body, is_near in zip(row.bodies, frame.near, strict=True)
        if is_near
    )


def find_truth(
    frames: Sequence[HullFrame],
    rows: Sequence[Row],
    certify: Certify,
    open_at_m: float,
    room: EngineRoom,
    advance: Callable[[], object],
) -> Truth:
    """Return which triangles collide, by certificates, and dense samples of those that do."""
    bodies = rows[0].bodies
    found: list[dict[int, BodyTruth]] = []
    certify_s, sample_s = np.zeros(len(frames)), np.zeros(len(frames))
    near_triangles = [np.zeros(len(body.triangles), np.bool_) for body in bodies]
    for number, frame in enumerate(frames):
        started = time.perf_counter()
        found.append(
            {
                index: certify_body(
                    frame.hull, frame.body(index, bodies[index]), certify, open_at_m
                )
                for index in np.flatnonzero(frame.near).tolist()
            }
        )
        for index, one in found[-1].items():
            near_triangles[index] |= one.verdict != FREE
        certify_s[number] = time.perf_counter() - started
        advance()

    finest_m = min(predicted_m(row, near_triangles) for row in rows)
    spacing_wanted_m = spacing_m = finest_m / FINER
    if finest_m > 0:  # neither NaN, where nothing is near, nor 0, where all that is has no size
        edges_m = np.concatenate(
            [
                longest_edges(body.triangles)[near]
                for body, near in zip(bodies, near_triangles, strict=True)
            ]
        )
        spacing_m = affordable_spacing(edges_m, spacing_wanted_m)
        dense = [
            dense_mesh(body.triangles, near, spacing_m)
            for body, near in zip(bodies, near_triangles, strict=True)
        ]
        for number, frame in enumerate(frames):
            started = time.perf_counter()
            for index, one in found[number].items():
                if (one.verdict != FREE).any():
                    mesh = frame.mesh(index, dense[index])
                    found[number][index] = room.call(
                        sample_body, frame.hull, one, mesh, room.engine, TRUTH_POINTS
                    )
            sample_s[number] = time.perf_counter() - started
    open_most_m = max((one.open_at_m for frame in found for one in frame.values()), default=0.0)
    settings = TruthSettings(open_at_m, open_most_m, spacing_wanted_m, spacing_m, TRUTH_POINTS)
    return Truth(found, settings, certify_s, sample_s, near_triangles)


def judge_all(
    frames: Sequence[HullFrame],
    rows: Sequence[Row],
    rooms: Sequence[EngineRoom],
    truth: Truth,
    advance: Callable[[], object],
    leave_out: Callable[[str, DeviceError], object] | None,
) -> tuple[list[EngineRoom], list[list[Judgement]]]:
    """Return the engines whose devices serve, and what each one's answer to each row is worth."""
    judged: dict[EngineRoom, list[Judgement]] = {room: [] for room in rooms}
    for row in rows:
        known: dict[bytes, NDArray[np.float64]] = {}
        for room in list(judged):
            try:
                judged[room].append(room.call(_judge_row, room, frames, row, truth.frames, known))
            except DeviceError as error:
                if leave_out is None or len(judged) == 1:
                    raise
                leave_out(room.engine.name, error)
                del judged[room]
            advance()
    return list(judged), list(judged.values())


def _judge_row(
    room: EngineRoom,
    frames: Sequence[HullFrame],
    row: Row,
    truth: list[dict[int, BodyTruth]],
    known: dict[bytes, NDArray[np.float64]],
) -> Judgement:
    """Return what an engine's answer to a row is worth.

    Engines mostly agree to the sample: `known` keeps the distances by what was answered.
    """
    n_points = triangles_missed = objects_missed = against_proof = 0
    witness_m, dense_m = [np.zeros(0)], [np.zeros(0)]
    for number, frame in enumerate(frames):
        for index, hits in answer_of(room, frame, row).items():
            one = truth[number][index]
            n_points += len(hits)
            touched = np.zeros(len(one.verdict), np.bool_)
            touched[hits.touched()[0]] = True
            triangles_missed += int((~touched & (one.verdict == COLLIDING)).sum())
            against_proof += int((touched & (one.verdict == FREE)).sum())
            if one.collides and len(hits) == 0:
                objects_missed += 1
            # Done even where the answer is known already: to warm up.
            reported_world, _ = collision_points(frame.body(index, row.bodies[index]), hits)
            true_world = np.concatenate([one.witnesses_world, one.dense_world])
            if len(hits) == 0 or len(true_world) == 0:
                continue
            key = hashlib.sha256(b"%d %d" % (number, index))
            key.update(hits.start.tobytes() + hits.stop.tobytes())
            if key.digest() not in known:
                known[key.digest()] = nearest_distances(true_world, reported_world)
            found_m = known[key.digest()]
            witness_m.append(found_m[: len(one.witnesses_world)])
            dense_m.append(found_m[len(one.witnesses_world) :])
    return Judgement(
        n_points,
        triangles_missed,
        objects_missed,
        against_proof,
        np.concatenate(witness_m),
        np.concatenate(dense_m),
    )


def answer_of(room: EngineRoom, frame: HullFrame, row: Row) -> dict[int, Hits]:
    """Return an engine's hits on the bodies that are near."""
    room.raise_if_left()
    near = np.flatnonzero(frame.near).tolist()
    hull = replace(frame.hull)  # the same arrays, but a hull that no engine has seen
    meshes = [frame.mesh(index, row.bodies[index].triangles) for index in near]
    hits = room.engine.query(hull, meshes)
    return dict(zip(near, hits, strict=True))


def predicted_m(row: Row, near_triangles: list[NDArray[np.bool_]]) -> float:
    """Return the largest edge / (u - 1) of triangles that are near; NaN if there is none."""
    spacings_m = [
        (longest_edges(body.triangles) / np.maximum(body.triangles.viewports - 1, 1))[near]
        for body, near in zip(row.bodies, near_triangles, strict=True)
    ]
    return largest(np.concatenate(spacings_m))


def largest(values: NDArray[np.float64]) -> float:
    """Return the largest value; NaN if there is none."""
    return float(values.max()) if len(values) else float("nan")
