"""Which preset suits two surveys, told from how evenly their points cover the ground plan.

From the air every square metre gets about as many points as the next. A scanner on a vehicle puts most of them on what
is near, and on walls, which have next to no area in plan: there a quarter of the occupied plan holds two thirds of the
points and more. The reader counts points by plan cell anyway, so this costs no further pass over them.
"""

from __future__ import annotations

from dataclasses import dataclass

from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey

LIMIT = 0.64
"""Share of the points in the densest quarter of the occupied plan: below, a survey is airborne (docs/method.md)."""

CLEARLY_BELOW, CLEARLY_ABOVE = 0.58, 0.67
"""Between these the share does not tell clearly."""

MIN_CELLS = 64
"""Plan cells (`Extent.cells`) that a survey must occupy to be told by its points: 400 m2."""


@dataclass(frozen=True)
class PresetChoice:
    """A preset and what speaks for it.

    Attributes
    ----------
    name : str
        ``street`` or ``aerial``.
    reason : str
        What was measured, as the second half of a sentence.
    is_clear : bool
        Whether both surveys lie well on the side of this preset.
    is_mixed : bool
        Whether one was clearly made from the air and the other clearly not; the sparser one was chosen for.
    """

    name: str
    reason: str
    is_clear: bool
    is_mixed: bool


def preset_for(surveys: Pair[Survey]) -> PresetChoice:
    """The preset that suits both surveys: ``aerial`` if they were made from the air, else ``street``."""
    extents = surveys.map(lambda survey: survey.extent)
    told = [extent for extent in extents if len(extent.cells) >= MIN_CELLS]
    if not told:
        return PresetChoice("street", "the surveys are too small to tell", is_clear=False, is_mixed=False)
    sparsest = max(told, key=lambda extent: (extent.spacing_m, extent.dense_share))
    shares = [extent.dense_share for extent in told]
    is_clear_from_air, is_clear_from_street = max(shares) < CLEARLY_BELOW, min(shares) > CLEARLY_ABOVE
    figures = " and ".join(f"{extent.dense_share:.0%}" for extent in extents)
    return PresetChoice(
        "aerial" if sparsest.dense_share < LIMIT else "street",
        f"the densest quarter of the plan holds {figures} of the points (before and after; from the air mostly 30 to "
        "50 %, from a vehicle 70 to 80 %)",
        is_clear=len(told) == 2 and (is_clear_from_air or is_clear_from_street),
        is_mixed=min(shares) < CLEARLY_BELOW and max(shares) > CLEARLY_ABOVE,
    )


def doubts_about(name: str, surveys: Pair[Survey]) -> list[str]:
    """What to tell a reader of a run with the preset ``name``, if the surveys do not look like what it is made for."""
    if name not in ("street", "aerial"):
        return []
    suits = preset_for(surveys)
    if suits.is_mixed:
        return [
            f"One survey looks airborne and the other as made from a vehicle: {suits.reason}. What only one of them "
            "could see is no change."
        ]
    if suits.is_clear and suits.name != name:
        kind = "airborne surveys" if suits.name == "aerial" else "surveys by vehicle"
        return [f"These look like {kind}: {suits.reason}. The preset {suits.name} is made for them, not {name}."]
    return []
