"""``loda-pdal detect``: two surveys in, a folder with the changes out."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loda_pdal.cli import options, stopping, verbosity
from loda_pdal.cli.ahead import METHOD, WRITERS, import_ahead
from loda_pdal.cli.progress import Reporter, reporter_for
from loda_pdal.params import AUTO, PRESETS

if TYPE_CHECKING:
    from loda_pdal.model.pair import Pair
    from loda_pdal.model.survey import Survey
    from loda_pdal.params import Parameters


@click.command(short_help="Find what changed between two surveys.")
@click.argument("before", type=click.Path(path_type=Path))
@click.argument("after", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", "folder", required=True, type=click.Path(path_type=Path), help="Folder for the results."
)
@options.parameters(*PRESETS, AUTO)
@click.option(
    "--trajectory-before",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Where the sensor was in the survey BEFORE: CSV with time, x, y, z, or LAS with GPS time.",
)
@click.option(
    "--trajectory-after", metavar="FILE", type=click.Path(path_type=Path), help="The same of the survey AFTER."
)
@options.epsg
@options.assume_same_crs
@options.threads
@click.option(
    "--max-memory", type=click.FloatRange(min=0, min_open=True), metavar="GB", help="Memory the run may take."
)
@click.option("--keep-frames", is_flag=True, help="Do not move the before points onto the after survey.")
@click.option(
    "--cloud-format",
    type=click.Choice(("laz", "las", "copc")),
    default="laz",
    show_default=True,
    help="How the point cloud is written; copc is for viewers and does not keep the order of the points.",
)
@options.overwrite
@options.as_json
@options.progress
@click.option("--validate", is_flag=True, help="Check everything, compute nothing.")
@verbosity.options
def detect(
    before: Path,
    after: Path,
    folder: Path,
    preset: str | None,
    params_file: Path | None,
    settings: tuple[str, ...],
    trajectory_before: Path | None,
    trajectory_after: Path | None,
    epsg: int | None,
    assume_same_crs: bool,
    threads: int | None,
    max_memory: float | None,
    keep_frames: bool,
    cloud_format: str,
    overwrite: bool,
    as_json: bool,
    progress_kind: str,
    validate: bool,
) -> None:
    """Find what changed between the surveys BEFORE and AFTER (LAS, LAZ or COPC)."""
    with reporter_for(progress_kind) as reporter:
        if progress_kind == "json":
            stopping.when_parent_dies()
        parameters = options.chosen_parameters(preset, params_file, settings)
        from loda_pdal.io.outputs import check_output_folder
        from loda_pdal.model.pair import Pair

        check_output_folder(folder, overwrite, (before, after))
        trajectories = Pair(trajectory_before, trajectory_after)
        surveys = _read(reporter, before, after, trajectories, parameters, epsg, assume_same_crs, max_memory)
        run_info: dict[str, Any] = {"command": ["loda-pdal", *sys.argv[1:]]}
        if preset in (None, AUTO):
            from loda_pdal.preset_choice import preset_for

            suits = preset_for(surveys)
            parameters = options.chosen_parameters(preset, params_file, settings, suits.name)
            if parameters.name == suits.name:
                reporter.info(f"Preset {suits.name}: {suits.reason}.")
                run_info["preset_reason"] = suits.reason
        if validate:
            reporter.info("Everything is in order; nothing was computed.")
            return
        summary, outputs = _run(
            reporter, surveys, folder, parameters, threads, keep_frames, cloud_format, overwrite, run_info
        )
        reporter.result(outputs, summary)
    if progress_kind == "json":
        return
    if as_json:
        from loda_pdal.io.plain import to_json

        click.echo(to_json({"outputs": outputs, "summary": summary}), nl=False)
    else:
        click.echo(_readable(summary, outputs))


def _read(
    reporter: Reporter,
    before: Path,
    after: Path,
    trajectories: Pair[Path | None],
    parameters: Parameters,
    epsg: int | None,
    assume_same_crs: bool,
    max_memory: float | None,
) -> Pair[Survey]:
    """Both surveys, after every check that can be made before long work."""
    from loda_pdal.io.las import read_epochs

    import_ahead(*METHOD, *WRITERS)
    reporter.progress(0, 1, "reading the surveys")
    surveys = read_epochs(
        before,
        after,
        epsg=epsg,
        assume_same_crs=assume_same_crs,
        max_memory=None if max_memory is None else int(max_memory * 1e9),
        leaf_m=parameters.fuse.leaf_m,
        trajectories=trajectories,
    )
    for epoch in surveys:
        for note in epoch.notes:
            reporter.info(f"{epoch.path}: {note}")
    return surveys


def _run(
    reporter: Reporter,
    surveys: Pair[Survey],
    folder: Path,
    parameters: Parameters,
    threads: int | None,
    keep_frames: bool,
    cloud_format: str,
    overwrite: bool,
    run_info: dict[str, Any],
) -> tuple[dict[str, Any], dict[str, Path]]:
    """The run itself: its summary and the files it wrote."""
    from loda_pdal.io.outputs import abandon_outputs, write_outputs
    from loda_pdal.io.summary import summarise
    from loda_pdal.pipeline import STEPS, detect_changes

    stopping.before_stopping(abandon_outputs)
    options.use_threads(threads)
    options.compile_kernels(reporter)
    started, total = datetime.now(tz=UTC), len(STEPS) + 1

    def progress(done: int, of: int, text: str) -> None:
        if done < of:
            reporter.progress(done, total, text)

    result = detect_changes(surveys.before, surveys.after, parameters, progress)
    summary = summarise(result, surveys)
    for warning in summary["warnings"]:
        reporter.warning(warning)
    reporter.progress(len(STEPS), total, "writing the results")
    outputs = write_outputs(
        result,
        surveys,
        folder,
        overwrite=overwrite,
        keep_frames=keep_frames,
        run_info={**run_info, "started": started.isoformat(timespec="seconds"), "preset": parameters.name},
        cloud_format=cloud_format,
    )
    reporter.progress(total, total, "done")
    return summary, outputs


def _readable(summary: dict[str, Any], outputs: dict[str, Path]) -> str:
    """The summary in a few lines."""
    lines = [f"{summary['changed']} of {summary['objects']} objects changed."]
    for label, kinds in summary["counts"].items():
        n = sum(kinds.values())
        if n:
            parts = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
            lines.append(f"  {label:<13}{n:>6}   {parts}")
    for label, figures in summary["ground_changes"].items():
        if figures["pieces"]:
            word = "raised" if label == "Increased" else "lowered"
            lines.append(f"  Ground {word}: {figures['pieces']} places, {figures['area_m2']:.0f} m2")
    lod = summary["lod95"]
    if lod["median_m"] is not None:
        lines.append(f"Limit of detection (95 %): {lod['median_m']:.3f} m in the median.")
    width = max(map(len, outputs))
    return "\n".join(lines + [f"  {name:<{width}}  {path}" for name, path in outputs.items()])
