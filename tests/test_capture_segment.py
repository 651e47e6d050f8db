"""Objects are cut out of frames; noise, shadows, the camera's gain and a shift by a pixel are not.

Scenes are generated: a background with texture at several scales, on which objects of known shape
are laid. The recordings at the end come with masks painted by hand and with ground truth.
"""

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.thorough import asked
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybridve.calib.errors import SessionError
from hybridve.calib.image_io import FrameSource, open_source, read_image
from hybridve.hull.capture.background import Background, learn_background
from hybridve.hull.capture.segment import Segmenter, SegmentSettings, clean

_FEW = settings(max_examples=asked(20))

WIDTH, HEIGHT = 160, 120
NOISE = 2.0  # grey levels

#: Colours that no shadow of the greenish background has, BGR.
OBJECT_COLOURS = [(40, 40, 200), (220, 120, 60), (25, 25, 25), (235, 60, 235)]

#: Share of pixels: of a tenth that are wrong, five of nine meet in one place in a thousand.
OUTVOTED = 0.005

Bytes = NDArray[np.uint8]
Reals = NDArray[np.float64]

seeds = st.integers(0, 2**32 - 1)


def a_scene(rng: np.random.Generator, width: int = WIDTH, height: int = HEIGHT) -> Reals:
    """Return a (H, W, 3) greenish background of 70 to 200 grey levels, smooth and rough texture."""
    texture = np.zeros((height, width))
    for sigma_px, strength in ((20.0, 30.0), (4.0, 8.0), (1.0, 6.0)):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma_px)
        texture += strength * layer / layer.std()
    brightness = np.clip(135 + texture, 80, 190)
    return np.stack([brightness * factor for factor in (0.9, 1.05, 0.85)], axis=2)


def recorded(rng: np.random.Generator, scene: Reals, noise: float = NOISE) -> Bytes:
    return np.clip(np.round(scene + rng.normal(0, noise, scene.shape)), 0, 255).astype(np.uint8)


def learnt(rng: np.random.Generator, scene: Reals, noise: float = NOISE) -> Background:
    return learn_background(recorded(rng, scene, noise) for _ in range(20))


def a_segmenter(rng: np.random.Generator, scene: Reals, **changes: float) -> Segmenter:
    return Segmenter(learnt(rng, scene), SegmentSettings(**changes))  # type: ignore[arg-type]


def ellipse(center: tuple[float, float], axes: tuple[float, float], degrees: float) -> Bytes:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.ellipse(mask, (center, (2 * axes[0], 2 * axes[1]), degrees), 1, -1)
    return mask


@st.composite
def shapes(draw: st.DrawFn) -> Bytes:
    """Ellipses, convex polygons and bars, of 6 pixels and more across, anywhere in the image."""
    x, y = draw(st.integers(10, WIDTH - 10)), draw(st.integers(10, HEIGHT - 10))
    kind = draw(st.sampled_from(["ellipse", "polygon", "bar"]))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    if kind == "ellipse":
        axes = draw(st.integers(5, 30)), draw(st.integers(5, 30))
        return ellipse((x, y), axes, draw(st.integers(0, 180)))
    if kind == "polygon":
        rng = np.random.default_rng(draw(seeds))
        points = np.array([x, y]) + rng.integers(-30, 31, (8, 2))
        points = np.concatenate([points, [[x - 6, y - 6], [x + 6, y - 6], [x, y + 6]]])
        cv2.fillConvexPoly(mask, cv2.convexHull(points.astype(np.int32)), 1)
        return mask
    direction = draw(st.integers(0, 180))
    corners = cv2.boxPoints(((x, y), (draw(st.integers(30, 90)), 8), direction))
    cv2.fillConvexPoly(mask, np.round(corners).astype(np.int32), 1)
    return mask


def laid_over(scene: Reals, mask: Bytes, colour: tuple[int, int, int]) -> Reals:
    """Return the scene with an object, whose pixels at the edge are half and half."""
    soft = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), 0.5)[..., None]
    return soft * np.array(colour, np.float64) + (1 - soft) * scene


