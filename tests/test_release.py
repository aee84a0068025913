"""What `make release` writes: the wheel has every file of the package, and the sdist builds it again."""

import email
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from pathlib import Path

import pytest

from warpgs import __version__

pytest.importorskip("hatchling")

ROOT = Path(__file__).parent.parent
DATA = {".cu", ".css", ".html", ".py", ".toml", ".typed"}
"""Endings of the files of the package."""


def build(source: Path, out: Path, kind: str) -> Path:
    """Build `kind` ("wheel" or "sdist") of the project in `source`, without a network; return its file."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", kind, "--directory", str(out)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (file,) = out.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return file


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The wheel, the sdist, and the wheel that is built from the sdist."""
    folder = tmp_path_factory.mktemp("release")
    wheel, sdist = build(ROOT, folder / "wheel", "wheel"), build(ROOT, folder / "sdist", "sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    return wheel, sdist, build(folder / f"warpgs-{__version__}", folder / "again", "wheel")


def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        return email.message_from_bytes(archive.read(f"warpgs-{__version__}.dist-info/METADATA"))


def test_the_wheel_has_every_file_of_the_package_and_nothing_else(release):
    with zipfile.ZipFile(release[0]) as archive:
        names = {n for n in archive.namelist() if ".dist-info/" not in n}
    files = (p for p in (ROOT / "warpgs").rglob("*") if p.is_file() and "__pycache__" not in p.parts)
    assert names == {p.relative_to(ROOT).as_posix() for p in files}
    assert {Path(n).suffix for n in names} == DATA


def test_the_sdist_builds_the_same_wheel(release):
    """Byte for byte, from the package and the files that describe it alone."""
    wheel, sdist, again = release
    assert again.name == wheel.name == f"warpgs-{__version__}-py3-none-any.whl"
    assert again.read_bytes() == wheel.read_bytes()
    with tarfile.open(sdist) as archive:
        first = {n.split("/")[1] for n in archive.getnames()}
    described = {"CHANGELOG.md", "CITATION.cff", "LICENSE", "PKG-INFO", "README.md", "pyproject.toml"}
    assert first - {".gitignore"} == {"warpgs", *described}


def test_the_metadata_name_version_licence_pythons_and_command(release):
    known = metadata(release[0])
    assert (known["Version"], known["License-Expression"], known["License-File"]) == (__version__, "Apache-2.0", "LICENSE")
    assert set(known["Requires-Python"].split(",")) == {">=3.11", "<3.14"}
    python = "Programming Language :: Python :: 3."
    named = [c.removeprefix(python) for c in known.get_all("Classifier") if c.startswith(python)]
    assert named == ["11", "12", "13"]
    with zipfile.ZipFile(release[0]) as archive:
        commands = archive.read(f"warpgs-{__version__}.dist-info/entry_points.txt").decode()
    plugin = ["[nerfstudio.method_configs]", "warpgs", "=", "warpgs.compat.nerfstudio:METHOD"]
    assert commands.split() == ["[console_scripts]", "warpgs", "=", "warpgs.app.cli:main", *plugin]
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
