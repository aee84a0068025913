"""What is installed: pinned with hashes, and under licences that let everybody use it."""

import importlib.metadata
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.conftest import without_missing_extras

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
ALLOWED = {
    "0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "ISC", "MIT", "MIT-0", "MIT-CMU", "MPL-2.0",
    "PSF-2.0", "Zlib", "LLVM-exception",
}  # fmt: skip
"""Licences by their SPDX names; none asks for the source of what is built on it, none forbids a use."""
FORBIDDEN = re.compile(r"\bA?GPL|GNU (Affero )?General Public|non-?commercial|\bCC-BY-NC", re.IGNORECASE)
NVIDIA = ("nvidia-", "cuda-")
"""Beginnings of names of CUDA libraries, of which docs/dependencies.md speaks by itself."""
COPYLEFT = {"pi-heif": {"LGPL-3.0-only"}, "pycolmap": {"LGPL-2.1-or-later", "GPL-2.0-or-later"}}
"""Licences of libraries inside the wheels of the extra `poses`, of which docs/dependencies.md says what follows from them."""
UNLOCKED = ("export",)
"""Extras that are in no lock: large, and needed by slow tests alone."""
EXPLAINED = ("docutils",)
"""Packages whose metadata name a licence of files that are not in the wheel, as docs/dependencies.md explains."""


def plain(requirement: str) -> str:
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
    rows = re.findall(r"^\| (\w+) \| ([^|]+) \| ([a-z0-9, -]+) \|$", text, re.MULTILINE)
    return {name: (licence, use) for use, licence, names in rows for name in names.split(", ")}


def test_the_lock_is_of_this_project():
    """All that pyproject.toml asks for, at the versions of constraints.txt, with all extras that tests need, and no place."""
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    lock, extras = locked(), PROJECT["optional-dependencies"]
    named = {plain(r) for e in extras.keys() - set(UNLOCKED) - {"dev"} for r in extras[e]}
    named |= {plain(r) for r in PROJECT["dependencies"]}
    assert named | {plain(r) for r in extras["dev"]} <= lock.keys()
    assert named <= pins.keys()
    assert {n: [v] for n, v in pins.items()} == {n: lock[n] for n in pins}
    text, makefile = ((ROOT / name).read_text("utf-8") for name in ("requirements.lock", "Makefile"))
    assert [n for n in text.splitlines() if re.search(r"file:|://|--(extra-)?index|--find-links|/opt/| @ ", n)] == []
    needed = sorted(extras.keys() - set(UNLOCKED))
    assert re.findall(r"--extra (\w+)", text.partition("==")[0]) == needed
    assert f"EXTRAS ?= {','.join(needed)}\nexport WARPGS_EXTRAS_INSTALLED := 1" in makefile


def test_every_package_stands_in_the_table_with_its_use():
    wanted = {n: "indirect" for n in locked() if not n.startswith(NVIDIA)}
    for extra in PROJECT["optional-dependencies"]:
        wanted |= {plain(r): extra for r in PROJECT["optional-dependencies"][extra]}
    wanted |= {plain(r): "fit" for r in PROJECT["dependencies"]}
    assert {n: use for n, (_, use) in table().items()} == wanted
    for name, (licence, _) in table().items():
        assert set(re.split(r" AND | OR | WITH ", licence)) <= ALLOWED | COPYLEFT.get(name, set()), name
    assert {name for name, (_, use) in table().items() if use == "poses"} == COPYLEFT.keys()
    # installed packages say the same by the field that the index shows; long texts hold licences of compiled parts
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


def test_actions_and_images_are_named_by_what_they_contain():
    """A commit or a digest; a tag can be moved to other code. The version stands beside it."""
    used = [n for p in (ROOT / ".github").rglob("*.yml") for n in re.findall(r"uses:.*", p.read_text("utf-8"))]
    assert used and [n for n in used if not re.fullmatch(r"uses: [\w./-]+@[0-9a-f]{40}  # v[0-9.]+", n)] == []
    assert len(set(used)) == len({n.partition("@")[0] for n in used}), "one version of each"
    bases, stages = zip(*re.findall(r"^FROM (\S+) AS (\S+)$", (ROOT / "Dockerfile").read_text("utf-8"), re.MULTILINE))
    assert [b for b in bases if b not in stages and not re.fullmatch(r"[\w./-]+:[\w.-]+@sha256:[0-9a-f]{64}", b)] == []


def test_an_image_installs_as_its_user_files_that_are_there():
    """Root installs the system's libraries alone; what COPY names is in the project."""
    text = (ROOT / "Dockerfile").read_text("utf-8")
    root, _, user = text.partition("USER warpgs\n")
    assert root.count("\nRUN ") == 1 and "apt-get install" in root and user.count("\nRUN ") >= 6 and "USER" not in user
    named = [name for line in re.findall(r"^COPY --chown=warpgs (.*)$", user, re.MULTILINE) for name in line.split()[:-1]]
    assert named and [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize(
    ("reason", "fails"),
    [("could not import 'viser'", True), ("onnx not installed: pip install '.[export]'", False), ("no CUDA device", False)],
)
def test_a_skipped_test_fails_where_all_extras_are_said_to_be_installed(monkeypatch, reason, fails):
    """The Makefile says so; who runs pytest without them sees the test skipped."""
    for value, outcome in (("1", "failed" if fails else "skipped"), ("", "skipped")):
        monkeypatch.setenv("WARPGS_EXTRAS_INSTALLED", value)
        report = SimpleNamespace(skipped=True, outcome="skipped", longrepr=("a_test.py", 3, f"Skipped: {reason}"))
        assert without_missing_extras(report).outcome == outcome
