"""What is installed: pinned with hashes, and under licences that let everybody use it."""

import importlib.metadata
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
ALLOWED = {
    "0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "ISC", "MIT", "MIT-CMU", "MPL-2.0",
    "PSF-2.0", "Zlib", "LLVM-exception",
}  # fmt: skip
"""Licences by their SPDX names; none asks for the source of what is built on it, none forbids a use."""
FORBIDDEN = re.compile(r"\bA?GPL|GNU (Affero )?General Public|non-?commercial|\bCC-BY-NC", re.IGNORECASE)
NVIDIA = ("nvidia-", "cuda-")
"""Beginnings of names of CUDA libraries, of which docs/dependencies.md speaks by itself."""
EXPLAINED = ("docutils",)
"""Packages whose metadata name a licence of files that are not in the wheel, as docs/dependencies.md explains."""


def plain(requirement: str) -> str:
    """The name in a requirement, as package indexes write it."""
    return re.sub(r"[-_.]+", "-", re.match(r"[A-Za-z0-9._-]+", requirement)[0]).lower()


def locked() -> dict[str, list[str]]:
    """Versions by name in the lock; every one must have hashes."""
    found: dict[str, list[str]] = {}
    for part in re.split(r"\n(?=[a-z])", (ROOT / "requirements.lock").read_text("utf-8"))[1:]:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", part), part[:80]
        name, version = re.match(r"([a-z0-9-]+)==([^ ]+)", part).groups()
        found.setdefault(name, []).append(version)
    return found


def table() -> dict[str, tuple[str, str]]:
    """Licence and use by name in docs/dependencies.md."""
    _, _, text = (ROOT / "docs" / "dependencies.md").read_text("utf-8").partition("|---|---|---|")
    rows = re.findall(r"^\| ([a-z0-9-]+) \| ([^|]+) \| ([^|]+) \|$", text, re.MULTILINE)
    return {name: (licence.strip(), use.strip()) for name, licence, use in rows}


def test_the_lock_is_of_this_project():
    """It holds all that pyproject.toml asks for, at the versions of constraints.txt."""
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    lock = locked()
    assert {plain(r) for r in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]} <= lock.keys()
    assert {n: [v] for n, v in pins.items()} == {n: lock[n] for n in pins}


def test_every_package_stands_in_the_table_with_its_use():
    wanted = {n: "indirect" for n in locked() if not n.startswith(NVIDIA)}
    for extra in PROJECT["optional-dependencies"].keys() - {"dev"}:
        wanted |= {plain(r): extra for r in PROJECT["optional-dependencies"][extra]}
    wanted |= {plain(r): "tests and documents" for r in PROJECT["optional-dependencies"]["dev"]}
    wanted |= {plain(r): "fit" for r in PROJECT["dependencies"]}
    assert {n: use for n, (_, use) in table().items()} == wanted


def test_no_licence_forbids_or_demands():
    for name, (licence, _) in table().items():
        assert set(re.split(r" AND | OR | WITH ", licence)) <= ALLOWED, name


def test_installed_packages_say_the_same():
    """By the field that the index shows; long texts hold the licences of compiled parts, which the document speaks of."""
    checked = 0
    for name, (licence, _) in table().items():
        try:
            said = importlib.metadata.metadata(name)
        except importlib.metadata.PackageNotFoundError:  # of another system, or of the extra
            continue
        short = [t for t in said.get_all("License") or [] if len(t) < 80]
        classes = [c for c in said.get_all("Classifier") or [] if c.startswith("License")]
        assert name in EXPLAINED or not [t for t in [*short, *classes] if FORBIDDEN.search(t)], name
        expression = said.get("License-Expression")
        assert expression in (None, licence), name
        checked += 1
    assert checked > 40
