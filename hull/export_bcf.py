"""The clashes of a report as BCF, with a picture each."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError
from hybridve.hull.clash_pictures import ClashPicture, clash_pictures
from hybridve.hull.recorded import Recorded, rig_of
from hybridve.hull.report.bcf import BcfTopic, BcfView, Vector, write_bcf
from hybridve.hull.report.clashes import Clash
from hybridve.hull.report.ledger import Listed
from hybridve.hull.report.read import Report
from hybridve.hull.report.touched import read_touched
from hybridve.hull.report.wording import sentence
from hybridve.hull.view.paint import Painter

Progress = Callable[[str, int, int], None]


def write_clashes_bcf(
    path: Path,
    report: Report,
    listed: Sequence[Listed],
    *,
    recorded: Recorded | None = None,
    progress: Progress | None = None,
) -> str:
    """Write the clashes of a report as BCF; return why they have no pictures, or "".

    Raises
    ------
    ReportError
        If it cannot be written.
    SessionError
        If the recordings cannot be read.
    """
    origin_m, touched = read_touched(report.path)
    rig = rig_of(report, recorded)
    why = "" if touched and rig is not None else "the report holds no meshes, or no rig"
    topics = []
    with ExitStack() as stack:
        painter = None
        if not why and listed:
            try:
                painter = stack.enter_context(Painter())
            except DeviceError as error:
                why = str(error)
        for number, one in enumerate(listed):
            picture = None
            if painter is not None and rig is not None:
                if progress is not None:
                    progress("pictures of clashes", number, len(listed))
                picture = clash_pictures(
                    report, one.clash, origin_m, touched, rig, recorded, painter
                )[0]
            topics.append(_topic(report, one, picture))
    name = Path(str(report.settings.get("scene", report.path))).stem
    write_bcf(path, name, topics)
    return why


def _topic(report: Report, one: Listed, picture: ClashPicture | None) -> BcfTopic:
    clash, entry = one.clash, one.entry
    words = sentence(clash).replace("+-", "±")
    when = f"{clash.first_s:.2f}-{clash.last_s:.2f} s, {clash.n_episodes} times"
    return BcfTopic(
        id=entry.id,
        object=clash.name,
        kind=clash.kind,
        status=entry.status,
        title=f"{clash.name}: {clash.kind}",
        description=f"{words}\n{when}\n{report.path.name}",
        labels=(clash.name, "sure" if clash.is_sure else "not sure"),
        created=str(report.attributes.get("created_utc", "")),
        who=entry.who,
        when=entry.when,
        comment=entry.comment,
        view=None if picture is None else _view(clash, picture),
    )


def _view(clash: Clash, picture: ClashPicture) -> BcfView:
    viewpoint = picture.viewpoint
    direction = viewpoint.target_world - viewpoint.eye_world
    _, png = cv2.imencode(".png", picture.image)
    height, width = picture.image.shape[:2]
    ends = (clash.worst.on_object_world, clash.worst.on_hull_world)
    is_line = np.isfinite(ends).all() and not np.array_equal(*ends)
    return BcfView(
        eye=_vector(viewpoint.eye_world),
        direction=_vector(direction / np.linalg.norm(direction)),
        up=_vector(viewpoint.up_world),
        vertical_fov_deg=viewpoint.vertical_fov_deg,
        aspect=width / height,
        png=png.tobytes(),
        line=(_vector(ends[0]), _vector(ends[1])) if is_line else None,
    )


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
