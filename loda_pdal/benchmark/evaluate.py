"""Run a suite: simulate its blocks, run the method on each, score, and pool (paper, section 4.4).

A folder keeps all of it, so that an interrupted run goes on where it was: blocks are made again only if their options,
the city model or the simulator are others than before, results if the block, the parameters or the method are.

    FOLDER/NAME/          before.laz, after.laz, their trajectories, truth.json; block.json says how they were made
    FOLDER/NAME/result/   as `loda-pdal detect` writes it; result.json beside it says how it was made
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from loda_pdal.benchmark.metrics import Scores, markdown_table
from loda_pdal.benchmark.protocols import ScoreReport, combined, judge
from loda_pdal.benchmark.runs import Annotation, JudgedPoints, read_annotation, read_run
from loda_pdal.benchmark.simulate import simulate_block, write_block
from loda_pdal.benchmark.suites import SIZES, SuiteBlock, pieces, streets
from loda_pdal.benchmark.truth import Truth
from loda_pdal.io.las import read_epochs
from loda_pdal.io.outputs import write_outputs
from loda_pdal.model.errors import InputError, LodaError
from loda_pdal.model.pair import Pair
from loda_pdal.model.survey import Survey
from loda_pdal.params import Parameters
from loda_pdal.pipeline import detect_changes

Say = Callable[[str], None]

N_RESAMPLES = 1000
"""Draws of blocks that the interval of a score is taken from."""

MOST_CANDIDATES = 40
"""So many pieces of cities are tried for each that is wanted."""

_PACKAGE = Path(__file__).resolve().parent.parent
_SIMULATOR = ("benchmark/simulate", "benchmark/truth.py")
METHOD_SOURCES = (
    *(f"io/{name}.py" for name in ("crs", "geopackage", "las", "las_points", "las_writer", "trajectory")),
    *("assembly.py", "kernels", "model", "params.py", "pipeline.py", "stages"),
)


@dataclass(frozen=True)
class BlockScore:
    """One block of a suite: its name, its scores, and the seconds that the method took on it (None: not run anew)."""

    name: str
    report: ScoreReport
    seconds: float | None = None


@dataclass(frozen=True)
class SuiteScore:
    """Scores of all blocks of one split of a suite, with what they were run with."""

    suite: str
    split: str
    parameters: str
    blocks: list[BlockScore]

    @property
    def pooled(self) -> ScoreReport:
        """All blocks as one."""
        return combined([block.report for block in self.blocks])

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "suite": self.suite,
            "split": self.split,
            "parameters": self.parameters,
            "pooled": self.pooled.to_dict(),
            "macro_iou_95": interval([b.report for b in self.blocks]),
            "part_macro_iou_95": interval([b.report for b in self.blocks], by_part=True),
            "blocks": {b.name: {"seconds": b.seconds, **b.report.to_dict()} for b in self.blocks},
        }

    def to_markdown(self) -> str:
        """A row per block, then the tables of all blocks together."""
        reports = [block.report for block in self.blocks]
        header = ["block", "n", "ACC", "mF1", "mIoU", "mIoU by part", "class mIoU", "false alarms per ha"]
        rows = [_row(block.name, block.report) for block in self.blocks]
        lines = [
            f"# Suite {self.suite}, {self.split} split: {len(reports)} blocks, {self.parameters}",
            markdown_table(header, [*rows, _row("all, pooled", self.pooled)]),
        ]
        if len(reports) > 1:
            whole, part = interval(reports), interval(reports, by_part=True)
            lines.append(
                f"mIoU lies between {100 * whole[0]:.1f} and {100 * whole[1]:.1f}, by part between {100 * part[0]:.1f} "
                f"and {100 * part[1]:.1f}: 95 % of {N_RESAMPLES} draws of blocks with replacement."
            )
        return "\n\n".join([*lines, self.pooled.to_markdown()])


def run_suite(
    folder: Path,
    suite: str,
    split: str,
    parameters: Parameters,
    *,
    models: Path | None = None,
    limit: int | None = None,
    result: str = "result",
    with_trajectories: bool = False,
    is_plain: bool = False,
    say: Say = lambda text: None,
    look: Callable[[str, Path, JudgedPoints, Truth, ScoreReport], None] | None = None,
) -> SuiteScore:
    """Simulate, run and score the blocks of one split of a suite.

    Parameters
    ----------
    folder : Path
        Keeps blocks and results; a second call takes what is there.
    suite, split : str
        See `loda_pdal.benchmark.suites`.
    parameters : Parameters
        Of the method.
    models : Path, optional
        Folder of the city models; needed where the suite has pieces of cities.
    limit : int, optional
        Blocks to run: the first ones.
    result : str
        Name of the folder of results in the folder of each block.
    with_trajectories : bool
        Tell the method where the sensors were.
    is_plain : bool
        The same blocks without traffic, clutter, glass and the like.
    say : callable
        Told what is going on.
    look : callable, optional
        Called for each block with its name, result folder, points, truth and scores: for pictures.
    """
    blocks = []
    variant = SuiteBlock.plain if is_plain else lambda block: block
    for name, block_dir in prepared_blocks(folder, suite, split, models=models, limit=limit, say=say, variant=variant):
        seconds = _ensure_result(block_dir, result, parameters, name, say, with_trajectories)
        truth = Truth.read(block_dir / "truth.json")
        points = read_run(block_dir / result, truth, block_dir)
        report = judge(points, truth)
        if look is not None:
            look(name, block_dir / result, points, truth, report)
        blocks.append(BlockScore(name, report, seconds))
        took = "" if seconds is None else f" in {seconds:.0f} s"
        say(f"{name}: mIoU {_per_cent(report.scores().macro_iou)}, {report.false_alarms_per_ha:.1f} alarms/ha{took}")
    told = described(parameters) + (" with trajectories" if with_trajectories else "")
    return SuiteScore(f"{suite}, plain" if is_plain else suite, split, told, blocks)


def prepared_blocks(
    folder: Path,
    suite: str,
    split: str,
    *,
    models: Path | None = None,
    limit: int | None = None,
    say: Say,
    variant: Callable[[SuiteBlock], SuiteBlock] = lambda block: block,
) -> Iterator[tuple[str, Path]]:
    """Name and folder of each block of a suite, or of a variant of it, simulated where it is not there yet."""
    n_streets, n_pieces = SIZES[suite][split]
    if limit is not None:
        n_streets, n_pieces = min(n_streets, limit), min(n_pieces, max(limit - n_streets, 0))
    if n_pieces and models is None:
        raise InputError(
            f"The {split} split of suite {suite} has pieces of cities.",
            "Name the folder of city models with --models.",
            "models-missing",
        )
    candidates = pieces(suite, split, models) if n_pieces and models is not None else iter(())
    for street in streets(suite, split)[:n_streets]:
        block = variant(street)
        _ensure_block(folder, block, say)
        yield block.name, folder / block.name
    found = 0
    for piece in islice(candidates, n_pieces * MOST_CANDIDATES):
        block = variant(piece)
        if _ensure_block(folder, block, say):
            found += 1
            yield block.name, folder / block.name
        if found == n_pieces:
            break
    if found < n_pieces:
        raise InputError(
            f"{models} has room for {found} of {n_pieces} pieces.", "Give other city models.", "city-model"
        )


class KnownBlock(NamedTuple):
    """A block with all that is known of it."""

    surveys: Pair[Survey]
    annotation: Pair[Annotation]
    truth: Truth


def read_block(block_dir: Path) -> KnownBlock:
    """A block that was simulated."""
    truth = Truth.read(block_dir / "truth.json")
    paths = Pair(block_dir / "before.laz", block_dir / "after.laz")
    return KnownBlock(read_epochs(*paths), paths.map(lambda path: read_annotation(path, truth)), truth)


def interval(reports: list[ScoreReport], *, by_part: bool = False) -> tuple[float, float]:
    """Where 95 % of the mIoU lie that as many blocks, drawn with replacement, would give."""
    tables = np.array([report.scores(by_part=by_part).confusion for report in reports])
    draws = np.random.default_rng(1).integers(len(reports), size=(N_RESAMPLES, len(reports)))
    found = [Scores(tables[draw].sum(axis=0)).macro_iou or 0.0 for draw in draws]
    low, high = np.percentile(found, (2.5, 97.5))
    return float(low), float(high)


def _ensure_block(folder: Path, block: SuiteBlock, say: Say) -> bool:
    """Simulate a block unless it is there; whether its city model has room for it."""
    stamp = {"seed": block.seed, "options": _plain_options(block), "simulator": sources_digest(*_SIMULATOR)}
    target = folder / block.name
    known = read_stamp(target / "block.json")
    if known is not None and {k: known.get(k) for k in stamp} == stamp:
        return bool(known["has_room"])
    say(f"{block.name}: simulating")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{block.name}-", dir=folder) as scratch:
        made = Path(scratch) / block.name
        made.mkdir()
        has_room = True
        try:
            write_block(simulate_block(block.seed, block.options), made)
        except InputError as error:
            if not block.is_city or error.code != "city-model":
                raise
            has_room = False
            say(f"{block.name}: passed over, {error.message}")
        (made / "block.json").write_text(json.dumps({**stamp, "has_room": has_room}, indent=1) + "\n", encoding="utf-8")
        shutil.rmtree(target, ignore_errors=True)
        made.rename(target)
    return has_room


def _ensure_result(
    block_dir: Path, result: str, parameters: Parameters, name: str, say: Say, with_trajectories: bool
) -> float | None:
    """Run the method on a block unless its result is there; seconds that it took."""
    stamp_path = block_dir / f"{result}.json"
    stamp = {
        "block": _file_digest(block_dir / "block.json"),
        "parameters": json.loads(json.dumps(parameters.to_dict())),
        "method": sources_digest(*METHOD_SOURCES),
        "with_trajectories": with_trajectories,
    }
    if read_stamp(stamp_path) == stamp and (block_dir / result / "run.json").is_file():
        return None
    say(f"{name}: running")
    stamp_path.unlink(missing_ok=True)
    start = time.perf_counter()
    before, after = block_dir / "before.laz", block_dir / "after.laz"
    ways: Pair[Path | None] = Pair(None, None)
    if with_trajectories:
        ways = Pair(block_dir / "before_trajectory.csv", block_dir / "after_trajectory.csv")
    with naming(name):
        surveys = read_epochs(before, after, trajectories=ways)
        found = detect_changes(surveys.before, surveys.after, parameters)
    seconds = time.perf_counter() - start
    write_outputs(found, surveys, block_dir / result, overwrite=True, run_info={"preset": parameters.name})
    write_stamp(stamp_path, stamp)
    return seconds


@cache
def sources_digest(*parts: str) -> str:
    """Checksum of sources of this package (files, or all of a folder), by path below it: a version that nobody has to
    remember to raise."""
    digest = hashlib.sha256()
    for part in parts:
        path = _PACKAGE / part
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(source.relative_to(_PACKAGE).as_posix().encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()


def _file_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def version_of(block_dir: Path) -> str:
    """What a block and the method are: what was found with others is found anew."""
    return _file_digest(block_dir / "block.json") + sources_digest(*METHOD_SOURCES)


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Errors of the method say on ``what`` it was run."""
    try:
        yield
    except LodaError as error:
        raise InputError(f"{what}: {error.message}", error.remedy, error.code) from error


