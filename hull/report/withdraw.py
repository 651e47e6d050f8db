"""What single frames said too surely, taken back: as all frames together know better."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def withdrawn(
    verdict: NDArray[np.str_],
    reason: NDArray[np.str_],
    certificate: NDArray[np.str_],
    wrong: Sequence[str],
) -> tuple[NDArray[np.str_], NDArray[np.str_], NDArray[np.str_]]:
    """Return verdicts, reasons and certificates (F,) without what is not to be believed.

    In a frame that is not to be believed, nothing is "kept" and nothing certified free; what
    touches or comes too near is left as a warning.

    Parameters
    ----------
    verdict, reason, certificate : (F,) str
        Of one object, as its frames say.
    wrong : sequence of F str
        Why a frame is not to be believed; empty where it is.
    """
    verdicts, reasons, certificates = verdict.tolist(), reason.tolist(), certificate.tolist()
    for row, why in enumerate(wrong):
        if not why:
            continue
        if verdicts[row] == "kept":
            verdicts[row], reasons[row] = "unknown", why
        if certificates[row] == "free":
            certificates[row] = ""
    return np.array(verdicts, np.str_), np.array(reasons, np.str_), np.array(certificates, np.str_)


def doubted(
    at_least_m: NDArray[np.float64],
    m_per_px: NDArray[np.float64],
    excess_px: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return what a clearance is at least (F,), metres, where outlines err more than was stated.

    Parameters
    ----------
    at_least_m : (F,) float64
        What it is at least with errors as stated; NaN where it is not known.
    m_per_px : (F, C) float64
        By how much it falls as each outline moves outward by a pixel.
    excess_px : (F, C) float64
        By how much more each outline may be off.
    """
    less_m = (np.nan_to_num(m_per_px) * excess_px).sum(axis=1)
    return np.where(less_m > 0.0, np.maximum(0.0, at_least_m - less_m), at_least_m)
