"""Commands on a scene of 48 x 36 px, what they write when nobody interrupts them, and whether what is there is whole."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from warpgs.export.base import read_gaussians
from warpgs.export.ply import read_ply
from warpgs.files import LOCK
from warpgs.folders import NAMES as OWN_NAMES
from warpgs.pipeline.metrics.lpips import NETS
from warpgs.pipeline.run.folder import load_checkpoint
from warpgs.report.film import _decoded_sizes
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, split_spec, still_life, write_demo

ROOT = Path(__file__).parent.parent.parent
STEPS, FRAMES, VIEWS = 60, 4, 8
HALF_WAY = 33
"""Step at which the run is interrupted that the other commands start from; its checkpoint is of step 30."""
COMMANDS = (
    "fit", "resume", "render", "export", "convert", "mesh", "prune", "eval", "view", "compare", "worker", "farm", "poses",
    "level",
)  # fmt: skip
"""The commands that are killed; ``worker`` is a farm whose jobs run in its own process, so that their calls are seen."""
NEEDS = {"view": "viser", "poses": "pycolmap"}
"""Modules that a command needs and that may be missing."""
SAME_BYTES = (".ply", ".spz", ".glb", ".png", ".jpg", ".webp", ".mp4", ".safetensors")
"""Suffixes of files that are the same whenever they are written again; the others hold times and places."""

TEXTS = (".txt", ".md", ".csv", ".tex", ".svg")
"""Suffixes of texts that nothing reads back."""

OWN = {
    "fit": ("run/",), "resume": ("run/",), "eval": ("run/eval.json", "run/renders/", "run/depth/"), "render": ("film/",),
    "prune": ("run-pruned/",), "export": ("a.ply",), "convert": ("b.spz",), "mesh": ("m.glb",),
    "view": ("run/crop.json", "run/path.json"), "compare": ("study/",), "worker": ("results/",), "farm": ("results/",),
    "poses": ("posed/",), "plot": ("run/plot.png",), "priors": ("sheets/",), "ablate": ("ablation/",), "demo": ("made/",),
    "convert-lpips": ("lpips.safetensors",), "level": ("run/config.json", "run/point_cloud.ply"),
}  # fmt: skip
"""Beginnings of the paths that a command writes, for all commands that write; doctor reads alone. After level, the others would
make other files."""


def can_run(command: str) -> bool:
    return command not in NEEDS or importlib.util.find_spec(NEEDS[command]) is not None


def words_of(command: str, scene: Path, work: Path) -> list[str]:
    run, cpu = str(work / "run"), ["--device", "cpu"]
    fit = [
        "fit", str(scene), "--out", run, "--split", split_spec(VIEWS), "--steps", str(STEPS), "--preset", "quick",
        "--checkpoint-every", "10", "--threads", "1", *cpu,
    ]  # fmt: skip
    short = ["--split", split_spec(VIEWS), "--steps", "4", *cpu]
    farm = [
        str(scene.parent / "scenes"),
        "--out",
        str(work / "results"),
        "--preset",
        "quick",
        "--checkpoint-every",
        "1",
        *short,
    ]
    return {
        "fit": fit,
        "resume": [*fit, "--resume"],
        "render": ["render", run, "--path", "turntable", "--frames", str(FRAMES), "--out", str(work / "film"), *cpu],
        "export": ["export", run, "--to", str(work / "a.ply")],
        "convert": ["convert", str(work / "a.ply"), str(work / "b.spz")],
        "mesh": ["mesh", run, "--out", str(work / "m.glb"), "--resolution", "24", *cpu],
        "prune": ["prune", run, "--keep-psnr", "3", *cpu],
        "eval": ["eval", run, *cpu],
        "view": ["view", run, "--port", "0", *cpu],
        "compare": ["compare", str(scene), "--out", str(work / "study"), "--presets", "3dgs,mcmc", "--seeds", "1", *short],
        "farm": ["farm", *farm],
        "worker": ["worker", *farm],
        "poses": ["poses", str(scene.parent / "photographs"), "--out", str(work / "posed"), "--threads", "1"],
        "plot": ["plot", run, *cpu],
        "priors": ["priors", "show", str(scene), "--split", split_spec(VIEWS), "--out", str(work / "sheets")],
        "ablate": ["ablate", str(scene), "--out", str(work / "ablation"), "--seeds", "1", *short],
        "level": ["level", run, "--up", "photographs", *cpu],
        "demo": ["demo", str(work / "made"), "--views", "8", "--width", "32", "--height", "32"],
        "convert-lpips": [
            "convert-lpips", "--backbone", str(scene.parent / "alexnet.pth"), "--heads", str(scene.parent / "alex.pth"),
            "--out", str(work / "lpips.safetensors"),
        ],
    }[command]  # fmt: skip


def environment() -> dict[str, str]:
    search = os.pathsep.join([str(ROOT), *filter(None, sys.path)])  # packages, too, wherever this process found them
    return os.environ | {
        "PYTHONPATH": search, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "PYTHONUTF8": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip


@dataclass(frozen=True)
class Done:
    """An ended process, and the calls that it made."""

    code: int
    said: str
    calls: dict[str, list[tuple[str, str, str]]]
    """By command: kind of each call, its path from the folder, and the SHA-256 of what a replacement puts there."""


@functools.cache
def server() -> subprocess.Popen:
    words = [sys.executable, "-P", "-m", "tests.faults.child", "serve"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen(words, env=environment(), text=True, bufsize=1, **pipes)


def child(work: Path, *commands: list[str], kill_at: int = 0) -> Done:
    """Run commands in one process that kills itself before a call of the last one; its temporary files lie in ``work``."""
    trace, said = (work.with_name(f"{work.name}.{end}") for end in ("calls", "said"))
    tmp = work / "tmp"
    tmp.mkdir(exist_ok=True)
    words = [str(work), str(kill_at), str(trace), *commands[0], *(w for c in commands[1:] for w in ("+", *c))]
    if not hasattr(os, "fork"):
        process = [sys.executable, "-P", "-m", "tests.faults.child", *words]
        with said.open("wb") as file:
            ended = subprocess.run(process, env=environment() | {"TEMP": str(tmp)}, stdout=file, stderr=file, check=False)
        code = ended.returncode
    else:
        print(json.dumps({"words": words, "tmp": str(tmp), "said": str(said)}), file=server().stdin, flush=True)
        code = int(server().stdout.readline())
    return Done(code, said.read_text("utf-8", errors="replace"), calls_in(trace))


def calls_in(trace: Path) -> dict[str, list[tuple[str, str, str]]]:
    calls: dict[str, list[tuple[str, str, str]]] = {}
    for line in trace.read_text("utf-8").splitlines() if trace.is_file() else []:
        if line.startswith("command "):
            name = line.removeprefix("command ")
            calls[name] = []  # of a command that ran twice, the second time counts
        else:
            kind, path, digest = line.split("\t")
            calls[name].append((kind, Path(path).as_posix(), digest))
    return calls


def succeeded(done: Done) -> Done:
    assert done.code == 0, done.said
    return done


def digests(folder: Path) -> dict[str, str]:
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in paths}


def is_temporary(path: str) -> bool:
    """Return whether only an interrupted command may leave a path: one of a temporary name, or a lock."""
    return any(p == LOCK or OWN_NAMES.fullmatch(p) for p in path.split("/"))


def leftovers(folder: Path) -> list[str]:
    return [p for p in (p.relative_to(folder).as_posix() for p in folder.rglob("*")) if is_temporary(p)]


def check_whole(folder: Path, *, ended: bool) -> None:
    """Read every file back that has a name of its own; a log may lack the end of its last line where it has not ended."""
    whole = {
        ".json": lambda p: json.loads(p.read_text("utf-8")) is not None, ".jsonl": lambda p: check_log(p, ended),
        ".png": lambda p: cv2.imdecode(np.fromfile(p, np.uint8), cv2.IMREAD_UNCHANGED) is not None,
        **dict.fromkeys((".jpg", ".webp"), lambda p: cv2.imread(str(p)) is not None),
        ".mp4": lambda p: _decoded_sizes(p) == [(48, 36)] * FRAMES,
        ".ply": lambda p: len(read_ply(p)), ".spz": lambda p: len(read_gaussians(p)), ".bin": lambda p: p.stat().st_size,
        ".glb": lambda p: int.from_bytes(p.read_bytes()[8:12], "little") == p.stat().st_size,
        ".safetensors": lambda p: load_checkpoint(p.parent),
        ".html": lambda p: p.read_text("utf-8").rstrip().endswith("</html>"),
    }  # fmt: skip
    for path in folder.rglob("*"):
        if not (path.is_dir() or path.suffix in TEXTS or is_temporary(path.relative_to(folder).as_posix())):
            assert whole[path.suffix](path), path


def check_log(path: Path, ended: bool) -> bool:
    """Read metrics.jsonl: one line a step, none missing or twice, all of them where the fit has ended."""
    lines = path.read_bytes().split(b"\n")
    last, steps = lines.pop(), [json.loads(line)["step"] for line in lines]
    asked = json.loads((path.parent / "config.json").read_text("utf-8"))["config"]["steps"]
    return not (ended and last) and steps == list(range(1, len(steps) + 1)) and (not ended or len(steps) == asked)


@dataclass(frozen=True)
class Reference:
    """The commands as they end when nobody interrupts them."""

    folder: Path
    scene: Path
    calls: dict[str, list[tuple[str, str, str]]]
    """Calls of each command, as in `Done`."""
    after: dict[str, dict[str, str]]
    """Files after each command, by path, and their SHA-256."""

    def before(self, command: str, work: Path) -> None:
        """Make the folder that a command starts from."""
        work.mkdir()
        start = {"fit": None, "worker": None, "farm": None, "resume": "interrupted"}.get(command, "finished")
        if start is not None:
            shutil.copytree(self.folder / start, work, dirs_exist_ok=True)


def write_photographs(folder: Path) -> None:
    folder.mkdir()
    shapes = still_life(0)
    for i, c in enumerate(camera_path(8, 240, 180)[1:5]):
        image = raycast.render(shapes, raycast.Light(), c.K, c.viewmat, 240, 180)
        cv2.imwrite(str(folder / f"{i}.png"), np.round(255 * image[..., ::-1]).astype(np.uint8))


def write_lpips_sources(folder: Path) -> None:
    """Write the two files that LPIPS weights are made of, of a smallest network's shapes."""
    state = {name: torch.ones(shape) for name, shape in NETS["alex"].shapes().items()}
    torch.save({k: v for k, v in state.items() if k.startswith("features")}, folder / "alexnet.pth")
    torch.save({k: v for k, v in state.items() if k.startswith("lin")}, folder / "alex.pth")


