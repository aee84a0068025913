"""Farms: each job once, whatever dies, and the same bytes as single fits."""

import contextlib
import csv
import importlib.util
import json
import os
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.pipeline.fake_slurm import install_slurm
from tests.pipeline.farms import HereEngine, jobs_of, write_scenes
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.files import make_folder
from warpgs.locks import hold_folder
from warpgs.pipeline.farm import job as record
from warpgs.pipeline.farm import work
from warpgs.pipeline.farm.farm import LocalEngine, local_slots, run_farm
from warpgs.pipeline.farm.job import (
    CHECKED,
    LOG,
    PLY,
    RECORD,
    THUMBNAIL,
    file_digest,
    finished,
    job_of,
    job_text,
    read_job_record,
)
from warpgs.pipeline.farm.slurm import SlurmEngine
from warpgs.pipeline.farm.work import Outcome, run_job
from warpgs.pipeline.run.fit import fit_request
from warpgs.pipeline.train.loss import LOSS_TERMS
from warpgs.pipeline.train.presets import PRESETS, preset_settings
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.process import run_python
from warpgs.ranks import is_loopback, listeners


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder with two scenes."""
    return write_scenes(tmp_path_factory.mktemp("data") / "scenes")


@pytest.fixture(scope="module")
def single(scenes, tmp_path_factory):
    """SHA-256 of the PLY file that `fit` alone makes of each scene."""
    found = {}
    for job in jobs_of(scenes, tmp_path_factory.mktemp("single")):
        fit_request(job.request)
        found[job.name] = file_digest(job.request.out / PLY)
    return found


@pytest.fixture(scope="module")
def done(scenes, tmp_path_factory):
    """Results of a farm in this process."""
    out = tmp_path_factory.mktemp("done") / "results"
    run_farm(jobs_of(scenes, out), HereEngine())
    return out


@pytest.fixture
def unfitted(monkeypatch):
    """Let jobs end without a fit, with files that hold their names: for tests of who does what."""

    def pretend(request, *_, **__):
        make_folder(request.out)
        for name in CHECKED:
            (request.out / name).write_text(request.scene.path)
        return Outcome("fitted", {"test": {}, "steps": 1})

    monkeypatch.setattr(work, "ensure_run", pretend)
    monkeypatch.setattr(work, "_wanted", lambda *_: ("", None, None))
    return pretend


@pytest.fixture
def results(done, tmp_path):
    """A copy of them."""
    return shutil.copytree(done, tmp_path / "results", dirs_exist_ok=True)


def digests(statuses):
    return {s.job.name: s.record.files.get(PLY) for s in statuses}


TERM = """
import os
from dataclasses import dataclass
from pathlib import Path
from warpgs.pipeline.train.loss import LossTerm

@dataclass(frozen=True)
class Blocks(LossTerm):
    folder: str = ""

    def active(self, step, steps):
        mark = Path(self.folder, "mark")
        if step == 5 and not mark.exists():
            mark.touch()
            Path(self.folder, "pipe").open()  # nobody ever writes there
        return False
"""
"""A loss term of no effect that stops the first fit that has it before its fifth step."""


def test_processes_give_the_bytes_of_single_fits_and_one_that_is_killed_is_replaced(scenes, single, tmp_path, monkeypatch):
    """The process of the first job is killed in the middle of its fit; code of the user's own is loaded there, too."""
    monkeypatch.setattr(LOSS_TERMS, "_classes", dict(LOSS_TERMS._classes))
    (tmp_path / "term.py").write_text(TERM)
    os.mkfifo(tmp_path / "pipe")
    term = LOSS_TERMS.load(f"{tmp_path / 'term.py'}:Blocks")
    engine, killed = LocalEngine(local_slots("cpu", 1, 1)), []
    jobs = jobs_of(scenes, tmp_path / "out", loss_terms=(term(str(tmp_path)),))

    def show(statuses):
        if (tmp_path / "mark").exists() and not killed:
            killed.append(statuses[0].step)
            os.kill(engine.workers()["s0"], signal.SIGKILL)

    try:
        statuses = run_farm(jobs, engine, show, poll=0.1)
    finally:
        engine.close()
    assert killed and [s.attempts for s in statuses] == [2, 1]
    assert [s.state for s in statuses] == ["done", "done"] and "killed by signal 9" in statuses[0].notes[0]
    assert digests(statuses) == single and statuses[0].record.how == "continued"
    assert "held-out PSNR" in (tmp_path / "out" / "s1" / LOG).read_text("utf-8")
    assert (tmp_path / "out" / "s1" / THUMBNAIL).is_file()


