"""The commands of the pages are found, left out with a reason, and their failures seen."""

import shutil
from pathlib import Path

import pytest

from tools.run_docs import ROOT, collect, main, pages, prepare, run_blocks, shortened

PAGE = """Words.

```bash
echo first > a
ssh -L 8080:127.0.0.1:8080 you@there
```

<!-- docs-run: needs a GPU -->
```bash
echo never > b
```

```
$ warpgs export run --to a.ply
warpgs fit scene --out x --device cuda
```

```{math}
1 + 1
```

```python
open("p", "w").write("python")
```

```
a table without a language
```
"""


def test_blocks_and_reasons():
    first, marked, bare, python = collect("x.md", PAGE)
    assert (first.line, first.code) == (4, "echo first > a")
    assert first.left_out == (("ssh -L 8080:127.0.0.1:8080 you@there", "another machine"),)
    assert (marked.code, marked.left_out) == ("", (("echo never > b", "needs a GPU"),))
    assert (bare.code, bare.left_out[0][1]) == ("warpgs export run --to a.ply", "GPU")
    assert python.python and python.code.startswith("open(") and not first.python


def test_a_marker_says_why():
    with pytest.raises(ValueError, match="line 3"):
        collect("x.md", "<!-- docs-run:  -->\n```bash\necho a\n```\n")


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_blocks_run_in_order_and_failures_are_named(tmp_path):
    text = "```python\nopen('a', 'w')\n```\n```bash\ncat a\nfalse\ntouch late\n```\n```bash\ncp a b\n```\n"
    (line,) = run_blocks(collect("x.md", text), tmp_path, tmp_path)
    assert line.startswith("x.md, line 5: exit code 1") and (tmp_path / "b").exists() and not (tmp_path / "late").exists()


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_the_next_block_runs_where_the_last_one_ended(tmp_path):
    """As in the reader's shell, after `cd`."""
    text = "```bash\nmkdir tour && cd tour\n```\n```bash\ntouch a\n```\n```python\nopen('b', 'w')\n```\n"
    assert run_blocks(collect("x.md", text), tmp_path, tmp_path) == []
    assert (tmp_path / "tour" / "a").exists() and (tmp_path / "tour" / "b").exists()


def test_a_page_gets_what_it_uses_and_does_not_make(tmp_path):
    made, folder = tmp_path / "made", tmp_path / "page"
    for name in ("scene", "run", "photographs"):
        (made / name).mkdir(parents=True)
    folder.mkdir()
    prepare(folder, "warpgs fit scene/ --out run/\nwarpgs render run/", made)
    assert [p.name for p in folder.iterdir()] == ["scene"]


def test_only_what_is_long_is_made_short():
    assert shortened(["fit", "s", "--out", "r"])[-2:] == ["--steps", "40"]
    assert shortened(["compare", "s", "--seeds", "5", "--steps=9"]) == ["compare", "s", "--seeds", "1", "--steps=9"]
    assert shortened(["fit", "s", "--steps=3", "--view"])[2:] == ["--steps=3", "--view", "--view-port", "0"]
    for words in (["fit", "s", "--steps=3"], ["fit", "--help"], ["export", "run"], []):
        assert shortened(words) == words


def test_every_page_can_be_read():
    """No marker lacks its reason, and hardly anything is left out."""
    blocks = [b for p in pages() for b in collect(p, Path(ROOT / p).read_text("utf-8"))]
    assert sum(bool(b.code) for b in blocks) > 20
    assert sum(len(b.left_out) for b in blocks) <= 26


def test_the_program_shows_its_flags_and_names_an_unknown_page(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "--install" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["docs/no.md"])
    assert "no such page: docs/no.md" in capsys.readouterr().err
