"""Training views: their tensors on the device, the order in which steps take them, and what is learned of them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from warpgs.device import FLOAT, STEP, Needs, StepSizes
from warpgs.errors import UsageError
from warpgs.pipeline.metrics.scores import OPAQUE
from warpgs.pipeline.model.edit import batch_of
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.view_modules import ViewModule
from warpgs.plugins import returned
from warpgs.scene import Camera, Tensors, View


def there(array: Any, device: torch.device) -> Any:
    """Return an array as a float32 tensor on a device; None stays None."""
    return None if array is None else torch.as_tensor(array, dtype=torch.float32, device=device)


def seen(modules: Sequence[ViewModule], rgb: torch.Tensor, values: Tensors) -> torch.Tensor:
    """Apply view modules to rendered colours [H, W, 3]; ``values`` are the modules' values for the view, by name, [...]."""
    for module in modules:
        shown = module.after_render(rgb, values)
        rgb = returned(module, "after_render", shown, torch.Tensor, "colours [H, W, 3]", shape=rgb.shape)
    return rgb


@dataclass(frozen=True)
class LearnedView:
    """Camera and learned values of one training view."""

    modules: tuple[ViewModule, ...]
    """View modules of the fit."""
    given: Camera
    """Given camera, which modules change."""
    values: Tensors
    """Current values, by name, [...], overwritten in place."""


class LearnedViews:
    """The view modules of a fit and the table of their parameters, which has a row for each training view."""

    def __init__(self, modules: Sequence[ViewModule], views: Sequence[View], device: torch.device):
        """Begin with the initial parameters of each module for training views."""
        self.modules = tuple(modules)
        self._names: list[tuple[str, ...]] = []
        first: dict[str, torch.Tensor] = {}
        for module in modules:
            own, what = module.parameters(views), "tensors [V, ...] by name, with a row for each training view"
            returned(module, "parameters", own, Mapping, what, each=torch.Tensor, shape=(len(views),))
            for name in own.keys() & first.keys():
                other = next(m.name for m, names in zip(modules, self._names) if name in names)
                raise UsageError(f"the view modules {other!r} and {module.name!r} both have a parameter {name!r}; rename one")
            rates = returned(module, "lrs", module.lrs(0.0, 1.0), Mapping, what := "a rate for each parameter, by name")
            returned(module, "lrs", {n: rates.get(n) for n in own}, Mapping, what, each=(int, float))
            first |= {n: t.to(device, torch.float32) for n, t in own.items()}
            self._names.append(tuple(own))
        self.table = Table(first, {}, device, len(views))
        """Parameters with their Adam moments."""

    def params_of(self, module: ViewModule) -> dict[str, torch.Tensor]:
        """Return the parameters of one of the modules, by name, shape [V, ...]."""
        return {n: self.table.params[n] for n in self._names[self.modules.index(module)]}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rate of each parameter; arguments are those of `ViewModule.lrs`."""
        return {n: lr for m in self.modules for n, lr in m.lrs(progress, extent).items()}

    def values(self, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the values of all modules for views with these indices [B], by name, shape [B, ...]; differentiable."""
        values: dict[str, torch.Tensor] = {}
        for m in self.modules:
            own = m.values(self.params_of(m), numbers)
            what, size = "tensors [B, ...] by name", numbers.shape
            values |= returned(m, "values", own, Mapping, what, each=torch.Tensor, shape=size)
        return values

    def before_render(self, camera: Camera, values: Tensors) -> Camera:
        """Return the camera that views are rendered from; arguments are those of `ViewModule.before_render`."""
        for module in self.modules:
            camera = returned(module, "before_render", module.before_render(camera, values), Camera, "a Camera")
        return camera

    def regularisation(self, values: Tensors) -> dict[str, torch.Tensor]:
        """Return the terms that modules add to the loss of a view with these values [...], shape [] each, by module name."""
        terms, what = [(m, m.regularisation(values)) for m in self.modules], "a tensor of shape [], or None"
        return {m.name: returned(m, "regularisation", t, torch.Tensor, what, shape=()) for m, t in terms if t is not None}

    def cameras(self, given: Mapping[str, Camera], train: Sequence[str], test: Sequence[str]) -> Mapping[str, Camera]:
        """Return the current cameras of all views, by name; arguments are those of `ViewModule.cameras`."""
        for module in self.modules:
            new = module.cameras(given, train, test, self.params_of(module))
            given = returned(module, "cameras", new, Mapping, "the Camera of each view by name", each=Camera)
        return given


