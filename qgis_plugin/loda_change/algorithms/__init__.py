"""One algorithm per thing that the engine does; each only builds a command line."""
