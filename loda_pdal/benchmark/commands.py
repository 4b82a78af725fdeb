"""`loda-pdal bench`: simulated street blocks with known truth, scores of runs against it, and what runs cost."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import click

if TYPE_CHECKING:
    from loda_pdal.params import Parameters


F = TypeVar("F", bound=Callable[..., Any])


def _together(*options: Callable[[Any], Any]) -> Callable[[F], F]:
    """Several options as one decorator."""

    def decorated(command: F) -> F:
        for option in reversed(options):
            command = option(command)
        return command

    return decorated


_suite_options = _together(
    click.option("--suite", type=click.Choice(["vehicle", "airborne"]), required=True, help="Which blocks."),
    click.option("--models", type=click.Path(path_type=Path, exists=True), help="Folder of city models."),
    click.option("--limit", type=click.IntRange(1), metavar="N", help="Only the first blocks."),
    click.option("--preset", help="Parameters; street for vehicle, aerial for airborne, if left out."),
    click.option("--set", "settings", metavar="STAGE.KEY=VALUE", multiple=True, help="Set one parameter; repeatable."),
)
"""Which blocks, and with which parameters: what the commands share that run the method on suites."""

_split = click.option(
    "--split",
    type=click.Choice(["train", "validation", "test"]),
    default="validation",
    show_default=True,
    help="Which of them; choices are made on train and validation only.",
)

_written = _together(
    click.option("--json", "as_json", is_flag=True, help="Write everything as JSON."),
    click.option(
        "--markdown", type=click.Path(path_type=Path, dir_okay=False), help="Write the tables to this file too."
    ),
)


class _Result(Protocol):
    def to_dict(self) -> dict[str, Any]: ...

    def to_markdown(self) -> str: ...


def _show(found: _Result, as_json: bool, markdown: Path | None) -> None:
    """Print a result, and write its tables where they were asked for."""
    tables = found.to_markdown()
    if markdown is not None:
        markdown.write_text(tables + "\n", encoding="utf-8")
    click.echo(json.dumps(found.to_dict()) if as_json else tables)


def _chosen(suite: str, preset: str | None, settings: tuple[str, ...]) -> Parameters:
    """The parameters that the options of a suite choose."""
    from loda_pdal.params import Parameters

    chosen = Parameters.preset(preset or {"vehicle": "street", "airborne": "aerial"}[suite])
    for setting in settings:
        chosen = chosen.with_setting(setting)
    return chosen


def _say(text: str) -> None:
    click.echo(text, err=True)


_FOLDER = click.Path(path_type=Path, exists=True, file_okay=False)


@click.group()
def bench() -> None:
    """Simulated scenes with known truth, scores, and what a run costs."""


@bench.command()
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Street, edits, noise and place.")
@click.option("--city", type=click.Path(path_type=Path), help="CityJSON model to take the buildings from.")
@click.option("--sensor", type=click.Choice(["vehicle", "airborne"]), default="vehicle", show_default=True)
@click.option("--length", type=float, default=100.0, show_default=True, help="Length of the block, m.")
@click.option("--width", type=float, default=56.0, show_default=True, help="Width of the block, m.")
@click.option("--density", type=float, default=1.0, show_default=True, help="Pulses, relative to the default.")
@click.option("--density-after", type=float, default=1.0, show_default=True, help="Pulses of the later survey.")
@click.option("--lanes", type=click.IntRange(1, 2), default=2, show_default=True, help="Passes of the vehicle.")
@click.option("--shift", type=float, default=0.05, show_default=True, help="Misregistration of the before epoch, m.")
@click.option("--rotation", type=float, default=0.2, show_default=True, help="Its rotation, degrees.")
@click.option("--noise", type=float, default=0.02, show_default=True, help="Range noise, m.")
@click.option(
    "--leaf", type=click.FloatRange(min=0.01), metavar="M", help="Write one mean point per voxel of this edge."
)
@click.option("--no-edits", is_flag=True, help="Survey an unchanged street twice.")
@click.option(
    "--plain", is_flag=True, help="A tidy, empty street on two days alike: no traffic, clutter, windows, rain or gaps."
)
@click.option("--overwrite", is_flag=True, help="Replace files that are there already.")
@click.option("--json", "as_json", is_flag=True, help="Write the summary as JSON.")
def simulate(
    out: Path,
    seed: int,
    city: Path | None,
    sensor: str,
    length: float,
    width: float,
    density: float,
    density_after: float,
    lanes: int,
    shift: float,
    rotation: float,
    noise: float,
    leaf: float | None,
    no_edits: bool,
    plain: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Make a block of a street or city, survey it twice, and write before.laz, after.laz and truth.json to OUT."""
    from loda_pdal.benchmark.simulate import Reality, SimulationOptions, fused_block, simulate_block, write_block

    options = SimulationOptions(
        length_m=length,
        width_m=width,
        city="" if city is None else str(city),
        sensor=sensor,
        density=density,
        density_after=density_after,
        lanes=(-1.6, 1.6)[:lanes],
        shift_m=shift,
        rotation_deg=rotation,
        noise_m=noise,
        has_edits=not no_edits,
        reality=Reality.none() if plain else Reality(),
    )
    block = simulate_block(seed, options)
    if leaf is not None:
        block = fused_block(block, leaf)
    paths = write_block(block, out, overwrite=overwrite)
    if as_json:
        summary = {
            "outputs": {name: str(path) for name, path in paths.items()},
            "points": {"before": len(block.surveys.before), "after": len(block.surveys.after)},
            "instances": block.truth.counts(),
        }
        click.echo(json.dumps(summary))
        return
    click.echo(f"{len(block.surveys.before)} points before, {len(block.surveys.after)} after, in {out}")
    for name, row in block.truth.counts().items():
        click.echo(f"{name}: " + ", ".join(f"{n} {label}" for label, n in row.items()))


