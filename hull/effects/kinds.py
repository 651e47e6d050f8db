"""The kinds of effects there are, found by name; a module is imported once a scene names it."""

import importlib
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any

from pydantic import ValidationError

from hybridve.calib.errors import SceneError
from hybridve.hull.cad.scene import Scene
from hybridve.hull.effects.effect import Effect, EffectKind, Entry, Setting
from hybridve.hull.toml_io import explain_validation

#: The group of entry points by which other packages add kinds.
GROUP = "hybridve.effects"

#: Those that come with hybridve: their modules, each with a `KIND`.
_BUILT_IN = ("rigid", "hinge", "cloth", "particles", "shadow", "light", "proximity")


def known_kinds() -> tuple[str, ...]:
    """Return the names of all kinds there are."""
    added = {point.name for point in entry_points(group=GROUP)}
    return (*_BUILT_IN, *sorted(added.difference(_BUILT_IN)))


def kind_of(name: str, label: str) -> EffectKind:
    """Return a kind of effect, imported.

    Raises
    ------
    SceneError
        If there is none of this name, or one that was added cannot be imported.
    """
    if name in _BUILT_IN:
        found: EffectKind = importlib.import_module(f"hybridve.hull.effects.{name}").KIND
        return found
    for point in entry_points(group=GROUP):
        if point.name == name:
            try:
                loaded = point.load()
            except Exception as error:
                raise SceneError(
                    f"{label}.kind: the effect {name!r} is given by {point.value}, which cannot "
                    f"be imported: {error}"
                ) from error
            if not isinstance(loaded, EffectKind):
                raise SceneError(
                    f"{label}.kind: the effect {name!r} is given by {point.value}, which is "
                    f"{type(loaded).__name__}, expected an EffectKind"
                )
            return loaded
    raise SceneError(
        f"{label}.kind: there is no effect {name!r}; there are {', '.join(known_kinds())}"
    )


def read_entries(scene: Scene) -> tuple[tuple[Entry, EffectKind], ...]:
    """Return the effects that a scene names, their settings read, with the kind of each.

    Raises
    ------
    SceneError
        If a kind or a key is unknown or wrong, two have one name, two move one object, or one moves
        what a file moves.
    """
    found: list[tuple[Entry, EffectKind]] = []
    for number, raw in enumerate(scene.effects, start=1):
        label = f"{scene.path}: effect.{number}"
        kind = kind_of(str(raw["kind"]), label)
        try:
            table = kind.table.model_validate(raw)
        except ValidationError as error:
            raise SceneError(
                explain_validation(error, scene.path, kind.table, ("effect", number - 1))
            ) from None
        found.append((Entry(table.name or table.default_name, table, label), kind))
    _refuse_shared([entry for entry, _ in found])
    _refuse_driven([entry for entry, _ in found], scene)
    return tuple(found)


def _refuse_shared(entries: Sequence[Entry]) -> None:
    movers: dict[str, str] = {}
    names: dict[str, str] = {}
    for entry in entries:
        place = entry.label.rpartition(" ")[2]
        for name in entry.table.claimed:
            if name in movers:
                raise entry.error(
                    f"{name!r} is moved by {movers[name]} already; an object can be moved by one "
                    "effect only",
                    "object",
                )
            movers[name] = place
        if entry.name in names:
            raise entry.error(
                f"{entry.name!r} is what {names[entry.name]} is called too; give each a `name` of "
                "its own",
                "name",
            )
        names[entry.name] = place


def _refuse_driven(entries: Sequence[Entry], scene: Scene) -> None:
    driven = {one.name: one.about.get("motion") for one in scene.objects if one.motion is not None}
    for entry in entries:
        for name in entry.table.claimed:
            if name in driven:
                key = (driven[name] or {}).get("kind", "poses")
                raise entry.error(
                    f"{name!r} moves as its `{key}` says, so that no effect can move it; take out "
                    "one of the two",
                    "object",
                )


def make_effects(
    found: Sequence[tuple[Entry, EffectKind]], setting: Setting
) -> list[tuple[Effect, tuple[Entry, ...]]]:
    """Return the effects, each with the entries that it simulates; in the order of the scene."""
    together: dict[Any, list[Entry]] = {}
    for entry, kind in found:
        together.setdefault(kind.make, []).append(entry)
    return [(make(entries, setting), tuple(entries)) for make, entries in together.items()]


def software_of(found: Sequence[tuple[Entry, EffectKind]]) -> Mapping[str, str]:
    """Return the libraries that the numbers of these effects depend on, and their versions."""
    return {name: version for _, kind in found for name, version in kind.software().items()}
