"""The PDAL face: filters.python stages, pipelines and the embedded runner."""

from loda_pdal.pdal_face.runner import PipelineRun, run_pipeline, stop_pdal

__all__ = ["PipelineRun", "run_pipeline", "stop_pdal"]
