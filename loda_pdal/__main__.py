"""``python -m loda_pdal`` is the command ``loda-pdal``."""

from loda_pdal.cli.main import main

if __name__ == "__main__":
    main()