def test_a_rerun_skips_what_is_finished_and_valid(scenes, single, results):
    """Nothing is started; a changed byte, setting or photograph starts that job alone."""
    engine = HereEngine()
    assert [s.state for s in run_farm(jobs_of(scenes, results), engine)] == ["done", "done"] and engine.begun == []
    ply = results / "s1" / "run" / PLY
    data = bytearray(ply.read_bytes())
    data[-1] ^= 1
    ply.write_bytes(data)
    statuses = run_farm(jobs_of(scenes, results), engine)
    assert engine.begun == ["s1"] and digests(statuses) == single
    assert [s.record.how for s in statuses] == ["fitted", "continued"]


def test_links_that_double_a_scene_at_each_level_are_not_listed(tmp_path, monkeypatch):
    """40 folders with two links each to the next would be a million million folders."""
    monkeypatch.setattr(record, "MOST_FILES", 100)
    for level in range(7):
        (tmp_path / f"{level}").mkdir()
        for name in "ab":
            (tmp_path / f"{level}" / name).symlink_to(tmp_path / f"{level + 1}")
    (tmp_path / "7").mkdir()
    for level in ("0", "3"):
        (tmp_path / level / "image.png").touch()
    assert record.source_stamp(tmp_path / "3") and not record.source_stamp(tmp_path / "0")  # 31 folders, and 255


def test_touched_photographs_are_read_again_and_the_run_is_kept(scenes, results, tmp_path):
    """Other times of files are no other data; another setting is another run, and the old one is moved aside."""
    copied = shutil.copytree(scenes, tmp_path / "scenes")
    moved = [replace(j, request=replace(j.request, scene=replace(j.request.scene, path=str(copied / j.name))))
             for j in jobs_of(scenes, results)]  # fmt: skip
    assert all(finished(j) is None for j in moved)
    assert [s.record.how for s in run_farm(moved, HereEngine())] == ["kept", "kept"]
    (status,) = run_farm(jobs_of(scenes, results, steps=4)[:1], HereEngine())
    assert (status.record.how, status.record.steps) == ("redone", 4)
    assert (results / "s0" / "run.old1").is_dir()


def test_settings_that_follow_from_the_views_are_the_same_settings(scenes, tmp_path):
    """The default preset leaves some open, which the record of a run has as chosen: finished runs are kept all the same."""
    assert PRESETS["default"].half_resolution is None
    (job, _) = jobs_of(scenes, tmp_path)
    open_job = replace(job, request=replace(job.request, config=replace(job.request.config, half_resolution=None)))
    run_farm([open_job], HereEngine())
    (tmp_path / "s0" / RECORD).unlink()
    (status,) = run_farm([open_job], HereEngine())
    assert status.record.how == "kept"


def test_a_second_farm_on_the_folder_takes_over_what_the_first_one_does(scenes, unfitted, tmp_path):
    """While the first farm is in the middle of a job, the second one does the other and waits; neither job is done twice."""
    jobs, second, states = jobs_of(scenes, tmp_path), HereEngine(), []

    def meanwhile(text):
        inner = run_farm_until_alone(jobs, second, states)
        assert inner == "waits"
        return run_job(text)

    first = HereEngine(meanwhile)
    statuses = run_farm(jobs, first)
    assert first.begun == ["s0"] and second.begun == ["s1"]
    assert states[-1] == ["elsewhere", "done"] and [s.state for s in statuses] == ["done", "done"]
    again = HereEngine()
    assert digests(run_farm(jobs, again)) == digests(statuses) and again.begun == []


class Alone(Exception):
    """The second farm has nothing left but jobs of the first."""


def run_farm_until_alone(jobs, engine, states):
    def show(statuses):
        states.append([s.state for s in statuses])
        if states[-1] == ["elsewhere", "done"]:
            raise Alone

    try:
        run_farm(jobs, engine, show, poll=0)
    except Alone:
        return "waits"
    return "ended"


