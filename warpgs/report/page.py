"""The HTML page of a run, with its curves."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from warpgs.files import write_text
from warpgs.process import Detail

MOST_BYTES = 100
"""Longest name that is kept unchanged, without suffix: any file system allows it."""
NOT_EVERYWHERE = re.compile(
    r'^\.|[<>:"\\|?*\x00-\x1f\x7f]|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)|^$|[\ud800-\udfff]', re.IGNORECASE
)
"""Names that hide a file, that are not UTF-8, or that Windows does not take."""


def image_names(views: Iterable[str]) -> dict[str, str]:
    """Return the file name, without suffix, of the images of each view of a scene.

    A file has the view's name without suffix, with _ for /, if this name is unique, ignoring capitals. A name that is
    ambiguous, longer than 100 bytes or not allowed on some system is shortened; digits of a hash of the whole name follow.

    Args:
        views: Names of all views of the scene, so that a view has one name in every folder.
    """
    own = {view: _own_name(view) for view in views}
    count = Counter(map(_folded, own.values()))
    kept = {v: n for v, n in own.items() if count[_folded(n)] == 1 and not NOT_EVERYWHERE.search(n) and _size(n) <= MOST_BYTES}
    taken = set(map(_folded, kept.values()))
    for view, name in own.items():
        if view in kept:
            continue
        part = re.sub(r"[^\w.-]", "_", name).lstrip(".").encode("utf-8", "replace")[: MOST_BYTES // 2].decode("utf-8", "ignore")
        digits, length = hashlib.sha256(view.encode("utf-8", "surrogatepass")).hexdigest(), 8
        while _folded(f"{part}-{digits[:length]}") in taken:
            length += 1
        kept[view] = f"{part}-{digits[:length]}"
        taken.add(_folded(kept[view]))
    return {view: kept[view] for view in own}


def renaming_notes(names: dict[str, str]) -> list[str]:
    """Return notes on views with other names for their images."""
    changed = [f"{view} is {name}.png" for view, name in names.items() if name != _own_name(view)]
    if not changed:
        return []
    words = ", ".join(changed[:3]) + (f", and {len(changed) - 3} more" if len(changed) > 3 else "")
    return [
        f"images of some views have other names, because view names are alike, long, or not allowed on every system: {words}"
    ]


def _own_name(view: str) -> str:
    path = PurePosixPath(view)
    return str(path).removesuffix(path.suffix).replace("/", "_")


def _folded(name: str) -> str:
    """Return a key that is equal for names that a file system may confuse: macOS and Windows ignore capitals."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _size(name: str) -> int:
    return len(name.encode("utf-8", "surrogatepass"))


WIDTH, HEIGHT = 380, 190
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 26, 26
MAX_POINTS = 300


def ticks(low: float, high: float) -> list[float]:
    """Return two to five round numbers, evenly spaced, inside a range."""
    rough = (high - low) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, first + 8) if i * step <= high + 1e-9 * step]


def tick_label(value: float) -> str:
    """Return a number as written on axes: 20000 becomes 20k."""
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e4 else f"{value:g}"


