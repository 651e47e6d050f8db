"""Silhouettes freed of what cannot matter: objects of one picture that no other camera confirms.

A piece of a silhouette (an 8-connected component) to which no point of the hull projects can be
dropped without changing the hull at all: what the hull is, it is without it. Such pieces are things
that only one camera sees (a chair in a corner, a reflection); they are no errors, but a person who
looks at the silhouettes wants to see what counts.

Whether a piece is confirmed is asked of the hull that has this piece as its camera's silhouette:
the piece goes only if `hybridve.hull.agreement.search` proves that hull to be empty along the
piece's rays. In doubt nothing is dropped.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.lens import Undistortion
from hybridve.hull.agreement.search import EMPTY, Rule, make_pencils, search
from hybridve.hull.capture.recording import undistort_mask
from hybridve.hull.query.silhouettes import Views, make_hull

Mask = NDArray[np.uint8]


def drop_unconfirmed(
    views: Views, undistortions: list[Undistortion], masks: list[Mask]
) -> list[Mask]:
    """Return a frame's silhouettes without the pieces that no point of the hull projects to.

    Parameters
    ----------
    views : Views
        C cameras.
    undistortions : list of Undistortion
        How each camera's recorded image becomes its view.
    masks : list of C (H, W) uint8
        Silhouettes in the images as recorded, above 0 on object pixels.

    Returns
    -------
    list of C (H, W) uint8
        The same hull; 1 on object pixels.
    """
    undistorted = [
        undistort_mask(mask, lens) for mask, lens in zip(masks, undistortions, strict=True)
    ]
    pencils, rule = make_pencils(views), Rule.of(views)
    result = []
    for camera, (mask, lens) in enumerate(zip(masks, undistortions, strict=True)):
        count, labels = cv2.connectedComponents((mask > 0).astype(np.uint8), connectivity=8)
        kept = (mask > 0).astype(np.uint8)
        for label in range(1, count):
            piece = undistort_mask((labels == label).astype(np.uint8), lens)
            alone = [*undistorted[:camera], piece, *undistorted[camera + 1 :]]
            if search(make_hull(views, alone), pencils, camera, rule).verdict == EMPTY:
                kept[labels == label] = 0
        result.append(kept)
    return result
