"""The README's example does what it says."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_example_optimises_a_picture(capsys):
    """It runs as printed, is about twenty lines long, and ends with a small error."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    assert len(code.splitlines()) <= 28
    exec(compile(code, "README.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) < 0.06


def test_links_lead_somewhere():
    """Every file that the README and the architecture name exists."""
    for document in ("README.md", "docs/architecture.md", "CONTRIBUTING.md"):
        text = (ROOT / document).read_text("utf-8")
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", text):
            assert ((ROOT / document).parent / target).exists(), f"{document}: {target}"
