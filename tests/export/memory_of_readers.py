"""Child of `test_memory`: reads each file named, and prints the most memory that it took beyond its result.

The address space is bounded first, so that a reader that takes too much fails at once, whatever else the machine does.
"""

import json
import resource
import sys
from pathlib import Path

from warpgs.errors import DataError
from warpgs.export.base import read_gaussians

ROOM = 64 * 2**20


def status(key):
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


def measured(path, result):
    """Return what reading takes beyond ``result`` and the file itself [bytes], and the words of a refusal."""
    needed = result + path.stat().st_size
    limit = status("VmSize") + needed + 2 * ROOM  # the allocator keeps some for itself
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    Path("/proc/self/clear_refs").write_text("5")
    before, words = status("VmRSS"), ""
    try:
        read_gaussians(path)
    except DataError as e:
        words = str(e)
    peak = status("VmHWM") - before
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return peak - needed, words


if __name__ == "__main__":
    files = json.loads(sys.argv[1])
    for path in {Path(p).suffix: p for p, _ in files}.values():  # imports and caches of the decoders
        read_gaussians(Path(path).with_name("tiny" + "".join(Path(path).suffixes)))
    for path, result in files:
        print(json.dumps([path, *measured(Path(path), result)]), flush=True)
