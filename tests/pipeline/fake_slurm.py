"""Programs named sbatch, squeue and scancel that run each job as a process of this machine."""

import sys
from pathlib import Path

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
