"""The one table of colours: GeoPackage styles, report and pictures all read it.

Blue means more (Added, Increased), orange means less (Removed, Decreased): the pairs stay apart for the common kinds
of colour blindness and in grey print (after Okabe and Ito's palette). Undetermined is purple, Unchanged is grey.
"""

from __future__ import annotations

from loda_pdal.model.labels import ChangeLabel, ObjectClass

LABEL_COLOURS: dict[ChangeLabel, str] = {
    ChangeLabel.ADDED: "#0072b2",
    ChangeLabel.REMOVED: "#d55e00",
    ChangeLabel.INCREASED: "#56b4e9",
    ChangeLabel.DECREASED: "#e69f00",
    ChangeLabel.UNDETERMINED: "#a16bb5",
    ChangeLabel.UNCHANGED: "#9aa0a6",
}
"""Colour of each change label, ``#rrggbb``, in the order of a legend."""

CLASS_COLOURS: dict[ObjectClass, str] = {
    ObjectClass.BUILDING: "#b0413e",
    ObjectClass.VEGETATION: "#2e8b57",
    ObjectClass.MOBILE: "#4c6fb1",
    ObjectClass.OTHER: "#8c6d31",
    ObjectClass.GROUND: "#b8b0a2",
    ObjectClass.NOISE: "#555555",
    ObjectClass.UNCLASSIFIED: "#cccccc",
}
"""Colour of each object class, ``#rrggbb``."""


def rgb(colour: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
