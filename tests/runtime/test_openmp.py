"""Idle threads of OpenMP: they sleep where warpgs is imported first, and a warning says so where they do not."""

import os
import subprocess
import sys

import pytest

RENDER = """
n = 5000
g = warpgs.Gaussians(torch.rand(n, 3), torch.rand(n, 4), torch.rand(n, 3) - 4, torch.zeros(n), torch.zeros(n, 1, 3))
camera = warpgs.Camera(torch.eye(4), torch.eye(3), 16, 16)
for threads in (1, 2, 2):
    torch.set_num_threads(threads)
    warpgs.rasterize(g, camera)
    print("rendered", threads, file=sys.stderr)
"""
"""5,000 Gaussians are enough work for the threads of a launch (`interop.SERIAL_WORK`)."""


@pytest.mark.parametrize(
    "imports, policy, warned", [("torch, warpgs", None, 1), ("warpgs, torch", None, 0), ("torch, warpgs", "active", 0)]
)
def test_a_warning_where_torch_was_imported_first(imports, policy, warned):
    """Once, in the first render with threads, unless the environment says how OpenMP waits."""
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    if policy:
        environment["OMP_WAIT_POLICY"] = policy
    code = f"import sys\nimport {imports}\n{RENDER}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    alone, *threaded = done.stderr.split("rendered 1")
    assert "OMP_WAIT_POLICY" not in alone
    assert threaded[0].count("import warpgs before torch, or set OMP_WAIT_POLICY=passive") == warned
    assert threaded[0].count("<string>:9: RuntimeWarning") == warned  # the line that calls rasterize
