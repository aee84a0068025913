"""Farms: each job once and with the bytes of single fits; lists of jobs; the engines of Slurm and Ray."""

import contextlib
import csv
import importlib.util
import json
import os
import pickle
import shlex
import shutil
import signal
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.pipeline.farms import HereEngine, install_slurm, jobs_of, write_scenes
from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import LOCK, input_digest, make_folder
from warpgs.locks import hold_folder, private_shared_folder
from warpgs.pipeline.farm import job as record, slurm, work
from warpgs.pipeline.farm.farm import LocalEngine, local_slots, make_engine, run_farm
from warpgs.pipeline.farm.ray import RayEngine
from warpgs.pipeline.farm.slurm import SlurmEngine
from warpgs.pipeline.farm.work import run_job
from warpgs.pipeline.run.fit import fit_request
from warpgs.pipeline.train.loss import LOSS_TERMS
from warpgs.pipeline.train.presets import preset_settings
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.ranks import is_loopback, listeners


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("data") / "scenes")


@pytest.fixture(scope="module")
def single(scenes, tmp_path_factory):
    """SHA-256 of the PLY file that `fit` alone makes of each scene."""
    found = {}
    for job in jobs_of(scenes, tmp_path_factory.mktemp("single")):
        fit_request(job.request)
        found[job.name] = input_digest(job.request.out / record.PLY)
    return found


@pytest.fixture(scope="module")
def done(scenes, tmp_path_factory):
    out = tmp_path_factory.mktemp("done") / "results"
    run_farm(jobs_of(scenes, out), HereEngine())
    return out


@pytest.fixture
def unfitted(monkeypatch):
    """Let jobs end without a fit, with files that hold their names: for tests of who does what."""

    def pretend(request, *_, **__):
        make_folder(request.out)
        for name in record.CHECKED:
            (request.out / name).write_text(request.scene.path)
        return "fitted", {"test": {}, "steps": 1}, ""

    monkeypatch.setattr(work, "ensure_run", pretend)
    monkeypatch.setattr(work, "_wanted", lambda *_: ("", None, None))
    return pretend


@pytest.fixture
def results(done, tmp_path):
    return shutil.copytree(done, tmp_path / "results", dirs_exist_ok=True)


def digests(statuses):
    return {s.job.name: s.record.files.get(record.PLY) for s in statuses}


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
    monkeypatch.setattr(LOSS_TERMS, "_classes", dict(LOSS_TERMS._classes))
    (tmp_path / "term.py").write_text(TERM)
    os.mkfifo(tmp_path / "pipe")
    term = LOSS_TERMS.load(f"{tmp_path / 'term.py'}:Blocks")
    engine, killed = LocalEngine(local_slots("cpu", 1, 1)), []
    jobs = jobs_of(scenes, tmp_path / "out", loss_terms=(term(str(tmp_path)),))

    def show(statuses):
        if (tmp_path / "mark").exists() and not killed:
            killed.append(statuses[0].step)
            os.kill(engine._workers["s0"]._process.pid, signal.SIGKILL)

    try:
        statuses = run_farm(jobs, engine, show, poll=0.1)
    finally:
        engine.close()
    assert killed and [s.attempts for s in statuses] == [2, 1]
    assert [s.state for s in statuses] == ["done", "done"] and "killed by signal 9" in statuses[0].notes[0]
    assert digests(statuses) == single and statuses[0].record.how == "continued"
    assert "held-out PSNR" in (tmp_path / "out" / "s1" / record.LOG).read_text("utf-8")
    assert (tmp_path / "out" / "s1" / record.THUMBNAIL).is_file()


