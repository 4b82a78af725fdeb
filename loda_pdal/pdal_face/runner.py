"""Running a pipeline file: through PDAL where a usable one is installed, else by ourselves."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from loda_pdal.kernels.parallel import thread_count
from loda_pdal.model import errors
from loda_pdal.model.errors import LodaError, OutputError, PipelineError
from loda_pdal.pdal_face import builder
from loda_pdal.pdal_face.document import Stage, read_stages, to_document
from loda_pdal.pdal_face.partial import PartialFile, discard_partial_files
from loda_pdal.pdal_face.program import find_pdal, pdal_version

Progress = Callable[[int, int, str], None]

ENGINES = ("auto", "pdal", "embedded")

FIRST_WITH_SOUND_LAZ = (2, 3)
"""Before it, PDAL could not compress points of classes above 31: there we let it write LAS, and compress that."""

_CHUNK = 1_000_000
_OUR_ERROR = re.compile(r"loda_pdal\.model\.errors\.(?P<kind>\w+): (?P<text>.*?)(?:\\n|\n|'*$)", re.DOTALL)

_running: list[subprocess.Popen[str]] = []


@dataclass(frozen=True)
class PipelineRun:
    """What a pipeline run did.

    Attributes
    ----------
    engine : str
        ``pdal`` or ``embedded``.
    outputs : list of Path
        The files its writers name.
    is_validated_only : bool
        Whether it was only checked.
    """

    engine: str
    outputs: list[Path]
    is_validated_only: bool = False


def run_pipeline(
    path: str | Path,
    overrides: Mapping[str, str] | None = None,
    *,
    engine: str = "auto",
    validate: bool = False,
    progress: Progress | None = None,
) -> PipelineRun:
    """Run a PDAL pipeline of loda-pdal stages.

    LAS outputs get their names when they are whole: a run that fails leaves old files as they were.

    Parameters
    ----------
    path : str or Path
        The JSON file, or the name of one of our own pipelines (`builder.CHAINS`) where no such file exists.
    overrides : mapping, optional
        Options in PDAL's spelling without the dashes: ``{"stage.before.filename": "2015.laz"}``.
    engine : str
        ``pdal``, ``embedded``, or ``auto``: PDAL where its Python plugin can run our stages, else embedded.
    validate : bool
        Check everything and compute nothing.
    progress : callable, optional
        ``progress(done, total, text)``; with PDAL, which reports none, at the start and at the end.
    """
    if engine not in ENGINES:
        raise PipelineError(f"There is no engine {engine!r}.", f"Use one of {', '.join(ENGINES)}.", "engine-unknown")
    own = builder.pipeline(str(path)) if str(path) in builder.CHAINS and not Path(path).exists() else None
    stages = read_stages(Path(path), overrides, own)
    program = find_pdal() if engine != "embedded" else None
    if engine == "pdal" and program is None:
        raise PipelineError(
            "There is no pdal program whose filters.python can import loda_pdal.",
            "See docs/pdal.md for how to install it, or run without it: --engine embedded.",
            "pdal-missing",
        )
    if program is not None:
        return _run_with_pdal(program, stages, validate, progress)
    from loda_pdal.pdal_face.embedded import execute, prepare

    prepared = prepare(stages)
    outputs = [p.output for p in prepared if p.output] if validate else execute(prepared, progress)
    return PipelineRun("embedded", outputs, validate)


def stop_pdal() -> None:
    """End a run that is going on in another thread: its `pdal` program, and the files it has not finished."""
    for process in _running.copy():
        process.kill()
        process.wait()
    discard_partial_files()


def _run_with_pdal(program: Path, stages: list[Stage], validate: bool, progress: Progress | None) -> PipelineRun:
    outputs = [
        Path(s.options["filename"]) for s in stages if s.type.startswith("writers.") and s.options.get("filename")
    ]
    if validate:
        _call([str(program), "pipeline", "--stdin", "--validate"], stages)
        return PipelineRun("pdal", outputs, True)
    if progress:
        progress(0, 1, "pdal pipeline")
    files = {i: PartialFile(Path(s.options["filename"])) for i, s in enumerate(stages) if _is_one_file(s)}
    raw = dict(files)
    if pdal_version(program) < FIRST_WITH_SOUND_LAZ:
        raw = {i: PartialFile(file.path.with_suffix(".las")) for i, file in files.items()}
    try:
        _call([str(program), "pipeline", "--stdin"], [_writing_to(raw.get(i), stage) for i, stage in enumerate(stages)])
        for i, file in files.items():
            if raw[i].part != file.part:
                _compress(raw[i].part, file.part)
            file.finish()
    except OSError as error:
        raise OutputError(str(error), "Check the folder of the output.", "output-unwritable") from error
    finally:
        for file in (*files.values(), *raw.values()):
            file.discard()
    if progress:
        progress(1, 1, "done")
    return PipelineRun("pdal", outputs)


def _writing_to(file: PartialFile | None, stage: Stage) -> Stage:
    """The stage with its output under the temporary name."""
    return stage if file is None else replace(stage, options={**stage.options, "filename": str(file.part)})


def _compress(las: Path, laz: Path) -> None:
    import laspy

    with laspy.open(las) as reader, laspy.open(laz, mode="w", header=reader.header, do_compress=True) as writer:
        for points in reader.chunk_iterator(_CHUNK):
            writer.write_points(points)


def _is_one_file(stage: Stage) -> bool:
    """Whether the stage writes one LAS file under the name it is given."""
    name = stage.options.get("filename")
    return stage.type == "writers.las" and isinstance(name, str) and name.upper() != "STDOUT" and "#" not in name


def _call(command: list[str], stages: list[Stage]) -> None:
    """Run PDAL to its end; its failure becomes our error, and an interruption ends it."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "LODA_THREADS": str(thread_count())},
    )
    _running.append(process)
    try:
        said, _ = process.communicate(json.dumps(to_document(stages)))
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        _running.remove(process)
    if process.returncode != 0:
        raise error_from(said, process.returncode)


def error_from(said: str, returncode: int) -> LodaError:
    """Our own error if a stage raised one, as PDAL printed it, else PDAL's last words as a `PipelineError`."""
    found = list(_OUR_ERROR.finditer(said))
    if found:
        kind = getattr(errors, found[-1]["kind"], PipelineError)
        is_ours = isinstance(kind, type) and issubclass(kind, LodaError)
        return (kind if is_ours else PipelineError)(found[-1]["text"].strip(), "", "stage-failed")
    lines = [line.strip() for line in said.replace("\\n", "\n").splitlines() if line.strip(" '\"")]
    last = lines[-1].strip("'\"") if lines else f"it ended with code {returncode} and said nothing"
    return PipelineError(
        f"PDAL failed: {last}", "Run `pdal pipeline` by hand with -v 4 for all it says.", "pdal-failed"
    )
