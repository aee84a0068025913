"""Public names: how a face loads them on first use, and where a name is that older code imports from within the package.

The faces are `warpgs`, `warpgs.train`, `warpgs.kernels`, `warpgs.io`, `warpgs.export`, `warpgs.compat.gsplat` and
`warpgs.compat.inria`. Everything else may move. Inside the package, names are imported from the modules that define them, so
that faces make no circle.
"""

import functools
import importlib
import sys
from collections.abc import Callable
from typing import Any


def _moved(face: str, *names: str, **renamed: str) -> dict[str, str]:
    """Return the places at a face of names, and of those that are ``renamed`` there."""
    return {old: f"{face}.{now}" for old, now in (dict(zip(names, names)) | renamed).items()}


OLD = {
    "errors": _moved("warpgs", "DataError", "NotFiniteError", "ResourceError", "UsageError", "WarpgsError"),
    "export.arrays": _moved("warpgs.export", "Arrays"),
    "export.base": _moved("warpgs.export", "Format", register="register_format"),
    "export.formats": _moved("warpgs.export", "read_gaussians", "write_gaussians"),
    "geometry": _moved("warpgs", "depth_normals", "gaussian_normals", "look_at"),
    "io.folders": _moved("warpgs.io", "SceneFolder", "ViewList", "view_name"),
    "io.given_maps": _moved("warpgs.io", "NamedMaps"),
    "io.images": _moved("warpgs.io", "Lens", "LoadedImage"),
    "io.map_files": _moved("warpgs.io", MapOptions="ReadOptions"),
    "io.readers": _moved("warpgs.io", "Probe", "Reader", "ReadOptions", register="register_reader"),
    "kernels.cameras.base": _moved("warpgs.kernels", "CameraModel", register="register_camera_model"),
    "kernels.ssim": _moved("warpgs.train", "ssim"),
    "kernels.step_buffers": _moved("warpgs.train", "Setting"),
    "mesh.fuse": _moved("warpgs", "MeshOptions", fuse="fuse_mesh"),
    "pipeline.model.init": _moved("warpgs.train", "InitConfig"),
    "pipeline.model.table": _moved("warpgs.train", "Column", "DensityUpdate", "Table"),
    "pipeline.train.context": _moved("warpgs.train", "Growth", "Settings", "StrategyContext"),
    "pipeline.train.learned_views": _moved("warpgs.train", "LearnedView"),
    "pipeline.train.loss": _moved("warpgs.train", "LossInputs", "LossTerm", "Target", "total", register="register_loss_term"),
    "pipeline.train.loss_terms.photometric": _moved("warpgs.train", "photometric_loss"),
    "pipeline.train.memory_plan": _moved("warpgs.train", "most_instances"),
    "pipeline.train.presets": _moved("warpgs", "PRESETS"),
    "pipeline.train.schedule": _moved("warpgs.train", "OptimizerConfig", "Phases"),
    "pipeline.train.step": _moved("warpgs.train", "captured_renderer", "eager_renderer"),
    "pipeline.train.strategies.base": _moved("warpgs.train", "Strategy", register="register_strategy"),
    "pipeline.train.strategies.clone_split": _moved("warpgs.train", "CloneSplit"),
    "pipeline.train.strategies.gradient_growth": _moved("warpgs.train", "GradientGrowth"),
    "pipeline.train.view_modules.base": _moved(
        "warpgs.train", "FittedViews", "Tensors", "ViewModule", register="register_view_module"
    ),
    "pipeline.train.views": _moved("warpgs.train", "TrainingView"),
    "report.images": {"png": "PIL.Image.Image.save"},
    "rules": _moved("warpgs", "rule_named"),
    "runtime.ranks": _moved("warpgs.train", join="join_ranks"),
    "runtime.step_sizes": _moved("warpgs.train", "Needs", "STEP", "StepSizes"),
    "scene": {"Prior": "warpgs.train.Prior", "Scene": "warpgs.Scene"},
    "schema": _moved("warpgs.train", fields="state_schema"),
    "synthetic.demo": dict.fromkeys(("camera_path", "still_life", "write_demo"), "warpgs.write_demo"),
    "synthetic.raycast": dict.fromkeys(("Light", "render"), "warpgs.write_demo"),
}
"""Names that older pages and examples imported, by their module below ``warpgs``, each with the name that replaces it."""


def lazy(face: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a face: the names that it imports for type checkers load on first use.

    Its ``__all__`` has all of them but the faces below it.
    """
    # Importing torch and Warp at once would delay `warpgs --help` by seconds. The imports are read from the face's
    # source, which is always there: Warp compiles kernels from their source, too.

    @functools.cache
    def places() -> dict[str, tuple[str, str]]:
        """Return the module of each public name, and the name there."""
        import ast

        spec: Any = sys.modules[face].__spec__
        (block,) = (n for n in ast.parse(spec.loader.get_source(face)).body if isinstance(n, ast.If))
        rows = [n for n in block.body if isinstance(n, ast.ImportFrom)]
        return {a.asname or a.name: (n.module or "", a.name) for n in rows for a in n.names}

    def get(name: str) -> object:
        """Import a public name on first use."""
        if name == "__all__":
            return sorted(n for n, (home, _) in places().items() if home != face)
        if name not in places():
            raise AttributeError(f"module {face!r} has no attribute {name!r}")
        home, attribute = places()[name]
        if home == face:  # a face below this one
            return importlib.import_module(f"{face}.{attribute}")
        return getattr(importlib.import_module(home), attribute)

    def names_of_face() -> list[str]:
        """Return the public names and those with two underscores."""
        return sorted([*places(), *(n for n in vars(sys.modules[face]) if n.startswith("__"))])

    return get, names_of_face


class OldNames:
    """Finder of the modules of `OLD`: an import of a module or name that is gone raises an error with the new name."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Return what the next finders find; None for other modules.

        Raises:
            ModuleNotFoundError: The module is gone.
        """
        if not name.startswith("warpgs."):
            return None
        own = OLD.get(name.removeprefix("warpgs."), {})
        below = {f"warpgs.{old}": names for old, names in OLD.items() if f"warpgs.{old}".startswith(f"{name}.")}
        if not own and not below:
            return None
        later: list[Any] = sys.meta_path[sys.meta_path.index(self) + 1 :]
        spec = next((found for finder in later if (found := finder.find_spec(name, path, target))), None)
        if spec is None:
            moved = [f"{old}.{n} is now {new}" for old, names in {name: own, **below}.items() for n, new in names.items()]
            raise ModuleNotFoundError(f"the module {name} is gone: {'; '.join(moved)}", name=name)
        load = spec.loader.exec_module

        def load_and_compare(module: Any) -> None:
            """Load a module; let it name the new places of what it lacks, and ask this finder for modules below it."""
            load(module)
            if lost := {n: new for n, new in own.items() if not hasattr(module, n)}:
                module.__getattr__ = lambda n: _raise_moved(name, n, lost)
            if below and not hasattr(module, "__path__"):
                module.__path__ = []  # a folder that became a file

        spec.loader.exec_module = load_and_compare
        return spec


def _raise_moved(module: str, name: str, lost: dict[str, str]) -> None:
    """Raise the error about a name that a module lacks."""
    if name in lost:
        raise ImportError(f"{module}.{name} is now {lost[name]}", name=module)
    raise AttributeError(f"module {module!r} has no attribute {name!r}")
