"""Write the generated parts of docs/ and the charts of docs/performance.md from bench/results.

usage: python -m bench.document
The same results give the same bytes.
"""

from __future__ import annotations

from bench.lib.pages import DOCS, files
from warpgs.files import write_text


def main() -> None:
    """Write the files."""
    for path, text in files().items():
        (DOCS / path).parent.mkdir(parents=True, exist_ok=True)
        write_text(DOCS / path, text)


if __name__ == "__main__":
    main()