def assert_boundary_within(found: Bytes, truth: Bytes, reach_px: int = 1) -> None:
    """Assert that a mask lies between the truth shrunk and the truth grown by some pixels."""
    window = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    shrunk = cv2.erode(truth, window, borderType=cv2.BORDER_REPLICATE) > 0
    grown = cv2.dilate(truth, window) > 0
    assert not (shrunk & (found == 0)).any(), "part of the object is missing"
    assert not ((found > 0) & ~grown).any(), "background is taken for object"


#: No shadow can then explain what is darker or brighter.
NO_SHADOWS = {"shadow_darkest": 1.0, "shadow_brightest": 1.0}


@_FEW
@given(
    seed=seeds,
    noise=st.floats(0, 4),
    gain=st.floats(0.85, 1.18),
    changes=st.sampled_from([{}, NO_SHADOWS]),
)
def test_noise_and_gain_alone_make_no_object(
    seed: int, noise: float, gain: float, changes: dict[str, float]
) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    segmenter = Segmenter(
        learnt(rng, scene, noise),
        SegmentSettings(speck_px=0, **changes),  # type: ignore[arg-type]
    )

    for _ in range(5):
        mask = segmenter.segment(recorded(rng, gain * scene, noise))

        assert mask.shape == (HEIGHT, WIDTH)
        assert mask.dtype == np.uint8
        assert not mask.any()


@_FEW
@given(
    seed=seeds,
    shape=shapes(),
    colour=st.sampled_from(OBJECT_COLOURS),
    gain=st.sampled_from([1.0, 1.0, 0.94, 1.06]),
)
def test_boundaries_are_right_to_a_pixel(
    seed: int, shape: Bytes, colour: tuple[int, int, int], gain: float
) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    segmenter = a_segmenter(rng, scene)

    mask = segmenter.segment(recorded(rng, gain * laid_over(scene, shape, colour)))

    assert_boundary_within(mask, shape)


def shadow(center: tuple[float, float], axes: tuple[float, float], darkest: float) -> Reals:
    """Return (H, W, 1) factors of a shadow with an edge as soft as at 10 pixels."""
    hard = ellipse(center, axes, 20).astype(np.float64)
    return np.asarray(1 - (1 - darkest) * cv2.GaussianBlur(hard, (0, 0), 5)[..., None], np.float64)


@_FEW
@given(seed=seeds, darkest=st.floats(0.55, 0.95), x=st.integers(20, 140), y=st.integers(20, 100))
def test_a_shadow_is_no_object(seed: int, darkest: float, x: int, y: int) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    segmenter = a_segmenter(rng, scene)

    mask = segmenter.segment(recorded(rng, scene * shadow((x, y), (35, 20), darkest)))

    assert not mask.any()


@_FEW
@given(seed=seeds, colour=st.sampled_from(OBJECT_COLOURS))
def test_an_object_is_told_from_the_shadow_it_casts(
    seed: int, colour: tuple[int, int, int]
) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    segmenter = a_segmenter(rng, scene)
    truth = ellipse((80, 50), (14, 30), 10)

    shaded = scene * shadow((90, 85), (45, 14), 0.65)
    mask = segmenter.segment(recorded(rng, laid_over(shaded, truth, colour)))

    # Where the object meets its shadow, half-and-half pixels are darker than the empty scene.
    assert_boundary_within(mask, truth, 2)


