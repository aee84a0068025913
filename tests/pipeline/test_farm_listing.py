"""What a farm is given: folders, globs, and files of jobs that anybody may have written."""

from pathlib import Path

import pytest

from tests.pipeline.farms import write_scenes
from warpgs.errors import DataError, UsageError
from warpgs.pipeline.farm.job import list_jobs


def test_folders_and_globs(tmp_path):
    """Each folder is a scene, hidden ones are not; equal names are told apart by the folders above."""
    for name in ("b/scene", "a/scene", ".hidden"):
        (tmp_path / name).mkdir(parents=True)
    assert [j[:2] for j in list_jobs(str(tmp_path))] == [("a", tmp_path / "a"), ("b", tmp_path / "b")]
    assert [j[0] for j in list_jobs(f"{tmp_path}/*/scene")] == ["a-scene", "b-scene"]
    with pytest.raises(UsageError, match="no scene found"):
        list_jobs(f"{tmp_path}/*/nothing")


def test_a_scene_is_no_folder_of_scenes(tmp_path):
    write_scenes(tmp_path, 1)
    with pytest.raises(UsageError, match="is a single scene: fit it with `warpgs fit`"):
        list_jobs(str(tmp_path / "s0"))


def test_lines_are_flags_of_fit(tmp_path):
    """Relative paths are from the file; booleans are switches, in groups too."""
    path = tmp_path / "jobs.jsonl"
    path.write_text('{"scene": "x", "steps": 5, "refine_poses": true, "method.pm": false}\n\n{"scene": "/y", "name": "z"}')
    first, second = list_jobs(str(path))
    assert first == ("x", tmp_path / "x", ("--steps=5", "--refine-poses", "--method.no-pm"))
    assert second == ("z", Path("/y"), ())


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("{", "not valid JSON"),
        ("[]", "must be an object"),
        ('{"name": "a"}', "scene is missing"),
        ('{"scene": 3}', "scene must be text"),
        ('{"scene": "a", "name": "../b"}', "is not a valid name"),
        ('{"scene": "a", "name": "index.html"}', "is not a valid name"),
        ('{"scene": "a", "out": "/b"}', "cannot be set for a single job"),
        ('{"scene": "a", "allow_outside": true}', "cannot be set"),
        ('{"scene": "a", "strategy": "evil.py:Evil"}', "names user code"),
        ('{"scene": "a", "view_modules": "evil.py:Evil"}', "names user code"),
        ('{"scene": "a", "steps": [1]}', "must be text"),
        ('{"scene": "a", "--steps": 1}', "cannot be set"),
        ('{"scene": "a\\u0000"}', "without a zero byte"),
        ('{"scene": "a", "name": ".b"}', "is not a valid name"),
        ('{"scene": "a", "name": "%s"}' % (100 * "写"), "has 300 bytes, but a job's name may have at most 200"),
        ('{"scene": "a", "name": "%s"}' % (101 * "x"), "is not a valid name"),
        ("[" * 60 + "]" * 60, "nested deeper"),
    ],
)
def test_lines_that_are_no_jobs(tmp_path, line, word):
    """One sentence, with the number of the line where it is the line's fault."""
    path = tmp_path / "jobs.jsonl"
    path.write_text(line, "utf-8")
    with pytest.raises(DataError, match=word):
        list_jobs(str(path))


def test_the_longest_name(tmp_path):
    """It is a folder, beside which one with a longer name can lie."""
    path = tmp_path / "jobs.jsonl"
    path.write_text('{"scene": "a", "name": "%s"}' % (66 * "写"), "utf-8")
    ((name, _, _),) = list_jobs(str(path))
    (tmp_path / f"{name}.old1").mkdir()


def test_two_jobs_need_two_names(tmp_path):
    path = tmp_path / "jobs.jsonl"
    path.write_text('{"scene": "a/x"}\n{"scene": "b/X"}')
    with pytest.raises(UsageError, match=r"jobs\.jsonl: two jobs have the name 'X'"):
        list_jobs(str(path))
