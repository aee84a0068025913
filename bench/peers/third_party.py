"""Files exchanged with other programs: ours read by them, and theirs read by warpgs, number by number.

PATHS are runs, exported in every format, and files from elsewhere. NODE_PATH lists folders of npm packages, each version of
splat-transform in its own; --python is an interpreter with the Python packages; --browser runs `third_party.mjs`. Numbers are
in file units about the file's origin; rotations up to sign and half turns about an ellipsoid's own axes; logs of lengths.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.judge import NAMES, compared, rigid
from warpgs.errors import DataError
from warpgs.export.base import Arrays, arrays_of, format_of, logits
from warpgs.export.spz import SPZ, SPZConfig
from warpgs.io.transforms import read_cameras
from warpgs.mesh.fuse import MeshOptions
from warpgs.pipeline.run.export import Filters, export, mesh

WHAT = "largest differences between what other programs and warpgs read of the same files, in both directions"
ARGUMENTS = "import sys, PACKAGE as m; s, d = sys.argv[1:]; "
PYTHON = {
    "spz": "u, p = m.UnpackOptions(), m.PackOptions(); u.to_coord = p.from_coord = m.RDF; "
    "c = m.load_spz(s, u) if s.endswith('spz') else m.load_splat_from_ply(s, u); "
    "(m.save_spz if d.endswith('spz') else m.save_splat_to_ply)(c, p, d)",
    "gsply": "import gsply.sog_reader as g; "
    "c = m.read_spz(s) if s.endswith('spz') else g.sogread(s) if s.endswith('sog') else m.plyread(s); "
    "m.write_spz(d, c) if d.endswith('spz') else m.plywrite(d, c, compressed='.compressed' in d)",
    "plyfile": "c = m.PlyData.read(s); c.text = '.text' in d; c.write(d)",
    "open3d": "import numpy; c = m.io.read_triangle_mesh(s); numpy.savez(d, vertices=c.vertices, faces=c.triangles)",
    "pycolmap": "import numpy; c = m.Reconstruction(s).images.values(); "
    "numpy.savez(d, **{i.name: i.camera.calibration_matrix() @ i.cam_from_world().matrix() for i in c})",
}
"""Code of each Python package that converts a file ``s`` to a file ``d``; SPZ is converted to and from the axes of PLY."""
READS = {
    "spz": (".spz",), "gsply": (".ply", ".spz", ".sog"), "plyfile": ("m.ply",), "three.js": ("m.ply", ".glb", ".gltf"),
    "splat-transform": (".ply", ".spz", ".sog", ".splat"), "Spark": (".ply", ".spz", ".sog", ".splat"),
}  # fmt: skip
WRITES: dict[str, tuple[tuple[str, ...], ...]] = {
    "spz": ((".spz",),), "gsply": ((".ply",), (".compressed.ply",), (".spz",)), "plyfile": ((".ply",), (".text.ply",)),
    "splat-transform": ((".ply",), (".compressed.ply",), (".spz",), (".sog", "-g", "cpu", "-i", "1"), (".glb",)),
}  # fmt: skip
"""Suffixes that a program writes, each with further arguments."""
PACKAGES = {"splat-transform": "@playcanvas/splat-transform", "Spark": "@sparkjsdev/spark", "three.js": "three"}
PACKAGES |= {"gltf-validator": "gltf-validator"}
LICENCES = {"plyfile": "GPL-3.0-or-later", "pycolmap": "BSD-3-Clause", "gltf-validator": "Apache-2.0"}
"""Licences that are not MIT."""
TURNED = {("three.js", ".glb"): "z", ("three.js", ".gltf"): "z", ("Spark", ".spz"): "x"}
"""Axis of the half turn from PLY, for programs that show formats with y up as they are stored; others convert to PLY."""
FLOAT = (1e-5,) * 6
MESHES = ("mesh.ply", "mesh.glb")
STEPS = {
    ".splat": (0, 1 / 128, 1e-5, 1 / 255, 1, 0), ".spz": (2.0**-12, 1 / 361, 1 / 16, 1 / 255, 1 / 38, 1 / 8),
    ".sog": (1e-3, 1 / 180, 0.1, 1 / 255, 0.05, 0.05), "Spark": (1e-5, 1 / 8, 1 / 128, 1 / 255, 1 / 64, 1 / 32),
}  # fmt: skip
"""Steps by `NAMES`, if above twice the difference of warpgs's own file: SPZ at its fewest bits, typical codebooks of SOG.
Spark holds half floats, clips harmonics to a power of two, and takes rotations of .splat without a length of 1."""
VALIDATE = (
    "require('gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))"
    ".then((r) => console.log(r.issues.messages.filter((m) => !m.severity && "
    "m.code !== 'MESH_PRIMITIVE_INVALID_ATTRIBUTE').length))"
)
"""Number of errors but those for attributes of extensions, which the validator does not know."""


def own(path: Path) -> Arrays:
    """Return the Gaussians that warpgs reads, in file units about the origin."""
    return arrays_of(format_of(path).read_stored(path))


def of_page(body: dict) -> Arrays:
    """Return the Gaussians that the page posted."""
    wide = {"quats": 4, "logit_opacities": 1, "opacities": 1}
    a = {name: np.array(values, np.float64).reshape(-1, wide.get(name, 3)) for name, values in body.items()}
    if "opacities" in a:
        a["logit_opacities"] = logits(a["opacities"], 2.0**-22)
    a["sh"] = np.stack([a[f"sh{k}"] for k in range(25) if f"sh{k}" in a], 1)
    return a | {"logit_opacities": a["logit_opacities"][:, 0]}


def programs(python: str) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Return the start of a command line for each program and version, and licences, or the reason why it is not run."""
    there = {}
    for name, code in PYTHON.items():
        about = f"import {name}, importlib.metadata as m; print(m.version('{name}'), end='')"
        done = subprocess.run([python, "-c", about], capture_output=True, text=True, check=False)
        if done.returncode == 0:
            there[f"{name} {done.stdout}"] = [python, "-c", ARGUMENTS.replace("PACKAGE", name) + code]
    for name, package in PACKAGES.items():
        for folder in os.environ.get("NODE_PATH", "").split(os.pathsep):
            if (file := Path(folder, package, "package.json")).is_file():
                about = json.loads(file.read_text("utf-8"))["version"]
                there[f"{name} {about}"] = ["node", str(file.parent / "bin/cli.mjs"), "-w", "-q"]
    facts = {known: LICENCES.get(known.split()[0], "MIT") for known in there}
    missing = {*PYTHON, *PACKAGES} - {known.split()[0] for known in there}
    return there, facts | dict.fromkeys(sorted(missing), "not run: not installed")