@_FEW
@given(seed=seeds, level=st.floats(180, 220), square_px=st.integers(1, 4), x=st.integers(0, WIDTH))
def test_what_has_the_colour_of_a_shadow_but_not_the_texture_is_an_object(
    seed: int, level: float, square_px: int, x: int
) -> None:
    rng = np.random.default_rng(seed)
    scene = level * np.ones((HEIGHT, WIDTH, 1)) * (0.9, 1.05, 0.85)
    truth = ellipse((x, 60), (30, 20), 0)
    segmenter = a_segmenter(rng, scene)

    # A chessboard of two shadows. Any 7 x 7 pixels have as many of both, but for one, so that each
    # factor is off their mean by 0.181; an object is what is off by 0.143 (the shadow's threshold,
    # the share of unseen colours and the least variation of a shade, at the darkest level). Noise
    # adds 0.006 to a factor: between the two there are 6 sigma, and it takes five pixels of nine.
    rows, columns = np.indices((HEIGHT, WIDTH)) // square_px
    factor = np.where((rows + columns) % 2 == 1, 0.5, 0.87)
    painted = scene * np.where(truth > 0, factor, 1)[..., None]
    mask = segmenter.segment(recorded(rng, painted))

    # Of what is nearer to the border than the 7 x 7 pixels reach, the scene around may be part.
    window = np.ones((9, 9), np.uint8)
    assert mask[cv2.erode(truth, window, borderType=cv2.BORDER_REPLICATE) > 0].all()
    assert not mask[cv2.dilate(truth, np.ones((3, 3), np.uint8)) == 0].any()


@pytest.mark.slow
def test_without_shadows_allowed_they_are_objects() -> None:
    rng = np.random.default_rng(3)
    scene = a_scene(rng)
    segmenter = a_segmenter(rng, scene, shadow_darkest=1.0, shadow_brightest=1.0)

    mask = segmenter.segment(recorded(rng, scene * shadow((80, 60), (35, 20), 0.6)))

    assert mask[60, 80] == 1


@_FEW
@given(seed=seeds, right=st.integers(-1, 1), down=st.integers(-1, 1), darker=st.booleans())
def test_a_picture_that_is_off_by_a_pixel_shows_no_object(
    seed: int, right: int, down: int, darker: bool
) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    scene[20:100:12, 20:140] += -70 if darker else 50  # lines, as of tiles
    scene[20:100, 20:140:12] += -70 if darker else 50
    segmenter = a_segmenter(rng, scene, speck_px=0, **NO_SHADOWS)

    mask = segmenter.segment(recorded(rng, np.roll(scene, (down, right), axis=(0, 1))))

    # np.roll brings rows and columns in from the other side.
    assert not mask[2:-2, 2:-2].any()


@_FEW
@given(seed=seeds)
def test_single_pixels_are_outvoted_by_those_around_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    truth = ellipse((80, 60), (30, 40), 0)
    wrong = rng.random((HEIGHT, WIDTH)) < 0.1
    segmenter = a_segmenter(rng, scene, speck_px=0, hole_px=0)

    # A tenth of the object lets the scene show through, a tenth of the scene has its colour.
    picture = np.where((truth[..., None] > 0) ^ wrong[..., None], (40, 40, 200), scene)
    mask = segmenter.segment(recorded(rng, picture))

    assert (mask != truth)[cv2.erode(truth, np.ones((5, 5))) > 0].mean() < OUTVOTED
    assert (mask != truth)[cv2.dilate(truth, np.ones((5, 5))) == 0].mean() < OUTVOTED


@_FEW
@given(seed=seeds)
def test_a_picture_depends_on_itself_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = a_scene(rng)
    background = learnt(rng, scene)
    pictures = [
        recorded(rng, laid_over(scene, ellipse((x, 60), (20, 30), 0), colour))
        for x, colour in zip((20, 60, 100, 140), OBJECT_COLOURS, strict=True)
    ]
    one = Segmenter(background, SegmentSettings())

    forth = [one.segment(picture) for picture in pictures]
    back = [one.segment(picture) for picture in reversed(pictures)][::-1]
    alone = [Segmenter(background, SegmentSettings()).segment(picture) for picture in pictures]

    np.testing.assert_array_equal(forth, back)
    np.testing.assert_array_equal(forth, alone)


