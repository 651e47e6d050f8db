"""Boards of markers as others print them, and images of them with known truth.

What is printed comes from OpenCV's own generator (ChArUco) and from the drawing rules and codes of
Kalibr's (AprilGrid), never from the code under test.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.boards.markers import AprilGrid, Charuco
from hybridve.calib.camera import Camera
from hybridve.calib.lens import cam_from_img, img_from_cam
from hybridve.calib.pose import Pose, invert, transform

#: The first codes of the family 36h11, as Kalibr's generator lists them.
CODES_36H11 = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC)

BLACK, WHITE = 30, 215

#: The grey level beside all sheets.
AROUND = 120.0


@dataclass(frozen=True, eq=False)
class Sheet:
    """A printed sheet, flat in the plane z = 0 of a board's frame, seen from its printed side.

    Attributes
    ----------
    print_ : (H, W) uint8
        Grey levels, the first row at the top (the largest y).
    left_m, top_m : float
        Where its upper left corner lies.
    dot_m : (float, float)
        The sides of one of its dots along x and y.
    """

    print_: NDArray[np.uint8]
    left_m: float
    top_m: float
    dot_m: tuple[float, float]

    def grey(self, points: NDArray[np.float64], around: float) -> NDArray[np.float64]:
        """Return grey levels (P,) of points (P, 2) in metres; `around` beside the sheet."""
        column = np.floor((points[:, 0] - self.left_m) / self.dot_m[0]).astype(int)
        row = np.floor((self.top_m - points[:, 1]) / self.dot_m[1]).astype(int)
        height, width = self.print_.shape
        on = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        grey = np.full(len(points), around)
        grey[on] = self.print_[row[on], column[on]]
        return grey

    def outline(self) -> NDArray[np.float64]:
        """Return points all around its edge, in metres: (P, 3)."""
        along, height_width = np.linspace(0.0, 1.0, 20), self.print_.shape
        size_m = np.array(height_width[::-1]) * self.dot_m
        edge = [np.column_stack([along, np.full(20, side)]) for side in (0.0, 1.0)]
        around = np.concatenate([*edge, *(points[:, ::-1] for points in edge)]) * size_m
        return np.column_stack(
            [self.left_m + around[:, 0], self.top_m - around[:, 1], np.zeros(80)]
        )

    def inverted(self) -> "Sheet":
        """Return the sheet printed white on black."""
        return Sheet(
            (BLACK + WHITE - self.print_).astype(np.uint8), self.left_m, self.top_m, self.dot_m
        )


def charuco_sheet(board: Charuco, legacy: bool = False, dots: int = 40) -> Sheet:
    """Return a ChArUco board as OpenCV prints it, `dots` a square, within a white margin."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    marker = board.marker_m / board.square_m
    count = board.columns * board.rows // 2
    ids = np.arange(board.first_id, board.first_id + count)
    drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, marker, dictionary, ids)
    drawn.setLegacyPattern(legacy)
    size = (board.columns * dots, board.rows * dots)
    image = np.pad(drawn.generateImage(size, marginSize=0), dots // 2, constant_values=255)
    side_x_m, side_y_m = board.sides_m
    return Sheet(
        np.where(image > 127, WHITE, BLACK).astype(np.uint8),
        -1.5 * side_x_m,
        (board.rows - 0.5) * side_y_m,
        (side_x_m / dots, side_y_m / dots),
    )


def april_sheet(
    columns: int,
    rows: int,
    tag_m: float,
    gap_m: float,
    codes: Sequence[int] = CODES_36H11,
    squares: bool = True,
) -> Sheet:
    """Return an AprilGrid as Kalibr draws it: 10 modules a tag, two of them its border.

    The gap must be a whole number of half modules. Without `squares` nothing is black between the
    tags, as on the grids of OpenCV.
    """
    dots = 20
    module = dots
    tag, gap = 10 * module, round(10 * module * gap_m / tag_m)
    width, height = columns * (tag + gap) + gap, rows * (tag + gap) + gap
    # Drawn with y up, like on the paper, and turned over at the end.
    paper = np.full((height, width), WHITE, np.uint8)
    for number in range(columns * rows):
        x = gap + (number % columns) * (tag + gap)
        y = gap + (number // columns) * (tag + gap)
        paper[y : y + tag, x : x + tag] = BLACK
        bits = np.array(
            [[bool(codes[number] >> (6 * i + j) & 1) for j in range(6)] for i in range(6)]
        )
        bits = np.rot90(bits, 2)  # as Kalibr does; its row 0 is the topmost
        for i, j in np.argwhere(bits):
            left, bottom = x + (2 + j) * module, y + (7 - i) * module
            paper[bottom : bottom + module, left : left + module] = WHITE
        for corner_x in (x - gap, x + tag) if squares else ():
            for corner_y in (y - gap, y + tag):
                paper[corner_y : corner_y + gap, corner_x : corner_x + gap] = BLACK
    paper = np.pad(paper, gap, constant_values=WHITE)
    dot_m = tag_m / tag
    lower = -2 * gap * dot_m
    return Sheet(
        np.ascontiguousarray(paper[::-1]), lower, lower + len(paper) * dot_m, (dot_m, dot_m)
    )


def render_sheets(
    camera: Camera,
    sheets: Sequence[tuple[Sheet, Pose]],
    noise_grey: float = 0.0,
    samples: int = 4,
    seed: int = 11,
) -> NDArray[np.uint8]:
    """Render sheets at their cam_from_board; each pixel is the mean of `samples` squared rays.

    The rays pass at places that differ from pixel to pixel. Earlier sheets cover later ones; all of
    each lies before the camera.
    """
    rng = np.random.default_rng(seed)
    image = np.full((camera.height_px, camera.width_px), AROUND)
    # Elsewhere no ray meets a sheet.
    outlines = [img_from_cam(camera, transform(pose, sheet.outline())) for sheet, pose in sheets]
    lowest, highest = (side(np.concatenate(outlines), axis=0) for side in (np.min, np.max))
    left, top = np.clip(np.floor(lowest).astype(int), 0, image.shape[::-1])
    right, bottom = np.clip(np.ceil(highest).astype(int), 0, image.shape[::-1])
    columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    total = np.zeros(columns.shape)
    for sub_row in range(samples):
        for sub_column in range(samples):
            x = columns + (sub_column + rng.uniform(size=columns.shape)) / samples
            y = rows + (sub_row + rng.uniform(size=rows.shape)) / samples
            rays = cam_from_img(camera, np.column_stack([x.ravel(), y.ravel()]))
            grey = np.full(len(rays), np.nan)
            for sheet, pose in sheets:
                directions = np.column_stack([rays, np.ones(len(rays))]) @ pose[:, :3]
                center = invert(pose)[:, 3]
                reach = -center[2] / directions[:, 2]
                points = (center + reach[:, None] * directions)[:, :2]
                here = sheet.grey(points, np.nan)
                here[reach < 0] = np.nan
                grey = np.where(np.isnan(grey), here, grey)
            total += np.nan_to_num(grey, nan=AROUND).reshape(total.shape)
    image[top:bottom, left:right] = total / samples**2
    if noise_grey:
        image = image + rng.normal(0.0, noise_grey, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def project_board(
    camera: Camera, cam_from_board: Pose, board: Charuco | AprilGrid
) -> NDArray[np.float64]:
    """Return where a camera sees a board's points: (N, 2) pixels, exactly."""
    return img_from_cam(camera, transform(cam_from_board, board.points_board))
