"""Rules: the code that is mutated, the device that runs it, and its tests."""

import ast
import re
from pathlib import Path

SPEED = {
    "AHEAD", "SHORT", "CHUNKS_PER_THREAD", "FEW_THREADS", "SERIAL_WORK", "SEGMENT", "LANES",
    "ERROR_SEGMENT", "ERROR_LANES", "BATCH", "BLOCK", "BOX",
    "MAX_TILES", "WARPS", "STRIP", "ABREAST", "MAX_GRAPHS", "MIN_REPLAYS", "FREE_CAPTURES", "SMALL_BYTES",
}  # fmt: skip
"""Sizes of portions of work, and numbers of graphs; results are equal for every value allowed by the constant's comment."""

HINTS = {
    "cost", "enable_backward", "grid_stride", "record_tape", "sync", "requires_grad", "cuda_max_registers", "launch_bounds",
    "max_unroll",
}  # fmt: skip
"""Keywords, and keys of options, of Warp or torch that do not affect results."""

SLACK = {"margin", "slack", "slack_x", "slack_y", "limit_of"}
"""Safety margins of bounds: a margin larger by a hundredth lists an additional tile, without effect. Operators are mutated."""

MUTATED = (
    "warpgs/kernels/*.py", "warpgs/kernels/cuda/*.cu",
)  # fmt: skip
"""The files that are mutated."""

CUDA_FILES = ("warpgs/kernels/blend_cuda.py", "warpgs/kernels/ssim.py", "warpgs/kernels/native.py")
CUDA_FUNCTIONS = {
    "warpgs/kernels/launch.py": ("_Recorded", "_recorded", "warp_stream", "_warp_stream", "stream_of", "warp_device"),
    "warpgs/kernels/graphs.py": (
        "CapturedGraph", "GraphMemory", "GraphPool.capture", "GraphPool.release",
    ),
    "warpgs/kernels/update.py": ("scheduled_update",),
    "warpgs/kernels/walk.py": ("make_native",),
}  # fmt: skip
"""Code that only a CUDA device runs, in addition to code that `sides` and `ends_cpu` find."""

CUDA_ARGUMENTS = {"deterministic", "block_dim"}
"""Arguments that have an effect only on CUDA, where their defaults and their values are tested."""

LIMITS, LIMITS_PROJECT, LIMITS_BLEND = (f"kernels/test_{what}.py" for what in ("limits", "project", "limits"))
SPANS, CUTS = "kernels/test_ellipse.py", "kernels/test_launch.py"
RECORDS, BODIES, GUARDS = (f"kernels/test_{what}.py" for what in ("limits", "native", "guard_bytes"))
EXTREMES, LAYERS = "numerics/test_extreme_projection.py", "numerics/test_extreme_compositing.py"
OPS = {
    "adam": ["kernels/test_update.py", LIMITS, "pipeline/test_model.py"],
    "blend": ["kernels/test_blend.py", "render/test_rasterize.py", LIMITS_BLEND],
    "blend_channels": ["kernels/test_blend.py", "render/test_outputs.py"],
    "blend_cpu": ["kernels/test_blend.py", LIMITS_BLEND, RECORDS, LAYERS, "render/test_window.py"],
    "blend_cuda": ["kernels/test_blend.py", "render/test_rasterize.py", LIMITS_BLEND, RECORDS, LAYERS, "render/test_window.py"],
    "cameras/": ["kernels/test_project.py", LIMITS_PROJECT, EXTREMES, "kernels/test_cameras.py"],
    "cuda_graph": ["kernels/test_graphs.py", "render/test_graphed.py"],
    "step_buffers": ["kernels/test_update.py"],
    "interop": [CUTS, "kernels/test_update.py", "kernels/test_sh.py", "kernels/test_tiles.py"],
    "compiler": ["kernels/test_blend.py"],
    "camera_reach": ["kernels/test_neighbours.py"],
    "dropout": ["kernels/test_update.py"],
    "covariance": ["render/test_inputs.py"],
    "falloff": [SPANS, "kernels/test_blend.py", LIMITS_BLEND],
    "functions": ["kernels/test_project.py", SPANS, LIMITS_PROJECT, EXTREMES, "kernels/test_tiles.py", "render/test_window.py"],
    "knn": ["kernels/test_neighbours.py", LIMITS],
    "allocator": ["kernels/test_launch.py", "kernels/test_graphs.py", "render/test_graphed.py"],
    "heaviest": ["kernels/test_walk.py"],
    "median_depth": ["kernels/test_walk.py", "kernels/test_blend.py"],
    "native": [
        "kernels/test_project.py", "kernels/test_tiles.py", "render/test_rasterize.py", LIMITS_PROJECT, LIMITS_BLEND, RECORDS,
    ],
    "opacity_decay": ["kernels/test_update.py"],
    "pixel_size": ["kernels/test_neighbours.py"],
    "plane_costs": ["kernels/test_sweep.py"], "plane_depths": ["kernels/test_sweep.py"],
    "project": ["kernels/test_project.py", LIMITS_PROJECT, EXTREMES, "kernels/test_tiles.py", "render/test_rasterize.py"],
    "project_backward": ["kernels/test_project.py", LIMITS_PROJECT, RECORDS, EXTREMES, "render/test_rasterize.py"],
    "scanlines": ["kernels/test_sweep.py"],
    "sh": ["kernels/test_sh.py", "kernels/test_project.py"],
    "ssim": ["kernels/test_ssim.py", LIMITS],
    "tsdf": ["kernels/test_tsdf.py"],
    "tiles": ["kernels/test_tiles.py", LIMITS_BLEND, RECORDS, "render/test_rasterize.py", "render/test_window.py"],
}  # fmt: skip
"""Tests by the longest matching prefix of a file's name tests that fail soonest come first."""

