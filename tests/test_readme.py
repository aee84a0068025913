"""The examples of the README and of the page on Python do what they say."""

import dataclasses
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from warpgs import PRESETS, read_ply
from warpgs.synthetic.demo import write_demo

ROOT = Path(__file__).parent.parent


def snippets(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)


def test_the_example_of_the_rasterizer_fits_an_image(capsys):
    """Run as printed, it ends near the target."""
    text = next(t for t in snippets("docs/rasterizer.md") if "rasterize(" in t and "backward()" in t)
    assert len(text.splitlines()) <= 28
    exec(compile(text, "docs/rasterizer.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) < 0.06


def test_the_example_fits_a_scene(tmp_path, monkeypatch):
    """Run as printed beside a tiny scene, with fewer steps: the PLY is there, in file units."""
    write_demo(tmp_path / "scene", views=8, width=48, height=36)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS._made, "quick", dataclasses.replace(PRESETS["quick"], steps=5))
    exec(compile(snippets("README.md")[0], "README.md", "exec"), {})
    ours, runs = (read_ply(tmp_path / name) for name in ("model.ply", "fitted/point_cloud.ply"))
    assert torch.equal(ours.means, runs.means)


def test_links_lead_somewhere():
    """Every file that the README and the architecture name exists."""
    for document in ("README.md", "docs/architecture.md", "CONTRIBUTING.md"):
        text = (ROOT / document).read_text("utf-8")
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", text):
            assert ((ROOT / document).parent / target).exists(), f"{document}: {target}"


def test_the_hosted_checks_are_those_of_the_readme():
    """Both commands, each system, and every Python that the package allows."""
    text = (ROOT / ".github/workflows/test.yml").read_text("utf-8")
    commands = re.findall(r"^(make \w+) ", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE)
    assert re.findall(r"- run: (make \w+)", text) == commands == ["make demo", "make test"]
    assert all(f"{system}-latest" in text for system in ("ubuntu", "macos", "windows"))
    low, high = re.search(r'requires-python = ">=3\.(\d+),<3\.(\d+)"', (ROOT / "pyproject.toml").read_text("utf-8")).groups()
    assert re.search(r"python: \[(.*)\]", text)[1] == ", ".join(f'"3.{n}"' for n in range(int(low), int(high)))


@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
@pytest.mark.parametrize(("system", "folder"), [("Windows_NT", "Scripts"), ("", "bin")])
def test_the_commands_call_what_a_virtual_environment_has(tmp_path, system, folder):
    """On Windows programs lie in another folder."""
    command = ["make", "-n", "-f", str(ROOT / "Makefile"), "demo", "test", f"OS={system}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert f".venv/{folder}/warpgs fit" in done.stdout and f".venv/{folder}/python -m pytest" in done.stdout
    assert ("/bin/" in done.stdout) == (folder == "bin")
