"""All methods on the same blocks, judged by the same protocols; and the search for a baseline's parameters."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from loda_pdal.benchmark.baselines import c2c, forest, m3c2, ndsm
from loda_pdal.benchmark.baselines.baseline import Baseline
from loda_pdal.benchmark.baselines.scene import Block, Marks, Scene, judged_points, read_block, scene_of
from loda_pdal.benchmark.baselines.tuned import TUNED
from loda_pdal.benchmark.evaluate import Say
from loda_pdal.benchmark.metrics import Scores, markdown_table
from loda_pdal.benchmark.protocols import ScoreReport, combined, judge, judge_instances
from loda_pdal.benchmark.suites import split_of_made
from loda_pdal.model.errors import InputError
from loda_pdal.model.pair import Pair
from loda_pdal.params import Parameters
from loda_pdal.pipeline import detect_changes

OURS = "loda-pdal"

UNTRAINED = (m3c2.BASELINE, ndsm.BASELINE, c2c.BASELINE)
"""Baselines that need no training blocks."""


@dataclass(frozen=True)
class Comparison:
    """What every method reached on the same blocks.

    Attributes
    ----------
    reports : dict of str to ScoreReport
        Per method, all blocks pooled.
    seconds : dict of str to float
        Wall-clock time of each method on all blocks together, from points in memory to labels: fusing, registration and
        ground included, which are the same work for all.
    skipped : dict of str to str
        Methods that did not run, and why.
    """

    reports: dict[str, ScoreReport]
    seconds: dict[str, float]
    skipped: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        methods = {name: {**report.to_dict(), "seconds": self.seconds[name]} for name, report in self.reports.items()}
        return {"methods": methods, "skipped": self.skipped}

    def to_markdown(self) -> str:
        """One row per method, in per cent."""
        labels = [f"{score.label.title} IoU" for score in Scores.of([], []).labels]
        header = ["method", "n", "ACC", "mF1", "mIoU", *labels, "mIoU by part", "false alarms per ha", "seconds"]
        rows = [_row(name, report, self.seconds[name]) for name, report in self.reports.items()]
        notes = [f"Skipped: {name}, {reason}" for name, reason in self.skipped.items()]
        return "\n\n".join([markdown_table(header, rows), *notes])


@dataclass(frozen=True)
class Tuned:
    """What a search found for one method: the parameters, and the paper's mIoU with them."""

    params: Any
    macro_iou: float


def run_baselines(
    folders: Sequence[Path],
    *,
    training: Sequence[Path] = (),
    preset: str = "street",
    with_ours: bool = True,
    say: Say = lambda text: None,
) -> Comparison:
    """Every method on the same block folders.

    Parameters
    ----------
    folders : sequence of Path
        As ``bench simulate`` wrote them.
    training : sequence of Path
        Blocks to train the random forest on; without any it is skipped.
    preset : str
        Whose registration and ground all methods get, whose parameters the baselines were tuned with, and with which
        our own method runs.
    with_ours : bool
        Whether our own method runs too.
    say : callable
        Told what is going on.

    Returns
    -------
    Comparison
        Reports of all blocks pooled (`protocols.combined`).
    """
    parameters = Parameters.preset(preset)
    methods, skipped = _methods(training, parameters, say)
    reports: dict[str, list[ScoreReport]] = {}
    seconds: dict[str, float] = {}

    def keep(name: str, block: Block, marks: Pair[Marks], spent: float) -> None:
        report = judge(judged_points(block, marks), block.truth)
        reports.setdefault(name, []).append(report)
        seconds[name] = seconds.get(name, 0.0) + spent
        say(f"{block.name}: {name}, mIoU {100 * (report.scores().macro_iou or 0.0):.1f}, {spent:.1f} s")

    for folder in folders:
        block = read_block(folder)
        if with_ours:
            start = time.perf_counter()
            found = detect_changes(block.surveys.before, block.surveys.after, parameters)
            marks = found.points.map(lambda points: Marks(points.change, points.object.astype("int64")))
            keep(OURS, block, marks, time.perf_counter() - start)
        start = time.perf_counter()
        scene = scene_of(block.surveys, parameters)
        prepared = time.perf_counter() - start
        for method in methods:
            start = time.perf_counter()
            params = TUNED[preset][method.name]
            marks = scene.on_points(method.decide(scene, method.measure(scene, params), params))
            keep(method.name, block, marks, prepared + time.perf_counter() - start)
    return Comparison({name: combined(parts) for name, parts in reports.items()}, seconds, skipped)


