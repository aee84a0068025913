"""Write the pages that show results: docs/performance.md with its charts, docs/measured.md, and the tables of docs/accuracy.md.

usage: python -m bench.document
The same results give the same bytes.
"""

from __future__ import annotations

from bench.lib import accuracy_page, measured_page, performance_page, result_file
from warpgs.files import write_text


def main() -> None:
    """Write the files."""
    docs = result_file.ROOT / "docs"
    files = performance_page.files(result_file.stored("ops")) | {"measured.md": measured_page.page()}
    files["accuracy.md"] = accuracy_page.filled((docs / "accuracy.md").read_text("utf-8"))
    for path, text in files.items():
        (docs / path).parent.mkdir(parents=True, exist_ok=True)
        write_text(docs / path, text)


if __name__ == "__main__":
    main()
