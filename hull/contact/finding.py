"""All that one frame says of one object, bundled."""

from dataclasses import dataclass

from hybridve.hull.contact.detect import Contact


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """One object in one frame.

    Attributes
    ----------
    contact : Contact
        Whether it is touched, where, and how sure that is.
    """

    contact: Contact

    @property
    def touches(self) -> bool:
        """Whether a point of the object's surface is in the hull, sampled or certified."""
        return self.contact.collides or self.contact.certificate == "colliding"
