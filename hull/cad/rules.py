"""Rules of a scene: what of the clashes is not worth a word, and what single parts require."""

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

from hybridve.calib.plain import Told

_Corner = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Rule(Told):
    """One rule; of `ignore`, `shortest_s` and `required_clearance_m` it says one.

    Attributes
    ----------
    objects : tuple of str
        Patterns of the names of objects that it holds for; ``*`` stands for any letters.
    ignore : bool
        Whether contacts with them are left out.
    zone_m : (corner, corner) or None
        The box in which they are, along the axes of the world or of the object's own frame, lower
        and upper corner; None for everywhere.
    zone_in : "world" or "object"
        Whose frame that is.
    shortest_s : float
        Clashes that last less are left out.
    required_clearance_m : float or None
        How far real things are to stay away from them.
    comment : str
        Why.
    """

    objects: tuple[str, ...] = ("*",)
    ignore: bool = False
    zone_m: tuple[_Corner, _Corner] | None = None
    zone_in: Literal["world", "object"] = "world"
    shortest_s: float = 0.0
    required_clearance_m: float | None = None
    comment: str = ""

    def holds_for(self, name: str) -> bool:
        """Tell whether it is about an object.

        Examples
        --------
        >>> Rule(("bracket.*",)).holds_for("bracket.bolt"), Rule(("lid",)).holds_for("lid.2")
        (True, False)
        """
        return any(fnmatchcase(name, pattern) for pattern in self.objects)

    @property
    def text(self) -> str:
        """What it says, in words."""
        whom = "" if self.objects == ("*",) else f" of {', '.join(self.objects)}"
        where = "" if self.zone_m is None else " in a zone"
        if self.required_clearance_m is not None:
            what = f"{1e3 * self.required_clearance_m:g} mm are required{whom}"
        elif self.shortest_s:
            what = f"shorter than {self.shortest_s:g} s{whom}"
        else:
            what = f"ignored{whom}{where}"
        return f"{what} ({self.comment})" if self.comment else what
