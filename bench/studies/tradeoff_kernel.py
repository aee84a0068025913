"""Time of an image with its gradients against its error, for every setting of the rasterizer, on frozen scenes, with a chart.

RUN is a fit, for the trained scene. An interrupted measurement continues: scenes in --out are not measured again. A chart is
written as SVG beside --out.
"""

from __future__ import annotations

from pathlib import Path

from bench.lib import pareto, result_file
from bench.lib.arguments import parse
from bench.lib.frozen import scenes
from bench.lib.pool import stored_rows
from bench.lib.tables import markdown
from bench.lib.tradeoff_kernel import measure_scene, sorting_share
from warpgs.files import write_text
from warpgs.pipeline.run.request import choose_device

WHAT = "time of a render and its gradients against their error, for every setting"


def chart(done: dict) -> str:
    """Return a chart of the time of an image with its gradients against its mean error, a panel for each scene."""
    panels = []
    what = "processor time of an image with gradients" if done["machine"]["device"] == "cpu" else "image with gradients"
    for name, scene in done["scenes"].items():
        points = tuple(
            pareto.Point(r["setting"], r["knob"], r["both_ms"], max(r["mean"], 1e-9), preset=r["preset"])
            for r in done["rows"] if r["scene"] == name and "both_ms" in r
        )  # fmt: skip
        panels.append(pareto.Panel(name, scene["what"], f"{what} [ms]", "mean error to float64 without cut-offs", points))
    m = done["machine"]
    return pareto.chart(f"{m['name']}: time against error, {done['size'][0]} x {done['size'][1]} px", panels)


def table(done: dict) -> str:
    """Return time and mean error of every setting as multiples of `exact`'s, scene by scene."""
    names, lines = list(done["scenes"]), []
    rows = {n: {r["setting"]: r for r in done["rows"] if r["scene"] == n} for n in names}
    for setting in rows[names[0]]:
        lines.append([setting])
        for n in names:
            r, e = rows[n].get(setting), rows[n]["exact"]
            time = "" if r is None else f"{r['both_ms'] / e['both_ms']:.2f}" if "both_ms" in r else "-"
            lines[-1].append("" if r is None else f"{time}, {r['mean'] / e['mean']:.2g}")
    return markdown(["setting", *(f"{n}: time, error" for n in names)], lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure what the file lacks, scene by scene; write, draw, print the table."""
    a = parse(
        __doc__, arguments, need=("out",), device="auto", run=Path, width=252, count=8000, seed=0, repeats=7, plot=False,
        out=Path,
    )  # fmt: skip
    device, height = choose_device(a.device)[0], round(a.width * 0.75)
    facts = {"kind": "kernel", "size": [a.width, height, a.count, a.seed], "scene": str(a.run and a.run.name)}
    rows = [] if a.plot else stored_rows(a.out, **facts)
    done = result_file.read(a.out) if rows or a.plot else {"scenes": {}}
    for make in () if a.plot else scenes(device, a.width, height, a.count, a.run, a.seed):
        scene = make()
        if scene.name not in done["scenes"]:
            rows += measure_scene(scene, a.repeats)
            size = {"gaussians": len(scene.gaussians), "width": scene.camera.width, "height": scene.camera.height}
            done["scenes"][scene.name] = {"what": scene.what, **size, "sorting": sorting_share(scene, a.repeats)}
            done = result_file.result(WHAT, device, rows, **facts, repeats=a.repeats, scenes=done["scenes"])
            result_file.write(a.out, done)
            print(f"{scene.name}: {scene.what}: done", flush=True)
    write_text(a.out.with_suffix(".svg"), chart(done))
    print(table(done))


if __name__ == "__main__":
    main()
