"""Index of a farm: one HTML page with a card for each job, and all failures, grouped by message."""

from __future__ import annotations

import html
import re
import textwrap
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from warpgs.files import write_text
from warpgs.report.farm_table import JobRow
from warpgs.report.page import STYLE
from warpgs.report.progress import duration
from warpgs.runtime.byte_units import format_bytes

CARDS = """
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(240px,1fr));gap:18px}
.card{background:var(--card);border:1px solid var(--line);border-radius:10px;overflow:hidden;min-width:0}
.card img{border-radius:0;aspect-ratio:8/3;object-fit:cover;background:var(--line)}
.card .none{aspect-ratio:8/3;display:grid;place-items:center;color:var(--soft);background:var(--paper);font-size:13px}
.card p{margin:0;padding:10px 14px 12px;font-size:13px;color:var(--soft);overflow-wrap:anywhere}
.card b{display:block;font-size:15px;color:var(--ink)}.failed b{color:#c0392b}a{color:inherit}
.card.failed{border-color:#c0392b}
"""
SHORT = 120
"""Largest number of letters of a message on a card; the table of failures shows the whole message."""


@dataclass(frozen=True)
class JobCard:
    """A job on the page."""

    row: JobRow
    ssim: float | None = None
    """Mean SSIM over held-out views."""
    ply_bytes: int = 0
    """Size of the PLY file."""
    thumbnail: str = ""
    """Path of the job's image, relative to the page; empty without one."""
    report: str = ""
    """Path of the job's report, relative to the page; empty without one."""


def _address(path: str) -> str:
    """Return a path as an address; bytes of names that are not text are kept."""
    return quote(path, errors="surrogateescape")


def _link(path: str, inner: str) -> str:
    return f'<a href="{_address(path)}">{inner}</a>' if path else inner


def _card(card: JobCard) -> str:
    row, name = card.row, html.escape(card.row.name)
    image = f'<img loading="lazy" alt="render and photograph of {name}" src="{_address(card.thumbnail)}">'
    if not card.thumbnail:
        image = f'<div class="none">{html.escape(row.state)}</div>'
    failed = row.state == "failed"
    facts = [
        "" if row.psnr is None else f"PSNR {row.psnr:.2f} dB", "" if card.ssim is None else f"SSIM {card.ssim:.3f}",
        f"{row.gaussians:,} Gaussians" if row.gaussians else "", format_bytes(card.ply_bytes) if card.ply_bytes else "",
        duration(row.seconds) if row.seconds and not failed else "",
        textwrap.shorten(row.message, SHORT, placeholder=" ...") if failed else "",
    ]  # fmt: skip
    words = html.escape(", ".join(filter(None, facts)) or row.state)
    image, head = _link(card.report, image), _link(card.report, f"<b>{name}</b>")
    return f'<div class="card {html.escape(row.state)}">{image}<p>{head}{words}</p></div>'


def _failures(cards: list[JobCard]) -> str:
    """Return failed jobs by message, the most frequent first."""
    by_message: dict[str, list[str]] = defaultdict(list)
    for card in cards:
        if card.row.state == "failed":
            name = rf"(?<!\w){re.escape(card.row.name)}(?!\w)"
            message = re.sub(name, "SCENE", card.row.message)  # messages that differ only in the job's name count as one
            by_message[message].append(card.row.name)
    rows = "".join(
        f"<tr><td>{html.escape(message)}</td><td>{len(names)}</td><td>{html.escape(', '.join(names[:20]))}</td></tr>"
        for message, names in sorted(by_message.items(), key=lambda item: -len(item[1]))
    )
    head = "<tr><th>message</th><th>scenes</th><th>names</th></tr>"
    return f'<h2>Failures</h2><div class="table"><table>{head}{rows}</table></div>' if rows else ""


def farm_page(title: str, cards: list[JobCard], seconds: float) -> str:
    """Return the page of a farm.

    Args:
        title: Headline.
        cards: The jobs, in the order to show them.
        seconds: Time since the farm began [s].
    """
    states = [c.row.state for c in cards]
    scores = [c.row.psnr for c in cards if c.row.psnr is not None]
    figures = [
        ("scenes", f"{len(cards):,}"), ("done", f"{states.count('done'):,}"), ("failed", f"{states.count('failed'):,}"),
        ("mean held-out PSNR", f"{sum(scores) / len(scores):.2f} dB" if scores else "-"),
        ("all PLY files", format_bytes(sum(c.ply_bytes for c in cards))), ("time", duration(seconds)),
    ]  # fmt: skip
    open_jobs = len(cards) - states.count("done") - states.count("failed")
    line = f"{open_jobs:,} jobs are not done yet; load the page again later." if open_jobs else "All jobs have ended."
    cells = "".join(f"<div><b>{html.escape(v)}</b><span>{html.escape(k)}</span></div>" for k, v in figures)
    body = (
        f'<h1>{html.escape(title)}</h1><p class="sub">{line} <a href="results.csv">results.csv</a></p>'
        f'<div class="figures">{cells}</div>{_failures(cards)}<h2>Scenes</h2>'
        f'<div class="cards">{"".join(map(_card, cards))}</div>'
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,'
        f'initial-scale=1"><title>{html.escape(title)}</title><style>{STYLE}{CARDS}</style></head><body><main>{body}</main></body>'
        "</html>\n"
    )


def write_farm_page(path: Path, title: str, cards: list[JobCard], seconds: float) -> None:
    """Write the page of `farm_page`, with links to images and reports.

    Raises:
        ResourceError: The file cannot be written.
    """
    write_text(path, farm_page(title, cards, seconds))