@bench.command()
@click.argument("run_dir", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("truth_json", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@_written
def score(run_dir: Path, truth_json: Path, as_json: bool, markdown: Path | None) -> None:
    """Score the run in RUN_DIR against TRUTH_JSON: paper, part and strict protocols."""
    from loda_pdal.benchmark.protocols import score_run

    _show(score_run(run_dir, truth_json), as_json, markdown)


@bench.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@_suite_options
@_split
@click.option("--result", default="result", show_default=True, metavar="NAME", help="Folder of the results of a block.")
@click.option("--trajectories", is_flag=True, help="Tell the method where the sensors were; most users cannot.")
@click.option("--plain", is_flag=True, help="The same blocks without traffic, clutter, glass and the like.")
@_written
@click.option("--sheet", type=click.Path(path_type=Path), help="Pictures of the largest mistakes, a PNG or a folder.")
def run(
    folder: Path,
    suite: str,
    split: str,
    models: Path | None,
    limit: int | None,
    preset: str | None,
    settings: tuple[str, ...],
    result: str,
    trajectories: bool,
    plain: bool,
    as_json: bool,
    markdown: Path | None,
    sheet: Path | None,
) -> None:
    """Simulate the blocks of a suite into FOLDER, run the method on each and score them together.

    What is in FOLDER already is used, unless its parameters, the method or the simulator have changed since.
    """
    from loda_pdal.benchmark.evaluate import run_suite
    from loda_pdal.benchmark.sheet import PER_PAGE, MistakeTiles, write_sheets

    _compile_kernels()
    tiles = MistakeTiles(PER_PAGE)
    found = run_suite(
        folder,
        suite,
        split,
        _chosen(suite, preset, settings),
        models=models,
        limit=limit,
        result=result,
        with_trajectories=trajectories,
        is_plain=plain,
        say=_say,
        look=None if sheet is None else tiles.add,
    )
    if sheet is not None:
        title = f"{suite}, {split} split: the largest of {tiles.n} mistakes"
        _say(f"pictures: {', '.join(map(str, write_sheets(tiles.largest, title, sheet)))}")
    _show(found, as_json, markdown)


@bench.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@_suite_options
@_split
@_written
def ablate(
    folder: Path,
    suite: str,
    split: str,
    models: Path | None,
    limit: int | None,
    preset: str | None,
    settings: tuple[str, ...],
    as_json: bool,
    markdown: Path | None,
) -> None:
    """What each part of the method is worth on a suite: the paper's ablation table, and the same for what is ours.

    Blocks and outcomes are kept in FOLDER, so that an interrupted table goes on where it was.
    """
    from loda_pdal.benchmark import ablation

    _compile_kernels()
    chosen = _chosen(suite, preset, settings)
    _show(ablation.ablate(folder, suite, split, chosen, models=models, limit=limit, say=_say), as_json, markdown)


@bench.command()
@click.argument("run_dir", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("truth_json", type=click.Path(path_type=Path, exists=True, dir_okay=False), required=False)
@click.option(
    "-o", "--output", "out", type=click.Path(path_type=Path), required=True, help="A PNG, or a folder for the pages."
)
@click.option("--largest", type=click.IntRange(1), default=24, show_default=True, metavar="N", help="How many to show.")
@click.option("--per-page", type=click.IntRange(1, 60), default=24, show_default=True, help="How many on one page.")
def sheet(run_dir: Path, truth_json: Path | None, out: Path, largest: int, per_page: int) -> None:
    """Pictures of the largest mistakes of the run in RUN_DIR against TRUTH_JSON; of its largest changes without one."""
    from loda_pdal.benchmark.runs import read_points, read_run
    from loda_pdal.benchmark.sheet import MistakeTiles, change_tiles, write_sheets

    name = "/".join(run_dir.resolve().parts[-2:])
    if truth_json is None:
        tiles = change_tiles(run_dir, read_points(run_dir), largest)
        title = f"{name}: the {len(tiles)} largest changes"
    else:
        from loda_pdal.benchmark.protocols import judge
        from loda_pdal.benchmark.truth import Truth

        truth = Truth.read(truth_json)
        points = read_run(run_dir, truth, truth_json.parent)
        found = MistakeTiles(largest)
        found.add("", run_dir, points, truth, judge(points, truth))
        tiles, title = found.largest, f"{name}: {len(found.largest)} of {found.n} mistakes"
    for path in write_sheets(tiles, title, out, per_page):
        click.echo(path)


@bench.command()
@click.argument("folders", metavar="BLOCK_DIR...", nargs=-1, required=True, type=_FOLDER)
@click.option("--train", "training", metavar="BLOCK_DIR", multiple=True, type=_FOLDER, help="Block to train on.")
@click.option(
    "--preset",
    type=click.Choice(("street", "aerial")),
    default="street",
    show_default=True,
    help="Parameters of our own method, and of the baselines tuned for such surveys.",
)
@click.option("--tune", "is_tuning", is_flag=True, help="Search the baselines' parameters on these blocks instead.")
@_written
def baselines(
    folders: tuple[Path, ...],
    training: tuple[Path, ...],
    preset: str,
    is_tuning: bool,
    as_json: bool,
    markdown: Path | None,
) -> None:
    """Compare loda-pdal with M3C2, nDSM differencing, a random forest and C2C on the blocks in BLOCK_DIR...

    All get the same registration and ground heights. The random forest is trained on the blocks given with --train.
    """
    from loda_pdal.benchmark.baselines import run_baselines, tune

    _compile_kernels()
    if is_tuning:
        for name, found in tune(folders, training=training, preset=preset, say=_say).items():
            click.echo(f"{name}: {found.params}, mIoU {100 * found.macro_iou:.1f}")
        return
    _show(run_baselines(folders, training=training, preset=preset, say=_say), as_json, markdown)


@bench.command()
@click.argument("folders", metavar="SCENE_DIR...", nargs=-1, required=True, type=_FOLDER)
@click.option("--preset", type=click.Choice(("street", "aerial")), default="aerial", show_default=True)
@_written
def urb3dcd(folders: tuple[Path, ...], preset: str, as_json: bool, markdown: Path | None) -> None:
    """Point-wise scores on Urb3DCD scenes: folders with pointCloud0.ply and pointCloud1.ply."""
    from loda_pdal.benchmark.urb3dcd import run_scenes, to_markdown

    _compile_kernels()
    scores = run_scenes(folders, preset=preset, say=_say)
    table = to_markdown(scores)
    if markdown is not None:
        markdown.write_text(table + "\n", encoding="utf-8")
    click.echo(json.dumps({name: found.to_dict() for name, found in scores.items()}) if as_json else table)


@bench.command(name="urb3dcd-export")
@click.argument("block", metavar="BLOCK_DIR", type=_FOLDER)
@click.argument("out", metavar="SCENE_DIR", type=click.Path(path_type=Path, file_okay=False))
@click.option("--overwrite", is_flag=True, help="Replace a scene that is there already.")
def urb3dcd_export(block: Path, out: Path, overwrite: bool) -> None:
    """Write the simulated block in BLOCK_DIR as an Urb3DCD scene to SCENE_DIR."""
    from loda_pdal.benchmark.urb3dcd import scene_of_block, write_scene

    for path in write_scene(scene_of_block(block), out, overwrite=overwrite):
        click.echo(path)


@bench.command()
@click.argument("clouds", type=click.Path(path_type=Path, exists=True, dir_okay=False), nargs=-1, required=True)
@click.option("--preset", default="aerial", show_default=True, help="Parameters of the method.")
@click.option("--set", "settings", metavar="STAGE.KEY=VALUE", multiple=True, help="Set one parameter; repeatable.")
@click.option("--leave-out", type=click.IntRange(0, 255), multiple=True, help="Class that is not compared; repeatable.")
@click.option("--json", "as_json", is_flag=True, help="Write everything as JSON.")
def classes(
    clouds: tuple[Path, ...], preset: str, settings: tuple[str, ...], leave_out: tuple[int, ...], as_json: bool
) -> None:
    """Ground, building and vegetation against the ASPRS classes of real airborne CLOUDS, one by one.

    Noise, water, bridges and artefacts are not compared (classes 7, 9, 17, 18, 26, 65 and 66), unless --leave-out says
    otherwise.
    """
    from loda_pdal.benchmark.labelled import LEFT_OUT, compare_labels, labels_table

    _compile_kernels()
    chosen = _chosen("airborne", preset, settings)
    found = []
    for path in clouds:
        _say(f"{path.name}: classifying")
        found.append(compare_labels(path, chosen, leave_out or LEFT_OUT))
    click.echo(json.dumps([cloud.to_dict() for cloud in found]) if as_json else labels_table(found))


@bench.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@_suite_options
@_written
def calibrate(
    folder: Path,
    suite: str,
    models: Path | None,
    limit: int | None,
    preset: str | None,
    settings: tuple[str, ...],
    as_json: bool,
    markdown: Path | None,
) -> None:
    """Fit the calibration of the confidence on the training blocks of a suite and check it on its validation blocks.

    Blocks and what was found on them are kept in FOLDER, so that an interrupted fit goes on where it was.
    """
    from loda_pdal.benchmark import calibrate as calibration

    _compile_kernels()
    chosen = _chosen(suite, preset, settings)
    _show(calibration.calibrate(folder, suite, chosen, models=models, limit=limit, say=_say), as_json, markdown)


@bench.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@_suite_options
@_split
@_written
def unchanged(
    folder: Path,
    suite: str,
    split: str,
    models: Path | None,
    limit: int | None,
    preset: str | None,
    settings: tuple[str, ...],
    as_json: bool,
    markdown: Path | None,
) -> None:
    """Survey the blocks of a suite twice without edits: the share of the surface within LoD95, and what is called
    changed all the same."""
    from loda_pdal.benchmark.unchanged import survey_unchanged

    _compile_kernels()
    chosen = _chosen(suite, preset, settings)
    _show(survey_unchanged(folder, suite, split, chosen, models=models, limit=limit, say=_say), as_json, markdown)


@bench.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--points",
    "sizes",
    type=click.FloatRange(0.05, 4.0),
    multiple=True,
    default=(0.4, 0.8, 1.6, 2.4, 3.2),
    show_default=True,
    help="Million fused points of both epochs together; once for each block.",
)
@click.option("--repeats", type=click.IntRange(1), default=3, show_default=True, help="Runs per block; medians count.")
@click.option("--seed", type=click.IntRange(0), default=40, show_default=True, help="Of the simulated street.")
@click.option("--threads", type=click.IntRange(1), help="Threads to use; all processors if left out.")
@click.option("--preset", default="street", show_default=True, help="Parameters of the runs.")
@click.option("--json", "as_json", is_flag=True, help="Write everything as JSON.")
def profile(
    folder: Path, sizes: tuple[float, ...], repeats: int, seed: int, threads: int | None, preset: str, as_json: bool
) -> None:
    """Time and memory of `detect` by the size of the block: the paper's efficiency table, for this machine.

    Blocks are streets of growing length, simulated into FOLDER unless they are there, one point per 0.25 m voxel.
    Every run is a process of its own, from LAZ to all outputs. Leaves profile.json and profile.md in FOLDER.
    """
    from loda_pdal.benchmark.profile import profile_detect

    _compile_kernels()
    found = profile_detect(
        folder,
        sorted(sizes),
        repeats=repeats,
        seed=seed,
        options=["--preset", preset, *(["--threads", str(threads)] if threads else [])],
        say=_say,
    )
    click.echo(json.dumps(found.to_dict(), indent=2) if as_json else found.to_markdown())


def _compile_kernels() -> None:
    """Compile the kernels, and say so, where that has not been done."""
    from loda_pdal.kernels import is_cache_warm

    if not is_cache_warm():
        from loda_pdal.warmup import NOTICE, compile_kernels

        click.echo(NOTICE, err=True)
        with tempfile.TemporaryDirectory(prefix="loda-pdal-") as scratch:
            compile_kernels(Path(scratch))
