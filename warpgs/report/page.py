"""The HTML page of a run, with its curves."""

import base64
import hashlib
import json
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import quote

from warpgs.errors import listed
from warpgs.files import write_text
from warpgs.io.image_files import format_of, header_size
from warpgs.process import Detail, Task

MOST_BYTES = 100
"""Longest name that is kept unchanged, without suffix: any file system allows it."""
NOT_EVERYWHERE = re.compile(r'^\.|[<>:"\\|?*\x00-\x1f\x7f]|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)|^$|[\ud800-\udfff]', re.I)
"""Names that hide a file, that are not UTF-8, or that Windows does not take."""


def image_names(views: Iterable[str]) -> dict[str, str]:
    """Return the file name, without suffix, of the images of each view, by all view names: _ for /, made unique and valid."""
    # A file has the view's name without suffix, with _ for /, if this name is unique, ignoring capitals. A name that is
    # ambiguous, longer than 100 bytes or not allowed on some system is shortened; digits of a hash of the whole name follow.
    own = {view: _own_name(view) for view in views}
    count = Counter(map(_folded, own.values()))

    def named(view: str, name: str) -> str:
        size = len(name.encode("utf-8", "surrogatepass"))
        if count[_folded(name)] == 1 and not NOT_EVERYWHERE.search(name) and size <= MOST_BYTES:
            return name
        part = re.sub(r"[^\w.-]", "_", name).lstrip(".").encode("utf-8", "replace")[: MOST_BYTES // 2].decode("utf-8", "ignore")
        return f"{part}-{hashlib.sha256(view.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"

    return {view: named(view, name) for view, name in own.items()}


def renaming_notes(names: dict[str, str]) -> list[str]:
    """Return notes on views with other names for their images."""
    changed = [f"{view} is {name}.png" for view, name in names.items() if name != _own_name(view)]
    why = "because view names are alike, long, or not allowed on every system"
    return [f"images of some views have other names, {why}: {listed(changed, 3)}"] if changed else []


def _own_name(view: str) -> str:
    path = PurePosixPath(view)
    return str(path).removesuffix(path.suffix).replace("/", "_")


def _folded(name: str) -> str:
    """Return a key that is equal for names that a file system may confuse: macOS and Windows ignore capitals."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


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


def curve(title: str, xs: list[float], ys: list[float], unit: str = "") -> str:
    """Return an SVG chart of finite ``ys`` over ``xs``, as means of at most 300 groups; "no data" without any."""
    points = [(x, y) for x, y in zip(xs, ys) if math.isfinite(x) and math.isfinite(y)]
    group = max(1, math.ceil(len(points) / MAX_POINTS))
    chunks = [points[i : i + group] for i in range(0, len(points), group)]
    points = [(sum(x for x, _ in c) / len(c), sum(y for _, y in c) / len(c)) for c in chunks]
    head = f'<svg class="curve" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">'
    head += f'<text x="0" y="13" class="title">{title}{f" [{unit}]" if unit else ""}</text>'
    if not points:
        return head + f'<text x="{LEFT}" y="{HEIGHT / 2}">no data</text></svg>'
    x0, x1 = points[0][0], max(points[-1][0], points[0][0] + 1)
    y0, y1 = min(y for _, y in points), max(y for _, y in points)
    pad = 0.05 * (y1 - y0) or max(abs(y1) * 0.05, 1e-6)
    y0, y1 = y0 - pad, y1 + pad

    def place(x: float, y: float) -> tuple[float, float]:
        px = LEFT + (x - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT)
        return px, TOP + (y1 - y) / (y1 - y0) * (HEIGHT - TOP - BOTTOM)

    for tick in ticks(y0, y1):
        _, py = place(x0, tick)
        head += f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>'
        head += f'<text x="{LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{tick:g}</text>'
    for tick in ticks(x0, x1):
        head += f'<text x="{place(tick, y0)[0]:.1f}" y="{HEIGHT - 8}" text-anchor="middle">{tick:g}</text>'
    line = " ".join(f"{px:.1f},{py:.1f}" for px, py in (place(*p) for p in points))
    return f'{head}<polyline class="line" points="{line}"/></svg>'


Section = tuple[str, list[tuple[str, bytes]], list[list[str]], str]
"""Section of the page on sampling events or on coverage: sentences; caption and file of each image; rows of a table, the head
first; the meaning of the patterns in the images."""


def rendered(template: str, **contents: object) -> str:
    """Return a page of ``warpgs/report/templates``, with its contents escaped."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters |= {"data_uri": _data_uri, "aspect": _aspect, "address": lambda p: quote(p, errors="surrogateescape")}
    page = environment.get_template(template)
    own = "".join(page.blocks["script"](page.new_context())) if "script" in page.blocks else ""
    code = own.partition("<script>")[2].partition("</script>")[0]
    # the page's policy allows this script alone
    return page.render(script_sha256=base64.b64encode(hashlib.sha256(code.encode()).digest()).decode(), **contents)


def _data_uri(data: bytes) -> str:
    return f"data:image/{'webp' if data[:4] == b'RIFF' else 'png'};base64,{base64.b64encode(data).decode()}"


def _aspect(data: bytes) -> float:
    """Return the width of an image file in units of its height."""
    width, height = header_size(format_of(data), data)
    return width / height


def _without_folders(value: object) -> object:
    """Return JSON values with absolute paths cut to their last names, since a report is sent to others."""
    if isinstance(value, dict):
        return {k: _without_folders(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_folders(v) for v in value]
    absolute = isinstance(value, str) and (PurePosixPath(value).is_absolute() or PureWindowsPath(value).is_absolute())
    return PureWindowsPath(value).name if absolute else value  # its separators are / and \\


def write_page(path: Path, *, notes: list[str], record: dict[str, object], **contents: object) -> None:
    """Write the report page: one HTML file that refers to nothing outside it."""
    tasks, details = ([n for n in notes if isinstance(n, kind)] for kind in (Task, Detail))
    choices = [n for n in notes if not isinstance(n, Task | Detail)]
    words = json.dumps(_without_folders(record), indent=1)
    write_text(path, rendered("report.html", tasks=tasks, choices=choices, details=details, record=words, **contents))
