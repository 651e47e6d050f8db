"""What is wrong with a session, in one line each: what was found, what was expected, what to do."""

from hybridve.hull.agreement.causes import Cause
from hybridve.hull.agreement.record import NamedCause


def message_of(
    cause: Cause,
    *,
    frames: tuple[int, int, int, int],
    per_row: float,
    late_s: float,
    offset_s: float,
) -> str:
    """Return a cause in words.

    Parameters
    ----------
    cause : Cause
        What was found.
    frames : (first, last, last of the session, first of the session)
        Numbers of frames.
    per_row : float
        Frames from one row of the table to the next.
    late_s : float
        Of a delay: in seconds.
    offset_s : float
        What the session says that the camera began later by.
    """
    first, last, end, start = frames
    who = " and ".join(cause.cameras)
    fits = f"its outlines miss those of the others by {cause.before_px:.1f} px, "
    if cause.kind == "exchanged":
        return (
            f"{who} are exchanged: their outlines miss those of the others by "
            f"{cause.before_px:.1f} px, exchanged by {cause.after_px:.1f} px; exchange their "
            "recordings in session.toml, or their names in the rig"
        )
    if cause.kind in ("mirrored", "upside down", "turned"):
        state, undo = {
            "mirrored": ("mirrored left to right", "mirror it back"),
            "upside down": ("upside down, mirrored", "flip it back"),
            "turned": ("turned by 180 degrees, or its pose in the rig is", "turn it back"),
        }[cause.kind]
        return (
            f"{who}'s picture is {state}: {fits}so changed by {cause.after_px:.1f} px; {undo}, or "
            "calibrate again with pictures as they are recorded now"
        )
    if cause.kind == "scaled":
        return (
            f"{who}'s pictures have another size than those that the rig was made for: {fits}"
            f"scaled to another camera's size by {cause.after_px:.1f} px; take pictures of the "
            "size that the camera was calibrated with"
        )
    if cause.kind == "inverted":
        return (
            f"{who}'s masks show what is not there: inverted, its outlines miss those of the "
            f"others by {cause.after_px:.1f} px; invert them (object pixels are above "
            "mask_threshold)"
        )
    if cause.kind == "late":
        frames_late = cause.size * per_row
        low, high = sorted((abs(cause.low) * per_row, abs(cause.high) * per_row))
        when = "late" if cause.size > 0 else "early"
        return (
            f"{who} is {abs(frames_late):.2f} frames {when} (95 %: {low:.2f} to {high:.2f}): {fits}"
            f"in time by {cause.after_px:.1f} px; give it offset_s = {offset_s - late_s:.3f}"
            f"{_instead(cause)}"
        )
    if cause.kind == "bumped":
        x, y = cause.moved_px.tolist()
        way = f"{abs(x):.1f} px to the {'right' if x > 0 else 'left'} and {abs(y):.1f} px "
        way += "down" if y > 0 else "up"
        since = "" if first == start else f" since frame {first}"
        return (
            f"{who} has moved{since}: its picture stands {way} (95 %: {cause.low:.1f} to "
            f"{cause.high:.1f} px in all): {fits}moved back by {cause.after_px:.1f} px; calibrate "
            f"again with where it stood then, or leave it out with --drop-camera {who}"
            f"{_instead(cause)}"
        )
    if cause.kind == "frames":
        when = f"frame {first}" if first == last else f"frames {first} to {last}"
        by = f", by {cause.size:.1f} px more than usual" if cause.size == cause.size else ""
        return (
            f"{who}'s silhouettes of {when} fit none of the others{by}; look at them "
            "(`hybridve render --view agreement`), or leave the camera out with "
            f"--drop-camera {who}"
        )
    if cause.kind == "left behind":
        left, top, right, bottom = (round(at) for at in cause.box_px.tolist())
        return (
            f"{who} sees something all the time that no other camera confirms, at ({left}, {top}) "
            f"to ({right}, {bottom}) of its picture: it was left there, or moved, since the empty "
            "scene was recorded, or it is a reflection; the hull is the same without it"
        )
    whom = f"{who} contradicts the others" if who else "the silhouettes contradict each other"
    leave = f", or leave it out with --drop-camera {who}" if who else ""
    return (
        f"{whom} most of the time (frames {start} to {end}), and nothing that was tried explains "
        "it (exchanged, mirrored, turned, inverted, late, bumped); look at the silhouettes "
        f"(`hybridve render --view agreement`), at backgrounds and poses{leave}"
    )


def short_of(cause: Cause) -> str:
    """Return a cause in a few words."""
    who = " and ".join(cause.cameras)
    if not who:
        return "the silhouettes contradict each other"
    if cause.kind == "frames":
        return f"{who}'s silhouette fits none of the others"
    if cause.kind == "left behind":
        return f"{who} sees something that was left behind"
    if cause.kind == "contradictory":
        return f"{who} contradicts the others"
    return f"{who} {cause.kind}"


def brief(cause: NamedCause, camera: str) -> str:
    """Return a cause, as a report has it, in the few words that go into a picture of a camera.

    `camera` is the name of one of the cause's cameras.
    """
    if cause.kind == "exchanged":
        return f"exchanged with {' and '.join(name for name in cause.cameras if name != camera)}"
    if cause.kind == "late" and cause.size is not None:
        return f"{abs(cause.size):.2f} frames {'late' if cause.size > 0 else 'early'}"
    if cause.kind in ("bumped", "moved") and cause.size is not None:
        return f"{cause.kind} by {cause.size:.1f} px"
    if cause.kind == "frames":
        by = "" if cause.size is None else f" by {cause.size:.1f} px"
        if cause.first_frame == cause.last_frame:
            return f"fits none of the others{by} in frame {cause.first_frame}"
        return f"fits none of the others{by} in frames {cause.first_frame} to {cause.last_frame}"
    if cause.kind == "contradictory":
        return "contradicts the others"
    return cause.kind


def _instead(cause: Cause) -> str:
    """Return which other cameras it may be as well."""
    if not cause.instead:
        return ""
    return f"; or {', '.join(cause.instead)} is off the other way: the outlines tell no better"
