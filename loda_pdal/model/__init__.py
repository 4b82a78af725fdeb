"""The shared words: clouds, grids, transforms, labels, dimensions, records and errors."""
