"""The PDAL face: filters.python stages, pipelines and the embedded runner."""