def test_what_another_farm_finishes_is_taken_over_when_its_lock_is_gone(scenes, unfitted, tmp_path):
    """A farm that waits for a job looks again, and finds it done."""
    jobs, engine = jobs_of(scenes, tmp_path / "out"), HereEngine()
    with contextlib.ExitStack() as other:
        other.enter_context(hold_folder(jobs[0].folder))

        def show(statuses):
            if [s.state for s in statuses] == ["elsewhere", "done"]:
                work.fit_job(jobs[0])
                other.close()

        statuses = run_farm(jobs, engine, show, poll=0)
    assert engine.begun == ["s1"] and [s.state for s in statuses] == ["done", "done"]


@pytest.mark.parametrize(
    ("error", "attempts"), [(MemoryError("no room"), 2), (RuntimeError("no luck"), 2), (DataError("no scene"), 1)]
)
def test_crashes_and_lack_of_memory_cost_one_scene_and_are_tried_again(
    scenes, unfitted, tmp_path, monkeypatch, error, attempts
):
    """What a user must fix is not."""
    jobs = jobs_of(scenes, tmp_path)

    def fail(request, *rest, **named):
        if request.out.parent.name == "s0":
            raise error
        return unfitted(request, *rest, **named)

    monkeypatch.setattr(work, "ensure_run", fail)
    statuses = run_farm(jobs, HereEngine())
    assert [s.state for s in statuses] == ["failed", "done"] and statuses[0].attempts == attempts
    assert read_job_record(jobs[0].folder).message == statuses[0].record.message and str(error) in statuses[0].record.message
    monkeypatch.setattr(work, "ensure_run", unfitted)
    assert [s.state for s in run_farm(jobs, HereEngine())] == ["done", "done"]


def test_a_process_that_another_farm_left_behind_is_waited_for(scenes, results):
    """The run folder is locked, though nobody holds the job: it is looked at again later and no attempt is lost."""
    (job, _) = jobs_of(scenes, results)
    (job.request.out / "metrics.json").unlink()
    with contextlib.ExitStack() as other:
        other.enter_context(hold_folder(job.request.out))

        def work_of(text):
            state = run_job(text)
            if state == "held":
                other.close()
            return state

        engine = HereEngine(work_of)
        (status,) = run_farm([job], engine, poll=0)
    assert engine.begun == ["s0", "s0"] and (status.state, status.attempts) == ("done", 1)


@pytest.mark.parametrize("decorator", ["", "@register('sprouting')\n"])
def test_a_class_of_a_preset_file_is_found_by_another_process(scenes, tmp_path, monkeypatch, decorator):
    """Its name alone does not lead there: it is that of a module without a place, or one of the user's choice."""
    monkeypatch.setattr(STRATEGIES, "_classes", dict(STRATEGIES._classes))
    path = tmp_path / "mine.py"
    head = "from warpgs import Strategy\nfrom warpgs.pipeline.train.strategies.base import register\n"
    path.write_text(f"{head}{decorator}class Mine(Strategy):\n    pass\nmine = {{'strategy': Mine}}\n")
    (job, _) = jobs_of(scenes, tmp_path)
    text = job_text(replace(job, request=replace(job.request, config=preset_settings(f"{path}:mine")[0])))
    for name in [n for n, m in sys.modules.items() if getattr(m, "__file__", None) == str(path)]:
        del sys.modules[name]
    kept = {n: c for n, c in STRATEGIES._classes.items() if c.__module__.startswith("warpgs.")}
    monkeypatch.setattr(STRATEGIES, "_classes", kept)
    found = job_of(text)
    assert STRATEGIES.find(found.request.config.strategy).__name__ == "Mine" and job_text(found) == text


def test_a_job_as_text_is_the_same_job(scenes, tmp_path):
    (job, _) = jobs_of(scenes, tmp_path)
    assert job_of(job_text(job)) == job and job_of(job_text(job)).identity() == job.identity()
    elsewhere = replace(job, request=replace(job.request, device="cuda"))
    assert elsewhere.identity() != job.identity(), "photographs have another size on a GPU"


