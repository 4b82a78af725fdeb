"""How a block is made: its size, its surveys, and how much of what makes real surveys hard it has."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any

from loda_pdal.model.errors import ParameterError


@dataclass(frozen=True)
class Reality:
    """What makes a real street hard, each thing drawn from a random stream of its own.

    Attributes
    ----------
    traffic : float
        Vehicles, cyclists and people that move while the vehicle scans; 1 is a quiet street by day, 0 an empty one.
    clutter : float
        Street furniture and edits beyond those of a tidy street, relative to the usual amount; 0 none.
    leaf_share : tuple of float
        Least and most of a tree's leaves that a survey meets; each survey draws its own share.
    density_spread : float
        Each survey fires up to that share more or fewer pulses than asked for.
    lane_spread_m : float
        Standard deviation of how far each pass keeps from its lane, m.
    one_lane_share : float
        Chance that a survey leaves out one of several lanes.
    partial_share : float
        Chance that one of the surveys misses one end of the block.
    wet_share : float
        Chance that a survey is made on wet ground.
    is_glazed : bool
        Windows let pulses through; some return from behind them.
    weakest_signal : float
        Strength at which half of the returns are lost: dark surfaces far away have few.
    """

    traffic: float = 1.0
    clutter: float = 1.0
    leaf_share: tuple[float, float] = (0.55, 1.0)
    density_spread: float = 0.25
    lane_spread_m: float = 0.25
    one_lane_share: float = 0.2
    partial_share: float = 0.2
    wet_share: float = 0.25
    is_glazed: bool = True
    weakest_signal: float = 0.002

    def __post_init__(self) -> None:
        for name, low, high in (
            ("traffic", 0.0, 10.0),
            ("clutter", 0.0, 5.0),
            ("density_spread", 0.0, 0.9),
            ("lane_spread_m", 0.0, 1.0),
            ("one_lane_share", 0.0, 1.0),
            ("partial_share", 0.0, 1.0),
            ("wet_share", 0.0, 1.0),
            ("weakest_signal", 0.0, 1.0),
        ):
            _check(name, getattr(self, name), low, high)
        least, most = self.leaf_share
        _check("leaf_share", least, 0.0, most)
        _check("leaf_share", most, least, 1.0)

    @staticmethod
    def none() -> Reality:
        """A tidy, empty street on a dry day, both surveys alike."""
        return Reality(0.0, 0.0, (1.0, 1.0), 0.0, 0.0, 0.0, 0.0, 0.0, False, 0.0)


@dataclass(frozen=True)
class SimulationOptions:
    """How a block is made. Lengths in m.

    Attributes
    ----------
    length_m, width_m : float
        Extent along and across the street.
    city : str
        CityJSON file that the buildings come from; empty for a procedural street.
    sensor : str
        ``vehicle`` or ``airborne``.
    density : float
        Pulses per survey; 1 gives about 0.65 million returns from 100 m of street, or 10 pulses per m2 from the air.
    density_after : float
        Pulses of the later survey, relative to the earlier one.
    lanes : tuple of float
        One pass of the vehicle per entry: where it drives, m from the middle of the street.
    shift_m, rotation_deg : float
        Residual misregistration of the before epoch: how far it is moved, and turned about the middle of the block.
    noise_m, drift_m : float
        Range noise, and slow pose error.
    has_edits : bool
        False surveys an unchanged and empty street twice, with fresh noise and foliage.
    min_returns : int
        Fewer returns in a survey that an instance stands in, or from what changed of it, leave it out of the scores.
    min_visible : float
        So does a smaller share of what changed that the other survey could have measured.
    reality : Reality
        What else makes it hard.
    """

    length_m: float = 100.0
    width_m: float = 56.0
    city: str = ""
    sensor: str = "vehicle"
    density: float = 1.0
    density_after: float = 1.0
    lanes: tuple[float, ...] = (-1.6, 1.6)
    shift_m: float = 0.05
    rotation_deg: float = 0.2
    noise_m: float = 0.02
    drift_m: float = 0.02
    has_edits: bool = True
    min_returns: int = 30
    min_visible: float = 0.25
    reality: Reality = field(default_factory=Reality)

    def __post_init__(self) -> None:
        for name, low, high in (
            ("length_m", 30.0, 2000.0),
            ("width_m", 10.0, 80.0 if not self.city else 400.0),
            ("density", 0.01, 20.0),
            ("density_after", 0.1, 10.0),
            ("shift_m", 0.0, 100.0),
            ("rotation_deg", 0.0, 180.0),
            ("noise_m", 0.0, 1.0),
            ("drift_m", 0.0, 1.0),
        ):
            _check(name, getattr(self, name), low, high)
        if self.sensor not in ("vehicle", "airborne"):
            raise ParameterError(f"No sensor {self.sensor!r}.", "Choose vehicle or airborne.", "parameter-range")
        if not self.lanes:
            raise ParameterError("No lane to drive on.", "Give at least one.", "parameter-range")

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ParameterError(
            f"{name} = {value} is outside {low} to {high}.", "Choose a value in that range.", "parameter-range"
        )
