"""A report as one page: the answer, clashes with pictures, and what scrubs through all frames.

What the page is made of is gathered here: from the report, and, where the session is given, from
its recordings, of which the page then has pictures and the hull. What of these would make the page
larger than is wanted is left out frame by frame, evenly, and told.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridve.calib.errors import DeviceError, ReportError, SessionError
from hybridve.calib.lengths import bounds_mm, mm
from hybridve.calib.rig import Rig
from hybridve.hull.capture.recording import FrameRange
from hybridve.hull.clash_pictures import clash_pictures, fitted, row_of
from hybridve.hull.contact.verdict import VERDICTS
from hybridve.hull.curves import curve_of
from hybridve.hull.recorded import Recorded, rig_of, seen_frames
from hybridve.hull.report.clashes import Clashes
from hybridve.hull.report.ledger import Listed
from hybridve.hull.report.read import Report
from hybridve.hull.report.summarize import summarize
from hybridve.hull.report.touched import Touched, read_touched
from hybridve.hull.report.wording import (
    at_95_text,
    counted,
    counted_clashes,
    overall_text,
    sentence,
    worst_text,
)
from hybridve.hull.view.packed import STEP_M, packed, packed_lists, packed_surface, webp
from hybridve.hull.view.paint import Painter, camera_length_m, floor_under
from hybridve.hull.view.report_page import (
    ClashCard,
    Lane,
    Look,
    Page,
    PagePicture,
    write_report_page,
)
from hybridve.hull.view.surface import hull_surface
from hybridve.hull.view.viewpoint import up_axis

Image = NDArray[np.uint8]
Progress = Callable[[str, int, int], None]

#: A page is at most so large, bytes.
LIMIT_BYTES = 20_000_000

#: Of what the limit leaves so large a share is kept for pictures; the rest is for the hull.
_PICTURES_SHARE = 0.5

#: What all else may take; where it takes more, pictures and hull have less.
_RESERVE_BYTES = 1_500_000

#: Pictures of the cameras: width, quality of WebP, and what one takes at most, roughly.
_SMALL_PX, _SMALL_QUALITY = 320, 45

#: Quality of pictures of a clash.
_LARGE_QUALITY = 72

#: Of more clashes than this, only the worst have pictures.
_MOST_PICTURED = 24

#: Cells along the longest side of the hull in the scene.
_HULL_SPLIT = 36

#: Collision points of an object in a frame that are drawn.
_MOST_POINTS = 64

#: Colour of the outline in small pictures, BGR; as in large ones.
_OUTLINE_BGR = (191, 242, 26)


def write_page(
    path: Path,
    report: Report,
    found: Clashes,
    listed: Sequence[Listed],
    *,
    recorded: Recorded | None = None,
    missing: Sequence[str] = (),
    limit_bytes: int = LIMIT_BYTES,
    progress: Progress | None = None,
) -> int:
    """Write a report as a page, and return its size in bytes.

    Parameters
    ----------
    path : Path
        An .html.
    report, found, listed
        The report, its clashes, and what the ledger calls them.
    recorded : Recorded, optional
        What it is of: pictures and hull.
    missing : sequence of str
        What else the page must say that it does not show.
    limit_bytes : int
        How large the page may be.
    progress : callable, optional
        Told ``(what, done, total)``.

    Raises
    ------
    ReportError
        If the report has no frames, or the page cannot be written, or would be too large without
        any picture.
    SessionError
        If the recordings cannot be read.
    """
    if not len(report.index):
        raise ReportError(f"{report.path}: has no frames to show")
    origin_m, touched = read_touched(report.path)
    page = _page(report, found, listed, origin_m, touched, recorded, missing)
    cards, why = _cards(report, listed, origin_m, touched, recorded, progress)
    page = replace(page, clashes=cards, missing=[*page.missing, *why])
    if recorded is not None:
        small, hulls = _frames_shown(report, recorded, origin_m, progress)
        text = [*page.chunks.values(), *(one.webp for card in cards for one in card.pictures)]
        left = limit_bytes - _RESERVE_BYTES - sum(map(len, text))
        page = _filled(page, report, small, hulls, max(left, 0))
    size = write_report_page(path, page)
    if size > limit_bytes:
        path.unlink()
        raise ReportError(
            f"{path}: would be {size / 1e6:.1f} MB, expected {limit_bytes / 1e6:g} at most; its "
            "CAD has too many triangles, or the report too many frames: detect fewer frames "
            "(--frames ::2)"
        )
    return size


# --- What is said ------------------------------------------------------------------------------


def _page(
    report: Report,
    found: Clashes,
    listed: Sequence[Listed],
    origin_m: NDArray[np.float64],
    touched: Mapping[str, Touched],
    recorded: Recorded | None,
    missing: Sequence[str],
) -> Page:
    numbers = summarize(report)
    every = [one.clash for one in listed]
    lanes = [_lane(report, name, found["verdict"]) for name, found in _by_name(numbers).items()]
    lanes.sort(key=lambda lane: list(report.objects).index(lane.name))
    told = [*missing]
    if recorded is None:
        told.insert(
            0,
            "Without the session there are no pictures of cameras and no hull on this page: "
            "`hybridve export ... --session SESSION` puts them in.",
        )
    elif all(camera.has_masks for camera in recorded.session.cameras):
        told.append(
            "The session has ready masks and no pictures: what its cameras saw is shown as that."
        )
    if not touched:
        told.append("The report is of version 1, which holds no meshes: there is no scene in 3D.")
    rig = rig_of(report, recorded)
    if rig is None:
        told.append("The report holds no rig that can be read: no cameras are drawn.")
    scene, chunks = _scene(report, listed, origin_m, touched, rig, recorded)
    command = report.attributes.get("command")
    about = [
        f"{report.path.name}: {counted(len(report.index), 'frame')}, {numbers['seconds']:.2f} s, "
        f"made {report.attributes.get('created_utc', '')}" + (f" by `{command}`" if command else "")
    ]
    if numbers["frames_invalid"]:
        about.append(f"{counted(numbers['frames_invalid'], 'frame')} could not be evaluated")
    name = str(report.settings.get("session", report.path))
    return Page(
        title=f"{Path(name).parent.name or Path(name).stem}: what was touched",
        look=_look(numbers),
        verdict=numbers["verdict"] if numbers["trusted"] else "not to be trusted",
        sentence=_typeset(overall_text(numbers, every).partition(": ")[2]),
        about=about,
        missing=told,
        clashes=(),
        clashes_note=_clashes_note(found),
        lanes=lanes,
        index=report.index,
        time_s=report.time_s,
        reasons=report.reason.tolist(),
        warnings=[cause["message"] for cause in numbers["causes"]],
        cameras=_camera_rows(report, rig),
        objects=[_object_row(report, one) for one in numbers["objects"]],
        trust=_trust(report, rig, recorded),
        settings={
            "Run": {
                key: value
                for key, value in report.attributes.items()
                if key not in ("versions", "format")
            },
            "Versions": _parsed(report.attributes.get("versions", {})),
            "Settings": report.settings,
        },
        scene=scene,
        chunks=chunks,
    )


def _by_name(numbers: Mapping[str, Any]) -> dict[str, Any]:
    return {one["name"]: one for one in numbers["objects"]}


def _look(numbers: Mapping[str, Any]) -> Look:
    if not numbers["trusted"] or numbers["verdict"] in ("clash", "inside", "too near"):
        return "bad"
    return "good" if numbers["verdict"] == "kept" else "limits"


def _lane(report: Report, name: str, verdict: str) -> Lane:
    rows = report.objects[name]
    nothing = np.full(len(report.index), np.nan)
    required_mm = 1e3 * float(rows.about.get("required_clearance_m", 0.0))
    if "clearance_m" not in rows:
        return Lane(name, verdict, rows.verdict, nothing, nothing, nothing, required_mm)
    curve = curve_of(name, rows, report)
    return Lane(
        name,
        verdict,
        rows.verdict,
        curve.lower_mm,
        curve.upper_mm,
        np.where(curve.lower_mm > 0.0, curve.at_least_mm, np.nan),  # what touches has none
        required_mm,
    )


def _clashes_note(found: Clashes) -> str:
    parts = [
        f"{counted(found.n_patches, 'contact')} of single frames gathered into "
        f"{counted_clashes(len(found.clashes))}"
    ]
    parts += [
        f"rule {left.number} left out {counted_clashes(left.clashes)} in "
        f"{counted(left.frames, 'frame')}: {left.rule.text}"
        for left in found.left_out
    ]
    return "; ".join(parts) + "."


def _object_row(report: Report, told: Mapping[str, Any]) -> dict[str, Any]:
    rows = report.objects[told["name"]]
    nearest = told["clearance"]
    n_seeing = rows.get("n_seeing")
    row: dict[str, Any] = {
        "object": told["name"],
        "verdict": told["verdict"],
        "frames": ", ".join(f"{n} {one}" for one, n in told["frames_by_verdict"].items()),
        "proved": f"{told['frames_with_witness']} hit, {told['frames_proved_free']} free",
        "closed": told["closed"],
    }
    if nearest is not None:
        upper_m = nearest["upper_m"]
        row["smallest clearance, mm (bounds)"] = (
            f"beyond {mm(nearest['lower_m'], '.1f')}"
            if upper_m is None
            else _typeset(bounds_mm(nearest["lower_m"], upper_m))
        )
    row["required, mm"] = mm(told["required_clearance_m"] or None, "g")
    if n_seeing is not None:
        asked = n_seeing[n_seeing > 0]
        row["cameras that see what is near"] = (
            "not asked" if not len(asked) else f"{asked.min()} to {asked.max()}"
        )
    row["hinges on"] = ", ".join(told["hinges_on"]) or "no single camera"
    return row


def _camera_rows(report: Report, rig: Rig | None) -> list[dict[str, Any]]:
    rows = []
    for name, columns in report.cameras.items():
        agreement = report.agreement.cameras.get(name)
        row: dict[str, Any] = {"camera": name}
        if rig is not None:
            camera = rig[name]
            row["lens"] = camera.model
            row["image, px"] = f"{camera.width_px}x{camera.height_px}"
        share = columns.get("object_share")
        if share is not None and np.isfinite(share).any():
            row["object pixels, mean"] = f"{100 * np.nanmean(share):.1f} %"
        if "denied_px" in columns:
            row["frames in which others deny large pieces"] = int((columns["denied_px"] > 0).sum())
        if agreement is not None:
            if agreement.misfit_px is not None:
                row["limits of outlines miss by, px (mean)"] = f"{agreement.misfit_px:.1f}"
            row["outlines off beyond what is stated, px"] = f"{agreement.excess_px:.1f}"
        rows.append(row)
    return rows


def _trust(report: Report, rig: Rig | None, recorded: Recorded | None) -> dict[str, Any]:
    settings = report.settings
    about_rig: dict[str, Any] = {}
    certificate = None if recorded is None else _certificate(recorded)
    if certificate is not None:
        about_rig["certificate"] = certificate
    provenance = report.rig.get("provenance", {})
    check = report.rig.get("check") or (provenance.get("check") or {})
    if isinstance(check, Mapping) and check.get("message"):
        about_rig["against the session's boards"] = check["message"]
    for key in ("method", "rms_px", "noise", "software"):
        if key in provenance:
            about_rig[key] = provenance[key]
    if rig is not None:
        about_rig["states its errors"] = rig.covariance is not None
    agreement = report.agreement
    cameras_agree = (
        "not asked, or too little to tell"
        if not agreement.is_told
        else "the cameras agree"
        if agreement.is_trusted
        else agreement.distrust
    )
    doubt = settings.get("doubt")
    return {
        "The rig": about_rig or "nothing is known of how it was made",
        "Do the cameras agree": cameras_agree,
        "Silhouettes": {
            "what is assumed of outlines": doubt or "nothing: nobody asked for doubt",
            "segmentation": settings.get("segmentation", {}),
            "what cameras do not see": settings.get("unseen", "carve"),
        },
    }


def _certificate(recorded: Recorded) -> str | None:
    """Return what the certificate of the session's rig says in one line; None if there is none."""
    if recorded.session.rig_file is not None:
        return None
    path = recorded.session.folder / "rig" / "certificate.json"
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        return str(told["verdict"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _parsed(text: Any) -> Any:
    try:
        return json.loads(text) if isinstance(text, str) else text
    except ValueError:
        return text


# --- The scene ---------------------------------------------------------------------------------


def _scene(
    report: Report,
    listed: Sequence[Listed],
    origin_m: NDArray[np.float64],
    touched: Mapping[str, Touched],
    rig: Rig | None,
    recorded: Recorded | None,
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what the page's script is told, and what it reads besides."""
    chunks: dict[str, str] = {}
    objects = []
    around = [np.zeros((0, 3))]
    for number, name in enumerate(report.objects):
        chunks[f"object-{number}-frames"] = _frame_columns(report, name, origin_m)
        told: dict[str, Any] = {
            "name": name,
            "number": number,
            "has_mesh": name in touched,
            "required_mm": float(
                f"{1e3 * float(report.objects[name].about.get('required_clearance_m', 0.0)):.6g}"
            ),
        }
        if name in touched:
            one = touched[name]
            told |= _mesh_chunks(chunks, number, one)
            first = _first_placed(one)
            if first is not None:
                around.append(_box(one.mesh.vertices_at(first)))
        objects.append(told)
    up = up_axis(rig) if rig is not None else np.array([0.0, 0.0, 1.0])
    centers = np.zeros((0, 3)) if rig is None else rig.centers_world - origin_m
    places = [np.array(one.clash.worst.on_hull_world) - origin_m for one in listed]
    points = np.concatenate([*around, np.reshape(places, (-1, 3))])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = centers if len(centers) else np.zeros((1, 3))
    near = _near(points, places)
    middle = 0.5 * (near.min(axis=0) + near.max(axis=0))
    reach_m = max(float(np.linalg.norm(np.ptp(near, axis=0))), 0.1)
    floor = floor_under(np.concatenate([points, centers]) + origin_m, up)
    size_m = 12 * floor.grid_m
    height_m = floor.height_m - float(origin_m @ up)
    foot = middle + (height_m - middle @ up) * up
    first_row = row_of(report, listed[0].clash) if listed else 0
    scene: dict[str, Any] = {
        "frames": report.index.tolist(),
        "times": [round(one, 6) for one in report.time_s.tolist()],
        "reasons": {str(row): why for row, why in enumerate(report.reason.tolist()) if why},
        "verdicts": list(VERDICTS),
        "objects": objects,
        "cameras": [] if rig is None else _camera_poses(report, rig, origin_m, recorded),
        "camera_m": 0.2 if rig is None else camera_length_m(rig, middle + origin_m),
        "up": up.tolist(),
        "floor": {"middle": foot.tolist(), "size": size_m, "grid": floor.grid_m},
        "target": middle.tolist(),
        "distance": 1.7 * reach_m,
        "from": _from(up, centers, middle).tolist(),
        "clashes": [
            {
                "row": row_of(report, one.clash),
                "place": (one.clash.worst.on_object_world - origin_m).tolist(),
                "distance": max(0.6 * reach_m, 0.3),
            }
            for one in listed
        ],
        "first": first_row,
        "hull_every": 0,
        "hull_step_m": STEP_M,
        "pictures_every": 0,
    }
    return scene, chunks


def _box(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _near(
    points: NDArray[np.float64], places: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return the points (N, 3) that the first view shows: without those far off all others."""
    middle = np.median(np.reshape(places, (-1, 3)) if places else points, axis=0)
    away = np.linalg.norm(points - middle, axis=1)
    return np.asarray(points[away <= 2.5 * np.median(away) + 0.1])


def _from(
    up: NDArray[np.float64], centers: NDArray[np.float64], middle: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the direction from which the scene is looked at: as the first camera does, higher."""
    way = centers[0] - middle if len(centers) else np.array([1.0, -1.0, 0.6])
    level = way - (way @ up) * up
    length = float(np.linalg.norm(level))
    level = level / length if length > 1e-9 else np.roll(up, 1)
    direction = level + 0.55 * up
    return np.asarray(direction / np.linalg.norm(direction))


def _first_placed(one: Touched) -> int | None:
    """Return the first row in which it is known where an object stood; None if there is none."""
    known = np.flatnonzero(np.isfinite(one.mesh.placement).all(axis=(1, 2)))
    return int(known[0]) if len(known) else None


def _frame_columns(report: Report, name: str, origin_m: NDArray[np.float64]) -> str:
    """Return 13 columns (F,): bounds, at least, depth's bounds, D_rec, both witnesses, verdict."""
    rows = report.objects[name]
    nothing = np.full(len(report.index), np.nan)

    def column(key: str, axis: int | None = None) -> NDArray[np.float64]:
        values = rows.get(key)
        if values is None:
            return nothing
        return np.asarray(values if axis is None else values[:, axis], np.float64)

    places = [
        column(key, axis) - origin_m[axis]
        for key in ("clearance_on_object_m", "clearance_on_hull_m")
        for axis in range(3)
    ]
    verdict = np.array([VERDICTS.index(one) for one in rows.verdict.tolist()], np.float64)
    table = [
        column("clearance_m", 0),
        column("clearance_m", 1),
        column("clearance_at_least_m"),
        column("depth_m", 0),
        column("depth_m", 1),
        column("d_rec_m"),
        *places,
        verdict,
    ]
    return packed(np.array(table, np.float32))


def _mesh_chunks(chunks: dict[str, str], number: int, one: Touched) -> dict[str, Any]:
    """Add an object's mesh, where it stood, and what of it was touched."""
    mesh = one.mesh
    vertices, faces = _welded(mesh.vertices_m, mesh.faces)
    chunks[f"object-{number}-mesh"] = packed(vertices.astype(np.float32), faces.astype(np.uint32))
    chunks[f"object-{number}-placement"] = packed(mesh.placement.astype(np.float32))
    triangles, offset = one.triangles()
    if len(triangles):
        chunks[f"object-{number}-touched"] = packed_lists(triangles, offset)
        samples = [one.points(row, _MOST_POINTS) for row in range(len(offset) - 1)]
        counts = np.array([len(each) for each in samples], np.uint32)
        chunks[f"object-{number}-points"] = packed(
            counts, np.concatenate(samples).astype(np.float32)
        )
    return {"n_vertices": len(vertices), "n_faces": len(faces)}


def _welded(
    vertices_m: NDArray[np.float64], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a mesh in which each place is one vertex."""
    unique, place = np.unique(vertices_m, axis=0, return_inverse=True)
    return unique, place.ravel()[faces]


def _camera_poses(
    report: Report, rig: Rig, origin_m: NDArray[np.float64], recorded: Recorded | None
) -> list[dict[str, Any]]:
    """Return the cameras as the page draws them, about its origin."""
    moving = recorded is not None and bool(recorded.tracks)
    rigs = []
    if moving and recorded is not None:
        rigs = [
            None if recorded.tracks.missing(index) else recorded.rig_at(index)
            for index in report.index.tolist()
        ]
    told = []
    for camera in rig.cameras:
        fx, fy, cx, cy = (camera.pinhole[at] for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        entry: dict[str, Any] = {
            "name": camera.name,
            "width": camera.width_px,
            "height": camera.height_px,
            "fx": float(fx),
            "fy": float(fy),
            "cx": float(cx),
            "cy": float(cy),
            "pose": _pose(camera.cam_from_world, origin_m),
        }
        if moving and camera.name in rig.mounts:
            entry["poses"] = [
                None if one is None else _pose(one[camera.name].cam_from_world, origin_m)
                for one in rigs
            ]
        elif camera.name in rig.mounts:
            entry["pose"] = None  # where it was, the report does not say
        told.append(entry)
    return told


def _pose(cam_from_world: NDArray[np.float64], origin_m: NDArray[np.float64]) -> list[float]:
    pose = cam_from_world.copy()
    pose[:, 3] += pose[:, :3] @ origin_m
    return [round(float(one), 6) for one in pose.ravel()]


# --- Clashes with their pictures -----------------------------------------------------------------


def _cards(
    report: Report,
    listed: Sequence[Listed],
    origin_m: NDArray[np.float64],
    touched: Mapping[str, Touched],
    recorded: Recorded | None,
    progress: Progress | None,
) -> tuple[list[ClashCard], list[str]]:
    """Return the clashes as the page has them, and why some have no pictures."""
    rig = rig_of(report, recorded)
    why: list[str] = []
    cards: list[ClashCard] = []
    with ExitStack() as stack:
        painter = None
        if touched and rig is not None and listed:
            try:
                painter = stack.enter_context(Painter())
            except DeviceError as error:
                why.append(f"Clashes have no pictures: {error}")
        for number, one in enumerate(listed):
            pictures: list[PagePicture] = []
            if painter is not None and rig is not None and number < _MOST_PICTURED:
                if progress is not None:
                    progress("pictures of clashes", number, min(len(listed), _MOST_PICTURED))
                pictures = [
                    PagePicture(webp(each.image, _LARGE_QUALITY), each.says, each.caption)
                    for each in clash_pictures(
                        report, one.clash, origin_m, touched, rig, recorded, painter
                    )
                ]
            cards.append(_card(report, one, origin_m, pictures))
    if len(listed) > _MOST_PICTURED:
        why.append(f"Pictures are of the worst {_MOST_PICTURED} clashes only.")
    return cards, why


def _card(
    report: Report, one: Listed, origin_m: NDArray[np.float64], pictures: Sequence[PagePicture]
) -> ClashCard:
    clash, worst, entry = one.clash, one.clash.worst, one.entry
    cameras = ", ".join(worst.ends_at) or "none"
    if worst.n_seeing:
        cameras += f" (of {worst.n_seeing} that see it)"
    facts = [
        ("at worst", _in_mm(worst_text(clash))),
        ("at 95 %", _in_mm(at_95_text(clash))),
        (
            "when",
            f"{clash.first_s:.2f}-{clash.last_s:.2f} s, for {clash.dwell_s:.2f} s, "
            f"{counted(clash.n_episodes, 'time')}",
        ),
        ("on the part, mm", _point(1e3 * clash.place.center[0], 0)),
        ("on what is real, m", _point(worst.on_hull_world, 3)),
        ("cameras that decide it", cameras),
    ]
    if clash.required_m:
        facts.insert(2, ("required", f"{mm(clash.required_m, 'g')} mm"))
    if entry.comment or entry.who:
        by = ", ".join(text for text in (entry.who, entry.when) if text)
        facts.append(("decided", f"{entry.comment} ({by})" if entry.comment else by))
    if one.ties:
        facts.append(("lies beside", " or ".join(one.ties)))
    x, y, z = (float(value) for value in worst.on_object_world - origin_m)
    return ClashCard(
        id=entry.id,
        status=entry.status,
        kind=clash.kind,
        object=clash.name,
        words=_typeset(sentence(clash)),
        frame=worst.frame,
        row=row_of(report, clash),
        place_m=(x, y, z),
        facts=facts,
        pictures=pictures,
    )


def _typeset(text: str) -> str:
    """Return a text with the signs that terminals may lack."""
    return text.replace("+-", "±")


def _in_mm(text: str) -> str:
    """Return what is told of a clearance with its unit."""
    return _typeset(re.sub(r"([\d.]+)(?= deep| away|$)", r"\1 mm", text))


def _point(values: NDArray[np.float64], digits: int) -> str:
    return f"({', '.join(f'{round(one, digits) + 0.0:.{digits}f}' for one in values.tolist())})"


# --- Frames as recorded --------------------------------------------------------------------------


def _frames_shown(
    report: Report,
    recorded: Recorded,
    origin_m: NDArray[np.float64],
    progress: Progress | None,
) -> tuple[list[list[str]], list[str]]:
    """Return by row and camera small pictures, and by row the packed hull; "" where there is none.

    Raises
    ------
    SessionError
        If the recordings end before the report does.
    """
    index = report.index.astype(np.int64)
    steps = np.diff(index)
    step = int(np.gcd.reduce(steps)) if len(steps) else 1
    rows = {int(one): row for row, one in enumerate(index.tolist())}
    n_cameras = len(recorded.views.names)
    small = [[""] * n_cameras for _ in rows]
    hulls = [""] * len(rows)
    frames = FrameRange(int(index[0]), int(index[-1]) + 1, max(step, 1))
    done = 0
    for seen in seen_frames(recorded, frames, progress=progress):
        row = rows.get(seen.index)
        if row is None:
            continue
        done += 1
        if progress is not None:
            progress("pictures and hulls", done, len(rows))
        for number, image in enumerate(seen.images):
            if image is not None:
                mask = None if seen.masks is None else seen.masks[number]
                small[row][number] = webp(_small(image, mask), _SMALL_QUALITY)
        if seen.hull is not None:
            hulls[row] = packed_surface(hull_surface(seen.hull, split=_HULL_SPLIT), origin_m)
    if done == 0:
        raise SessionError(
            f"{recorded.session.path}: has none of the frames of {report.path}; name the session "
            "that the report was made from"
        )
    return small, hulls


def _small(image: Image, mask: NDArray[np.uint8] | None) -> Image:
    """Return a small picture with the outline of what is real."""
    small = fitted(image, _SMALL_PX).copy()
    if mask is not None:
        size = (small.shape[1], small.shape[0])
        there = cv2.resize((mask > 0).astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
        outlines, _ = cv2.findContours(
            (there > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(small, outlines, -1, _OUTLINE_BGR, 1, cv2.LINE_AA)
    return small


def _filled(
    page: Page, report: Report, small: list[list[str]], hulls: list[str], left_bytes: int
) -> Page:
    """Return the page with as many pictures and hulls as it has room for, every so manieth."""
    n_rows = len(report.index)
    size_hulls = sum(map(len, hulls))
    size_small = sum(len(one) for row in small for one in row)
    room = left_bytes * (1.0 - _PICTURES_SHARE)
    room = max(room, left_bytes - size_small)
    hull_every = _every(hulls, n_rows, room)
    used = sum(len(hulls[row]) for row in range(0, n_rows, hull_every)) if hull_every else 0
    pictures_every = _every(["".join(row) for row in small], n_rows, left_bytes - used)
    chunks = dict(page.chunks)
    if hull_every and size_hulls:
        chunks |= {f"hull-{row}": hulls[row] for row in range(0, n_rows, hull_every) if hulls[row]}
    if pictures_every:
        for number in range(len(small[0])):
            chunks[f"pictures-{number}"] = "\n".join(
                small[row][number] for row in range(0, n_rows, pictures_every)
            )
    scene = {**page.scene, "hull_every": hull_every, "pictures_every": pictures_every}
    return replace(page, scene=scene, chunks=chunks, pictures_every=pictures_every)


def _every(texts: Sequence[str], n_rows: int, room: float) -> int:
    """Return the smallest step at which every so manieth text fits; 0 if not even one does."""
    for every in range(1, n_rows + 1):
        if sum(len(texts[row]) + 64 for row in range(0, n_rows, every)) <= room:
            return every
    return 0
