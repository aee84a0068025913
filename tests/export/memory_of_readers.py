"""Child of `test_memory`: reads each file named, in bounded memory, and prints the most that it took beyond its result."""

import json
import resource
import sys
from pathlib import Path

import psutil

from tests.faults.bounds import MEMORY, PeakMemory
from warpgs.errors import DataError
from warpgs.export.base import read_gaussians


def measured(path, result):
    """Return what reading takes beyond ``result`` and the file itself [bytes], and the words of a refusal."""
    needed = result + path.stat().st_size
    limit = psutil.Process().memory_info().vms + needed + 2 * MEMORY  # the allocator keeps some for itself
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    peak, words = PeakMemory(), ""
    try:
        read_gaussians(path)
    except DataError as e:
        words = str(e)
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return peak.grown() - needed, words


if __name__ == "__main__":
    files = json.loads(sys.argv[1])
    for path in {Path(p).suffix: p for p, _ in files}.values():  # imports and caches of the decoders
        read_gaussians(Path(path).with_name("tiny" + "".join(Path(path).suffixes)))
    for path, result in files:
        print(json.dumps([path, *measured(Path(path), result)]), flush=True)
