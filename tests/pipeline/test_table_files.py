"""Tables of a study: the figures that were measured, in three notations that agree."""

import csv
import io
import math
import re

import pytest

from warpgs.pipeline.study.tables import Metric, Row, Table, csv_text, interval, latex, markdown, paired_difference, sample

PSNR, SSIM, LPIPS = Metric("psnr", "PSNR", True, 2), Metric("ssim", "SSIM", True, 3), Metric("lpips", "LPIPS", False, 3)
BASE, OTHER = [20.0, 20.2, 20.1], [20.6, 20.7, 20.8]


def table(**changes) -> Table:
    marks = ((True, True), (False, True)) if "switches" in changes else ((), ())
    rows = (
        Row("full", {"psnr": sample(BASE), "ssim": sample([0.8, 0.8, 0.8])}, {}, marks[0]),
        Row(
            "no a_b|c", {"psnr": sample(OTHER), "ssim": sample([0.7, 0.8, 0.6])},
            {"psnr": paired_difference(OTHER, BASE), "ssim": paired_difference([0.7, 0.8, 0.6], [0.8, 0.8, 0.8]),
             "lpips": paired_difference([], [])}, marks[1],
        ),
    )  # fmt: skip
    return Table(**{"caption": "A study of 100 %", "base": "full", "metrics": (PSNR, SSIM, LPIPS), "rows": rows} | changes)


def cells(text: str) -> list[list[list[str]]]:
    """The Markdown tables of a text, as rows of cells."""
    found, current = [], []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            current.append([c.strip().replace("\\|", "|") for c in re.split(r"(?<!\\)\|", line)[1:-1]])
        elif current:
            found.append(current)
            current = []
    return found


def test_markdown_holds_means_deviations_and_differences():
    """Two whole tables; the best of a column is bold; an interval that spares 0 is marked."""
    figures, gaps = cells(markdown(table()))
    assert figures[0] == ["method", "PSNR ↑", "SSIM ↑", "LPIPS ↓", "seeds"]
    assert figures[2] == ["full", "20.10 ± 0.10", "**0.800 ± 0.000**", "-", "3"]
    assert figures[3] == ["no a_b|c", "**20.70 ± 0.10**", "0.700 ± 0.100", "-", "3"]
    d = paired_difference(OTHER, BASE)
    assert gaps[2][:2] == ["no a_b|c", f"+0.60 [{d.low:+.2f}, {d.high:+.2f}] \\*"]
    assert not gaps[2][2].endswith("*") and gaps[2][3:] == ["-", "3"] and len(gaps) == 3
    assert len({len(r) for r in figures}) == len({len(r) for r in gaps}) == 1


def test_markdown_holds_the_number_of_gaussians():
    """The mean over seeds, without a best one; a row without a result has none."""
    rows = (Row("a", {"psnr": sample(BASE), "gaussians": sample([12000, 12001, 12005])}, {}), Row("b", {}, {}))
    figures, _ = cells(markdown(table(rows=rows, base="a", metrics=(PSNR,))))
    assert figures[0] == ["method", "PSNR ↑", "Gaussians", "seeds"]
    assert figures[2] == ["a", "**20.10 ± 0.10**", "12,002", "3"] and figures[3] == ["b", "-", "-", "0"]


def test_ablation_has_check_marks_in_every_notation():
    """The columns of the paper's second table."""
    t = table(switches=("Hier", "S_{rend}"))
    figures, _ = cells(markdown(t))
    assert figures[0][:3] == ["row", "Hier", "S_rend"] and [r[1:3] for r in figures[2:]] == [["✓", "✓"], ["✗", "✓"]]
    tex = latex(t)
    assert "$Hier$ & $S_{rend}$ & PSNR$\\uparrow$" in tex and "$\\times$ & $\\checkmark$ & $\\mathbf{20.70 \\pm 0.10}$" in tex
    rows = list(csv.DictReader(io.StringIO(csv_text(t))))
    assert [(r["Hier"], r["S_rend"]) for r in rows if r["metric"] == "psnr"] == [("1", "1"), ("0", "1")]


def test_csv_keeps_every_digit():
    """What was not measured is empty, not zero."""
    rows = {(r["row"], r["metric"]): r for r in csv.DictReader(io.StringIO(csv_text(table())))}
    d = paired_difference(OTHER, BASE)
    r = rows["no a_b|c", "psnr"]
    assert [float(r[k]) for k in ("mean", "sd", "difference", "low95", "high95")] == [
        sample(OTHER).mean, sample(OTHER).sd, d.mean, d.low, d.high,
    ]  # fmt: skip
    assert rows["full", "psnr"]["difference"] == "" and rows["full", "lpips"]["mean"] == "" and len(rows) == 6


def test_latex_is_balanced_and_escaped():
    """Braces and dollars pair up, names cannot break the table, every line has the same columns."""
    tex = latex(table())
    assert tex.count("{") == tex.count("}") and tex.count("$") % 2 == 0
    assert "no a\\_b|c" in tex and "100 \\%" in tex
    lines = [line for line in tex.splitlines() if line.endswith("\\\\")]
    assert len(lines) == 3 and {len(re.split(r"(?<!\\)&", line)) for line in lines} == {5}
    assert "\\begin{tabular}{lcccr}" in tex


def test_a_scene_s_name_is_no_latex():
    """TeX reads ^^5c as a backslash, and an empty line as the end of a paragraph."""
    caption = next(line for line in latex(table(caption="\\a^^5cinput{b}~c\n\nd")).splitlines() if "caption" in line)
    assert caption.startswith(
        "  \\caption{\\textbackslash{}a\\textasciicircum{}\\textasciicircum{}5cinput\\{b\\}\\textasciitilde{}c  d. "
    )


def test_the_tables_say_what_their_figures_are():
    """For a reader who has the table alone."""
    text, tex = markdown(table()), latex(table())
    assert text.startswith("Scores of held-out views: mean ± standard deviation over seeds, the best mean in bold:")
    assert (
        "mean $\\pm$ standard deviation over seeds. $\\Delta$: difference to full, paired by seed, with a 95 \\% t int" in tex
    )


def test_small_differences_keep_their_digits():
    """No minus zero, and an interval without 0 does not end at 0."""
    assert interval(paired_difference([20.0, 20.0, 20.001], [20.0, 20.001, 20.0]), 2) == "+0.00 [+0.00, +0.00]"
    assert interval(paired_difference([19.9986, 19.9988], [20.0, 20.0]), 2) == "-0.00130 [-0.00257, -0.00003]"


def test_one_seed_has_no_deviation():
    """A figure without a spread is printed alone, a difference without an interval likewise."""
    rows = (
        Row("a", {"psnr": sample([20.0])}, {}), Row("b", {"psnr": sample([21.0])}, {"psnr": paired_difference([21.0], [20.0])}),
    )  # fmt: skip
    figures, gaps = cells(markdown(table(rows=rows, base="a", metrics=(PSNR,))))
    assert figures[2][1] == "20.00" and gaps[2][1] == "+1.00"


@pytest.mark.parametrize("upwards,best", [(True, 21.0), (False, 20.0)])
def test_best_follows_the_direction_and_what_is_printed(upwards, best):
    """Equal when printed is equally best; nothing measured has no best."""
    metric = Metric("psnr", "PSNR", upwards, 2)
    rows = tuple(Row(str(v), {"psnr": sample([v])}, {}) for v in (20.001, 20.004, 21.0))
    assert table(rows=rows).best(metric) == best and math.isnan(table(rows=rows).best(LPIPS))
