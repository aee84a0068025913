"""Sizes in bytes: what is read, what is refused, what is written."""

import pytest

from warpgs.device import format_bytes, parse_bytes
from warpgs.errors import UsageError


@pytest.mark.parametrize(
    ("text", "size"), [("2GiB", 2**31), ("512 MB", 512 * 10**6), ("1.5kib", 1536), (".5 TB", 5 * 10**11), ("7B", 7)]
)
def test_sizes_are_read(text, size):
    """Powers of 1000 and of 1024, any case, with or without a space."""
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["", "2", "GiB", "-1GiB", "1e3MB", "nan GB", "0.1B", "2GiB!", "9" * 400 + "B", "٣GiB"])
def test_nonsense_is_no_size(text):
    """Without a unit it may be anything."""
    with pytest.raises(UsageError, match="memory limit"):
        parse_bytes(text)


def test_sizes_are_written():
    """One figure behind the point from MiB on."""
    assert [format_bytes(n) for n in (5, 2048, 3 * 2**20, 2.5 * 2**30, 2**41)] == [
        "5 B",
        "2 KiB",
        "3.0 MiB",
        "2.5 GiB",
        "2.0 TiB",
    ]
