"""Tiny farms: two scenes, a few steps, an engine that a test holds in its hands, and programs that stand in for Slurm's."""

import dataclasses
import sys
from pathlib import Path

from warpgs.pipeline.farm.job import Event, FarmJob
from warpgs.pipeline.farm.work import run_job
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.request import FitRequest, SceneRequest
from warpgs.pipeline.train.settings import FitConfig
from warpgs.synthetic.demo import split_spec, write_demo

CONFIG = FitConfig(steps=6, checkpoint_every=2, init=InitConfig(source="random", random_count=60))


def write_scenes(folder: Path, count: int = 2) -> Path:
    for i in range(count):
        write_demo(folder / f"s{i}", views=8, width=48, height=36, seed=i)
    return folder


def jobs_of(scenes: Path, out: Path, **settings) -> list[FarmJob]:
    config = dataclasses.replace(CONFIG, **settings)
    return [
        FarmJob(p.name, FitRequest(SceneRequest(str(p), split_spec(8)), out / p.name / "run", config, "cpu"), out / p.name, out)
        for p in sorted(scenes.iterdir())
    ]


class HereEngine:
    """Runs jobs in this process, one at a time, when it is asked for news."""

    name = "here"

    def __init__(self, work=run_job, slots: int = 1):
        self.work, self.slots, self.started, self.begun = work, slots, [], []

    def start(self, job: FarmJob) -> None:
        self.started.append(job)
        self.begun.append(job.name)

    def wait(self, seconds: float) -> list[Event]:
        """Run the oldest job; the function's result is its state, or its whole event."""
        job = self.started.pop(0)
        done = self.work(job.text())
        return [(job.name, done, "") if isinstance(done, str) else done]

    def close(self) -> None:
        """Do nothing."""


PROGRAM = """
import json, os, signal, subprocess, sys
from pathlib import Path

folder, name, words = Path({folder!r}), Path(sys.argv[0]).name, sys.argv[1:]
if name == "sbatch":
    script, number = sys.stdin.read(), len(list(folder.glob("*.call"))) + 1
    (folder / f"{{number}}.sh").write_text(script)
    (folder / f"{{number}}.call").write_text(json.dumps(words))
    log = next(w.partition("=")[2] for w in words if w.startswith("--output="))
    with open(log, "ab") as out:
        subprocess.Popen([sys.executable, "-I", __file__ + ".run", str(number)], stdout=out, stderr=out, start_new_session=True)
    print(f"{{number}};cluster")
elif name == "squeue":
    print("\\n".join(p.stem for p in folder.glob("*.call") if not p.with_suffix(".ended").exists()))
else:
    for number in words:
        os.kill(int((folder / f"{{number}}.pid").read_text()), signal.SIGTERM)
"""
RUNNER = """
import subprocess, sys
from pathlib import Path

base = Path({folder!r}, sys.argv[1])
process = subprocess.Popen(["sh", str(base) + ".sh"])
base.with_suffix(".pid").write_text(str(process.pid))
process.wait()
base.with_suffix(".ended").touch()
"""


def install_slurm(bin_folder: Path, folder: Path) -> None:
    """Write the programs into a folder for PATH; they keep what they know in another."""
    bin_folder.mkdir()
    folder.mkdir()
    for name in ("sbatch", "squeue", "scancel"):
        (bin_folder / name).write_text(f"#!{sys.executable} -I\n" + PROGRAM.format(folder=str(folder)))
        (bin_folder / name).chmod(0o755)
    (bin_folder / "sbatch.run").write_text(RUNNER.format(folder=str(folder)))