ROOMS = {
    "blend": ["blend", "blend_channels"], "cameras": ["cameras/"], "ellipse": ["functions", "covariance", "project_backward"],
    "graphs": ["cuda_graph"], "launch": ["interop", "allocator"], "native": ["native", "compiler"],
    "neighbours": ["knn", "camera_reach", "pixel_size"], "sweep": ["plane_costs", "plane_depths", "scanlines"],
    "update": ["adam", "step_buffers", "opacity_decay", "dropout"], "walk": ["heaviest", "median_depth"],
}  # fmt: skip
"""Entries of the table above for files that hold several ops."""

CUDA_OPS = {
    "adam": [GUARDS, "pipeline/train/test_batch.py"],
    "blend_cuda": [BODIES, GUARDS, "render/test_outputs.py"], "cameras/": [GUARDS],
    "cuda_graph": ["render/test_graphed_cuda.py", "pipeline/train/test_batch.py"],
    "interop": [BODIES, "kernels/test_project.py", "pipeline/train/test_batch.py"],
    "median_depth": [GUARDS], "native": [BODIES, GUARDS], "project": [GUARDS],
    "project_backward": [GUARDS], "project_cuda": [BODIES, GUARDS], "ssim": [GUARDS],
    "tiles": [BODIES, GUARDS, "pipeline/train/test_batch.py"],
}  # fmt: skip
"""Further tests for CUDA: single bodies, memory next to a tensor, captured steps."""

SKIPPED = ("tests/kernels/test_blend.py::test_gradcheck",)
"""Tests that take nearly a minute, and check the same digits as another test in the list."""


def tests_of(file: str, cuda: bool) -> list[str]:
    """Return the test files for a file that is mutated, on CUDA or on the CPU."""
    path = Path(file)
    ops = ROOMS.get(path.stem) if path.suffix == ".py" else None
    if ops is None:
        op = max((name for name in OPS if path.stem.startswith(name)), key=len)
        ops = ["blend_cuda" if file.endswith(".cu") and op == "blend" else op]
    more = [test for op in ops for test in CUDA_OPS.get(op, [])] if cuda else [CUTS]
    return [f"tests/{name}" for name in dict.fromkeys([*(test for op in ops for test in OPS[op]), *more])]


def left_out(node: ast.AST) -> bool:
    """Return whether a node is not mutated, with all below it.

    Not mutated are errors, since their text is not arithmetic; formatted text, that is, names of modules and messages; imports
    and `__all__`; hints and portions, which change the time but not the numbers; and slack, see `SLACK`.
    """
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.Import() | ast.ImportFrom():
            return True
        case ast.keyword(arg=name):
            return name in HINTS
        case ast.Assign(targets=[ast.Name(id=name)]):
            return name in SPEED
        case ast.AnnAssign(target=ast.Name(id=name)):
            return name in SPEED
    return False


def is_hint(node: ast.AST) -> bool:
    """Return whether a key of a dictionary is the name of a hint, so that its value is left out."""
    return isinstance(node, ast.Constant) and node.value in HINTS


def number_left_out(statement: ast.stmt | None) -> bool:
    """Return whether the numbers of a statement are left out, but not its operators."""
    return isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) in SLACK


def native_number_left_out(line: str) -> bool:
    """Return the same for a line of a CUDA body; sizes of portions of work count there, too."""
    declared = re.match(r"\s*(?:const float|auto|constexpr int) (\w+) =", line)
    return bool(declared) and declared[1] in SLACK | SPEED


def sides(node: ast.AST) -> tuple[bool, bool]:
    """Return whether only CUDA runs the body of an ``if`` (or conditional expression), and the same of its ``else``."""
    if not isinstance(node, ast.If | ast.IfExp):
        return False, False
    test = ast.unparse(node.test)
    if "== 'cuda'" in test or re.fullmatch(r"native|wp\.static\(native\)|is_native\(\w+\)", test):
        return True, False
    return False, "== 'cpu'" in test or "blocked" in test


def ends_cpu(statement: ast.AST) -> bool:
    """Return whether a statement is an ``if`` for the CPU that ends in a return, so that only CUDA runs the code after it."""
    if not isinstance(statement, ast.If) or not isinstance(statement.body[-1], ast.Return):
        return False
    return re.fullmatch(r"[\w.]+\.type == 'cpu'", ast.unparse(statement.test)) is not None
