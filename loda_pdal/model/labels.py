"""Object classes and change labels: the codes that every output uses."""

from __future__ import annotations

from enum import IntEnum


class ChangeLabel(IntEnum):
    """What happened to an object between the two surveys (paper, section 3, the label set Y).

    UNDETERMINED is not one of the paper's five labels: it says that the other survey could not have seen the
    object, or that nothing was evaluated there. It is never written as "unchanged" or as 0 m.
    """

    UNDETERMINED = 0
    UNCHANGED = 1
    ADDED = 2
    REMOVED = 3
    INCREASED = 4
    DECREASED = 5

    @property
    def title(self) -> str:
        """Label as it is written in tables and layers, e.g. ``Added``."""
        return self.name.capitalize()

    @property
    def swapped(self) -> ChangeLabel:
        """Label of the same object when the two surveys change places."""
        return _SWAPPED.get(self, self)


_SWAPPED = {
    ChangeLabel.ADDED: ChangeLabel.REMOVED,
    ChangeLabel.REMOVED: ChangeLabel.ADDED,
    ChangeLabel.INCREASED: ChangeLabel.DECREASED,
    ChangeLabel.DECREASED: ChangeLabel.INCREASED,
}


class ObjectClass(IntEnum):
    """Classification codes: ASPRS where ASPRS has one, the user range (64 and up) elsewhere."""

    UNCLASSIFIED = 1
    GROUND = 2
    VEGETATION = 5
    BUILDING = 6
    NOISE = 7
    MOBILE = 64
    OTHER = 65

    @property
    def title(self) -> str:
        """Class as it is written in tables and layers, e.g. ``building``."""
        return self.name.lower()


OBJECT_CLASSES = (ObjectClass.BUILDING, ObjectClass.VEGETATION, ObjectClass.MOBILE, ObjectClass.OTHER)
"""Classes that form instances, in the paper's order of priority (`other` is ours, METHOD 1.9)."""