def convert(command: list[str], source: Path, target: Path) -> Path:
    """Return a file that a program made of another one; DataError with its complaint."""
    target.unlink(missing_ok=True)
    done = subprocess.run([*command, str(source), str(target)], capture_output=True, text=True, check=False)
    if not target.is_file():
        lines = [line for line in (done.stderr + done.stdout).splitlines() if "rror" in line] or ["it wrote no file"]
        raise DataError(lines[-1].strip())
    return target


def shown(browser: str, work: Path, jobs: list[tuple[str, str]]) -> dict[tuple[str, str], dict]:
    """Return the numbers that the page of a browser reads of each file in a folder, by library and file."""
    bodies, done = {}, threading.Event()
    shutil.copy(Path(__file__).with_suffix(".mjs"), work / "page.mjs")
    for folder in os.environ["NODE_PATH"].split(os.pathsep):
        for name in (n for n in ("three", "@sparkjsdev") if Path(folder, n).is_dir()):
            (work / name).symlink_to(Path(folder, name))
    places = {"three": "build/three.module.js", "three/addons/": "examples/jsm/", "@sparkjsdev/spark": "dist/spark.module.js"}
    maps = json.dumps({"imports": {name: f"/{name.replace('/addons/', '')}/{place}" for name, place in places.items()}})
    page = f'<script type="importmap">{maps}</script><script>const JOBS = {json.dumps(jobs)}</script>'
    (work / "index.html").write_text(page + '<script type="module" src="/page.mjs"></script>', "utf-8")

    class Handler(SimpleHTTPRequestHandler):
        extensions_map = SimpleHTTPRequestHandler.extensions_map | {".mjs": "text/javascript"}

        def __init__(self, *args, **kwargs) -> None:
            super().__init__(*args, directory=str(work), **kwargs)

        def do_POST(self) -> None:
            bodies[jobs[int(self.path[1:])]] = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()
            if len(bodies) == len(jobs):
                done.set()

        def log_message(self, *_: object) -> None:
            """Print nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    words = [browser, "--headless", "--no-sandbox", f"--user-data-dir={work / 'profile'}"]
    window = subprocess.Popen([*words, f"http://127.0.0.1:{server.server_port}/"], stderr=subprocess.DEVNULL)
    done.wait(600)
    window.terminate()
    window.wait()
    server.shutdown()
    return bodies


def exported(run: Path, work: Path) -> list[str]:
    """Write a run in every format to a folder; return the names of the files of Gaussians."""
    plain, packed = ["m.ply", "m.compressed.ply", "m.splat", "m.sog", "m.glb", "m.gltf"], ["v2.spz", "v3.spz", "v4.spz"]
    for name in plain:
        export(run, work / name, Filters(clean=False))
    for name in packed:
        export(run, work / name, Filters(clean=False), SPZ(SPZConfig(int(name[1]))))
    for name in MESHES:
        mesh(run, work / name, MeshOptions(), "cpu", stage=str, say=str)
    export(run, work / "sparse")
    return plain + packed


def others(work: Path, program: str, command: list[str], bodies: dict) -> Iterator[tuple[str, float, float]]:
    """Yield file, difference and step of meshes, cameras and valid glTF files."""
    name, pieces = program.split(maxsplit=1)[0], (work / "mesh.ply").read_bytes().split(b"end_header\n", 1)
    n, f = (int(pieces[0].split(kind, 1)[1].split(maxsplit=1)[0]) for kind in (b"element vertex ", b"element face "))
    points = np.frombuffer(pieces[1], [("xyz", "<f4", 3), ("rgb", "u1", 3)], n)["xyz"]
    corners = points[np.frombuffer(pieces[1], [("n", "u1"), ("abc", "<i4", 3)], f, 15 * n)["abc"]].astype(np.float64)
    for file in MESHES if name in ("open3d", "three.js") else ():
        read = bodies.get((name, file)) or np.load(convert(command, work / file, work / "out.npz"))
        theirs = np.reshape(read["vertices"], (-1, 3))[np.reshape(read["faces"], -1)]
        yield file, rigid(corners.reshape(-1, 3), theirs), 4 * float(np.spacing(np.abs(points).max()))
    if name == "pycolmap":
        stored, theirs = format_of(work / "m.ply"), np.load(convert(command, work / "sparse/0", work / "out.npz"))
        stored.read_stored(work / "m.ply")
        apart = np.inf
        for view, camera in read_cameras(work / "sparse")[0].items():
            R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
            P = camera.K @ np.c_[R, R @ stored.origin + t]
            apart = max(0 if apart == np.inf else apart, float(np.abs(theirs[view] - P).max()))
        yield "sparse", apart, 1e-6
    for file in ("m.glb", "m.gltf", "mesh.glb") if name == "gltf-validator" else ():
        done = subprocess.run(["node", "-e", VALIDATE, str(work / file)], capture_output=True, text=True, check=False)
        yield file, float(done.stdout or "inf"), 0


def rows_of(files: list[str], work: Path, commands: dict[str, list[str]], browser: str, whole: bool) -> Iterator[dict]:
    """Yield a row for each file and program: what it reads, and what warpgs reads of its files from our PLY."""
    names = {program: program.split()[0] for program in commands}
    jobs = [(n, f) for n in names.values() if n in ("three.js", "Spark") for f in files if f.endswith(READS[n])]
    jobs += [("three.js", file) for file in MESHES if whole and "three.js" in names.values()]
    bodies = shown(browser, work, jobs) if jobs else {}
    for program, name in names.items():
        for file in (f for f in files if f.endswith(READS.get(name, ()))):
            steps = dict(zip(NAMES, STEPS.get(name, FLOAT)))
            steps |= {"quats": max(steps["quats"], 1 / 128)} if file.endswith(".splat") else {}
            steps |= {"opacities": 1 / 1000} if file.endswith((".spz", ".splat", ".sog")) and name != "Spark" else {}
            try:
                if "error" in (body := bodies.get((name, file), {})):
                    raise DataError(body["error"])
                theirs = of_page(body) if body else own(convert(commands[program], work / file, work / "out.ply"))
                facts = compared(own(work / file), theirs, steps, TURNED.get((name, Path(file).suffix), ""))
            except DataError as e:
                facts = {"verdict": f"not read: {str(e).replace(f'{work}/', '')}"}
            yield {"direction": "to", "program": program, "format": file} | facts
        for suffix, *words in WRITES.get(name, ()) if whole else ():
            mine = "v3.spz" if suffix == ".spz" else f"m{suffix.removeprefix('.text')}"
            model, steps = own(work / "m.ply"), dict(zip(NAMES, STEPS.get(suffix, FLOAT)))
            least = compared(model, own(work / mine), steps)["largest"]
            try:
                theirs = own(convert([*commands[program], *words], work / "m.ply", work / f"theirs{suffix}"))
                facts = compared(model, theirs, {k: max(v, 2 * least.get(k, 0)) for k, v in steps.items()})
            except DataError as e:
                facts = {"verdict": f"not read: {str(e).replace(f'{work}/', '')}"}
            yield {"direction": "from", "program": program, "format": suffix} | facts
        for file, most, step in others(work, program, commands[program], bodies) if whole else ():
            facts = {"largest": {"all": most}, "steps": {"all": step}, "verdict": "same" if most <= step else "other values"}
            yield {"direction": "to", "program": program, "format": file} | facts


def main() -> None:
    """Compare, print and write."""
    a = parse(__doc__, None, {"paths": [Path]}, python="python3", browser="chromium", out=Path)
    (commands, facts), rows = programs(a.python), []
    runs, loose = [p for p in a.paths if p.is_dir()], [p for p in a.paths if p.is_file()]
    for scene in [*runs, loose] if loose else runs:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            whole = isinstance(scene, Path)
            files = exported(scene, Path(folder)) if whole else [Path(shutil.copy(p, folder)).name for p in scene]
            for row in rows_of(files, Path(folder), commands, a.browser, whole):
                rows.append({"scene": scene.name if whole else "files"} | row)
                largest = " ".join(f"{name} {value:.2g}" for name, value in row.get("largest", {}).items())
                print(*list(rows[-1].values())[:4], row["verdict"], largest, sep="  ", flush=True)
    result_file.keep(a.out, WHAT, torch.device("cpu"), rows, programs=facts)


if __name__ == "__main__":
    main()