def build_reference(folder: Path) -> None:
    """Run every command once, and keep what there was before and after it."""
    scene, work = folder / "scene", folder / "work"
    write_demo(scene, views=VIEWS, width=48, height=36)
    for name in ("s0", "s1"):
        shutil.copytree(scene, folder / "scenes" / name)
    write_photographs(folder / "photographs")
    write_lpips_sources(folder)

    def words(command: str) -> list[str]:
        return words_of(command, scene, work)

    def keep(name: str) -> list[str]:
        return ["keep", str(work), str(folder / name)]

    work.mkdir()
    alone, after = {}, {}
    for command in ("worker", "farm", "fit"):
        alone[command] = succeeded(child(work, words(command))).calls[command]
        after[command] = digests(work)
        shutil.rmtree(work)
        work.mkdir()
    at = [i for i, call in enumerate(alone["fit"], 1) if call[0] == "step"][HALF_WAY - 1]
    assert child(work, words("fit"), kill_at=at).code not in range(6)
    (work / "other.txt").write_text("the user's own")
    # older results of the same commands: what they replace must not get lost
    older = [*(words(c) for c in ("render", "export", "convert", "mesh", "eval")), keep("interrupted")]
    # convert comes first, since export replaces what it reads
    last = ["convert", *(c for c in OWN if c not in ("convert", "resume", *alone))]
    last = [c for c in last if can_run(c)]
    done = succeeded(child(work, *older, words("resume"), keep("finished"), *map(words, last)))
    calls = done.calls | alone | {"resume": done.calls["fit"]}
    after |= {"resume": digests(folder / "finished")} | {c: digests(work) for c in last}
    (folder / "reference.json").write_text(json.dumps({"calls": calls, "after": after}))
