"""Optical flow between ordered pairs of views: OpenCV's methods, a folder of .flo files, or a network as an ONNX file.

Whatever the source, flow is float32 [H, W, 2] in pixels of the first view's image: a pixel (x, y) is found at (x + u, y + v)
in the second, for pixel centres at +0.5 in both. NaN means unknown.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.input_files import read_input, unread_reason
from warpgs.priors.epipolar import FlowBetween, fundamental, homogeneous
from warpgs.runtime.onnx_session import read_model
from warpgs.scene import View

KINDS = ("dis", "deepflow", "sparse")
FLO_MAGIC = np.float32(202021.25)
"""First four bytes of a .flo file (Baker et al. 2011, vision.middlebury.edu/flow)."""
MIN_UNKNOWN = 1e9
"""Flow with a component of at least this magnitude is unknown (Baker et al. 2011)."""
MAX_SIDE = 1 << 15
MAX_FLOW_PIXELS = 100_000_000
"""Largest number of pixels of a .flo file that is read."""
RATIO = 0.8
"""Largest ratio of the distances to the best and to the second match, for flow of kind sparse (Lowe's test)."""
LINE_DISTANCE = 2.0
"""Largest distance of a sparse match from its epipolar line [px]."""
MIN_SPARSE = 16
"""Smallest number of matches from which flow is interpolated."""
NET_STRIDE = 8
"""Both image sides are multiples of this [px] for networks such as RAFT."""
RANGES = {"255": (255.0, 0.0), "unit": (1.0, 0.0), "signed": (2.0, -1.0)}
"""Factor and offset from colours in [0, 1] to a network's input: RAFT's original code takes 0..255, torchvision's -1..1."""


def read_flo(path: Path) -> np.ndarray:
    """Return the flow of a Middlebury file, float32, shape [H, W, 2]; NaN where unknown.

    Raises:
        DataError: The file is missing, of another kind, or truncated.
    """
    try:
        raw = read_input(path, 12 + 8 * MAX_FLOW_PIXELS)
    except OSError as e:
        raise DataError(f"{path}: flow cannot be read ({unread_reason(e)}); check the path and its permissions") from e
    if len(raw) < 12 or np.frombuffer(raw, "<f4", 1)[0] != FLO_MAGIC:
        raise DataError(f"{path}: not a Middlebury .flo file (its first number must be 202021.25); write the flow again")
    width, height = (int(v) for v in np.frombuffer(raw, "<i4", 2, 4))
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DataError(f"{path}: its header gives {width} x {height} px; sides must be 1 to {MAX_SIDE}. Write the flow again")
    if len(raw) != 12 + 8 * width * height:
        raise DataError(
            f"{path}: {len(raw)} bytes, but {width} x {height} px take {12 + 8 * width * height}; it is truncated or "
            f"damaged. Copy or write it again"
        )
    flow = np.frombuffer(raw, "<f4", offset=12).reshape(height, width, 2)
    return np.where((np.abs(flow) < MIN_UNKNOWN).all(2, keepdims=True), flow, np.float32(np.nan)).astype(np.float32)


def resize_flow(flow: np.ndarray, width: int, height: int, second: tuple[int, int] | None = None) -> np.ndarray:
    """Return flow at another image size: resampled, with u and v scaled like the sides.

    Args:
        flow: Flow between two images of size h x w, shape [h, w, 2].
        width: New width of the first image [px].
        height: New height of the first image [px].
        second: New width and height of the second image [px], where they differ from the first's.

    Returns:
        Flow [px], float32, shape [height, width, 2].
    """
    import cv2

    h, w = flow.shape[:2]
    if (w, h) == (width, height) == (second or (width, height)):
        return flow
    # in positions, not offsets, so that images of two sizes are handled correctly
    x, y = np.meshgrid((np.arange(width) + 0.5) * w / width, (np.arange(height) + 0.5) * h / height)
    at = np.stack([x, y], 2)
    found = at + cv2.remap(flow, (at - 0.5).astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    to_width, to_height = second or (width, height)
    return (found * [to_width / w, to_height / h] - at * [width / w, height / h]).astype(np.float32)


def flo_names(views: Sequence[View], i: int, j: int) -> list[str]:
    """Return the file names under which the flow from view i to view j is looked for, in order.

    ``A-to-B.flo`` with the stems of both image names; then NexusGS's ``A_i_j.flo``, with i and j counted in the sorted list of
    training views.
    """
    a, b = (Path(views[k].name) for k in (i, j))
    order = sorted(range(len(views)), key=lambda k: views[k].name)
    ij = f"{order.index(i)}_{order.index(j)}"
    return [f"{a.stem}-to-{b.stem}.flo", f"{a.stem}_{ij}.flo", f"{a.name}_{ij}.flo"]


def _from_folder(folder: Path, views: Sequence[View]) -> FlowBetween:
    names = itertools.chain.from_iterable(flo_names(views, *p) for p in itertools.permutations(range(len(views)), 2))
    if not any((folder / n).is_file() for n in names):
        example = f" (such as {flo_names(views, 0, 1)[0]} or {flo_names(views, 0, 1)[1]})" if len(views) > 1 else ""
        raise DataError(f"{folder}: no .flo file of two training views{example}; give the folder that holds them")

    def between(i: int, j: int) -> np.ndarray | None:
        for name in flo_names(views, i, j):
            if (folder / name).is_file():
                a, b = views[i].camera, views[j].camera
                return resize_flow(read_flo(folder / name), a.width, a.height, (b.width, b.height))
        return None

    return between


def _gray(view: View) -> np.ndarray:
    import cv2

    return cv2.cvtColor((view.image * 255).round().clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def _same_size(views: Sequence[View], i: int, j: int, compute: Callable[[View, View], np.ndarray | None]) -> np.ndarray | None:
    """Return flow by a method that needs both images at one size: the second is resized to the first's size."""
    import cv2

    first, second = views[i], views[j]
    a, b = first.camera, second.camera
    if (a.width, a.height) != (b.width, b.height):
        image = cv2.resize(second.image, (a.width, a.height), interpolation=cv2.INTER_AREA)
        second = View(second.name, b, image)
    flow = compute(first, second)
    return flow if flow is None else resize_flow(flow, a.width, a.height, (b.width, b.height))


def _classic(kind: str) -> Callable[[View, View], np.ndarray]:
    import cv2

    if kind == "deepflow":
        method = cv2.optflow.createOptFlow_DeepFlow()
    else:
        method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        # down to full size with larger patches: half the depth error of the preset on wide baselines, a tenth of a second
        method.setFinestScale(0)
        method.setPatchSize(12)
        method.setPatchStride(4)
        method.setGradientDescentIterations(50)
        method.setVariationalRefinementIterations(10)
    return lambda first, second: method.calc(_gray(first), _gray(second), None)


def _sparse(views: Sequence[View]) -> FlowBetween:
    """Return a function for the flow from SIFT matches near epipolar lines, interpolated along edges (Revaud et al. 2015)."""
    import cv2

    sift, matcher = cv2.SIFT_create(contrastThreshold=0.01), cv2.BFMatcher(cv2.NORM_L2)
    features = []
    for view in views:
        keypoints, descriptors = sift.detectAndCompute(_gray(view), None)
        features.append((np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2), descriptors))

    def between(i: int, j: int) -> np.ndarray | None:
        (a, da), (b, db) = features[i], features[j]
        if len(a) < 2 or len(b) < 2:
            return None
        pairs = [(m.queryIdx, m.trainIdx) for m, n in matcher.knnMatch(da, db, k=2) if m.distance < RATIO * n.distance]
        ids = np.array(pairs, int).reshape(-1, 2)
        a, b = a[ids[:, 0]], b[ids[:, 1]]
        F = fundamental(views[i].camera, views[j].camera)[0]
        # OpenCV's pixel centres are at whole numbers
        lines = homogeneous(a + 0.5) @ F.T
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs((lines[:, :2] * (b + 0.5)).sum(1) + lines[:, 2]) / np.linalg.norm(lines[:, :2], axis=1)
        a, b = a[off < LINE_DISTANCE], b[off < LINE_DISTANCE]
        # a keypoint with two directions appears twice
        once = np.unique(a.round(), axis=0, return_index=True)[1]
        a, b = np.ascontiguousarray(a[once]), np.ascontiguousarray(b[once])
        if len(a) < MIN_SPARSE:
            return None
        images = [cv2.cvtColor(_gray(views[k]), cv2.COLOR_GRAY2BGR) for k in (i, j)]
        interpolator = cv2.ximgproc.createEdgeAwareInterpolator()
        interpolator.setK(min(128, len(a) - 1))
        return interpolator.interpolate(images[0], a, images[1], b)

    return between


def _network(path: Path, value_range: str) -> Callable[[View, View], np.ndarray]:
    """Return a function for the flow by a network of two images [1, 3, h, w]; its last output [1, 2, h, w] is used."""
    import cv2
    import onnxruntime

    data = read_model(path)
    try:
        session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"], enable_fallback=0)
    except Exception as e:
        raise DataError(f"{path}: onnxruntime cannot open it ({str(e).splitlines()[0]}); export the network again") from e
    inputs = session.get_inputs()
    if len(inputs) != 2 or any(len(i.shape) != 4 for i in inputs):
        shapes = ", ".join(f"{i.name} {i.shape}" for i in inputs)
        raise DataError(f"{path}: the inputs are {shapes}, but a flow network takes two images [1, 3, h, w]; export it again")
    factor, offset = RANGES[value_range]
    fixed = [n if isinstance(n, int) else 0 for n in inputs[0].shape[2:]]

    def compute(first: View, second: View) -> np.ndarray:
        h, w = first.image.shape[:2]
        size = (fixed[1] or -(-w // NET_STRIDE) * NET_STRIDE, fixed[0] or -(-h // NET_STRIDE) * NET_STRIDE)
        tensors = [
            (cv2.resize(v.image, size, interpolation=cv2.INTER_LINEAR) * factor + offset).astype(np.float32).transpose(2, 0, 1)
            for v in (first, second)
        ]
        try:
            found = session.run(None, {i.name: t[None] for i, t in zip(inputs, tensors)})
        except Exception as e:
            raise DataError(f"{path}: the network failed on {size[0]} x {size[1]} px ({str(e).splitlines()[0]})") from e
        flows = [f for f in found if np.shape(f) == (1, 2, size[1], size[0])]
        if not flows:
            raise DataError(
                f"{path}: no output has the shape [1, 2, {size[1]}, {size[0]}] of a flow: {[np.shape(f) for f in found]}; "
                "export the upsampled flow"
            )
        return resize_flow(np.ascontiguousarray(flows[-1][0].transpose(1, 2, 0), dtype=np.float32), w, h)

    return compute


def flow_between(views: Sequence[View], kind: str, value_range: str = "255") -> FlowBetween:
    """Return a function that gives the flow of an ordered pair of views; each pair is computed or read only once.

    Args:
        views: Training views.
        kind: dis (Kroeger et al. 2016), deepflow (Weinzaepfel et al. 2013), sparse (SIFT matches, interpolated along edges),
            the path of a folder of .flo files with names of `flo_names`, or of an ONNX file.
        value_range: Colours that an ONNX network takes: 255 (0 to 255), unit (0 to 1) or signed (-1 to 1).

    Returns:
        Function of (i, j) that returns the flow [H, W, 2] at the size of view i, or None if the pair has no flow.

    Raises:
        UsageError: The kind or the range is unknown.
        DataError: A file is missing or malformed; the returned function may raise this error, too, when a pair is first
            requested.
    """
    if value_range not in RANGES:
        raise UsageError(f"flow range {value_range!r} is not one of {', '.join(RANGES)}")
    path = Path(kind)
    if kind in ("dis", "deepflow"):
        method = _classic(kind)
        between = lambda i, j: _same_size(views, i, j, method)  # noqa: E731
    elif kind == "sparse":
        between = _sparse(views)
    elif path.is_dir():
        between = _from_folder(path, views)
    elif path.suffix == ".onnx" and path.is_file():
        method = _network(path, value_range)
        between = lambda i, j: _same_size(views, i, j, method)  # noqa: E731
    else:
        raise UsageError(
            f"flow {kind!r} is neither one of {', '.join(KINDS)} nor a folder of .flo files nor an .onnx file; check the path"
        )
    known: dict[tuple[int, int], np.ndarray | None] = {}

    def cached(i: int, j: int) -> np.ndarray | None:
        if (i, j) not in known:
            known[i, j] = between(i, j)
        return known[i, j]

    return cached