Kind = tuple[int, int, bool, str]
"""Width and height [px] of a view, whether it has a mask, and its camera model."""
Place = tuple[Kind, int]
"""Kind of a view, and its row in the stack of that kind."""


@dataclass(frozen=True)
class TrainingView:
    """A training view on the device of the fit."""

    camera: Camera
    """Current camera with float32 tensors on the device; a learned camera is overwritten in place."""
    image: torch.Tensor
    """Colours in [0, 1], shape [H, W, 3]."""
    mask: torch.Tensor | None = None
    """1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask."""
    consistent: torch.Tensor | None = None
    """Geometrically consistent z-depth [u], 0 where no other view confirms it, shape [H, W]; None if not computed."""
    maps: Tensors = field(default_factory=dict)
    """Maps for loss terms (`LossTerm.needs`), by name, each of shape [H, W] or [H, W, C]."""
    alpha: torch.Tensor | None = None
    """Opacity of the subject, in [0, 1], shape [H, W]; None if no training view has one (`with_alpha`)."""
    depth: torch.Tensor | None = None
    """Given z-depth [u] that agrees with the other views, 0 for missing values, shape [H, W]. Only available in
    `LossTerm.needs`; None later, or without given depth."""
    depth_weight: torch.Tensor | None = None
    """Confidence in ``depth``, in [0, 1], shape [H, W]; None for 1 everywhere, or without depth."""
    normals: torch.Tensor | None = None
    """Given unit normals in camera axes, 0 for missing values, shape [H, W, 3]. Only available in `LossTerm.needs`; None later,
    or without given normals."""
    learned: LearnedView | None = None
    """Values of the view in the view modules of the fit; None without view modules."""

    @staticmethod
    def of(view: View, device: torch.device) -> "TrainingView":
        """Return a view's pixels, mask, opacity and camera in float32 on a device."""
        c = view.camera
        lens = c.distortion if c.distortion is not None and len(c.distortion) else None
        arrays = (c.viewmat, c.K, lens, view.image, view.mask, view.alpha)
        viewmat, K, distortion, image, mask, alpha = (there(a, device) for a in arrays)
        return TrainingView(replace(c, viewmat=viewmat, K=K, distortion=distortion), image, mask, alpha=alpha)

    @property
    def kind(self) -> Kind:
        """Width, height, presence of a mask and camera model, which are equal for the views of a stack."""
        return self.camera.width, self.camera.height, self.mask is not None, self.camera.model

    @property
    def given(self) -> Camera:
        """Camera before view modules changed it."""
        return self.camera if self.learned is None else self.learned.given

    def seen(self, rgb: torch.Tensor) -> torch.Tensor:
        """Return rendered colours [H, W, 3] after the view modules of the fit."""
        return rgb if self.learned is None else seen(self.learned.modules, rgb, self.learned.values)

    @property
    def countable(self) -> torch.Tensor | None:
        """1 at pixels that are opaque and not masked out, else 0, shape [H, W]; None if all pixels count."""
        if self.alpha is None:
            return self.mask
        opaque = (self.alpha > OPAQUE).to(self.image.dtype)
        return opaque if self.mask is None else opaque * self.mask


