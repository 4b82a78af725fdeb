"""``python -m loda_pdal.pdal_face`` says which `pdal` can run our stages, or why none can."""

from __future__ import annotations

import sys

from loda_pdal.pdal_face.program import candidates, find_pdal, why_unusable


def main() -> int:
    """0 where there is a usable program, else 1."""
    found = find_pdal()
    if found:
        print(f"{found} runs loda-pdal's stages")
        return 0
    for candidate in candidates():
        print(f"{candidate}: {why_unusable(candidate)}", file=sys.stderr)
    print("no pdal program with filters.python that can import loda_pdal was found", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
