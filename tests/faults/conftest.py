"""The commands run once without a fault, for all tests of this folder: with pytest-xdist one worker runs them for all."""

import json
import os

import pytest
from filelock import FileLock

from tests.faults.tiny_runs import Reference, build_reference


@pytest.fixture(scope="session")
def reference(tmp_path_factory) -> Reference:
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "reference"
    with FileLock(folder.with_suffix(".lock")):
        if not (folder / "reference.json").is_file():
            folder.mkdir()
            build_reference(folder)
    return Reference(folder, folder / "scene", **json.loads((folder / "reference.json").read_text()))