def test_threads_that_share_a_segmenter_get_what_each_would_alone() -> None:
    rng = np.random.default_rng(0)
    scene = a_scene(rng)
    segmenter = a_segmenter(rng, scene)
    pictures = [
        recorded(rng, laid_over(scene, ellipse((x, 60), (20, 30), 0), (40, 40, 200)))
        for x in (30, 130)
    ]
    alone = [segmenter.segment(picture) for picture in pictures]
    wrong: list[int] = []

    def repeat(which: int) -> None:
        for _ in range(100):
            if (segmenter.segment(pictures[which]) != alone[which]).any():
                wrong.append(which)

    threads = [threading.Thread(target=repeat, args=(which,)) for which in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert not wrong


def test_opencv_threads_are_left_as_they_are() -> None:
    rng = np.random.default_rng(0)
    scene = a_scene(rng)
    before = cv2.getNumThreads()

    a_segmenter(rng, scene).segment(recorded(rng, scene))

    assert cv2.getNumThreads() == before


def test_a_black_scene_shows_what_is_bright_in_it() -> None:
    background = learn_background([np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 5)
    truth = ellipse((80, 60), (20, 30), 0)

    mask = Segmenter(background, SegmentSettings()).segment(
        np.repeat(200 * truth[..., None], 3, axis=2)
    )

    assert_boundary_within(mask, truth)


def test_a_scene_that_varies_by_itself_takes_more() -> None:
    """A screen in the background: what would be an object elsewhere is its own doing."""
    rng = np.random.default_rng(0)
    scene = np.full((HEIGHT, WIDTH, 3), 120.0)
    screen = np.s_[40:80, 50:110]

    def picture() -> Bytes:
        shown = scene.copy()
        shown[screen] += rng.normal(0, 25, 3)
        return recorded(rng, shown)

    segmenter = Segmenter(learn_background(picture() for _ in range(60)), SegmentSettings())
    shown = scene.copy()
    shown[screen] += (25, -25, 25)

    on_screen = segmenter.segment(recorded(rng, shown))
    elsewhere = segmenter.segment(recorded(rng, np.roll(shown, 60, axis=0)))

    assert not on_screen.any()
    assert elsewhere.any()


def test_a_frame_of_another_size_is_refused_with_both_sizes() -> None:
    rng = np.random.default_rng(0)
    segmenter = a_segmenter(rng, a_scene(rng))

    with pytest.raises(SessionError, match="picture is 80x60, its background is 160x120"):
        segmenter.segment(np.zeros((60, 80, 3), np.uint8))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("threshold", 0.0),
        ("noise_floor", -1.0),
        ("noise_share", float("nan")),
        ("shadow_threshold", 0.0),
        ("shadow_darkest", -0.1),
        ("shadow_darkest", 1.3),
        ("speck_px", -1),
        ("hole_px", -1),
    ],
)
def test_settings_without_meaning_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        SegmentSettings(**{name: value})  # type: ignore[arg-type]