def test_slots(monkeypatch):
    """GPUs take turns, under the names that the user's own variable gives them."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setattr("torch.cuda.current_device", lambda: 0)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda _: "a GPU")
    monkeypatch.setattr("torch.get_num_threads", lambda: 8)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    with pytest.raises(UsageError, match="--slots and --per-gpu must be numbers from 1"):
        local_slots("cuda", 0, 2)
    assert local_slots("cuda", None, 2) == [("cuda", 2, {"CUDA_VISIBLE_DEVICES": n}) for n in "3535"]


def test_the_command_fits_a_file_of_jobs_and_writes_its_index(scenes, tmp_path, capsys, monkeypatch):
    """Settings of all and of one; a failure by its message; exit code 4, and 0 once nothing fails."""
    monkeypatch.setattr("warpgs.pipeline.farm.farm.LocalEngine", lambda slots: HereEngine())
    jobs = tmp_path / "jobs.jsonl"
    lines = [{"scene": str(scenes / "s0"), "name": "a", "seed": 3}, {"scene": "gone", "name": "b & c"}]
    jobs.write_text("\n".join(map(json.dumps, lines)))
    words = ["farm", str(jobs), "--out", str(tmp_path / "out"), "--device", "cpu", "--preset", "3dgs", "--steps", "2"]
    words += ["--init.source", "random", "--init.random-count=50", "--split", "every:4"]
    assert main(words) == 4
    printed = capsys.readouterr()
    assert "1 of 2 jobs failed" in printed.err and "1 done" in printed.out
    page, table = (tmp_path / "out" / "index.html").read_text(), (tmp_path / "out" / "results.csv").read_text()
    rows = list(csv.DictReader(table.splitlines()))
    assert [(r["name"], r["state"], r["steps"]) for r in rows] == [("a", "done", "2"), ("b & c", "failed", "0")]
    assert str(tmp_path) in rows[1]["message"] and str(tmp_path) not in page  # a page is sent, and tells of no folder
    assert "<b>b &amp; c</b>" in page and 'src="a/thumbnail.jpg"' in page and "Failures" in page
    assert json.loads((tmp_path / "out" / "a" / "run" / "config.json").read_text())["config"]["seed"] == 3
    assert main(["farm", str(jobs), "--out", str(tmp_path / "out"), "--resume"]) == 2
    assert "--resume is not supported by farm" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ray", "slurm"])
def test_engines_of_clusters_give_the_same_bytes(scenes, single, tmp_path, monkeypatch, kind):
    """Ray with two workers, one of which is killed in mid-job; Slurm's as processes of this machine, from a planted folder."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent.parent.parent))
    jobs = jobs_of(scenes, tmp_path / "out")
    killed = tmp_path / "killed"
    if kind == "ray":
        from warpgs.pipeline.farm.ray import RayEngine

        if importlib.util.find_spec("ray") is None:  # what is imported before the engine listens at every interface
            pytest.skip("ray is not installed")
        engine = RayEngine("cpu", 2, 1)
        found = [ip for _, ip, _ in listeners()]
        assert len(found) > 3 and all(map(is_loopback, found))
        address = sys.modules["ray"].get_runtime_context().gcs_address
        stranger = run_python(JOIN, address, timeout=120, environment={"RAY_AUTH_TOKEN": "0" * 64})
        assert stranger.stdout == "refused\n", stranger.stderr
        engine.use(_die_once(str(killed)))
    else:
        install_slurm(tmp_path / "bin", tmp_path / "cluster")
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
        (tmp_path / "torch.py").write_text("raise SystemExit('planted')")
        monkeypatch.chdir(tmp_path)
        engine = SlurmEngine("cpu", 2, folder=tmp_path / "private")
    try:
        statuses = run_farm(jobs, engine)
    finally:
        engine.close()
    assert [s.state for s in statuses] == ["done", "done"] and digests(statuses) == single
    assert killed.exists() == (kind == "ray")
    assert kind == "ray" or [p.name for p in (tmp_path / "private").iterdir()] == ["lock"]


JOIN = """
import sys, ray
try:
    ray.init(address=sys.argv[1], log_to_driver=False)
    print("joined")
except ConnectionError:
    print("refused")
"""
"""What a process of another user does to run code in a cluster."""


def _die_once(mark):
    """Return `run_job`, but for the first call of s0: its process is killed in the middle of its fit."""

    def work(text, threads):
        def on_step(report):
            if report.step == 4 and job_of(text).name == "s0" and not Path(mark).exists():
                Path(mark).touch()
                os.kill(os.getpid(), signal.SIGKILL)

        return run_job(text, threads, on_step)

    return work
