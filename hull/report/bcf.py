"""BCF 3.0: clashes as topics that BIM tools open, with a snapshot and from where it is seen.

A small writer of our own, since what there is is of another licence: a zip with a folder a topic.

References
----------
buildingSMART, BIM Collaboration Format (BCF-XML) 3.0.
"""

import re
import uuid
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from hybridve.calib.errors import ReportError
from hybridve.calib.files import appearing
from hybridve.hull.places import MARK

Vector = tuple[float, float, float]

#: What identities are derived from: the same clash has the same in every file.
_NAMESPACE = uuid.UUID("5b0c9c6e-2f7e-5a0b-8d5e-0d1f6c3b9a41")

#: Files of a zip are of this day, so that equal input gives the same bytes.
_DAY = (1980, 1, 1, 0, 0, 0)

#: When something was made of which nobody knows.
_UNKNOWN_DATE = "1970-01-01T00:00:00+00:00"

#: What XML cannot hold.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class BcfView:
    """From where a topic is seen, metres in the world.

    Attributes
    ----------
    eye, direction, up : (float, float, float)
        Where the eye is, where it looks, and what is up.
    vertical_fov_deg, aspect : float
        Of the picture: its vertical field of view, and its width over its height.
    png : bytes
        The snapshot.
    line : (Vector, Vector) or None
        The two points that the clearance was measured between.
    """

    eye: Vector
    direction: Vector
    up: Vector
    vertical_fov_deg: float
    aspect: float
    png: bytes
    line: tuple[Vector, Vector] | None = None


@dataclass(frozen=True, slots=True)
class BcfTopic:
    """One clash.

    Attributes
    ----------
    id, object : str
        What it is called, and the object: its identity follows from these.
    kind, status : str
        As the ledger has them.
    title, description : str
        What it is.
    labels : tuple of str
        What else it is found by.
    created : str
        When the report was made, as ISO 8601 has it.
    who, when, comment : str
        What was decided about it; empty if nothing was.
    view : BcfView or None
        From where it is seen; None without a picture.
    """

    id: str
    object: str
    kind: str
    status: str
    title: str
    description: str
    labels: tuple[str, ...]
    created: str
    who: str
    when: str
    comment: str
    view: BcfView | None


def guid_of(*what: str) -> str:
    """Return the identity of something by its names: always the same.

    Examples
    --------
    >>> guid_of("lid", "lid-k3f7") == guid_of("lid", "lid-k3f7") != guid_of("lid", "lid-9xyz")
    True
    """
    return str(uuid.uuid5(_NAMESPACE, "\n".join(what)))


def write_bcf(path: Path, project: str, topics: Sequence[BcfTopic]) -> None:
    """Write topics as a .bcf, which appears only when it is complete.

    Raises
    ------
    ReportError
        If it cannot be written.
    """
    try:
        with (
            appearing(path) as partial,
            zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as file,
        ):
            file.comment = MARK.encode()
            _add(file, "bcf.version", _xml(Element("Version", VersionId="3.0")))
            _add(file, "project.bcfp", _xml(_project(project)))
            _add(file, "extensions.xml", _xml(_extensions(topics)))
            for number, topic in enumerate(topics):
                folder = guid_of(topic.object, topic.id)
                _add(file, f"{folder}/markup.bcf", _xml(_markup(topic, number)))
                if topic.view is not None:
                    _add(file, f"{folder}/viewpoint.bcfv", _xml(_viewpoint(topic, topic.view)))
                    _add(file, f"{folder}/snapshot.png", topic.view.png)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error


def _add(file: zipfile.ZipFile, name: str, content: bytes) -> None:
    about = zipfile.ZipInfo(name, _DAY)
    about.compress_type = zipfile.ZIP_DEFLATED
    about.external_attr = 0o644 << 16
    file.writestr(about, content)


def _xml(root: Element) -> bytes:
    ElementTree.indent(root)
    told: bytes = ElementTree.tostring(root, "utf-8", xml_declaration=True)
    return told


def _said(text: str) -> str:
    """Return a text as XML can hold it, never empty."""
    return _NO_XML.sub("?", text).strip() or "-"