def step_bytes(sizes: StepSizes) -> Needs:
    """Return the bytes of the view of a step.

    On CUDA, image, mask, opacity and one map of a loss term that reads depth are copied from the stacks. Views with an alpha
    channel are composited over the background of the step.
    """
    copies = (3 + sizes.masked + sizes.cutout + sizes.depth) * sizes.cuda
    return dict.fromkeys(STEP, FLOAT * sizes.pixels * (copies + 6 * sizes.cutout))


def view_bytes(views: Iterable[TrainingView]) -> int:
    """Return the bytes of views: images, masks, opacities and maps; shared memory is counted once.

    Stacks are not counted: on CUDA, images, masks, opacities and maps of the views are parts of the stacks (`stack_views`); on
    a CPU, stacks have no memory of their own.
    """
    tensors = (t for v in views for t in (v.image, v.mask, v.alpha, v.consistent, *v.maps.values()))
    return sum({s.data_ptr(): s.nbytes() for s in (t.untyped_storage() for t in tensors if t is not None)}.values())


def with_alpha(views: Sequence[View]) -> list[View]:
    """Return the views; if any has an opacity, opaque ones get an opacity of 1 everywhere [H, W]."""
    if all(v.alpha is None for v in views):
        return list(views)
    return [replace(v, alpha=np.ones(v.image.shape[:2], np.float32)) if v.alpha is None else v for v in views]


