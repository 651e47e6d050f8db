"""What cameras recognise around a symmetric board votes for the way round in which they saw it."""

import numpy as np
import pytest
from helpers.boards import ring
from numpy.typing import NDArray

from hybridve.calib.boards.target import Chessboard
from hybridve.calib.camera import Camera
from hybridve.calib.placing.surroundings import SceneFeatures, choose_looks, count_agreeing
from hybridve.calib.pose import compose, transform

BOARD = Chessboard(8, 6, 0.1)


def votes_for(
    looks: list[int], n_looks: int, edges: dict[tuple[int, int], float], chance: float = 3.0
) -> NDArray[np.float64]:
    votes = np.full((len(looks), len(looks), n_looks), chance)
    for (i, j), count in edges.items():
        votes[i, j, (looks[j] - looks[i]) % n_looks] += count
    return votes


@pytest.mark.parametrize(("looks", "n_looks"), [([0, 1, 1, 0, 1], 2), ([0, 3, 1, 2, 2], 4)])
def test_votes_along_a_chain_give_every_look(looks: list[int], n_looks: int) -> None:
    chain = {(0, 1): 40.0, (1, 2): 30.0, (2, 3): 50.0, (3, 4): 25.0}

    chosen = choose_looks(votes_for(looks, n_looks, chain))

    relative = [(look - chosen.looks[0]) % n_looks for look in chosen.looks]
    assert relative == [(look - looks[0]) % n_looks for look in looks]
    assert chosen.weakest_sigma == pytest.approx(min(chosen.margins_sigma))


def test_many_votes_beat_one_pair_that_errs() -> None:
    looks = [0, 1, 0, 1]
    edges = {(0, 1): 30.0, (1, 2): 30.0, (2, 3): 30.0, (0, 2): 30.0, (1, 3): 30.0}
    votes = votes_for(looks, 2, edges)
    votes[0, 3] = [60.0, 3.0]  # wrong: 0 and 3 differ by a look

    chosen = choose_looks(votes)

    assert [(look - chosen.looks[0]) % 2 for look in chosen.looks] == looks


def test_a_weak_link_between_strong_halves_is_told() -> None:
    looks = [0, 1, 0, 1]
    edges = {(0, 1): 100.0, (2, 3): 100.0, (1, 2): 2.0}

    chosen = choose_looks(votes_for(looks, 2, edges))

    assert min(chosen.margins_sigma) > 5.0  # no single camera is in doubt
    assert chosen.weakest_sigma < 1.0  # but the two halves are


@pytest.mark.parametrize("ahead", [0, 1, 2, 3])
def test_points_of_the_scene_vote_for_the_look_they_were_seen_in(ahead: int) -> None:
    board = Chessboard(6, 6, 0.1)
    first, second = ring(board, ["PINHOLE", "PINHOLE", "PINHOLE"])[:2]
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.0, -1.0, 0.0], [1.0, 1.0, 0.8], (200, 3))
    descriptors = np.eye(200, 128 * 2, dtype=np.float32)[:, : 128 * 2]

    def features(camera: Camera) -> SceneFeatures:
        points_cam = transform(camera.cam_from_world, points)
        nothing = np.zeros((0, 2)), np.zeros((0, 256), np.float32)
        return SceneFeatures(points_cam[:, :2] / points_cam[:, 2:], descriptors, *nothing, 500.0)

    # The second camera's pose is known up to a look only.
    back = board.board_from_turned(-ahead % 4)
    counts = count_agreeing(
        features(first),
        first.cam_from_world,
        features(second),
        compose(second.cam_from_world, back),
        board,
    )

    assert int(np.argmax(counts)) == ahead
    assert counts[ahead] == 200
    assert np.sort(counts)[-2] < 20  # an epipolar line of 3 px passes few other points


def test_matches_under_the_floor_or_behind_a_camera_do_not_count() -> None:
    first, second = ring(BOARD, ["PINHOLE", "PINHOLE", "PINHOLE"])[:2]
    middle = (first.center_world + second.center_world) / 2
    ahead = np.array([[0.35, 0.25, 0.1]])
    counted = {}
    for name, point in {
        "on the floor": ahead,
        "under it": ahead - [0.0, 0.0, 0.9],
        "behind": ahead + 4.0 * (middle - ahead),
    }.items():
        seen = []
        for camera in (first, second):
            points_cam = transform(camera.cam_from_world, point)
            assert (points_cam[0, 2] < 0) == (name == "behind")
            rays = points_cam[:, :2] / points_cam[:, 2:]
            one = np.ones((1, 128), np.float32)
            seen.append(SceneFeatures(rays, one, np.zeros((0, 2)), one[:0], 500.0))
        counted[name] = count_agreeing(
            seen[0], first.cam_from_world, seen[1], second.cam_from_world, BOARD
        )[0]

    assert counted == {"on the floor": 1, "under it": 0, "behind": 0}


def test_no_votes_are_no_evidence() -> None:
    chosen = choose_looks(np.zeros((3, 3, 2)))

    assert chosen.weakest_sigma == 0.0