def test_a_rerun_skips_what_is_finished_and_valid(scenes, single, results, tmp_path):
    """A changed byte starts that job alone; other times of files are no other data; another setting is another run."""
    engine, left = HereEngine(), results / "s1" / LOCK
    left.touch()  # by a farm that was killed after the job's last file
    assert [s.state for s in run_farm(jobs_of(scenes, results), engine)] == ["done", "done"] and engine.begun == []
    assert not left.exists()
    ply = results / "s1" / "run" / record.PLY
    data = bytearray(ply.read_bytes())
    data[-1] ^= 1
    ply.write_bytes(data)
    statuses = run_farm(jobs_of(scenes, results), engine)
    assert engine.begun == ["s1"] and digests(statuses) == single
    assert [s.record.how for s in statuses] == ["fitted", "continued"]
    copied = shutil.copytree(scenes, tmp_path / "scenes")
    moved = [replace(j, request=replace(j.request, scene=replace(j.request.scene, path=str(copied / j.name))))
             for j in jobs_of(scenes, results)]  # fmt: skip
    assert all(record.finished(j) is None for j in moved)
    assert [s.record.how for s in run_farm(moved, HereEngine())] == ["kept", "kept"] and record.finished(moved[0])
    os.utime(copied / "s0" / "images" / "000.png", (0, 0))
    assert record.finished(moved[0]) is None and record.finished(moved[1])
    (status,) = run_farm(jobs_of(scenes, results, steps=4)[:1], HereEngine())
    assert (status.record.how, status.record.steps) == ("redone", 4) and (results / "s0" / "run.old1").is_dir()
    # the record of a run has settings that were left open as chosen: the finished run is kept all the same
    (job, _) = jobs_of(scenes, tmp_path, half_resolution=None)
    run_farm([job], HereEngine())
    (tmp_path / "s0" / record.RECORD).unlink()
    (status,) = run_farm([job], HereEngine())
    assert status.record.how == "kept"


class Alone(Exception):
    """The second farm has nothing left but jobs of the first."""


def test_a_second_farm_on_the_folder_takes_over_what_the_first_one_does(scenes, unfitted, tmp_path):
    """It does the other job and waits; neither job is done twice; what another farm finishes is found done."""
    jobs, second = jobs_of(scenes, tmp_path), HereEngine()

    def show(statuses):
        if [s.state for s in statuses] == ["elsewhere", "done"]:
            raise Alone

    def meanwhile(text):
        with pytest.raises(Alone):
            run_farm(jobs, second, show, poll=0)
        return run_job(text)

    first = HereEngine(meanwhile)
    statuses = run_farm(jobs, first)
    assert first.begun == ["s0"] and second.begun == ["s1"] and [s.state for s in statuses] == ["done", "done"]
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
    assert (
        record.read_job_record(jobs[0].folder).message == statuses[0].record.message
        and str(error) in statuses[0].record.message
    )
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
    text = replace(job, request=replace(job.request, config=preset_settings(f"{path}:mine")[0])).text()
    for name in [n for n, m in sys.modules.items() if getattr(m, "__file__", None) == str(path)]:
        del sys.modules[name]
    kept = {n: c for n, c in STRATEGIES._classes.items() if c.__module__.startswith("warpgs.")}
    monkeypatch.setattr(STRATEGIES, "_classes", kept)
    found = record.job_of(text)
    assert STRATEGIES.find(found.request.config.strategy).__name__ == "Mine" and found.text() == text


def test_a_job_as_text_is_the_same_job(scenes, tmp_path, monkeypatch):
    (job, _) = jobs_of(scenes, tmp_path)
    assert record.job_of(job.text()) == job and record.job_of(job.text()).identity() == job.identity()
    elsewhere = replace(job, request=replace(job.request, device="cuda"))
    assert elsewhere.identity() != job.identity(), "photographs have another size on a GPU"
    # GPUs take turns, under the names that the user's own variable gives them
    torch = {"cuda.is_available": True, "cuda.device_count": 2, "cuda.current_device": 0, "cuda.get_device_name": "a GPU"}
    for name, value in (torch | {"get_num_threads": 8}).items():
        monkeypatch.setattr(f"torch.{name}", lambda *_, value=value: value)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    with pytest.raises(UsageError, match="2 GPUs with --per-gpu 2 have 4; give more"):
        local_slots("cuda", 5, 2)
    assert local_slots("cuda", None, 2) == [("cuda", 2, {"CUDA_VISIBLE_DEVICES": n}) for n in "3535"]


