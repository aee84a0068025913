"""Schemas: what is allowed passes, anything else is named with its place; size and depth are bounded."""

import json
import math

import pytest

from warpgs import schema
from warpgs.schema import SchemaError, fields, flag, items, mapping, number, one_of, or_null, parse, real, text, whole


@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (flag, [True, False], [0, 1, None, "true"]),
        (text, ["", "ä", "\udcff"], [1, None, "a\0b", "\ud800"]),
        (whole(1, 5), [1, 5], [0, 6, True, 1.0, "1", None, 10**4000]),
        (number(0), [0, 0.5, 10**18], [-1, math.nan, math.inf, True, "1", 10**400, None]),
        (number(above=0), [1e-300], [0, -0.0]),
        (real, [math.nan, -math.inf, 3], [True, "3", 10**400]),
        (one_of("a", 1), ["a", 1], ["b", True, 1.0, [], {}]),
        (or_null(flag), [None, True], [0]),
        (items(flag), [[], [True]], [[1], {}, "", None]),
        (items(flag, 2), [[True, False]], [[True], []]),
        (mapping(flag), [{}, {"a": True}], [{"a": 1}, {"a\0": True}, []]),
        (fields({"a": flag}, {"b": flag}), [{"a": True}, {"a": True, "b": False, "c": 1}], [{}, {"a": 1}, {"a": True, "b": 1}]),
        (fields({"a": flag}, others=False), [{"a": True}], [{"a": True, "c": 1}, []]),
    ],
)
def test_what_is_allowed_and_what_is_not(kind, good, bad):
    for value in good:
        kind(value, "x")
    for value in bad:
        with pytest.raises(SchemaError, match="x"):
            kind(value, "x")


def test_the_place_is_named():
    with pytest.raises(SchemaError, match=r"^a\[1\]\.b must be a finite number, not 'c'$"):
        fields({"a": items(fields({"b": number()}))})({"a": [{"b": 1}, {"b": "c"}]}, "")


@pytest.mark.parametrize("inner", ["[]", "{}", '{"a": []}'])
def test_depth_and_size_are_bounded(inner, monkeypatch):
    """Neither Python's stack nor anybody's who walks through the value is in danger."""

    def nested(depth):
        return "[" * (depth - 1) + inner + "]" * (depth - 1)

    least = parse(nested(schema.MAX_DEPTH - 1))
    assert isinstance(least, list) and json.dumps(least)
    for depth in (schema.MAX_DEPTH + 2, 100_000):
        with pytest.raises(SchemaError, match="nested deeper"):
            parse(nested(depth))
    monkeypatch.setattr(schema, "MAX_BYTES", 10)
    assert parse("[1, 2, 3]") == [1, 2, 3]
    with pytest.raises(SchemaError, match="larger"):
        parse("[1, 2, 3, 4]")


@pytest.mark.parametrize("bad", [b"", b"[", b"\xff\xfe\xfd", b"9" * 5000, b'{"a":}'])
def test_what_is_no_json(bad, tmp_path):
    (tmp_path / "a").write_bytes(bad)
    with pytest.raises(SchemaError, match="not valid JSON"):
        schema.read(tmp_path / "a")


@pytest.mark.parametrize("text", ["[" + "[]," * 20 + "[]]", b"[" + b"{}," * 20 + b"{}]"])
def test_many_lists_are_refused_before_they_are_made(text, monkeypatch):
    """Two bytes of text become seventy."""
    assert len(schema.parse(text)) == 21
    monkeypatch.setattr(schema, "MAX_PARTS", 20)
    monkeypatch.setattr(schema.json, "loads", lambda text: pytest.fail("it was parsed"))
    with pytest.raises(SchemaError, match="more than 20 lists and objects"):
        schema.parse(text)


def test_only_ordinary_files_are_read(tmp_path):
    with pytest.raises(IsADirectoryError):
        schema.read(tmp_path)
    with pytest.raises(FileNotFoundError):
        schema.read(tmp_path / "none")