def half_size_camera(c: Camera) -> Camera:
    """Return the camera with both sides of its image halved, rounded down but to at least one pixel."""
    width, height = max(1, c.width // 2), max(1, c.height // 2)
    scale = torch.tensor([width / c.width, height / c.height, 1.0], dtype=c.K.dtype, device=c.K.device)
    return replace(c, K=scale[:, None] * c.K, width=width, height=height)


def half_size(view: TrainingView) -> "TrainingView":
    """Return the view with both sides halved, rounded down but to at least one pixel; without scores.

    Colours, opacities and maps are means over the covered pixels; a pixel is masked if any covered pixel is masked.
    """
    camera = half_size_camera(view.camera)
    width, height = camera.width, camera.height

    def mean(channels: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.interpolate(channels[None], (height, width), mode="area")[0]

    def smaller(t: torch.Tensor) -> torch.Tensor:
        return mean(t[None])[0] if t.ndim == 2 else mean(t.permute(2, 0, 1)).permute(1, 2, 0).contiguous()

    mask = None if view.mask is None else (mean(view.mask[None])[0] > 1 - 1e-4).to(view.mask.dtype)
    maps, alpha = {n: smaller(t) for n, t in view.maps.items()}, None if view.alpha is None else smaller(view.alpha)
    learned = None if view.learned is None else replace(view.learned, given=half_size_camera(view.learned.given))
    return TrainingView(camera, smaller(view.image), mask, maps=maps, alpha=alpha, learned=learned)


Rows = torch.Tensor | tuple[torch.Tensor, ...]
"""One entry for each view: a tensor [V, ...], or on a CPU one tensor per view."""


@dataclass(frozen=True)
class ViewStack:
    """Training views of one kind, stacked, from which a step takes its view."""

    camera: Camera
    """Cameras as given: viewmat [V, 4, 4], K [V, 3, 3], and coefficients [V, P] or None."""
    images: Rows
    """Colours in [0, 1], shape [V, H, W, 3]."""
    masks: Rows | None
    """1 for unmasked pixels, 0 for masked ones, shape [V, H, W]; None without masks."""
    maps: Mapping[str, Rows]
    """Maps that loss terms requested, by name, each of shape [V, H, W, ...]."""
    numbers: torch.Tensor
    """Index of each view among all training views, int64, shape [V]."""
    alphas: Rows | None = None
    """Opacity of the subject, shape [V, H, W]; None if no training view has one."""


def camera_at(cameras: Camera, i: int) -> Camera:
    """Return camera ``i`` of a batch."""
    distortion = None if cameras.distortion is None else cameras.distortion[i]
    return replace(cameras, viewmat=cameras.viewmat[i], K=cameras.K[i], distortion=distortion)


def stacked(tensors: Sequence[torch.Tensor]) -> Rows:
    """Return tensors of one shape as one, [V, ...]; on a CPU, where a step reads one at a time, return them unchanged.

    Tensors that already are consecutive in memory, as in an earlier stack, are not copied.
    """
    first = tensors[0]
    if first.device.type == "cpu":
        return tuple(tensors)
    step, storage = first.numel() * first.element_size(), first.untyped_storage().data_ptr()
    behind = all(
        t.is_contiguous() and t.untyped_storage().data_ptr() == storage and t.data_ptr() == first.data_ptr() + i * step
        for i, t in enumerate(tensors)
    )
    if not behind:
        return torch.stack(list(tensors))
    return first.as_strided((len(tensors), *first.shape), (first.numel(), *first.stride()))


def stack_views(views: list[TrainingView], count: int) -> tuple[list[TrainingView], dict[Kind, ViewStack], list[Place]]:
    """Stack views by size, by whether they have a mask, and by camera model.

    Views after the first ``count`` are the same views at another size. Returns the views, whose pixels are parts of the stacks,
    without copies; the stacks by kind; and the kind and the row of each view in its stack.
    """
    rows: dict[Kind, list[int]] = {}
    places = []
    for i, view in enumerate(views):
        before = rows.setdefault(view.kind, [])
        places.append((view.kind, len(before)))
        before.append(i)
    stacks, shared = {}, list(views)
    for kind, numbers in rows.items():
        same = [views[i] for i in numbers]
        first = same[0]
        stacks[kind] = stack = ViewStack(
            batch_of([v.given for v in same]),
            stacked([v.image for v in same]), None if first.mask is None else stacked([v.mask for v in same]),
            {n: stacked([v.maps[n] for v in same]) for n in first.maps},
            torch.tensor([i % count for i in numbers], device=first.image.device, dtype=torch.int64),
            None if first.alpha is None else stacked([v.alpha for v in same]),
        )  # fmt: skip
        for row, i in enumerate(numbers):
            mask, alpha = (None if t is None else t[row] for t in (stack.masks, stack.alphas))
            maps = {n: t[row] for n, t in stack.maps.items()}
            shared[i] = replace(views[i], image=stack.images[row], mask=mask, maps=maps, alpha=alpha)
    return shared, stacks, places


def with_learned(views: list[TrainingView], learned: LearnedViews) -> list[TrainingView]:
    """Return the views with cameras and values of their own, which `show_learned` overwrites."""
    if not learned.modules:
        return views
    values, shown = learned.values(torch.arange(len(views), device=views[0].image.device)), []
    for i, v in enumerate(views):
        camera = replace(v.camera, viewmat=v.camera.viewmat.clone(), K=v.camera.K.clone())
        own = LearnedView(learned.modules, v.camera, {n: t[i].detach().clone() for n, t in values.items()})
        shown.append(replace(v, camera=camera, learned=own))
    return shown


@torch.no_grad()
def current(stack: ViewStack, learned: LearnedViews) -> ViewStack:
    """Return a stack with the current cameras of its views."""
    return replace(stack, camera=learned.before_render(stack.camera, learned.values(stack.numbers)))


@torch.no_grad()
def show_learned(views: list[TrainingView], stacks: dict[Kind, ViewStack], places: list[Place], learned: LearnedViews) -> None:
    """Write the current learned values into the views of `with_learned`; density strategies render these views."""
    if not learned.modules:
        return
    now = {kind: current(stack, learned).camera for kind, stack in stacks.items()}
    values = learned.values(torch.arange(len(views), device=views[0].image.device))
    for i, (view, (kind, row)) in enumerate(zip(views, places, strict=False)):
        view.camera.viewmat.copy_(now[kind].viewmat[row])
        view.camera.K.copy_(now[kind].K[row])
        for name, value in view.learned.values.items():
            value.copy_(values[name][i])