def _date(text: str) -> str:
    """Return a time as XML has it, or one that stands for none."""
    try:
        return datetime.fromisoformat(text).isoformat()
    except ValueError:
        return _UNKNOWN_DATE


def _text(parent: Element, tag: str, text: str) -> Element:
    child = SubElement(parent, tag)
    child.text = text
    return child


def _list(parent: Element, tag: str, each: str, texts: Iterable[str]) -> None:
    group = SubElement(parent, tag)
    for text in dict.fromkeys(texts):
        _text(group, each, _said(text))


def _project(name: str) -> Element:
    root = Element("ProjectInfo")
    project = SubElement(root, "Project", ProjectId=guid_of("project", name))
    _text(project, "Name", _said(name))
    return root


def _extensions(topics: Sequence[BcfTopic]) -> Element:
    root = Element("Extensions")
    _list(root, "TopicTypes", "TopicType", (one.kind for one in topics))
    _list(root, "TopicStatuses", "TopicStatus", (one.status for one in topics))
    _list(root, "TopicLabels", "TopicLabel", (label for one in topics for label in one.labels))
    _list(root, "Users", "User", (_author(one) for one in topics))
    return root


def _author(topic: BcfTopic) -> str:
    return topic.who or "hybridve"


def _markup(topic: BcfTopic, number: int) -> Element:
    root = Element("Markup")
    about = SubElement(
        root,
        "Topic",
        Guid=guid_of(topic.object, topic.id),
        ServerAssignedId=_said(topic.id),
        TopicType=_said(topic.kind),
        TopicStatus=_said(topic.status),
    )
    _text(about, "Title", _said(topic.title))
    _text(about, "Index", str(number))
    _list(about, "Labels", "Label", topic.labels)
    _text(about, "CreationDate", _date(topic.created))
    _text(about, "CreationAuthor", "hybridve")
    if topic.when:
        _text(about, "ModifiedDate", _date(topic.when))
        _text(about, "ModifiedAuthor", _said(_author(topic)))
    _text(about, "Description", _said(topic.description))
    if topic.comment:
        comment = SubElement(
            SubElement(about, "Comments"),
            "Comment",
            Guid=guid_of(topic.object, topic.id, "comment"),
        )
        _text(comment, "Date", _date(topic.when))
        _text(comment, "Author", _said(_author(topic)))
        _text(comment, "Comment", _said(topic.comment))
    if topic.view is not None:
        view = SubElement(SubElement(about, "Viewpoints"), "ViewPoint", Guid=_view_guid(topic))
        _text(view, "Viewpoint", "viewpoint.bcfv")
        _text(view, "Snapshot", "snapshot.png")
        _text(view, "Index", "0")
    return root


def _view_guid(topic: BcfTopic) -> str:
    return guid_of(topic.object, topic.id, "viewpoint")


def _viewpoint(topic: BcfTopic, view: BcfView) -> Element:
    root = Element("VisualizationInfo", Guid=_view_guid(topic))
    components = SubElement(root, "Components")
    component = SubElement(SubElement(components, "Selection"), "Component")
    _text(component, "OriginatingSystem", "hybridve")
    _text(component, "AuthoringToolId", _said(topic.object))
    SubElement(components, "Visibility", DefaultVisibility="true")
    camera = SubElement(root, "PerspectiveCamera")
    _vector(camera, "CameraViewPoint", view.eye)
    _vector(camera, "CameraDirection", view.direction)
    _vector(camera, "CameraUpVector", view.up)
    _text(camera, "FieldOfView", f"{view.vertical_fov_deg:.9g}")
    _text(camera, "AspectRatio", f"{view.aspect:.9g}")
    if view.line is not None:
        line = SubElement(SubElement(root, "Lines"), "Line")
        _vector(line, "StartPoint", view.line[0])
        _vector(line, "EndPoint", view.line[1])
    return root


def _vector(parent: Element, tag: str, values: Vector) -> None:
    child = SubElement(parent, tag)
    for axis, value in zip("XYZ", values, strict=True):
        _text(child, axis, f"{value:.12g}")
