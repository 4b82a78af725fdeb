"""Suites: named blocks by sensor and split, the same on every machine (paper, section 3).

vehicle    procedural streets, and pieces of cities that a vehicle drives through
airborne   pieces of cities surveyed from the air

A street belongs to the split that the hash of its name gives. Cities are split by model, so that no test piece shares a
building with one that was trained on: both models of Rotterdam Delfshaven hold the same town and give train and
validation pieces, Delft and the 3D BAG tile give test pieces only. Density, misregistration, noise and lanes of a block
follow from its seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from loda_pdal.benchmark.blocks import hash_share, split_of_name
from loda_pdal.benchmark.simulate import Reality, SimulationOptions
from loda_pdal.model.errors import InputError

MODELS = {
    "rotterdam_delfshaven_3-20.json": ("train", "validation"),
    "delfshaven_bertt_3-20.city.json": ("train", "validation"),
    "delft.city.json": ("test",),
    "3dbag_tile_00000.city.jsonl": ("test",),
}
"""City models and the splits that their pieces may belong to."""

TRAIN_SHARE = 6 / 7
"""Of the pieces of a model that gives train and validation: as many of each as of the streets."""

SEEN = frozenset(f"rotterdam_delfshaven_3-20 airborne {seed}" for seed in (501, 502, 503))
"""Pieces that were looked at during development: train, whatever their hash."""

SIZES = {
    "vehicle": {"train": (12, 4), "validation": (6, 2), "test": (14, 6)},
    "airborne": {"train": (0, 8), "validation": (0, 5), "test": (0, 10)},
}
"""How many streets and how many pieces of cities each split of a suite has."""

FIRST_STREET = {"train": 101, "validation": 101, "test": 601}
FIRST_PIECE = {
    "vehicle": {"train": 501, "validation": 501, "test": 1201},
    "airborne": {"train": 501, "validation": 501, "test": 1201},
}
"""Seeds are taken in order from here on. What a release was tested on was looked at since: the next begins above it."""

_CONDITIONS = 30
"""Number of the random stream that the conditions of a block come from; the simulator's own are lower."""


@dataclass(frozen=True)
class SuiteBlock:
    """One block: its name (also that of its folder), split, seed, and how it is made."""

    name: str
    split: str
    seed: int
    options: SimulationOptions

    @property
    def is_city(self) -> bool:
        """Whether it is a piece of a city model, which may have no room for it."""
        return bool(self.options.city)

    def unchanged(self) -> SuiteBlock:
        """The same block, surveyed twice without edits and passing traffic."""
        return replace(self, name=f"{self.name}_unchanged", options=replace(self.options, has_edits=False))

    def plain(self) -> SuiteBlock:
        """The same block without what makes it hard: the tidy street, or the city model as it is."""
        return replace(self, name=f"{self.name}_plain", options=replace(self.options, reality=Reality.none()))


def streets(suite: str, split: str) -> list[SuiteBlock]:
    """The procedural blocks of a suite."""
    n = SIZES[suite][split][0]
    names = (f"seed {seed}" for seed in count(FIRST_STREET[split]))
    seeds = (int(name.split()[1]) for name in names if split_of_name(name) == split)
    return [_block(f"seed_{seed}", split, seed, suite) for seed, _ in zip(seeds, range(n), strict=False)]


def pieces(suite: str, split: str, models: Path) -> Iterator[SuiteBlock]:
    """Pieces of city models in the order in which a suite takes them, without end: one that the simulator finds no room
    for is passed over, and so the first `SIZES` of them that have room are the suite's."""
    names = [name for name, splits in MODELS.items() if split in splits]
    missing = [name for name in names if not (models / name).is_file()]
    if missing:
        raise InputError(
            f"{models} has no {missing[0]}.", "Give the folder of city models with --models.", "models-missing"
        )
    return (
        _block(piece_name(model, suite, seed).replace(" ", "_"), split, seed, suite, str(models / model))
        for seed in count(FIRST_PIECE[suite][split])
        for model in names
        if split_of_piece(model, suite, seed) == split
    )


def piece_name(model: str, suite: str, seed: int) -> str:
    """Name of a piece of a city: model, sensor and seed."""
    return f"{model.partition('.')[0]} {suite} {seed}"


def split_of_piece(model: str, suite: str, seed: int) -> str:
    """Split of a piece of a city model: by model, and by the hash of its name where that leaves more than one."""
    splits = MODELS.get(model, ())
    if len(splits) == 1:
        return splits[0]
    name = piece_name(model, suite, seed)
    if not splits:
        return split_of_name(name)
    return "train" if name in SEEN or hash_share(name) < TRAIN_SHARE else "validation"


def split_of_made(made_by: Mapping[str, Any]) -> str:
    """Split of a block by what its truth says of how it was made (`Truth.made_by`)."""
    options, seed = made_by.get("options", {}), made_by.get("seed")
    if city := options.get("city"):
        return split_of_piece(Path(city).name, options["sensor"], int(made_by["seed"]))
    return split_of_name(f"seed {seed}")


def _block(name: str, split: str, seed: int, suite: str, city: str = "") -> SuiteBlock:
    random = np.random.default_rng([seed, _CONDITIONS])
    conditions = _from_the_air(random) if suite == "airborne" else _from_the_street(random)
    return SuiteBlock(name, split, seed, SimulationOptions(sensor=suite, city=city, **conditions))


def _from_the_street(random: np.random.Generator) -> dict[str, Any]:
    """Conditions of two surveys by vehicle; one of four blocks is passed once only."""
    lanes = [(-1.6, 1.6), (-1.6, 1.6), (-1.6, 1.6), (1.6,)]
    return {
        "density": _between(random, 0.7, 1.4),
        "density_after": _between(random, 0.6, 1.6),
        "lanes": lanes[random.integers(len(lanes))],
        "shift_m": round(random.uniform(0.0, 0.15), 3),
        "rotation_deg": round(random.uniform(0.0, 0.4), 3),
        "noise_m": round(random.uniform(0.01, 0.03), 3),
        "drift_m": round(random.uniform(0.005, 0.03), 3),
    }


def _from_the_air(random: np.random.Generator) -> dict[str, Any]:
    """Conditions of two flights: 5 to 20 points per m2, the later survey with half to twice as many."""
    return {
        "length_m": 120.0,
        "width_m": 120.0,
        "density": _between(random, 0.5, 2.0),
        "density_after": _between(random, 0.5, 2.0),
        "shift_m": round(random.uniform(0.0, 0.30), 3),
        "rotation_deg": round(random.uniform(0.0, 0.2), 3),
        "noise_m": round(random.uniform(0.01, 0.04), 3),
        "drift_m": round(random.uniform(0.01, 0.05), 3),
    }


def _between(random: np.random.Generator, low: float, high: float) -> float:
    """A ratio, evenly on a logarithmic scale."""
    return round(float(np.exp(random.uniform(np.log(low), np.log(high)))), 3)