def tune(
    folders: Sequence[Path],
    *,
    training: Sequence[Path] = (),
    preset: str = "street",
    say: Say = lambda text: None,
) -> dict[str, Tuned]:
    """The best parameters of every baseline, by the paper's mIoU over all instances of the blocks; arguments as for
    `run_baselines`. Test blocks are refused."""
    parameters = Parameters.preset(preset)
    methods, skipped = _methods(training, parameters, say)
    for name, reason in skipped.items():
        say(f"skipped: {name}, {reason}")
    known = list(_known(folders, parameters))
    return {method.name: _tuned(method, TUNED[preset][method.name], known, say) for method in methods}


def _tuned(method: Baseline, start: Any, known: Sequence[tuple[Block, Scene]], say: Say) -> Tuned:
    """The best that is found by changing one parameter at a time, from ``start`` on, until none gets better."""
    measured: dict[tuple[Any, ...], list[Any]] = {}

    def reached(params: Any) -> float:
        key = tuple(getattr(params, name) for name in method.measured_by)
        if key not in measured:
            measured[key] = [method.measure(scene, params) for _, scene in known]
        return _macro_iou(
            (block, scene.on_points(method.decide(scene, found, params)))
            for (block, scene), found in zip(known, measured[key], strict=True)
        )

    tried = {start: reached(start)}
    best, before = start, None
    while best != before:
        before = best
        for name, values in method.grid.items():
            candidates = [replace(best, **{name: value}) for value in values]
            tried |= {params: reached(params) for params in candidates if params not in tried}
            best = max([best, *candidates], key=tried.__getitem__)
        say(f"{method.name}: mIoU {100 * tried[best]:.1f} with {best}")
    return Tuned(best, tried[best])


def _macro_iou(answers: Iterable[tuple[Block, Pair[Marks]]]) -> float:
    judgements = [
        j
        for block, marks in answers
        for j in judge_instances(judged_points(block, marks), block.truth)
        if j.instance.is_evaluated
    ]
    scores = Scores.of([j.instance.label for j in judgements], [j.predicted for j in judgements])
    return scores.macro_iou or 0.0


def _methods(training: Sequence[Path], parameters: Parameters, say: Say) -> tuple[list[Baseline], dict[str, str]]:
    """Baselines that can run here, and why the others cannot."""
    methods = [method for method in UNTRAINED if method.is_installed]
    skipped = {m.name: _missing(m.needs) for m in UNTRAINED if not m.is_installed}
    if not forest.is_installed():
        skipped[forest.NAME] = _missing("scikit-learn")
    elif not training:
        skipped[forest.NAME] = "no training blocks were given (--train)."
    else:
        say(f"{forest.NAME}: training on {len(training)} blocks")
        methods.append(forest.baseline(list(_known(training, parameters))))
    return methods, skipped


def _known(folders: Sequence[Path], parameters: Parameters) -> Iterator[tuple[Block, Scene]]:
    """Blocks and scenes to choose parameters on or to train on; `InputError` for a test block."""
    for folder in folders:
        block = read_block(folder)
        if split_of_made(block.truth.made_by) == "test":
            raise InputError(
                f"{folder} is a test block.", "Tune and train on training or validation blocks.", "test-block"
            )
        yield block, scene_of(block.surveys, parameters)


def _missing(library: str) -> str:
    return f"{library} is not installed (pip install 'loda-pdal[bench]')."


def _row(name: str, report: ScoreReport, seconds: float) -> list[Any]:
    scores = report.scores()
    return [
        name,
        scores.n,
        scores.accuracy,
        scores.macro_f1,
        scores.macro_iou,
        *(score.iou for score in scores.labels),
        report.scores(by_part=True).macro_iou,
        f"{report.false_alarms_per_ha:.1f}",
        f"{seconds:.0f}",
    ]
