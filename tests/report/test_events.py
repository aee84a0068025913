import json
import math

import pytest

from warpgs.errors import ResourceError
from warpgs.files import write_bytes, write_json
from warpgs.report.progress import EventLog, read_events


def fill(path, steps, start=0):
    log = EventLog(path, start)
    for step in steps:
        log.write(step=step, loss=1 / step, psnr=20.0, count=5, seconds=0.1)
    log.close()


def test_every_event_is_a_line_of_strict_json(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = EventLog(path)
    log.write(step=1, loss=0.5, psnr=math.inf, count=7)
    log.write(step=2, loss=math.nan, psnr=21.5, count=8)
    log.flush()

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    lines = [json.loads(line, parse_constant=refuse) for line in path.read_text().splitlines()]
    assert lines == [
        {"step": 1, "loss": 0.5, "psnr": None, "count": 7},
        {"step": 2, "loss": None, "psnr": 21.5, "count": 8},
    ]
    log.close()
    assert math.isnan(read_events(path)[0]["psnr"]) and math.isnan(read_events(path)[1]["loss"])


def test_resume_forgets_what_came_after_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.jsonl"
    fill(path, range(1, 11))
    fill(path, range(7, 9), start=6)
    assert [e["step"] for e in read_events(path)] == [1, 2, 3, 4, 5, 6, 7, 8]


def test_resume_after_a_kill_in_the_middle_of_a_line(tmp_path):
    path = tmp_path / "metrics.jsonl"
    fill(path, range(1, 4))
    with path.open("ab") as f:
        f.write(b'{"step": 4, "lo')
    assert [e["step"] for e in read_events(path)] == [1, 2, 3]
    fill(path, [4], start=3)
    assert [e["step"] for e in read_events(path)] == [1, 2, 3, 4]
    assert path.read_bytes().count(b"\n") == 4


def test_a_new_fit_starts_empty_and_resume_without_a_log_works(tmp_path):
    path = tmp_path / "metrics.jsonl"
    fill(path, range(1, 4))
    EventLog(path).close()
    assert path.read_bytes() == b""
    path.unlink()
    fill(path, [5], start=4)
    assert [e["step"] for e in read_events(path)] == [5]


def test_lines_that_are_no_events_are_skipped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'[1]\n"x"\n{"loss": 1}\n{"step": "1"}\n\n\xff\n{"step": 3}\n')
    assert read_events(path) == [{"step": 3}]


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(ResourceError, match="no"):
        EventLog(tmp_path / "no" / "metrics.jsonl")


@pytest.mark.parametrize("stage", ["os.fsync", "os.replace"])
def test_a_failing_write_leaves_the_old_file_alone(tmp_path, monkeypatch, stage):
    path = tmp_path / "a.json"
    write_json(path, {"old": 1})

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"warpgs.files.{stage}", full)
    with pytest.raises(ResourceError, match="No space left"):
        write_bytes(path, b"new")
    monkeypatch.undo()
    assert json.loads(path.read_text()) == {"old": 1} and list(tmp_path.iterdir()) == [path]


def test_json_holds_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"a": [math.nan, 1.5], "b": (math.inf,), "c": {"d": 2}})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, 1.5], "b": [None], "c": {"d": 2}}
