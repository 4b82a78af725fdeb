"""One module per stage of the paper: arrays in, a result out, no files."""
