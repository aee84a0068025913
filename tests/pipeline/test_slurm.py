"""Slurm's engine: private files, nothing unpickled, and each way in which a job of Slurm can end."""

import os
import pickle
import shlex
import stat
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from tests.pipeline.farms import jobs_of
from warpgs.errors import ResourceError, UsageError
from warpgs.locks import private_shared_folder
from warpgs.pipeline.farm import slurm
from warpgs.pipeline.farm.farm import make_engine, run_farm
from warpgs.pipeline.farm.job import Event, JobRecord, job_of, write_record
from warpgs.pipeline.farm.slurm import SlurmEngine

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Slurm runs on Linux")


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
        """End a job, with an answer or without."""
        self.queue.remove(number)
        self.logs[number].write_text(log)
        if answer is not None:
            Path(self.scripts[number][6]).write_text(answer)


@pytest.fixture
def cluster(monkeypatch, tmp_path):
    """A cluster, and an engine's cache in this test's folder."""
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


def test_pickles_planted_in_the_results_are_never_loaded(cluster, job, tmp_path):
    """Under the names that submitit gave its files, in the results; the job is judged by its own record."""
    mark, folder = tmp_path / "mark", tmp_path / "results" / ".slurm"
    folder.mkdir(parents=True)
    for name in ("70_0_result.pkl", "70_submitted.pkl"):
        (folder / name).write_bytes(pickle.dumps(("success", Planted(mark))))
    engine = SlurmEngine("cpu", 1)
    start = engine.start

    def begin(job):
        start(job)
        write_record(job.folder, JobRecord(job.name, job.identity(), "failed", message="no luck"))
        cluster.end("70", "failed")

    engine.start = begin
    (status,) = run_farm([job], engine)
    engine.close()
    assert (status.state, status.record.message) == ("failed", "no luck")
    assert not mark.exists() and len(list(folder.iterdir())) == 2


def test_a_job_goes_to_its_node_as_json_in_a_private_folder(cluster, job, tmp_path):
    """Nobody else can enter it; its name is random; it is removed in the end; nothing is imported from the current folder."""
    engine = SlurmEngine("cuda", None, 3, 90, "gpu")
    assert engine.slots == 100
    engine.start(job)
    ((program, *options),) = cluster.calls
    words = cluster.scripts["70"]
    assert program == "sbatch" and words[:5] == ["exec", sys.executable, "-P", "-m", "warpgs.pipeline.farm.slurm"]
    assert {"--time=90", "--cpus-per-task=3", "--gpus-per-node=1", "--partition=gpu"} <= set(options)
    text, answer = map(Path, words[5:7])
    assert job_of(text.read_text()) == job and words[7] == "3"
    folder = text.parent
    assert folder.parent == tmp_path / "cache" / "warpgs" / "slurm" and answer.parent == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.stat().st_uid == os.getuid()
    assert not (tmp_path / "results").exists()
    with private_shared_folder(None) as other:
        assert other != folder and folder.is_dir(), "that of a farm which runs stays"
    engine.close()
    assert cluster.calls[-1] == ("scancel", "70") and not folder.exists() and not other.exists()


def test_a_folder_that_others_can_write_to_is_refused(cluster, tmp_path):
    """The folder itself or one above it; folders of killed farms are removed, a link is not followed."""
    base = tmp_path / "a" / "slurm"
    with private_shared_folder(base) as first:
        assert first.is_dir()
    (base / "old").mkdir()
    (base / "old" / "lock").touch()
    (tmp_path / "precious").mkdir()
    (base / "link").symlink_to(tmp_path / "precious")
    (base / "busy").mkdir()
    with FileLock(base / "busy" / "lock"), private_shared_folder(base):
        assert not (base / "old").exists() and (base / "busy").exists()
    assert list((tmp_path / "precious").iterdir()) == []
    for folder in (base, base.parent):
        folder.chmod(0o777)
        with pytest.raises(UsageError, match=r"other users can write to .*--slurm-folder"):
            make_engine("cpu", "slurm", slurm_folder=base)
        folder.chmod(0o700)
    (tmp_path / "file").touch()
    with pytest.raises(ResourceError, match="--slurm-folder"), private_shared_folder(tmp_path / "file"):
        pass


@pytest.mark.parametrize("state", ["done", "failed", "held"])
def test_an_answer_is_an_event(cluster, job, state):
    engine = SlurmEngine("cpu", 1)
    engine.start(job)
    assert engine.wait(0) == []
    cluster.end("70", state)
    assert engine.wait(0) == [Event(job.name, state)]
    assert [p.name for p in engine._folder.iterdir()] == ["lock"]
    engine.close()


def test_a_job_that_ends_without_an_answer_has_crashed(cluster, job, capsys):
    """Once Slurm has not listed it three times; where Slurm does not answer, nothing is known of any job."""
    engine = SlurmEngine("cpu", 1)
    engine.start(job)
    cluster.fail["squeue"] = "slurmctld is away"
    assert [engine.wait(0) for _ in range(5)] == [[]] * 5
    assert capsys.readouterr().err.count("slurmctld is away") == 1
    del cluster.fail["squeue"]
    cluster.end("70", log="error: *** JOB 70 CANCELLED DUE TO TIME LIMIT ***\n\n")
    assert engine.wait(0) == engine.wait(0) == []
    (event,) = engine.wait(0)
    assert event.state == "crashed" and "70 ended without an answer: error: *** JOB 70 CANCELLED DUE" in event.message
    engine.start(job)
    cluster.end("71", "gone wild")
    (event,) = engine.wait(0)
    assert event.state == "crashed" and "unknown answer" in event.message
    engine.close()


def test_what_slurm_refuses_is_said(cluster, job, monkeypatch, capsys):
    engine = SlurmEngine("cpu", 1)
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
        SlurmEngine("cpu", 1)


def test_the_process_of_a_job_answers_with_its_state(tmp_path, monkeypatch, capsys):
    """Nothing where it is interrupted; a reason on stderr where the job cannot begin."""
    (tmp_path / "job").write_text("TEXT")
    monkeypatch.setattr(slurm, "run_job", lambda text, threads: f"{text} {threads}")
    assert slurm.main(str(tmp_path / "job"), str(tmp_path / "answer"), "2") == 0
    assert (tmp_path / "answer").read_text() == "TEXT 2"

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(slurm, "run_job", stop)
    assert slurm.main(str(tmp_path / "job"), str(tmp_path / "none"), "2") == 130 and not (tmp_path / "none").exists()

    def refuse(*_):
        raise UsageError("the loss term is not there")

    monkeypatch.setattr(slurm, "run_job", refuse)
    assert slurm.main(str(tmp_path / "job"), str(tmp_path / "none"), "2") == 1 and not (tmp_path / "none").exists()
    assert capsys.readouterr().err == "the loss term is not there\n"


@pytest.mark.parametrize("name", ["sbatch", "squeue"])
def test_commands_are_called_without_a_shell(tmp_path, monkeypatch, name):
    """Their environment names no folder to import from but the package's, and hides no jobs; a missing one is a failure."""
    monkeypatch.setenv("SQUEUE_STATES", "RUNNING")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert slurm._call(name)[0] == 1
    (tmp_path / name).write_text('#!/bin/sh\nread -r line\necho "$1 $line $PYTHONSAFEPATH $SQUEUE_STATES."\n')
    (tmp_path / name).chmod(0o755)
    assert slurm._call(name, "$(id)", script="text\n")[1] == "$(id) text 1 .\n"
