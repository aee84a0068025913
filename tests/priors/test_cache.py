"""Maps on disk: found again when nothing changed, made again when anything did or the file is damaged."""

import sys
from pathlib import Path

import numpy as np
import pytest

from warpgs.priors import networks as cache_module
from warpgs.priors.networks import MapCache, cache_folder

IMAGE = np.random.default_rng(0).random((6, 9, 3), np.float32)
NAMES = ("a", "b")


def make_maps(calls=None):
    def make():
        if calls is not None:
            calls.append(1)
        return tuple(np.full((6, 9), v, np.float32) for v in (0.25, 1.0))

    return make


def test_a_second_call_reads_what_the_first_made(tmp_path):
    calls, store = [], MapCache(tmp_path / "deep" / "folder")
    first = store.maps(IMAGE, NAMES, {"model": "x"}, make_maps(calls))
    again = MapCache(store.folder)
    second = again.maps(IMAGE.copy(), NAMES, {"model": "x"}, make_maps(calls))
    assert len(calls) == 1 and (again.found, again.made, again.notes) == (1, 0, [])
    for f, s in zip(first, second):
        np.testing.assert_array_equal(f, s)
    assert [p.suffix for p in store.folder.iterdir()] == [".safetensors"], "nothing temporary is left"


def test_whatever_decides_the_maps_decides_the_entry(tmp_path, monkeypatch):
    store, calls = MapCache(tmp_path), []
    changed = IMAGE.copy()
    changed[3, 4, 1] = np.nextafter(changed[3, 4, 1], 2)
    cases = [(IMAGE, {"m": 1}), (changed, {"m": 1}), (IMAGE, {"m": 2}), (IMAGE.reshape(9, 6, 3), {"m": 1})]
    for image, decided_by in cases:
        store.maps(image, NAMES, decided_by, make_maps(calls))
    store.maps(IMAGE, ("a", "c"), {"m": 1}, make_maps(calls))
    monkeypatch.setattr(cache_module, "CODE", cache_module.CODE + 1)
    store.maps(IMAGE, NAMES, {"m": 1}, make_maps(calls))
    assert len(calls) == 6 == len(list(tmp_path.iterdir()))


def damage(path: Path, how: str) -> None:
    from safetensors.numpy import save

    good = path.read_bytes()
    one = np.ones((6, 9), np.float32)
    path.write_bytes(
        {
            "empty": b"",
            "cut off": good[: len(good) // 2],
            "noise": bytes(200),
            "one map short": save({"a": one}),
            "another shape": save({"a": one.T.copy(), "b": one}),
            "another type": save({"a": one.astype(np.float64), "b": one}),
            "NaN": save({"a": one * np.nan, "b": one}),
            "out of range": save({"a": one * 2, "b": one}),
        }[how]
    )


HOW = ("empty", "cut off", "noise", "one map short", "another shape", "another type", "NaN", "out of range")


@pytest.mark.parametrize("how", HOW)
def test_a_damaged_entry_is_made_again_with_a_note(tmp_path, how):
    MapCache(tmp_path).maps(IMAGE, NAMES, {}, make_maps())
    (path,) = tmp_path.iterdir()
    damage(path, how)
    store = MapCache(tmp_path)
    maps = store.maps(IMAGE, NAMES, {}, make_maps())
    assert (maps[0] == 0.25).all() and (maps[1] == 1).all() and store.made == 1
    assert len(store.notes) == 1 and "computed again" in store.notes[0] and str(path) in store.notes[0]
    mended = MapCache(tmp_path)
    mended.maps(IMAGE, NAMES, {}, make_maps())
    assert mended.found == 1 and mended.notes == []


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path):
    (tmp_path / "file").write_text("in the way")
    store = MapCache(tmp_path / "file" / "maps")
    for seed in range(3):
        maps = store.maps(IMAGE + seed, NAMES, {}, make_maps())
        assert (maps[1] == 1).all()
    assert len(store.notes) == 1 and "WARPGS_CACHE" in store.notes[0]


def test_where_the_cache_lies(monkeypatch, tmp_path):
    home, system = tmp_path / "home", tmp_path / "system"
    monkeypatch.setattr(Path, "home", lambda: home)
    for name in ("WARPGS_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert cache_folder() == home / ".cache" / "warpgs"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == home / ".cache" / "warpgs"
    monkeypatch.setenv("XDG_CACHE_HOME", str(system))
    assert cache_folder() == system / "warpgs"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert cache_folder() == home / "Library" / "Caches" / "warpgs"
    monkeypatch.setattr(sys, "platform", "win32")
    assert cache_folder() == home / "AppData" / "Local" / "warpgs" / "Cache"
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
