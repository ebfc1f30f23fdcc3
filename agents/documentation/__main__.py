"""``python -m agents.documentation``: write the documentation's tables anew; with ``--pictures`` its pictures."""

from __future__ import annotations

import sys
from pathlib import Path

from agents.documentation import write_tables
from agents.documentation.pictures import write_pictures

ROOT = Path(__file__).parents[2]

if __name__ == "__main__":
    written = write_tables(ROOT)
    if "--pictures" in sys.argv[1:]:
        written += write_pictures(ROOT / "docs")
    for path in written:
        print(path.relative_to(ROOT))
