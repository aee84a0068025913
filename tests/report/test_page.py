import base64
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from warpgs.process import Detail
from warpgs.report.images import png, webp
from warpgs.report.page import Section, ViewImages, curve, write_page

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
        ViewImages(f"images/{i}.png", f"PSNR {20 + i}.25 dB, SSIM 0.{80 + i}", *(image(0.1 * i + j / 5) for j in range(4)))
        for i in range(2)
    ]
    values = {
        "title": "garden", "subtitle": "preset default",
        "figures": [("held-out PSNR", "24.31 dB"), ("held-out SSIM", "0.842"), ("Gaussians", "104,233")],
        "notes": ["every 8th view held out", "downscaled by 2"],
        "scores": [["view", "PSNR [dB]"], ["images/0.png", "20.25"], ["images/1.png", "21.25"]],
        "views": views, "curves": [curve("Training loss", [1, 2, 3], [0.3, 0.2, 0.1])],
        "sampling": Section("Two sentences.", [("first", image(0.31)), ("later", image(0.32))], [["added"], ["12"]]),
        "overview": webp(np.full((6, 8, 3), 0.7)), "protocol": {"ground truth": "images_8 as stored", "LPIPS": "not measured"},
        "held_out": True, "coverage": None, "record": {"config": {"steps": 2000}, "versions": {"torch": "2"}},
    }  # fmt: skip
    values |= changes
    write_page(path, **values)
    text = path.read_text("utf-8")
    return values, text, Parsed(text)


def test_nothing_is_loaded_from_anywhere(tmp_path):
    _, text, page = write(tmp_path / "report.html")
    assert "http" not in text and "//" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)
    assert not page.all("link") and not re.search(r"@import|url\(", text)
    for _, attrs in page.tags:
        assert not {"href", "srcset", "action"} & set(attrs)
        assert re.match("data:image/(png|webp);base64,", attrs.get("src", "data:image/png;base64,"))


def test_all_images_are_embedded_byte_for_byte(tmp_path):
    values, _, page = write(tmp_path / "report.html")
    embedded = [base64.b64decode(a["src"].split(",", 1)[1], validate=True) for a in page.all("img")]
    given = [b for v in values["views"] for b in (v.reference, v.render, v.error, v.depth)]
    given += [values["overview"], *(data for _, data in values["sampling"].images)]
    assert sorted(embedded) == sorted(given)
    for data in embedded:
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (6, 8, 3)
    assert all(a.get("alt") for a in page.all("img"))


def test_every_number_given_is_shown_as_given(tmp_path):
    values, _, page = write(tmp_path / "report.html")
    labels, figures = zip(*values["figures"])
    shown = page.text("b")
    assert [t for t in shown if t in figures] == list(figures)
    assert [t for t in page.text("span") if t in labels] == list(labels)
    cells = [c for table in (values["scores"], values["sampling"].table) for row in table for c in row]
    assert page.text("th", "td") == cells
    assert page.text("li") == values["notes"]
    assert dict(zip(page.text("dt"), page.text("dd"))) == values["protocol"]
    captions = " ".join(page.text("figcaption"))
    assert all(v.caption in captions and v.name in shown for v in values["views"])
    assert json.loads("".join(page.text("pre"))) == values["record"]


def test_settings_hold_no_folder_of_the_machine(tmp_path):
    details = {"scene": {"path": "/home/me/fern", "masks": r"C:\Users\me\m.png"}, "tried": ["/data/a.py:Own", "data/fern", 7]}
    _, text, page = write(tmp_path / "report.html", record=details)
    shown = {"scene": {"path": "fern", "masks": "m.png"}, "tried": ["a.py:Own", "data/fern", 7]}
    assert json.loads("".join(page.text("pre"))) == shown and "/me" not in text


def test_every_view_has_a_slider_a_keyboard_reaches(tmp_path):
    _, text, page = write(tmp_path / "report.html")
    sliders = page.all("input")
    assert len(sliders) == 2 and all(s["type"] == "range" and "images/" in s["aria-label"] for s in sliders)
    assert "prefers-color-scheme:dark" in text and "viewport" in text


def test_names_from_files_cannot_become_markup(tmp_path):
    evil = '<script>alert("x")</script>&amp;\'"'
    view = ViewImages(evil, evil, *(image(0.5) for _ in range(4)))
    _, _, page = write(
        tmp_path / "report.html", title=evil, subtitle=evil, figures=[(evil, evil)], notes=[evil],
        scores=[["view"], [evil]], views=[view], record={evil: evil},
        sampling=Section(evil, [(evil, image(0.5))], [[evil]]),
    )  # fmt: skip
    assert len(page.all("script")) == 1
    assert page.text("h1", "p", "li", "td") == [evil] * 5
    assert page.all("input")[0]["aria-label"].endswith(evil)


def test_parts_that_are_not_there_leave_no_empty_heading(tmp_path):
    _, _, page = write(
        tmp_path / "report.html", notes=[], scores=[["view"]], views=[], curves=[], sampling=None, overview=None, protocol={}
    )
    assert page.text("h2") == ["Details"] and not page.all("img") and not page.all("ul")


def test_what_nobody_acts_on_stands_in_the_last_section(tmp_path):
    """Notes for the user come first, details last, and nothing twice; the overview is the first image."""
    notes = ["every 8th view held out", Detail("memory: 14 MiB planned")]
    _, text, page = write(tmp_path / "report.html", notes=notes)
    assert page.text("li") == notes
    assert text.index("Choices made for you") < text.index(notes[0]) < text.index("<h2>Details") < text.index(notes[1])
    assert "the Gaussians" in page.all("img")[0]["alt"] and page.all("img")[0]["src"].startswith("data:image/webp")


@pytest.mark.parametrize("held_out, words", [(True, "Held-out"), (False, "trained on")])
def test_views_are_called_what_they_are(tmp_path, held_out, words):
    _, _, page = write(tmp_path / "report.html", held_out=held_out)
    assert any(words in t for t in page.text("h2"))


def test_sampling_shows_the_first_image_and_the_others_on_request(tmp_path):
    """The first event is open under its text, later ones in a fold with their caption."""
    _, text, page = write(tmp_path / "report.html")
    assert "Why Gaussians were placed" in page.text("h2") and "Two sentences." in page.text("p")
    section = text[text.index("Why Gaussians") : text.index("<h2>Details")]
    assert section.count("<details>") == 1 and section.index('alt="first"') < section.index("<details>")
    assert section.index("<summary>later</summary>") < section.index('alt="later"')


@pytest.mark.parametrize(
    "ys", [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [float("nan")] * 3, [1e-9, 2e-9, float("inf")], [1e7, 2e7, 3e7], [-5.0, 0.0, 5.0]]
)
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
