"""The report page, with sampling events, and the index of a farm."""

import base64
import hashlib
import json
import math
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from warpgs.errors import ResourceError
from warpgs.files import write_json
from warpgs.pipeline.farm.farm import farm_page
from warpgs.pipeline.farm.job import JobRecord
from warpgs.process import Detail, Task
from warpgs.report.images import png, webp
from warpgs.report.page import curve, write_page
from warpgs.report.progress import EventLog, read_events

VOID = {"meta", "img", "input", "br", "hr", "link"}


class Parsed(HTMLParser):
    """Tags, attributes and text of a page; complains about tags that do not nest."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.texts = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]

    def text(self, *tags):
        return [t for tag, t in self.texts if tag in tags]


def image(value):
    return png(np.full((6, 8, 3), value, np.float32))


def write(path, **changes):
    views = [
        (f"images/{i}.png", f"PSNR {20 + i}.25 dB, SSIM 0.{80 + i}", *(image(0.1 * i + j / 5) for j in range(4)))
        for i in range(2)
    ]
    values = {
        "title": "garden", "subtitle": "preset default",
        "figures": [("held-out PSNR", "24.31 dB"), ("held-out SSIM", "0.842"), ("Gaussians", "104,233")],
        "notes": ["every 8th view held out", "downscaled by 2"],
        "scores": [["view", "PSNR [dB]"], ["images/0.png", "20.25"], ["images/1.png", "21.25"]],
        "views": views, "curves": [curve("Training loss", [1, 2, 3], [0.3, 0.2, 0.1])],
        "sampling": ("Two sentences.", [("first", image(0.31)), ("later", image(0.32))], [["added"], ["12"]], ""),
        "pictures": [(webp(np.full((6, 8, 3), v)), w) for v, w in ((0.6, "a new viewpoint"), (0.7, "the Gaussians"))],
        "protocol": {"ground truth": "images_8 as stored", "LPIPS": "not measured"},
        "held_out": True, "coverage": None, "record": {"config": {"steps": 2000}, "versions": {"torch": "2"}},
    }  # fmt: skip
    values |= changes
    write_page(path, **values)
    text = path.read_text("utf-8")
    return values, text, Parsed(text)


def test_nothing_is_loaded_from_anywhere_and_sampling_is_shown(tmp_path):
    """The policy allows the page's own script; each view has a slider for a keyboard; later events are in a fold."""
    _, text, page = write(tmp_path / "report.html")
    sliders = page.all("input")
    assert len(sliders) == 2 and all(s["type"] == "range" and "images/" in s["aria-label"] for s in sliders)
    assert "prefers-color-scheme:dark" in text and "viewport" in text
    assert "http" not in text.replace("http-equiv", "") and "//" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)
    assert not page.all("link") and not re.search(r"@import|url\(", text)
    for _, attrs in page.tags:
        assert not {"href", "srcset", "action"} & set(attrs)
        assert re.match("data:image/(png|webp);base64,", attrs.get("src", "data:image/png;base64,"))
    (policy,) = [m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert f"script-src 'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}';" in policy
    assert policy.startswith("default-src 'none';")
    assert "Why Gaussians were placed" in page.text("h2") and "Two sentences." in page.text("p")
    section = text[text.index("Why Gaussians") : text.index("<h2>Details")]
    assert section.count("<details>") == 1 and section.index('alt="first"') < section.index("<details>")
    assert section.index("<summary>later</summary>") < section.index('alt="later"')
    folds = re.findall(r"<summary><h2>(.*?)</h2></summary>", text)
    assert folds == ["How it was scored", "Why Gaussians were placed", "Details"]


def test_images_are_embedded_byte_for_byte_and_numbers_shown_as_given(tmp_path):
    values, _, page = write(tmp_path / "report.html")
    embedded = [base64.b64decode(a["src"].split(",", 1)[1], validate=True) for a in page.all("img")]
    given = [data for v in values["views"] for data in v[2:]]
    given += [*(data for data, _ in values["pictures"]), *(data for _, data in values["sampling"][1])]
    assert sorted(embedded) == sorted(given)
    for data in embedded:
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (6, 8, 3)
    assert all(a.get("alt") for a in page.all("img"))
    labels, figures = zip(*values["figures"])
    shown = page.text("b")
    assert [t for t in shown if t in figures] == list(figures)
    assert [t for t in page.text("span") if t in labels] == list(labels)
    cells = [c for table in (values["scores"], values["sampling"][2]) for row in table for c in row]
    assert page.text("th", "td") == cells
    assert page.text("li") == values["notes"]
    assert dict(zip(page.text("dt"), page.text("dd"))) == values["protocol"]
    captions = " ".join(page.text("figcaption"))
    assert all(caption in captions and name in shown for name, caption, *_ in values["views"])
    assert json.loads("".join(page.text("pre"))) == values["record"]


def test_names_from_files_cannot_become_markup(tmp_path):
    evil = '<script>alert("x")</script>&amp;\'"'
    view = (evil, evil, *(image(0.5) for _ in range(4)))
    _, _, page = write(
        tmp_path / "report.html", title=evil, subtitle=evil, figures=[(evil, evil)], notes=[evil],
        scores=[["view"], [evil]], views=[view], record={evil: evil},
        sampling=(evil, [(evil, image(0.5))], [[evil]], ""),
    )  # fmt: skip
    assert len(page.all("script")) == 1
    assert page.text("h1", "p", "li", "td") == [evil] * 5
    assert page.all("input")[0]["aria-label"].endswith(evil)
    # settings hold no folder of the machine
    details = {"scene": {"path": "/home/me/fern", "masks": r"C:\Users\me\m.png"}, "tried": ["/data/a.py:Own", "data/fern", 7]}
    _, text, page = write(tmp_path / "report.html", record=details)
    shown = {"scene": {"path": "fern", "masks": "m.png"}, "tried": ["a.py:Own", "data/fern", 7]}
    assert json.loads("".join(page.text("pre"))) == shown and "/me" not in text


def test_what_nobody_acts_on_stands_in_the_last_section(tmp_path):
    """A new viewpoint and the overview open the page; then what to do, then the views, choices, details; nothing twice."""
    notes = [Task("remove blurred ones"), "every 8th view held out", Detail("memory: 14 MiB planned")]
    _, text, page = write(tmp_path / "report.html", notes=[notes[1], notes[2], notes[0]])
    assert page.text("li") == notes
    order = ("<h2>To do", notes[0], "<h2>Held-out views", "<h2>Choices made for you", notes[1], "<h2>Details", notes[2])
    assert [text.index(words) for words in order] == sorted(map(text.index, order))
    first, overview = page.all("img")[:2]
    assert (first["alt"], overview["alt"]) == ("a new viewpoint", "the Gaussians") and "data:image/webp" in first["src"]
    assert text.count("--aspect:1.33") == 4
    nothing = {key: [] for key in ("notes", "views", "curves", "pictures")} | {"sampling": None, "protocol": {}}
    _, _, page = write(tmp_path / "report.html", scores=[["view"]], **nothing)
    assert page.text("h2") == ["Details"] and not page.all("img") and not page.all("ul")
    for held_out, words in ((True, "Held-out"), (False, "trained on")):
        assert any(words in t for t in write(tmp_path / "report.html", held_out=held_out)[2].text("h2"))


@pytest.mark.parametrize("ys", [[0.0, 0.0, 0.0], [float("nan")] * 3, [1e-9, 2e-9, float("inf")], [-5e7, 0.0, 5e7]])
def test_curves_stay_inside_their_frame(ys):
    svg = curve("loss", [10, 20, 30], ys)
    box = Parsed(svg).all("svg")[0]
    _, _, width, height = map(float, box["viewbox"].split())
    for line in Parsed(svg).all("polyline"):
        points = np.array([p.split(",") for p in line["points"].split()], float)
        assert np.isfinite(points).all() and (points >= 0).all() and (points <= [width, height]).all()
    assert ("no data" in svg) == (not np.isfinite(ys).any())
    assert "nan" not in svg.lower()


def test_curve_runs_down_where_values_fall_and_long_series_are_thinned():
    steps = list(range(1, 5001))
    svg = Parsed(curve("loss", steps, [1 / s for s in steps], "u"))
    points = np.array([p.split(",") for p in svg.all("polyline")[0]["points"].split()], float)
    assert 100 < len(points) <= 300 and (np.diff(points[:, 0]) > 0).all() and (np.diff(points[:, 1]) >= 0).all()
    assert "loss [u]" in svg.text("text")
    assert Parsed(curve("none", [], [])).text("text") == ["none", "no data"]


def fill(path, steps, start=0):
    log = EventLog(path, start)
    for step in steps:
        log.write(step=step, loss=1 / step, psnr=20.0, count=5, seconds=0.1)
    log.close()


def test_every_event_is_a_line_of_strict_json(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = EventLog(path)
    log.write(step=1, loss=0.5, psnr=math.inf, count=7)
    log.write(step=2, loss=math.nan, psnr=21.5, count=8)
    log.flush()

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    lines = [json.loads(line, parse_constant=refuse) for line in path.read_text().splitlines()]
    assert [[*line.values()] for line in lines] == [[1, 0.5, None, 7], [2, None, 21.5, 8]]
    log.close()
    assert math.isnan(read_events(path)[0]["psnr"]) and math.isnan(read_events(path)[1]["loss"])
    write_json(tmp_path / "a.json", {"a": [math.nan, 1.5], "b": (math.inf,), "c": {"d": 2}})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, 1.5], "b": [None], "c": {"d": 2}}
    with pytest.raises(ResourceError, match="no"):
        EventLog(tmp_path / "no" / "metrics.jsonl")
    # a resumed log ends with the checkpoint: later events and a line cut by a kill are dropped; a log may be missing
    path = tmp_path / "metrics.jsonl"
    fill(path, range(1, 11))
    fill(path, range(7, 9), start=6)
    assert steps_of(path) == [1, 2, 3, 4, 5, 6, 7, 8]
    with path.open("ab") as f:
        f.write(b'{"step": 9, "lo')
    assert steps_of(path) == [1, 2, 3, 4, 5, 6, 7, 8]
    fill(path, [9], start=8)
    assert steps_of(path) == [1, 2, 3, 4, 5, 6, 7, 8, 9] and path.read_bytes().count(b"\n") == 9
    EventLog(path).close()
    assert path.read_bytes() == b""
    path.unlink()
    fill(path, [5], start=4)
    assert steps_of(path) == [5]
    path.write_bytes(b'[1]\n"x"\n{"loss": 1}\n{"step": "1"}\n\n\xff\n{"step": 3}\n')
    assert read_events(path) == [{"step": 3}]


def steps_of(path):
    return [e["step"] for e in read_events(path)]


# The index of a farm: every job, whatever it is called.

ROWS = [
    JobRecord("a", "", "done", seconds=61.0, psnr=25.5, gaussians=1200, steps=500),
    JobRecord("b\x1b[31m", "", "running", seconds=3.0, steps=40), JobRecord("c", "", "waiting"),
    JobRecord("d", "", "failed", message="d: no images <b>"), JobRecord("e", "", "failed", message="e: no images <b>"),
]  # fmt: skip


def test_a_farm_s_index_shows_every_job():
    # the index counts failures by message; the name of the scene in it makes no other message; nothing of a name is markup
    page = farm_page("a & b", [(r, "x y/t.jpg" if r.name == "a" else "", "") for r in ROWS], 90)
    assert "<td>SCENE: no images &lt;b&gt;</td><td>2</td><td>d, e</td>" in page and "<h1>a &amp; b</h1>" in page
    assert 'src="x%20y/t.jpg"' in page and "2 jobs are not done yet" in page and "25.50 dB" in page