def curve(title: str, xs: list[float], ys: list[float], unit: str = "") -> str:
    """Return an SVG chart of ``ys`` over ``xs`` (steps); long series are shown by the means of at most 300 groups.

    Non-finite points are left out; without any finite point the chart says "no data".
    """
    points = [(x, y) for x, y in zip(xs, ys) if math.isfinite(x) and math.isfinite(y)]
    group = max(1, math.ceil(len(points) / MAX_POINTS))
    chunks = [points[i : i + group] for i in range(0, len(points), group)]
    points = [(sum(x for x, _ in c) / len(c), sum(y for _, y in c) / len(c)) for c in chunks]
    head = (
        f'<svg class="curve" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">'
        f'<text x="0" y="13" class="title">{title}{f" [{unit}]" if unit else ""}</text>'
    )
    if not points:
        return head + f'<text x="{LEFT}" y="{HEIGHT / 2}">no data</text></svg>'
    x0, x1 = points[0][0], max(points[-1][0], points[0][0] + 1)
    y0, y1 = min(y for _, y in points), max(y for _, y in points)
    pad = 0.05 * (y1 - y0) or max(abs(y1) * 0.05, 1e-6)
    y0, y1 = y0 - pad, y1 + pad

    def place(x: float, y: float) -> tuple[float, float]:
        px = LEFT + (x - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT)
        return px, TOP + (y1 - y) / (y1 - y0) * (HEIGHT - TOP - BOTTOM)

    parts = [head]
    for tick in ticks(y0, y1):
        _, py = place(x0, tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{tick_label(tick)}</text>')
    for tick in ticks(x0, x1):
        px, _ = place(tick, y0)
        parts.append(f'<text x="{px:.1f}" y="{HEIGHT - 8}" text-anchor="middle">{tick_label(tick)}</text>')
    line = " ".join(f"{px:.1f},{py:.1f}" for px, py in (place(*p) for p in points))
    parts.append(f'<polyline class="line" points="{line}"/></svg>')
    return "".join(parts)


STYLE = """
:root{--ink:#1b1d21;--soft:#666c76;--line:#dfe2e7;--paper:#fbfbf9;--card:#fff;--accent:#0b6e6e}
@media(prefers-color-scheme:dark){:root{--ink:#e8e9ec;--soft:#9aa1ac;--line:#30343b;--paper:#131518;--card:#1b1e22;--accent:#55c2bd}}
*{box-sizing:border-box}body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.55 -apple-system,BlinkMacSystemFont,"Segoe UI",Helvetica,Arial,sans-serif}
main{max-width:1080px;margin:0 auto;padding:48px 24px 80px}
h1{font-size:34px;letter-spacing:-.02em;margin:0 0 4px;overflow-wrap:anywhere}
h2{font-size:20px;margin:52px 0 14px;letter-spacing:-.01em}
.sub,figcaption,.dim{color:var(--soft)}.sub{margin:0}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(max(140px,22%),1fr));gap:1px;background:var(--card);
border:1px solid var(--line);border-radius:10px;overflow:hidden;margin:28px 0 0}
.figures div{box-shadow:0 0 0 1px var(--line);padding:16px 18px}
.figures b{display:block;white-space:nowrap;font-size:25px;font-weight:600;letter-spacing:-.02em;
font-variant-numeric:tabular-nums}.figures span{color:var(--soft);font-size:13px}
ul{padding-left:20px;margin:0}li{margin:3px 0}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{padding:7px 14px 7px 0;text-align:right;border-bottom:1px solid var(--line)}
th{font-weight:500;color:var(--soft);font-size:13px}th:first-child,td:first-child{text-align:left;overflow-wrap:break-word}
.table{overflow-x:auto}.legend{margin:14px 0 10px}
.view{margin:0 0 40px}.row{display:grid;grid-template-columns:2fr 1fr;gap:10px;align-items:start}
.wide{margin:14px calc(50% - min(50vw - 24px,800px))}.wide figcaption{padding-left:16px}
.first{margin:24px 0 0}.stack{display:grid;gap:10px}img{display:block;width:100%;height:auto;border-radius:6px}
figure{margin:0}figcaption{font-size:13px;padding:5px 0 0}
.slider{position:relative;border-radius:6px;overflow:hidden;touch-action:none;cursor:ew-resize;--cut:50%}
.slider:focus-within{outline:2px solid var(--accent);outline-offset:2px}
.slider img{border-radius:0}.slider .top{position:absolute;inset:0;clip-path:inset(0 calc(100% - var(--cut)) 0 0)}
.slider .bar{position:absolute;top:0;bottom:0;left:var(--cut);width:2px;background:#fff;box-shadow:0 0 4px #0008}
.slider input{position:absolute;inset:0;width:100%;height:100%;opacity:0;cursor:ew-resize;margin:0}
.tag{position:absolute;top:8px;padding:1px 8px;border-radius:4px;background:#000a;color:#fff;font-size:12px}
.curves{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:24px}
.curve{width:100%;height:auto}.curve text{font-size:11px;fill:var(--soft)}
.curve .title{font-size:13px;fill:var(--ink);font-weight:600}
.curve .grid{stroke:var(--line)}.curve .line{fill:none;stroke:var(--accent);stroke-width:1.8;stroke-linejoin:round}
dl{display:grid;grid-template-columns:minmax(120px,max-content) 1fr;gap:4px 18px;margin:0;font-size:14px}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
details{margin-top:14px}summary{cursor:pointer}
pre{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:16px;overflow:auto;
font-size:13px;line-height:1.45}
@media(max-width:700px){.figures div:last-child:nth-child(odd){grid-column:1/-1}
.row{grid-template-columns:1fr}.stack{grid-template-columns:1fr 1fr}}
"""
OVERVIEW, HELD_OUT = "the Gaussians, training cameras teal", ", held-out cameras orange"
SCRIPT = (
    "document.querySelectorAll('.slider input').forEach(i=>i.addEventListener('input',"
    "()=>i.parentElement.style.setProperty('--cut',i.value+'%')))"
)


@dataclass(frozen=True)
class ViewImages:
    """Images of one view, as bytes of WebP or PNG files."""

    name: str
    caption: str
    render: bytes
    reference: bytes
    error: bytes
    depth: bytes


@dataclass(frozen=True)
class SamplingReport:
    """Section of the page on the sampling events of a fit."""

    words: str
    """Sentences that explain the images."""
    images: list[tuple[str, bytes]]
    """Caption and image file of each event that has an image; the page shows the first, and the others on request."""
    table: list[list[str]]
    """Header row, then rows."""


@dataclass(frozen=True)
class CoverageReport:
    """Section of the page on coverage."""

    words: str
    """Sentences on the coverage."""
    legend: str
    """Meaning of the patterns in the images."""
    images: list[tuple[str, bytes]]
    """Name and image file of each view."""
    table: list[list[str]]
    """Header row, then rows."""


def _embed(data: bytes, alternative: str, style: str = "") -> str:
    source, kind = base64.b64encode(data).decode(), "webp" if data[:4] == b"RIFF" else "png"
    return f'<img alt="{html.escape(alternative)}"{style} src="data:image/{kind};base64,{source}">'


def _figure(data: bytes, caption: str) -> str:
    return f"<figure>{_embed(data, caption)}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _view(v: ViewImages) -> str:
    name = html.escape(v.name)
    return (
        f'<div class="view"><div class="row"><figure><div class="slider">{_embed(v.reference, f"reference image {v.name}")}'
        f'<div class="top">{_embed(v.render, f"render {v.name}")}</div><div class="bar"></div>'
        '<span class="tag" style="left:8px">render</span><span class="tag" style="right:8px">reference</span>'
        f'<input type="range" min="0" max="100" value="50" aria-label="render against reference image of {name}"></div>'
        f"<figcaption><b>{name}</b> &nbsp; {html.escape(v.caption)}</figcaption></figure>"
        f'<div class="stack">{_figure(v.error, "absolute error, 0 to 0.3")}'
        f"{_figure(v.depth, 'depth, near red, far blue')}</div>"
        "</div></div>"
    )


def _sampling(s: SamplingReport) -> str:
    parts = [f"<h2>Why Gaussians were placed</h2><p>{html.escape(s.words)}</p>{_table(s.table)}"]
    for i, (caption, data) in enumerate(s.images):
        image = f'<figure class="wide">{_embed(data, caption)}<figcaption>{html.escape(caption)}</figcaption></figure>'
        parts.append(image if i == 0 else f"<details><summary>{html.escape(caption)}</summary>{image}</details>")
    return "".join(parts)


def _coverage(c: CoverageReport) -> str:
    images = "".join(_figure(data, f"{name}, by coverage") for name, data in c.images)
    return (
        f"<h2>Where no training view looked</h2><p>{html.escape(c.words)}</p>{_table(c.table)}"
        f'<p class="sub legend">{html.escape(c.legend[0].upper() + c.legend[1:])}.</p><div class="curves">{images}</div>'
    )


def _table(rows: list[list[str]]) -> str:
    cells = [[html.escape(c).replace(" %", "&nbsp;%") for c in row] for row in rows]
    head, *body = ["".join(f"<{t}>{c}</{t}>" for c in row) for t, row in zip(["th"] + ["td"] * len(rows), cells)]
    return f'<div class="table"><table><tr>{head}</tr>{"".join(f"<tr>{r}</tr>" for r in body)}</table></div>'


def _list(lines: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(n)}</li>' for n in lines)}</ul>" if lines else ""


def _document(title: str, body: str) -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,'
        f'initial-scale=1"><title>{html.escape(title)}</title><style>{STYLE}</style></head><body><main>'
        f"{body}</main><script>{SCRIPT}</script></body></html>\n"
    )


