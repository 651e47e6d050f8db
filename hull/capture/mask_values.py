"""What the values of ready masks mean: which pixels are object, found from the masks themselves.

People have masks as 0 and 255, 0 and 1, 0 and 65535, numbers of things, colours of a palette, soft
edges, and silhouettes in the alpha channel of a cut-out. What they mean is settled by a look at
some pictures of the camera:

* one number a pixel: the grey level, or the brightest of the colours; or the alpha channel, if
  that is not the same everywhere;
* 0, 1, 2, ... without a gap, below `_MOST_LABELS`: numbers of things; all above 0 are object;
* two values, neither of them white: the larger is object;
* else grey levels, up to the full scale of the file: above half of it, or above `mask_threshold`
  255ths of it, is object.

What cannot be settled is refused with the values found and the key that settles it. A picture that
holds what the others cannot is refused when its turn comes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

#: Changes whenever masks are read otherwise: silhouettes that were stored before are stale then.
MASK_METHOD = 2

Channel = Literal["grey", "alpha"]
Raw = NDArray[Any]

#: Full scales of grey: 8 bits, sensors of 10, 12 and 14 bits in files of 16, and 16 bits.
_FULL_SCALES = (255, 1023, 4095, 16383, 65535)

#: Numbers of things in one mask at most.
_MOST_LABELS = 32

#: A few values, each of so large a share of the pixels, are no soft edges.
_FEW_VALUES, _OFTEN = 12, 2e-3

#: Levels that are neither nearly black nor nearly white, as shares of the full scale.
_GREY_FROM, _GREY_TO = 0.12, 0.88

#: Values that a message lists at most.
_MOST_LISTED = 8

#: A cut-out's colours mark the same pixels as its alpha channel, but for such a share.
_SAME_MASK = 1e-3


@dataclass(frozen=True, slots=True)
class MaskReading:
    """How the masks of a camera are read.

    Attributes
    ----------
    channel : "grey" or "alpha"
        Where the silhouette is.
    above : int
        Pixels with a larger value are object.
    most : int
        No value is larger.
    values : tuple of int
        The only values there are, where these are not all up to `most`; else empty.
    """

    channel: Channel = "grey"
    above: int = 127
    most: int = 255
    values: tuple[int, ...] = ()

    def mask(self, picture: Raw) -> NDArray[np.uint8]:
        """Return 1 on object pixels, (H, W).

        Raises
        ------
        ValueError
            If the picture holds values that its masks cannot, or lacks the channel.
        """
        level = level_of(picture, self.channel)
        largest = int(level.max(initial=0))
        if largest > self.most:
            raise ValueError(
                f"the mask has the value {largest}, those looked at first none above {self.most}"
            )
        if 0 < largest <= self.above and _is_dark_mask(level, largest, self.most):
            raise ValueError(
                f"the mask has only the values 0 and {largest}, those looked at first up to "
                f"{self.most}"
            )
        if self.values:
            known = np.zeros(self.most + 1, np.bool_)
            known[list(self.values)] = True
            if not known[level].all():
                raise ValueError(
                    f"the mask has the values {_listed(np.unique(level))}, those looked at first "
                    f"only {_listed(self.values)}"
                )
        return (level > self.above).view(np.uint8)


def level_of(picture: Raw, channel: Channel = "grey") -> Raw:
    """Return the one number of each pixel (H, W) that says whether it is object.

    Raises
    ------
    ValueError
        If there is no such channel.
    """
    has_alpha = picture.ndim == 3 and picture.shape[2] == 4
    if channel == "alpha":
        if not has_alpha:
            raise ValueError("the mask has no alpha channel, those looked at first have one")
        return np.asarray(picture[..., 3])
    if picture.ndim == 2:
        return picture
    return np.asarray(picture[..., :3].max(axis=2))


def reading_of(
    pictures: Iterable[Raw], threshold: int | None = None, channel: Channel | None = None
) -> MaskReading:
    """Return how masks are read, from some of them.

    Parameters
    ----------
    pictures : iterable of (H, W) or (H, W, 3 or 4) uint8 or uint16
        As they are stored, BGR and alpha.
    threshold : int, optional
        What of 255 of the full scale is not object yet, where the session says so.
    channel : "grey" or "alpha", optional
        Where the silhouette is, where the session says so.

    Raises
    ------
    ValueError
        If it cannot be told: with the values found, and the key that settles it.
    """
    seen = list(pictures)
    if channel is None:
        channel = _channel_of(seen)
    counts = np.zeros(65536, np.int64)
    for picture in seen:
        counts += np.bincount(level_of(picture, channel).ravel(), minlength=65536)
    values = np.flatnonzero(counts)
    is_wide = any(picture.dtype == np.uint16 for picture in seen)
    if len(values) == 0:
        return MaskReading(channel)
    largest = int(values[-1])
    full = next(scale for scale in _FULL_SCALES if scale >= largest)
    if largest == 0:  # nothing is known yet
        full = 65535 if is_wide else 255
    if threshold is not None:
        return MaskReading(channel, threshold * full // 255, full)
    if full in (255, 65535) and largest in (0, full):
        for picture in seen:
            level = level_of(picture, channel)
            if _is_dark_mask(level, int(level.max()), full):
                raise ValueError(
                    f"some masks have only the values 0 and {level.max()}, others up to {full}; "
                    "give masks of one kind"
                )
        _refuse_unclear(values, counts, full)
        return MaskReading(channel, full // 2, full)
    if largest < _MOST_LABELS and (values == np.arange(len(values))).all():
        return MaskReading(channel, 0, _MOST_LABELS)  # a number that comes later is a thing, too
    if len(values) == 2:
        low, high = int(values[0]), int(values[1])
        return MaskReading(channel, low, high, (low, high))
    if len(values) == 1:
        raise ValueError(
            f"every pixel of the masks looked at has the value {largest}; give masks whose object "
            "pixels differ from the rest, or say from where on a pixel is one (mask_threshold)"
        )
    _refuse_unclear(values, counts, full)
    if largest <= full // 2:
        raise ValueError(
            f"the masks hold values from {values[0]} to {largest}, none above half of {full}; say "
            "above which of 255 a pixel is object (mask_threshold)"
        )
    return MaskReading(channel, full // 2, full)


def _channel_of(pictures: Sequence[Raw]) -> Channel:
    """Return where the silhouette is: in the alpha channel, if that is not the same everywhere."""
    with_alpha = [one for one in pictures if one.ndim == 3 and one.shape[2] == 4]
    if not with_alpha:
        return "grey"
    alphas = [level_of(one, "alpha") for one in with_alpha]
    if len(np.unique(np.concatenate([np.unique(one) for one in alphas]))) == 1:
        return "grey"
    greys = [level_of(one) for one in with_alpha]
    levels = np.unique(np.concatenate([np.unique(one) for one in greys]))
    if len(levels) == 2:
        # Two masks in one file: they should be one.
        differing = sum(
            int(((grey > levels[0]) != (alpha > alpha.max(initial=1) // 2)).sum())
            for grey, alpha in zip(greys, alphas, strict=True)
        )
        if differing > _SAME_MASK * sum(one.size for one in greys):
            raise ValueError(
                f"the masks are told twice, by colours ({_listed(levels)}) and by the alpha "
                'channel, and not alike; say which holds (mask_channel = "grey" or "alpha")'
            )
    return "alpha"


def _is_dark_mask(level: Raw, largest: int, full: int) -> bool:
    """Tell whether levels are a mask of another kind: two values, both nearly black, both often."""
    if not 0 < largest <= _GREY_FROM * full:
        return False
    n_largest = int((level == largest).sum())
    return n_largest > _OFTEN * level.size and n_largest + int((level == 0).sum()) == level.size


def _refuse_unclear(values: NDArray[np.int64], counts: NDArray[np.int64], full: int) -> None:
    """Refuse a few values of which some are neither nearly black nor nearly white."""
    often = values[counts[values] > _OFTEN * counts.sum()]
    grey = often[(often > _GREY_FROM * full) & (often < _GREY_TO * full)]
    if len(values) <= _FEW_VALUES and len(grey):
        raise ValueError(
            f"the masks hold the values {_listed(values)}, and it is not clear which of them are "
            "object; say above which of 255 a pixel is (mask_threshold)"
        )


def _listed(values: Sequence[int] | NDArray[Any]) -> str:
    """Return values in words.

    Examples
    --------
    >>> _listed([0, 1]), _listed(range(20))
    ('0 and 1', '0, 1, 2, 3, 4, 5, 6, 7, ... 19')
    """
    texts = [str(int(value)) for value in values]
    if len(texts) > _MOST_LISTED:
        return f"{', '.join(texts[:_MOST_LISTED])}, ... {texts[-1]}"
    return " and ".join([", ".join(texts[:-1]), texts[-1]]) if len(texts) > 1 else texts[0]
