"""Pages of the site from outside of docs/: the README as the first page, two more documents, charts of bench/results/."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parent.parent.parent
PAGES = {"README.md": "index.md"} | {name: name for name in ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")}
CHARTS = re.compile(r"\]\((?:\.\./)+(bench/results/[^)\s]+)")


def on_files(files, config, **_):
    """Add the pages of the root and every chart that a document shows."""
    charts = {name for page in files.documentation_pages() for name in CHARTS.findall(page.content_string)}
    for name in sorted(charts):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for source, target in PAGES.items():
        text = (ROOT / source).read_text("utf-8").replace("](docs/", "](").replace("](README.md", "](index.md")
        files.append(File.generated(config, target, content=text))
    return files


def on_page_markdown(markdown: str, page, **_) -> str:
    """Point the links to charts and to the pages of the root at their copies in the site."""
    up = "../" * page.file.src_uri.count("/")
    for source, target in PAGES.items():
        markdown = markdown.replace(f"]({up}../{source}", f"]({up}{target}")
    return CHARTS.sub(lambda match: f"]({up}{match[1]}", markdown)