def _without_folders(value: object) -> object:
    """Return JSON values with absolute paths cut to their last names, since a report is sent to others."""
    if isinstance(value, dict):
        return {k: _without_folders(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_folders(v) for v in value]
    absolute = isinstance(value, str) and (PurePosixPath(value).is_absolute() or PureWindowsPath(value).is_absolute())
    return PureWindowsPath(value).name if absolute else value  # its separators are / and \\


@dataclass(frozen=True)
class Page:
    """Contents of a report page."""

    title: str
    """Headline."""
    subtitle: str
    """Line under the headline."""
    figures: list[tuple[str, str]]
    """Label and value of each key figure."""
    notes: list[str]
    """Automatic choices; a `Detail` is shown in the last section."""
    table: list[list[str]]
    """Header row, then a row per held-out view."""
    views: list[ViewImages]
    """Images of views."""
    curves: list[str]
    """SVG charts."""
    sampling: SamplingReport | None
    """The fit's sampling events; None without events."""
    overview: bytes | None
    """Image of cameras and points, or None."""
    protocol: dict[str, str]
    """Settings that must be equal for scores to be comparable, and the definition of each figure, by name."""
    details: dict
    """Configuration, versions and data, shown as JSON on request; paths are reduced to the last name."""
    coverage: CoverageReport | None = None
    """Scores of held-out views by coverage, or None."""
    held_out: bool = True
    """True if the views are held out; False if the fit was trained on them."""


def write_page(path: Path, page: Page) -> None:
    """Write the report page: one HTML file that refers to nothing outside it.

    Raises:
        ResourceError: The file cannot be written.
    """
    write_text(path, _document(page.title, "".join([*_head(page), *_scores(page), *_fit(page)])))


def _head(page: Page) -> list[str]:
    """Return the sections above the scores: title, overview, key figures, choices made for the user."""
    cells = "".join(f"<div><b>{html.escape(v)}</b><span>{html.escape(k)}</span></div>" for k, v in page.figures)
    overview = []
    if page.overview:
        caption = OVERVIEW + (HELD_OUT if page.held_out else "")
        overview = [f'<div class="first">{_figure(page.overview, caption)}</div>']
    choices = [n for n in page.notes if not isinstance(n, Detail)]
    return [
        f'<h1>{html.escape(page.title)}</h1><p class="sub">{html.escape(page.subtitle)}</p>', *overview,
        f'<div class="figures">{cells}</div>', *([f"<h2>Choices made for you</h2>{_list(choices)}"] if choices else []),
    ]  # fmt: skip


def _scores(page: Page) -> list[str]:
    """Return the sections on views, their scores, and the protocol of the scores."""
    sections = []
    if page.views:
        heading = "Held-out views" if page.held_out else "Views the fit was trained on"
        sections.append(f"<h2>{heading}</h2>{''.join(map(_view, page.views))}")
    if len(page.table) > 1:
        sections.append("<h2>Scores</h2>" + _table(page.table))
    if page.coverage:
        sections.append(_coverage(page.coverage))
    if page.protocol:
        items = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in page.protocol.items())
        sections.append(f"<h2>{'How it was scored' if page.held_out else 'Views'}</h2><dl>{items}</dl>")
    return sections


def _fit(page: Page) -> list[str]:
    """Return the sections on the fit: charts, sampling events, details."""
    sections = []
    if page.curves:
        sections.append(f'<h2>The fit</h2><div class="curves">{"".join(page.curves)}</div>')
    if page.sampling:
        sections.append(_sampling(page.sampling))
    settings = html.escape(json.dumps(_without_folders(page.details), indent=1))
    details = _list([n for n in page.notes if isinstance(n, Detail)])
    return [
        *sections,
        f"<h2>Details</h2>{details}<details><summary>configuration, versions, data</summary><pre>{settings}</pre></details>",
    ]
