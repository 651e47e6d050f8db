"""Generated recordings: they load, they show what they say, and their truth is true."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from hybridve.calib.boards.target import Chessboard, find_corners
from hybridve.calib.errors import SessionError
from hybridve.calib.lens import img_from_cam, project_points, undistortion
from hybridve.calib.pose import compose, transform
from hybridve.hull.cad.scene import Scene, load_scene
from hybridve.hull.capture.session import Session, load_session
from hybridve.hull.query.reference import contains_points
from hybridve.hull.query.silhouettes import make_hull, make_views
from hybridve.hull.synth import (
    BOXES_PASSING_CLEARANCE_M,
    PRESETS,
    Truth,
    read_truth,
    true_masks,
    write_session,
)
from hybridve.hull.synth.meshes import (
    Mesh,
    ball_mesh,
    bored_box_mesh,
    box_mesh,
    bracket_mesh,
    frame_mesh,
    sheet_mesh,
    write_stl,
)
from hybridve.hull.synth.render import make_view, shadow_lookup, shadow_map
from hybridve.hull.synth.shapes import Ball
from hybridve.hull.synth.stage import Lamp

#: Enough for each part of the motion: an arm inside payload_a, the ball beside payload_b, the
#: carton at the bracket.
N_FRAMES = 8

#: What two grey levels of noise and JPEG do to a corner, the worst still of a camera counted; and
#: the mean over all corners of a camera, where only a systematic error is left.
CORNER_RMS_PX = 0.1
CORNER_BIAS_PX = 0.02

#: STL keeps float32 millimetres: parts of 1 m lie within 0.1 micrometres.
MESH_M = 1e-7


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synth") / "boxes"
    write_session("boxes", folder, seed=3, n_frames=N_FRAMES)
    return folder


@pytest.fixture(scope="module")
def truth(folder: Path) -> Truth:
    return read_truth(folder)


@pytest.fixture(scope="module")
def session(folder: Path) -> Session:
    return load_session(folder)


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder / "scene.toml")


@pytest.mark.slow
def test_what_is_written_is_a_session_with_all_its_pictures(session: Session, truth: Truth) -> None:
    sizes = {camera.name: (camera.height_px, camera.width_px) for camera in truth.cameras}
    assert [camera.name for camera in session.cameras] == list(sizes)
    assert session.fps == truth.fps == PRESETS["boxes"].fps
    for camera in session.cameras:
        counts = {}
        for what in ("intrinsics", "extrinsics", "background", "recording"):
            source = getattr(camera, what)
            counts[what] = source.count()
            assert source.first().shape[:2] == sizes[camera.name]
        assert counts == {
            "intrinsics": len(truth.cam_from_board[camera.name]),
            "extrinsics": 10,
            "background": 20,
            "recording": N_FRAMES,
        }


@pytest.mark.slow
def test_cameras_differ_and_see_the_working_volume(truth: Truth) -> None:
    volume = np.array([[x, y, z] for x in (0.1, 0.7) for y in (-0.1, 0.5) for z in (0.0, 0.9)])
    for camera in truth.cameras:
        pixels, depth_m = project_points(camera, volume)
        assert (depth_m > 0).all()
        assert ((pixels > 0) & (pixels < [camera.width_px, camera.height_px])).all()
    assert len({tuple(camera.params) for camera in truth.cameras}) == len(truth.cameras)
    assert len({camera.width_px for camera in truth.cameras}) > 1


@pytest.mark.slow
def test_lenses_never_fold(truth: Truth) -> None:
    for camera in truth.cameras:
        k1, k2 = camera.params[4:6]
        # d/dr of r (1 + k1 r^2 + k2 r^4) is a quadratic in r^2 without a real root.
        assert 9 * k1**2 < 20 * k2


@pytest.mark.slow
@pytest.mark.parametrize("camera_index", range(4))
def test_board_corners_lie_where_the_lens_puts_them(
    session: Session, truth: Truth, camera_index: int
) -> None:
    camera = truth.cameras[camera_index]
    files = session.cameras[camera_index]
    assert session.target is not None
    assert session.target.unit_m is not None
    board = Chessboard(session.target.columns, session.target.rows, session.target.unit_m)
    assert files.intrinsics is not None
    assert files.extrinsics is not None
    poses = truth.cam_from_board[camera.name]
    views = [*zip(files.intrinsics.frames(), poses, strict=True)]
    views += [(image, camera.cam_from_world) for image in files.extrinsics.frames(stop=2)]
    all_errors_px = []

    for image, cam_from_board in views:
        corners = find_corners(image, board)

        assert corners is not None
        expected = img_from_cam(camera, transform(cam_from_board, board.points_board))
        errors_px = corners - expected
        assert np.sqrt((errors_px**2).sum(axis=1).mean()) < CORNER_RMS_PX
        all_errors_px.append(errors_px)
    assert np.abs(np.mean(all_errors_px, axis=(0, 1))).max() < CORNER_BIAS_PX


@pytest.mark.slow
def test_stills_reach_the_corners_of_the_image_and_are_tilted(truth: Truth) -> None:
    board = Chessboard(8, 5, 0.1)
    for camera in truth.cameras:
        pixels = np.array(
            [
                img_from_cam(camera, transform(pose, board.points_board))
                for pose in truth.cam_from_board[camera.name]
            ]
        )
        share = pixels.reshape(-1, 2) / [camera.width_px, camera.height_px]
        for x in (0, 1):
            for y in (0, 1):
                assert np.abs(share - [x, y]).max(axis=1).min() < 0.25
        tilts_deg = np.rad2deg(np.arccos(-truth.cam_from_board[camera.name][:, 2, 2]))
        assert np.ptp(tilts_deg) > 15
        assert tilts_deg.max() < 50


@pytest.mark.slow
def test_only_silhouettes_and_soft_shadows_tell_frames_from_the_background(
    session: Session, truth: Truth, folder: Path
) -> None:
    masks = true_masks(folder, N_FRAMES // 2)
    for camera in session.cameras:
        assert camera.background is not None
        assert camera.recording is not None
        empty = np.mean([image.astype(float) for image in camera.background.frames()], axis=0)
        (image,) = camera.recording.frames(N_FRAMES // 2, N_FRAMES // 2 + 1)
        mask = masks[camera.name]
        away = cv2.dilate(mask, np.ones((7, 7), np.uint8)) == 0
        ratio = cv2.blur(image.astype(float).mean(axis=2), (7, 7)) / cv2.blur(
            empty.mean(axis=2), (7, 7)
        )

        # Away from the silhouettes there is the room, as bright as the lamps, or in shadow.
        gain = np.median(ratio)
        ratio = ratio / gain
        assert 0.96 < gain < 1.04
        assert ratio[away].max() < 1.05
        assert ratio[away].min() > 0.55
        in_shadow = away & (ratio < 0.9)
        assert 0.001 < in_shadow.mean() < 0.1
        # On them something else.
        difference = np.abs(image / gain - empty).max(axis=2)
        assert np.median(difference[mask > 0]) > 30
        assert np.median(difference[away & ~in_shadow]) < 5


def test_the_shadow_of_a_ball_lies_in_line_with_the_lamp_and_is_soft() -> None:
    room = PRESETS["boxes"].make_stage().room
    lamp = Lamp((0.9, 0.1, 3.0), 0.2, 0.4)
    center = np.array([0.6, 0.2, 0.75])
    pose = np.column_stack([np.eye(3), center])

    shadow = shadow_map(lamp, room, [Ball(0.15)], [pose])

    # From 3 m above, by way of 0.75 m: a third beyond the ball.
    expected = np.array(lamp.position_world[:2]) + (4 / 3) * (center - lamp.position_world)[:2]
    rows, columns = np.indices(shadow.shape)
    found = [(shadow * k).sum() / shadow.sum() for k in (columns, rows)]
    pixel_m = 4.0 / shadow.shape[0]
    found_world = room.center_world + (np.array(found) + 0.5) * pixel_m - 2.0
    assert np.linalg.norm(found_world - expected) < pixel_m
    assert shadow.max() == pytest.approx(1.0, abs=1e-3)
    penumbra = ((shadow > 0.05) & (shadow < 0.95)).sum() * pixel_m**2
    # Between circles of 0.20 m -+ a lamp of 0.20 m seen from three times as far.
    ring = np.pi * ((0.2 + 0.0667) ** 2 - (0.2 - 0.0667) ** 2)
    assert 0.6 * ring < penumbra < 1.1 * ring


@pytest.mark.slow
def test_shadows_lie_on_the_floor_where_cameras_see_it() -> None:
    stage = PRESETS["boxes"].make_stage()
    x, y = np.meshgrid(np.linspace(-0.3, 0.9, 9), np.linspace(-0.3, 0.7, 9))
    on_floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    pixel_m = 0.01
    expected = (on_floor[:, :2] - stage.room.center_world + 2.0) / pixel_m - 0.5
    for camera in stage.cameras:
        pixels, _ = project_points(camera, on_floor)

        lookup = shadow_lookup(make_view(camera), stage.room)

        places = (pixels - 0.5).astype(np.float32)[:, None]  # OpenCV's convention
        x_px, y_px = places[..., 0], places[..., 1]
        found = [cv2.remap(part, x_px, y_px, cv2.INTER_LINEAR)[:, 0] for part in lookup]
        # Remap interpolates at 1/32 pixel, and a pixel is up to two texels long on the floor.
        np.testing.assert_allclose(np.stack(found, axis=1), expected, atol=0.1)


@pytest.mark.slow
def test_objects_behave_as_the_preset_says(truth: Truth) -> None:
    payload_a, payload_b = truth.objects["payload_a"], truth.objects["payload_b"]
    bracket, shelf = truth.objects["bracket"], truth.objects["shelf"]
    assert 0 < payload_a.collides.sum() < N_FRAMES
    assert set(np.array(payload_a.nearest_shape)[payload_a.collides]) == {"fist"}
    assert 0 < bracket.collides.sum() < N_FRAMES
    assert not payload_b.collides.any()
    assert payload_b.clearance_m.min() == pytest.approx(
        BOXES_PASSING_CLEARANCE_M, abs=truth.tolerance_m
    )
    assert not shelf.collides.any()
    assert shelf.clearance_m.min() > 0.5
    rotated = [
        name
        for name, found in truth.objects.items()
        if not np.allclose(found.world_from_mesh[:, :3], np.eye(3))
    ]
    assert rotated == ["bracket"]


@pytest.mark.slow
def test_while_it_collides_an_object_has_no_clearance_and_else_no_penetration(
    truth: Truth,
) -> None:
    for found in truth.objects.values():
        np.testing.assert_array_equal(found.collides, found.penetration_m > 0)
        np.testing.assert_array_equal(found.collides, found.clearance_m == 0)


@pytest.mark.slow
def test_the_hull_is_no_farther_than_the_shapes_and_says_so_only_within_its_reach(
    truth: Truth,
) -> None:
    for name, found in truth.objects.items():
        assert (found.hull_collides >= found.collides).all()
        np.testing.assert_array_equal(found.hull_collides, found.hull_clearance_m == 0)
        near = found.clearance_m < truth.hull_reach_m - truth.hull_resolution_m
        if name != "shelf":
            assert near.any()
        allowed_m = found.clearance_m[near] + truth.tolerance_m + 2e-9
        assert (found.hull_clearance_m[near] <= allowed_m).all()
        assert (found.hull_clearance_m[~np.isnan(found.hull_clearance_m)] <= 0.1).all()


@pytest.mark.slow
def test_contacts_begin_between_the_frames_that_show_them(truth: Truth) -> None:
    for found in truth.objects.values():
        began = np.flatnonzero(found.collides[1:] & ~found.collides[:-1])
        for frame in began:
            inside = (found.contact_times_s * truth.fps >= frame) & (
                found.contact_times_s * truth.fps <= frame + 1
            )
            assert inside.sum() == 1
        assert len(found.contact_times_s) == len(found.contact_points_m)
    # The arm enters once; at frames so far apart nothing is missed that a frame shows.
    assert len(truth.objects["payload_a"].contact_times_s) == 1
    assert len(truth.objects["shelf"].contact_times_s) == 0


@pytest.mark.slow
def test_clearances_and_penetrations_are_those_of_the_files_written(
    truth: Truth, scene: Scene
) -> None:
    steps = 16
    i, j = (k.ravel() for k in np.mgrid[: steps + 1, : steps + 1])
    keep = i + j <= steps
    u, v = (k[keep][:, None] / steps for k in (i, j))
    assert [thing.name for thing in scene.objects] == list(truth.objects)
    for thing in scene.objects:
        found = truth.objects[thing.name]
        corners = thing.vertices_world[thing.faces]
        a, b, c = (corners[:, None, k] for k in range(3))
        samples = (a + (b - a) * u + (c - a) * v).reshape(-1, 3)
        spacing_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() / steps
        for frame in range(N_FRAMES):
            sampled = min(
                shape.signed_distance(
                    (samples - truth.world_from_shape[name][frame, :, 3])
                    @ truth.world_from_shape[name][frame, :, :3]
                )[0].min()
                for name, shape in truth.shapes.items()
            )
            distance_m = found.clearance_m[frame] - found.penetration_m[frame]
            assert sampled - spacing_m < distance_m <= sampled + truth.tolerance_m + MESH_M
            # The point named is of the surface: no farther from a sample than they are apart.
            offsets = samples - found.nearest_on_object_m[frame]
            assert np.sqrt((offsets**2).sum(axis=1).min()) < spacing_m


@pytest.mark.slow
def test_the_hull_of_the_true_silhouettes_touches_what_the_true_shapes_touch(
    truth: Truth, scene: Scene, folder: Path
) -> None:
    lenses = [undistortion(camera) for camera in truth.cameras]
    views = make_views(
        tuple(camera.name for camera in truth.cameras),
        np.array([[lens.width_px, lens.height_px] for lens in lenses]),
        np.array(
            [
                lens.img_from_cam @ camera.cam_from_world
                for lens, camera in zip(lenses, truth.cameras, strict=True)
            ]
        ),
    )
    footprint_m = 0.005  # of a pixel, at the farthest part of the working volume
    for frame in range(N_FRAMES):
        masks = true_masks(folder, frame)
        straight = []
        for lens, camera in zip(lenses, truth.cameras, strict=True):
            assert lens.map_x is not None
            assert lens.map_y is not None
            moved = cv2.remap(masks[camera.name], lens.map_x, lens.map_y, cv2.INTER_NEAREST)
            straight.append(np.asarray(moved, np.uint8))
        hull = make_hull(views, straight)
        for thing in scene.objects:
            found = truth.objects[thing.name]
            at_deepest = contains_points(hull, found.nearest_on_object_m[frame : frame + 1])
            if found.penetration_m[frame] > footprint_m:
                assert at_deepest[0]
            if not found.collides.any():  # and objects that stay free are free of the hull too
                corners = thing.vertices_world[thing.faces].reshape(-1, 3, 3)
                samples = np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1)])
                assert not contains_points(hull, samples).any()


@pytest.mark.slow
def test_shapes_that_move_as_one_stay_together(truth: Truth) -> None:
    # The forearm's near end lies in the fist, the rod's in the ball, in every frame.
    for name, other in (("forearm", "fist"), ("rod", "ball")):
        for frame in range(N_FRAMES):
            half_length_m = truth.shapes[name].sizes_m[0]
            pose = truth.world_from_shape[name][frame]
            ends = transform(pose, half_length_m * np.array([[0, 0, -1.0], [0, 0, 1.0]]))
            center = truth.world_from_shape[other][frame][:, 3]
            radius_m = truth.shapes[other].sizes_m[0]
            assert np.linalg.norm(ends - center, axis=1).min() < radius_m


def test_real_things_do_not_run_through_each_other() -> None:
    stage = PRESETS["boxes"].make_stage()
    for moment in np.linspace(0.0, 1.0, 97):
        groups = []
        for actor in stage.actors:
            world_from_actor = actor.world_from_actor(float(moment))
            groups.append(
                [
                    (real.shape, compose(world_from_actor, real.actor_from_shape))
                    for real in actor.shapes
                ]
            )
        for index, group in enumerate(groups):
            for shape, pose in group:
                outline = transform(pose, shape.outline())
                for other in groups[:index]:
                    for other_shape, other_pose in other:
                        local = (outline - other_pose[:, 3]) @ other_pose[:, :3]
                        assert other_shape.signed_distance(local)[0].min() > 0.02


@pytest.mark.slow
def test_every_dataset_says_what_it_is(folder: Path) -> None:
    found = []

    def look(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found.append(name)
            assert item.attrs["description"]
            assert "unit" in item.attrs
            assert item.fletcher32

    with h5py.File(folder / "truth.h5") as file:
        file.visititems(look)
    assert len(found) > 30


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_overwriting_leaves_nothing_old(
    folder: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    again.mkdir()
    shutil.copy(folder / "truth.h5", again)  # a generated recording stands there already
    (again / "meshes").mkdir()
    (again / "meshes" / "old.txt").write_text("old")

    write_session("boxes", again, seed=3, n_frames=N_FRAMES, overwrite=True)

    names = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert len(names) > 60
    for name in names:
        assert (folder / name).read_bytes() == (again / name).read_bytes(), name


@pytest.mark.slow
def test_a_taken_folder_is_refused_and_left_alone(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")

    for overwrite in (False, True):
        with pytest.raises(SessionError, match="holds no generated recording"):
            write_session("boxes", tmp_path, overwrite=overwrite)
    with pytest.raises(SessionError, match="holds a generated recording already"):
        write_session("boxes", folder)

    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert read_truth(folder).seed == 3


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda path: write_session("boxs", path), "no preset 'boxs'; one of boxes"),
        (lambda path: write_session("boxes", path, n_frames=0), "0 frames asked for"),
        (lambda path: write_session("boxes", path, seed=-1), "the seed is -1"),
        (lambda path: write_session("boxes", Path("/proc/none")), "cannot be written"),
        (lambda path: read_truth(path), "was not generated"),
        (lambda path: true_masks(path, 0), "was not generated"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    tmp_path: Path, ask: Callable[[Path], object], message: str
) -> None:
    with pytest.raises(SessionError, match=message) as caught:
        ask(tmp_path / "new")

    assert "\n" not in str(caught.value)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_interrupted_it_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupt(what: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_session("boxes", tmp_path / "new", n_frames=1, progress=interrupt)

    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_frame_that_is_not_there_is_refused(folder: Path) -> None:
    for frame in (-1, N_FRAMES):
        with pytest.raises(SessionError, match=f"there is no frame {frame}; it has {N_FRAMES}"):
            true_masks(folder, frame)


def test_another_version_of_the_truth_is_refused_by_name(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "truth.h5", "w") as file:
        file.attrs.update(format="hybridve-truth", version=99)

    with pytest.raises(SessionError, match=r"version 99, expected 'hybridve-truth' version 2"):
        read_truth(tmp_path)


@pytest.mark.parametrize(
    ("mesh", "volume_mm3"),
    [
        (box_mesh((240.0, 180.0, 160.0), 30.0), 240 * 180 * 160),
        (box_mesh((10.0, 10.0, 10.0), 100.0), 1000),
        (bracket_mesh((160.0, 120.0, 140.0), 30.0, 25.0), 120 * (160 * 30 + 30 * 110)),
        (frame_mesh((800.0, 50.0, 900.0), 60.0, 70.0), 50 * (800 * 900 - 680 * 780)),
        (  # less a prism over a regular polygon
            bored_box_mesh((240.0, 200.0, 220.0), 32.0, 100.0, 24, 45.0),
            240 * 200 * 220 - 100 * 12 * 32**2 * np.sin(np.pi / 12),
        ),
        (  # an icosahedron: its edge is 4 / sqrt(10 + 2 sqrt 5) of the radius
            ball_mesh(50.0, 0),
            5 / 12 * (3 + np.sqrt(5)) * (50 * 4 / np.sqrt(10 + 2 * np.sqrt(5))) ** 3,
        ),
    ],
)
def test_meshes_are_closed_face_outwards_and_hold_their_volume(
    mesh: Mesh, volume_mm3: float
) -> None:
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}

    a, b, c = np.moveaxis(mesh.triangles_mm, 1, 0)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6

    assert len(directed) == len(edges)  # each edge once in each direction
    assert {(b, a) for a, b in directed} == directed
    assert volume == pytest.approx(volume_mm3)
    assert len(np.unique(mesh.vertices_mm, axis=0)) == len(mesh.vertices_mm)


@pytest.mark.parametrize("halvings", [1, 2, 3])
def test_a_ball_of_triangles_is_closed_round_and_has_corners_on_the_axes(halvings: int) -> None:
    mesh = ball_mesh(50.0, halvings)

    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(mesh.faces) == 20 * 4**halvings
    assert len(mesh.vertices_mm) == 10 * 4**halvings + 2
    assert {(b, a) for a, b in directed} == directed
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices_mm, axis=1), 50.0)
    for corner in 50.0 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert np.linalg.norm(mesh.vertices_mm - corner, axis=1).min() < 1e-9
    # It lies between the sphere about it and the one within, and faces outwards.
    a, b, c = np.moveaxis(mesh.triangles_mm, 1, 0)
    normals = np.cross(b - a, c - a)
    depth = np.einsum("ij,ij->i", a, normals) / np.linalg.norm(normals, axis=1)
    volume = np.einsum("ij,ij->i", a, normals).sum() / 6
    assert 4 / 3 * np.pi * depth.min() ** 3 < volume < 4 / 3 * np.pi * 50.0**3


def test_a_sheet_is_one_piece_with_a_border_and_the_area_of_its_folds() -> None:
    mesh = sheet_mesh((720.0, 800.0), (24, 15), 12.0, 4)

    edges = np.sort(
        np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    )
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert len(mesh.faces) == 720
    assert (counts == 1).sum() == 2 * (24 + 15)
    assert (counts == 2).sum() == (3 * 720 - 2 * (24 + 15)) // 2
    a, b, c = np.moveaxis(mesh.triangles_mm, 1, 0)
    # Six steps of 30 mm to a fold, at 0, +-60 and +-120 degrees: two level, four by 12 sin 60.
    width = 4 * (2 * 30.0 + 4 * np.hypot(30.0, 12.0 * np.sqrt(3) / 2))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(800.0 * width)


def test_a_bore_that_does_not_fit_is_refused() -> None:
    for radius_mm, depth_mm, sides in ((100.0, 50.0, 24), (20.0, 220.0, 24), (20.0, 50.0, 23)):
        with pytest.raises(ValueError, match=r"leaves the box|multiple of four"):
            bored_box_mesh((240.0, 200.0, 220.0), radius_mm, depth_mm, sides, 45.0)


def test_triangles_are_no_longer_than_the_spacing() -> None:
    mesh = bracket_mesh((160.0, 120.0, 140.0), 30.0, 25.0)

    extents = np.ptp(mesh.triangles_mm, axis=1)

    assert extents.max() <= 25.0 + 1e-9


def test_stl_is_binary_and_reads_back(tmp_path: Path) -> None:
    mesh = box_mesh((30.0, 20.0, 10.0), 10.0)

    write_stl(tmp_path / "part.stl", mesh, "part, millimetres")

    data = (tmp_path / "part.stl").read_bytes()
    assert data[:80].rstrip() == b"part, millimetres"
    assert int.from_bytes(data[80:84], "little") == len(mesh.faces)
    assert len(data) == 84 + 50 * len(mesh.faces)
    facets = np.frombuffer(data[84:], np.dtype([("floats", "<f4", (4, 3)), ("attributes", "<u2")]))[
        "floats"
    ]
    np.testing.assert_allclose(facets[:, 1:], mesh.triangles_mm, atol=1e-5)
    outwards = np.cross(facets[:, 2] - facets[:, 1], facets[:, 3] - facets[:, 1])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    np.testing.assert_allclose(facets[:, 0], outwards, atol=1e-6)