def _plain_options(block: SuiteBlock) -> dict[str, Any]:
    """The options as JSON gives them back; the city model by what it holds, not by where it lies."""
    options: dict[str, Any] = json.loads(json.dumps(asdict(block.options)))
    if block.is_city:
        options["city"] = f"{Path(block.options.city).name} {_file_digest(Path(block.options.city))}"
    return options


def read_stamp(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None where there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def write_stamp(path: Path, known: dict[str, Any]) -> None:
    """Write a JSON object to a file, all of it or nothing."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    part.replace(path)


def described(parameters: Parameters) -> str:
    """The preset, and what is not as it says."""
    base = Parameters.preset(parameters.name).to_dict()
    own = parameters.to_dict()
    changed = [
        f"{stage}.{key}={json.dumps(value)}"
        for stage, values in own.items()
        if isinstance(values, dict)
        for key, value in values.items()
        if value != base[stage][key]
    ]
    return " ".join([f"preset {parameters.name}", *changed])


def _row(name: str, report: ScoreReport) -> list[Any]:
    s, part = report.scores(), report.scores(by_part=True)
    return [
        name,
        s.n,
        s.accuracy,
        s.macro_f1,
        s.macro_iou,
        part.macro_iou,
        report.classes.macro_iou,
        f"{report.false_alarms_per_ha:.1f}",
    ]


def _per_cent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"