def test_the_command_fits_a_file_of_jobs_and_writes_its_index(scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("warpgs.pipeline.farm.farm.LocalEngine", lambda slots: HereEngine())
    jobs = tmp_path / "jobs.jsonl"
    lines = [{"scene": str(scenes / "s0"), "name": "a", "seed": 3}, {"scene": "gone", "name": "b & c"}]
    jobs.write_text("\n".join(map(json.dumps, lines)))
    words = ["farm", str(jobs), "--out", str(tmp_path / "out"), "--device", "cpu", "--steps", "2"]
    words += ["--init.source", "random", "--init.random-count=50", "--split", "every:4"]
    assert main(words) == 4
    printed = capsys.readouterr()
    assert "1 of 2 jobs failed" in printed.err and "1 done" in printed.out and printed.out.count("preset default:") == 1
    page, table = (tmp_path / "out" / "index.html").read_text(), (tmp_path / "out" / "results.csv").read_text()
    rows = list(csv.DictReader(table.splitlines()))
    assert [(r["name"], r["state"], r["steps"]) for r in rows] == [("a", "done", "2"), ("b & c", "failed", "0")]
    assert str(tmp_path) in rows[1]["message"] and str(tmp_path) not in page  # a page is sent, and tells of no folder
    assert "<b>b &amp; c</b>" in page and 'src="a/thumbnail.webp"' in page and "Failures" in page
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
        if importlib.util.find_spec("ray") is None:  # what is imported before the engine listens at every interface
            pytest.skip("ray is not installed")
        engine = RayEngine("cpu", 2, 1)
        found = [ip for _, ip, _ in listeners()]
        assert len(found) > 3 and all(map(is_loopback, found))
        address = sys.modules["ray"].get_runtime_context().gcs_address
        program, environment = [sys.executable, "-c", JOIN, address], os.environ | {"RAY_AUTH_TOKEN": "0" * 64}
        stranger = subprocess.run(program, capture_output=True, text=True, timeout=120, env=environment, check=False)
        assert stranger.stdout == "refused\n", stranger.stderr
        engine._task = engine._ray.remote(**engine._options)(_die_once(str(killed)))
    else:
        install_slurm(tmp_path / "bin", tmp_path / "cluster")
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
        (tmp_path / "torch.py").write_text("raise SystemExit('planted')")
        monkeypatch.chdir(tmp_path)
        engine = SlurmEngine("cpu", 2, 1, 240, None, tmp_path / "private")
    try:
        statuses = run_farm(jobs, engine)
    finally:
        engine.close()
    assert [s.state for s in statuses] == ["done", "done"] and digests(statuses) == single
    assert killed.exists() == (kind == "ray")
    assert kind == "ray" or not list((tmp_path / "private").iterdir())


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
            if report.step == 4 and record.job_of(text).name == "s0" and not Path(mark).exists():
                Path(mark).touch()
                os.kill(os.getpid(), signal.SIGKILL)

        return run_job(text, threads, on_step)

    return work


# What a farm is given: folders, globs, and files of jobs that anybody may have written.


def test_folders_globs_and_lines_of_flags(tmp_path, monkeypatch):
    for name in ("b/scene", "a/scene", ".hidden"):
        (tmp_path / name).mkdir(parents=True)
    assert [j[:2] for j in record.list_jobs(str(tmp_path))] == [("a", tmp_path / "a"), ("b", tmp_path / "b")]
    assert [j[0] for j in record.list_jobs(f"{tmp_path}/*/scene")] == ["a-scene", "b-scene"]
    with pytest.raises(UsageError, match="no scene found"):
        record.list_jobs(f"{tmp_path}/*/nothing")
    write_scenes(tmp_path / "more", 1)
    with pytest.raises(UsageError, match="is a single scene: fit it with `warpgs fit`"):
        record.list_jobs(str(tmp_path / "more" / "s0"))
    # relative paths are from the file; booleans are switches, in groups too; the longest name is one of a folder
    path, long = tmp_path / "jobs.jsonl", 66 * "写"
    line = '{"scene": "x", "steps": 5, "refine_poses": true, "method.pm": false}'
    path.write_text(f"{line}\n\n{json.dumps({'scene': '/y', 'name': long})}", "utf-8")
    first, second = record.list_jobs(str(path))
    assert first == ("x", tmp_path / "x", ("--steps=5", "--refine-poses", "--method.no-pm"))
    assert second == (long, Path("/y"), ())
    (tmp_path / f"{long}.old1").mkdir()
    path.write_text('{"scene": "a/x"}\n{"scene": "b/X"}')
    with pytest.raises(UsageError, match=r"jobs\.jsonl: two jobs have the name 'X'"):
        record.list_jobs(str(path))
    # 40 folders with two links each to the next would be a million million folders
    monkeypatch.setattr(record, "MOST_FILES", 100)
    levels = [tmp_path / f"{level}" for level in range(8)]
    for level, below in zip(levels, [*levels[1:], None]):
        level.mkdir()
        for name in "ab" if below else "":
            (level / name).symlink_to(below)
    for level in (levels[0], levels[3]):
        (level / "image.png").touch()
    assert record.source_stamp(levels[3]) and not record.source_stamp(levels[0])  # 31 folders, and 255
    # lines that are no jobs end in one sentence, with the number of the line where it is the line's fault
    path = tmp_path / "jobs.jsonl"
    for word, values in {
        "is not a valid name": [{"name": n} for n in ("../b", "index.html", ".b", 101 * "x")], "must be text": [{"steps": [1]}],
        "which may have 200 bytes": [{"name": 100 * "写"}], "scene must be text": [{"scene": 3}],
        "cannot be set for a single job": [{"out": "/b"}, {"allow_outside": True}, {"--steps": 1}],
        "names user code": [{"strategy": "evil.py:Evil"}, {"view_modules": "evil.py:Evil"}],
        "without a zero byte": [{"scene": "a\0"}], "not valid JSON": ["{"], "must be an object": ["[]"],
        "scene is missing": ['{"name": "a"}'], "nested deeper": ["[" * 60 + "]" * 60],
    }.items():  # fmt: skip
        for value in values:
            path.write_text(value if isinstance(value, str) else json.dumps({"scene": "a"} | value), "utf-8")
            with pytest.raises(DataError, match=word):
                record.list_jobs(str(path))


# Slurm's engine: private files, nothing unpickled, and each way in which a job of Slurm can end.

with_slurm = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Slurm runs on Linux")


class Cluster:
    """Slurm as its three commands show it; jobs wait until a test ends them."""

    def __init__(self):
        self.calls, self.queue, self.scripts, self.fail, self.logs = [], [], {}, {}, {}

    def call(self, program, *options, script=""):
        self.calls.append((program, *options))
        if program in self.fail:
            return 1, "", self.fail[program]
        if program == "sbatch":
            self.queue.append(str(len(self.scripts) + 70))
            self.scripts[self.queue[-1]] = shlex.split(script.splitlines()[1])
            self.logs[self.queue[-1]] = next(Path(o.partition("=")[2]) for o in options if o.startswith("--output="))
            return 0, f"{self.queue[-1]};here\n", ""
        return 0, "\n".join(self.queue), ""

    def end(self, number, answer=None, log=""):
        self.queue.remove(number)
        self.logs[number].write_text(log)
        if answer is not None:
            Path(self.scripts[number][6]).write_text(answer)


@pytest.fixture
def cluster(monkeypatch, tmp_path):
    found = Cluster()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(slurm, "_call", found.call)
    monkeypatch.setattr(slurm.shutil, "which", lambda name: name)
    monkeypatch.setattr(slurm, "QUEUE_EVERY", 0.0)
    return found


@pytest.fixture
def job(tmp_path):
    (tmp_path / "scenes" / "s0").mkdir(parents=True)
    (found,) = jobs_of(tmp_path / "scenes", tmp_path / "results")
    return found


class Planted:
    """A pickle that makes a file where it is loaded."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@with_slurm
def test_pickles_planted_in_the_results_are_never_loaded(cluster, job, tmp_path):
    """Under the names that submitit gave its files, in the results; the job is judged by its own record."""
    mark, folder = tmp_path / "mark", tmp_path / "results" / ".slurm"
    folder.mkdir(parents=True)
    for name in ("70_0_result.pkl", "70_submitted.pkl"):
        (folder / name).write_bytes(pickle.dumps(("success", Planted(mark))))
    engine = SlurmEngine("cpu", 1, 1, 240, None, None)
    start = engine.start

    def begin(job):
        start(job)
        record.write_record(job.folder, record.JobRecord(job.name, job.identity(), "failed", message="no luck"))
        cluster.end("70", "failed")

    engine.start = begin
    (status,) = run_farm([job], engine)
    engine.close()
    assert (status.state, status.record.message) == ("failed", "no luck")
    assert not mark.exists() and len(list(folder.iterdir())) == 2


@with_slurm
def test_a_job_goes_to_its_node_as_json_in_a_private_folder(cluster, job, tmp_path):
    engine = SlurmEngine("cuda", None, 3, 90, "gpu", None)
    assert engine.slots == 100
    engine.start(job)
    ((program, *options),) = cluster.calls
    words = cluster.scripts["70"]
    assert program == "sbatch" and words[:5] == ["exec", sys.executable, "-P", "-m", "warpgs.pipeline.farm.slurm"]
    assert {"--time=90", "--cpus-per-task=3", "--gpus-per-node=1", "--partition=gpu"} <= set(options)
    text, answer = map(Path, words[5:7])
    assert record.job_of(text.read_text()) == job and words[7] == "3"
    folder = text.parent
    assert folder.parent == tmp_path / "cache" / "warpgs" / "slurm" and answer.parent == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.stat().st_uid == os.getuid()
    assert not (tmp_path / "results").exists()
    with private_shared_folder(None) as other:
        assert other != folder and folder.is_dir(), "that of a farm which runs stays"
    engine.close()
    assert cluster.calls[-1] == ("scancel", "70") and not folder.exists() and not other.exists()


@with_slurm
def test_a_folder_that_others_can_write_to_is_refused(cluster, tmp_path):
    """The folder itself or one above it; folders of killed farms are removed, a link is not followed."""
    base = tmp_path / "a" / "slurm"
    with private_shared_folder(base) as first:
        assert first.is_dir()
    old, link = (base / f".warpgs-{i:016x}.tmp" for i in range(2))
    old.mkdir()
    (tmp_path / "precious").mkdir()
    link.symlink_to(tmp_path / "precious")
    with private_shared_folder(base) as busy, private_shared_folder(base):
        assert not old.exists() and busy.exists()
    assert list((tmp_path / "precious").iterdir()) == []
    for folder in (base, base.parent):
        folder.chmod(0o777)
        with pytest.raises(UsageError, match=r"other users can write to .*--slurm-folder"):
            make_engine("cpu", "slurm", slurm_folder=base)
        folder.chmod(0o700)
    (tmp_path / "file").touch()
    with pytest.raises(ResourceError, match="--slurm-folder"), private_shared_folder(tmp_path / "file"):
        pass


@with_slurm
def test_each_end_of_a_job_is_an_event_and_what_slurm_refuses_is_said(cluster, job, capsys, monkeypatch):
    """An answer; none, once Slurm has not listed the job three times; where Slurm does not answer, nothing is known."""
    engine = SlurmEngine("cpu", 1, 1, 240, None, None)
    for number, state in enumerate(("done", "failed", "held"), 70):
        engine.start(job)
        assert engine.wait(0) == []
        cluster.end(str(number), state)
        assert engine.wait(0) == [(job.name, state, "")]
    assert not list(engine._folder.iterdir())
    engine.start(job)
    cluster.fail["squeue"] = "slurmctld is away"
    assert [engine.wait(0) for _ in range(5)] == [[]] * 5
    assert capsys.readouterr().err.count("slurmctld is away") == 1
    del cluster.fail["squeue"]
    cluster.end("73", log="error: *** JOB 73 CANCELLED DUE TO TIME LIMIT ***\n\n")
    assert engine.wait(0) == engine.wait(0) == []
    ((_, state, reason),) = engine.wait(0)
    assert state == "crashed" and "73 ended without an answer: error: *** JOB 73 CANCELLED DUE" in reason
    engine.close()
    engine = SlurmEngine("cpu", 1, 1, 240, None, None)
    cluster.fail["sbatch"] = "sbatch: error: invalid partition specified: nope\n"
    with pytest.raises(ResourceError, match="rejected job s0: sbatch: error: invalid partition"):
        engine.start(job)
    del cluster.fail["sbatch"]
    engine.start(job)
    cluster.fail["scancel"] = "no permission"
    engine.close()
    assert "jobs may still run: no permission" in capsys.readouterr().err
    monkeypatch.setattr(slurm.shutil, "which", lambda name: None)
    with pytest.raises(UsageError, match="needs Slurm's sbatch, squeue, scancel"):
        SlurmEngine("cpu", 1, 1, 240, None, None)


@with_slurm
def test_the_process_of_a_job_answers_with_its_state_and_calls_without_a_shell(tmp_path, monkeypatch, capsys):
    (tmp_path / "job").write_text("TEXT")

    for error, code in ((None, 0), (KeyboardInterrupt(), 130), (UsageError("the loss term is not there"), 1)):

        def work(text, threads, error=error):
            if error is not None:
                raise error
            return f"{text} {threads}"

        monkeypatch.setattr(slurm, "run_job", work)
        answer = tmp_path / str(code)
        assert slurm.main(str(tmp_path / "job"), str(answer), "2") == code and answer.exists() == (code == 0)
    assert (tmp_path / "0").read_text() == "TEXT 2" and capsys.readouterr().err == "the loss term is not there\n"
    # whose environment names no folder to import from but the package's, and hides no jobs
    monkeypatch.setenv("SQUEUE_STATES", "RUNNING")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert slurm._call("squeue")[0] == 1
    (tmp_path / "squeue").write_text('#!/bin/sh\nread -r line\necho "$1 $line $PYTHONSAFEPATH $SQUEUE_STATES."\n')
    (tmp_path / "squeue").chmod(0o755)
    assert slurm._call("squeue", "$(id)", script="text\n")[1] == "$(id) text 1 .\n"


# Ray's engine joins the cluster that is named, or starts a private one; it takes none that another user could have planted.


@pytest.fixture
def started(monkeypatch):
    found = {}
    fake = SimpleNamespace(
        is_initialized=lambda: False, init=lambda **options: found.update(options), cluster_resources=lambda: {"CPU": 4},
        remote=lambda **_: lambda work: work,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setattr(os, "environ", {k: v for k, v in os.environ.items() if not k.startswith("RAY_")})
    return found


def test_a_cluster_of_our_own_is_private(started):
    """It never looks for one in /tmp/ray; others need its token, and cannot enter the folder of its sockets."""
    assert RayEngine("cpu", None, 1, 2).slots == 2
    folder = Path(started["_temp_dir"]).parent
    assert started["address"] == "local" and len(os.environ["RAY_AUTH_TOKEN"]) == 64 and "RAY_AUTH_MODE" not in os.environ
    assert os.name == "nt" or (stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.stat().st_uid == os.getuid())


@pytest.mark.parametrize("by_variable", [True, False])
def test_a_cluster_that_is_named_is_joined(started, monkeypatch, by_variable):
    if by_variable:
        os.environ["RAY_ADDRESS"] = "head:6379"
    RayEngine("cpu", 1, 1, address=None if by_variable else "head:6379")
    assert started["address"] == "head:6379" and "_temp_dir" not in started and "RAY_AUTH_TOKEN" not in os.environ

    def fail(**_):
        raise ConnectionError("no route")

    monkeypatch.setattr(sys.modules["ray"], "init", fail)
    with pytest.raises(ResourceError, match="Ray at head:6379 does not answer \\(no route\\); check RAY_ADDRESS"):
        RayEngine("cpu", 1, 1, address="head:6379")