def cleaned_by_opencv(mask: Bytes, speck_px: int, hole_px: int) -> Bytes:
    """The specification of `clean`, piece by piece."""
    result = mask.copy()
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    for label in range(1, len(stats)):
        if stats[label, cv2.CC_STAT_AREA] < speck_px:
            result[labels == label] = 0
    framed = cv2.copyMakeBorder(1 - result, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(framed, connectivity=4)
    for label in range(1, len(stats)):
        if label != labels[0, 0] and stats[label, cv2.CC_STAT_AREA] < hole_px:
            result[labels[1:-1, 1:-1] == label] = 1
    return result


@settings(max_examples=asked(200))
@given(
    seed=seeds,
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    density=st.floats(0, 1),
    grain_px=st.integers(1, 5),
    speck_px=st.integers(0, 40),
    hole_px=st.integers(0, 40),
)
def test_specks_and_holes_are_those_that_opencv_labels(
    seed: int, width: int, height: int, density: float, grain_px: int, speck_px: int, hole_px: int
) -> None:
    rng = np.random.default_rng(seed)
    coarse = (rng.random((height, width)) < density).astype(np.uint8)
    mask = np.kron(coarse, np.ones((grain_px, grain_px), np.uint8))[:height, :width]
    mask = np.ascontiguousarray(mask ^ (rng.random(mask.shape) < 0.03)).astype(np.uint8)
    before = mask.copy()

    result = clean(mask, speck_px, hole_px)

    np.testing.assert_array_equal(result, cleaned_by_opencv(mask, speck_px, hole_px))
    np.testing.assert_array_equal(mask, before)


def test_specks_go_small_holes_close_and_a_ring_stays_a_ring() -> None:
    rng = np.random.default_rng(5)
    scene = a_scene(rng)
    segmenter = a_segmenter(rng, scene, speck_px=60, hole_px=150)
    truth = ellipse((60, 60), (40, 40), 0) - ellipse((60, 60), (25, 25), 0)  # a hole of 1960 pixels
    disc = ellipse((130, 60), (20, 20), 0)
    hole = ellipse((130, 60), (5, 5), 0)  # 80 pixels
    speck = ellipse((140, 15), (3, 3), 0)  # 30 pixels

    mask = segmenter.segment(
        recorded(rng, laid_over(scene, truth | (disc - hole) | speck, (40, 40, 200)))
    )

    assert_boundary_within(mask, truth | disc)


def background_of(source: FrameSource) -> Background:
    return learn_background(source.frames())


@pytest.fixture(scope="module")
def horseman_masks(recordings: Path) -> list[Bytes]:
    """The first frame of each camera, cut out with the default settings."""
    root = recordings / "horseman"
    return [
        Segmenter(
            background_of(open_source(root, f"cam{camera}/background.avi")), SegmentSettings()
        ).segment(open_source(root, f"cam{camera}/video.avi").first())
        for camera in (1, 2, 3, 4)
    ]


@pytest.mark.recording
def test_the_horseman_is_as_painted_by_hand(recordings: Path, horseman_masks: list[Bytes]) -> None:
    """IoU with masks painted by hand, whose boundary is a pixel off here and there (0.1 of IoU).

    Reached: 0.902, 0.929, 0.925, 0.886. Plain differencing reaches 0.77 on average.
    """
    scores = []
    for camera, mask in enumerate(horseman_masks, start=1):
        path = recordings / "horseman" / "manual_masks" / f"manual_mask_{camera}.jpg"
        painted = read_image(path)[..., 0] > 127
        found = mask > 0
        if camera == 3:
            # A board and the chair that it leans on stand here in the recording, but not in the
            # empty scene: objects, though nobody painted them.
            found[200:300, 540:] = False
            assert mask[200:300, 540:].sum() > 2000, "the board is an object"
        scores.append((painted & found).sum() / (painted | found).sum())

    assert np.mean(scores) >= 0.90
    assert min(scores) >= 0.87


@pytest.mark.recording
def test_cars_on_a_highway_are_told_from_their_shadows(recordings: Path) -> None:
    """F1 over 200 frames with ground truth; shadows count as background.

    Reached: 0.929. A plain difference reaches 0.925 with its best threshold on a background that
    was chosen for it. Cars pass through the background's frames, too.
    """
    root = recordings / "highway"

    def frames(indices: range) -> Iterator[Bytes]:
        return (read_image(root / "input" / f"in{index:06d}.jpg") for index in indices)

    segmenter = Segmenter(learn_background(frames(range(1, 466, 8))), SegmentSettings())
    hits = false_alarms = misses = 0
    for index, image in zip(range(900, 1100), frames(range(900, 1100)), strict=True):
        truth = read_image(root / "groundtruth" / f"gt{index:06d}.png")[..., 0]
        judged = (truth != 85) & (truth != 170)  # outside the region, unknown
        moving, found = truth == 255, segmenter.segment(image) > 0
        hits += int((moving & found & judged).sum())
        false_alarms += int((~moving & found & judged).sum())
        misses += int((moving & ~found & judged).sum())

    assert 2 * hits / (2 * hits + false_alarms + misses) >= 0.925
