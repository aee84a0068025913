"""The commands of the pages are found, left out with a reason, and their failures seen."""

import shutil

import pytest

from tools.run_docs import collect, run_blocks, shortened

PAGE = """Words.

```bash
echo first > a
pip install "warpgs[view]"
```

<!-- docs-run: needs a GPU -->
```bash
echo never > b
```

```
$ warpgs export run --to a.ply
warpgs view run
```

```{math}
1 + 1
```

```python
print("not a shell")
```

```
a table without a language
```
"""


def test_blocks_and_reasons():
    first, marked, bare = collect("x.md", PAGE)
    assert (first.line, first.code, first.left_out) == (4, "echo first > a", ("network or another machine",))
    assert (marked.code, marked.left_out) == ("", ("needs a GPU",))
    assert (bare.code, bare.left_out) == ("warpgs export run --to a.ply", ("stays open",))


def test_a_marker_says_why():
    with pytest.raises(ValueError, match="line 3"):
        collect("x.md", "<!-- docs-run:  -->\n```bash\necho a\n```\n")


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_blocks_run_in_order_and_failures_are_named(tmp_path):
    text = "```bash\necho 1 > a\n```\n```bash\ncat a\nfalse\ntouch late\n```\n```bash\ncp a b\n```\n"
    (line,) = run_blocks(collect("x.md", text), tmp_path, tmp_path)
    assert line.startswith("x.md, line 5: exit code 1") and (tmp_path / "b").exists() and not (tmp_path / "late").exists()


def test_only_what_is_not_said_is_made_short():
    assert shortened(["fit", "s", "--out", "r"])[-2:] == ["--steps", "40"]
    for words in (["fit", "s", "--steps=3"], ["fit", "--help"], ["export", "run"], []):
        assert shortened(words) == words
