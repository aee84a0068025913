"""A small file that unpacks to much takes hardly more memory than the Gaussians that it holds, or is refused."""

import gzip
import json
import math
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from tests.export import memory_of_readers
from tests.gaussians import cloud
from warpgs.export import sog, spz
from warpgs.export.base import SH_SIZES, arrays_of, suffixes, write_gaussians

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux bounds and tells the memory of a process")


def size_of(n, degree):
    return 4 * n * (3 + 4 + 3 + 1 + 3 * SH_SIZES[degree])


def spz_bomb(path, megabytes, degree, version=3):
    """Write as many Gaussians as a file of that size may have, all alike."""
    size = megabytes * 2**20
    width = 20 + 3 * (SH_SIZES[degree] - 1)
    n = (spz.MAX_RATIO * size) // width
    if version == 3:
        packed = gzip.compress(spz.HEADER.pack(spz.MAGIC, 3, n, degree, 12, 0, 0) + b"\x40" * (width * n), 9)
        # a comment in the header makes the file as large as it claims to be
        fill = size - len(packed)
        packed = packed[:3] + b"\x10" + packed[4:10] + b"x" * (fill - 1) + b"\0" + packed[10:]
        path.write_bytes(packed)
    else:
        zstandard = pytest.importorskip("zstandard")
        lengths = [9 * n, n, 3 * n, 3 * n, 4 * n, 3 * (SH_SIZES[degree] - 1) * n]
        compressor = zstandard.ZstdCompressor(level=12)
        streams = [compressor.compress(b"\x40" * s) for s in lengths if s]
        toc = b"".join(struct.pack("<QQ", len(c), s) for c, s in zip(streams, [s for s in lengths if s]))
        data = spz.HEADER_4.pack(spz.MAGIC, 4, n, degree, 12, 0, len(streams), spz.HEADER_4.size) + toc + b"".join(streams)
        path.write_bytes(data + bytes(size - len(data)))
    return size_of(n, degree)


def sog_bomb(path, megabytes, degree):
    n = megabytes * 2**20
    side = math.ceil(math.sqrt(n))
    image = sog._webp(np.full((side, side, 4), 252, "u1"))
    names = {"means": ["l.webp", "l.webp"], "quats": ["l.webp"], "scales": ["l.webp"], "sh0": ["l.webp"]}
    book = np.linspace(-1, 1, 256).tolist()
    ranges = {"codebook": book, "mins": [0] * 3, "maxs": [1] * 3}
    meta = {"version": 2, "count": n} | {k: {"files": v} | ranges for k, v in names.items()}
    members = {"l.webp": image, "fill": bytes(n)}
    if degree:
        k = SH_SIZES[degree] - 1
        members["p.webp"] = sog._webp(np.full((sog.PALETTE // sog.COLUMNS, sog.COLUMNS * k, 4), 255, "u1"))
        meta["shN"] = {"count": sog.PALETTE, "bands": degree, "codebook": book, "files": ["p.webp", "l.webp"]}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, content in members.items():
            archive.writestr(name, content)
    return size_of(n, degree)


def large(path, n, degree):
    """Write as many Gaussians as they are, in a format that compresses nothing, or little."""
    write_gaussians(path, cloud(n, degree=degree), units="file")
    return size_of(n, degree)


QUICK = {"a.spz": lambda p: spz_bomb(p, 1, 0), "a.sog": lambda p: sog_bomb(p, 1, 0)}
MORE = {
    "b.spz": lambda p: spz_bomb(p, 2, 3), "c.spz": lambda p: spz_bomb(p, 2, 3, 4), "b.sog": lambda p: sog_bomb(p, 4, 3),
    "d.spz": lambda p: spz_bomb(p, 8, 0), "a.ply": lambda p: large(p, 300_000, 3), "a.splat": lambda p: large(p, 500_000, 0),
    "a.compressed.ply": lambda p: large(p, 300_000, 3), "a.glb": lambda p: large(p, 300_000, 3),
}  # fmt: skip


def check(folder, cases):
    files = []
    for name, make in cases.items():
        write_gaussians(folder / f"tiny{name[1:]}", cloud(3), units="file")
        files.append((str(folder / name), make(folder / name)))
    words = [sys.executable, "-m", memory_of_readers.__name__, json.dumps(files)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    found = {path.rsplit("/", 1)[1]: (beyond, refusal) for path, beyond, refusal in map(json.loads, done.stdout.splitlines())}
    assert found.keys() == cases.keys()
    assert not {name: it for name, it in found.items() if it[1] or it[0] > memory_of_readers.MEMORY}


def test_memory_beyond_the_result(tmp_path):
    check(tmp_path, QUICK)
    assert size_of(1, 3) == sum(a.nbytes for a in arrays_of(cloud(1, degree=3)).values())


@pytest.mark.fault
def test_memory_beyond_the_result_of_every_format(tmp_path):
    """And of larger files: what is held beside the result does not grow with it."""
    check(tmp_path, MORE)
    assert {suffix for name in (QUICK | MORE) for suffix in suffixes() if name[1:] == suffix} == {*suffixes()} - {".gltf"}
