"""Flow from files, from OpenCV and from a network, and depth from its matches."""

import dataclasses
import struct

import cv2
import numpy as np
import pytest

from tests.priors import networks as nw
from tests.priors.rigs import rig, still_life, write_flo
from warpgs.errors import DataError, UsageError
from warpgs.geometry import back_project, project_points
from warpgs.priors import flow as flows
from warpgs.priors.flow import (
    _ratio_matches,
    epipolar_depth,
    flo_names,
    flow_between,
    flow_depth,
    fundamental,
    least_sensitive,
    nearest_views,
    pixel_grid,
    read_flo,
    resize_flow,
    round_trip,
)
from warpgs.priors.sweep import plane_homography, project_inverse
from warpgs.scene import Camera, View


def matches_of(first: Camera, second: Camera, depths: np.ndarray) -> np.ndarray:
    """Return the exact positions in the second image of pixels of the first."""
    return project_points(second, back_project(first, pixel_grid(first), depths))[0]


def true_depths(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(2.5, 6, count)


def exact_flow(views: list[View], depths: list[np.ndarray]):
    """Return flow between views of known depth; occluded pixels get wrong matches, as in real flow."""

    def flow(i: int, j: int) -> np.ndarray:
        at = matches_of(views[i].camera, views[j].camera, depths[i].ravel()) - pixel_grid(views[i].camera)
        return at.astype(np.float32).reshape(*depths[i].shape, 2)

    return flow


def epipolar_lines(a: Camera, b: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit normals and directions [N, 2] of the lines of all pixels."""
    lines = np.concatenate([pixel_grid(a), np.ones((a.width * a.height, 1))], 1) @ fundamental(a, b)[0].T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return normals, np.stack([-normals[:, 1], normals[:, 0]], 1)


def test_only_pinholes_have_epipolar_lines():
    """Another camera model is refused on either side, instead of a depth by the wrong geometry."""
    a, b, _ = rig()
    fisheye = dataclasses.replace(b, model="fisheye")
    for pair in ((a, fisheye), (fisheye, a)):
        for op, more in ((fundamental, ()), (plane_homography, (0.3,)), (project_inverse, (np.zeros((1, 2)), np.ones(1)))):
            with pytest.raises(UsageError, match="only pinhole cameras are supported here, not 'fisheye'"):
                op(*pair, *more)


def test_depth_is_exact_and_judged_by_the_foot_on_the_line():
    """Random depths come back from matches beside their lines; the residual is the distance, and points outside are invalid."""
    a, b, _ = rig()
    pixels, depths = pixel_grid(a), true_depths(64 * 48)
    assert pixels.shape == (64 * 48, 2) and pixels[[0, 1, 64]].tolist() == [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]]
    matches = matches_of(a, b, depths)
    for push in (np.zeros(len(pixels)), np.random.default_rng(1).uniform(-3, 3, len(pixels))):
        depth, residual, _, valid = epipolar_depth(a, b, pixels, matches + push[:, None] * epipolar_lines(a, b)[0])
        assert np.max(np.abs(depth / depths - 1)) < 1e-9 and np.allclose(residual, np.abs(push), atol=1e-9)
        inside = (matches >= 0).all(1) & (matches[:, 0] < 64) & (matches[:, 1] < 48)
        assert np.array_equal(valid, inside) and 100 < inside.sum() < len(inside)
    # beyond the vanishing point, without a baseline, at the epipole, where a match is no number
    a, b, _ = rig()
    pixels = pixel_grid(a)
    depth, residual, _, valid = epipolar_depth(a, b, pixels, matches_of(a, b, -true_depths(len(pixels))))
    assert (depth < 0).all() and residual.max() < 1e-6 and not valid.any()
    ahead = Camera(a.viewmat.copy(), a.K, 64, 48)
    ahead.viewmat[2, 3] -= 0.5
    epipole = a.K[:2, 2][None]
    unknown = np.array([[np.nan, 1], [1, np.inf], [-np.inf, 2], [np.nan, np.nan]])
    for other, at, matches in ((a, pixels, pixels), (ahead, epipole, epipole), (b, pixels[:4], unknown)):
        assert not epipolar_depth(a, other, at, matches)[3].any()
    a, b, _ = rig()
    pixels, floor = pixel_grid(a), 2.0
    depths = np.geomspace(3, 3000, len(pixels))
    *_, valid = epipolar_depth(a, b, pixels, matches_of(a, b, depths), floor)
    world = back_project(a, pixels, depths)
    rays = [world - c.center for c in (a, b)]
    cosine = (rays[0] * rays[1]).sum(1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    angle = np.degrees(np.arccos(cosine))
    assert not valid[angle < floor - 1e-3].any() and valid[angle > floor + 1e-3].any()
    # the change of the depth with the match moved by 1e-4 px along the line
    a, b, _ = rig()
    pixels = pixel_grid(a)
    matches = matches_of(a, b, true_depths(len(pixels)))
    _, _, sensitivity, good = epipolar_depth(a, b, pixels, matches)
    moved = [epipolar_depth(a, b, pixels, matches + h * epipolar_lines(a, b)[1])[0] for h in (1e-4, -1e-4)]
    # the step of half a pixel leaves a relative error of its square
    assert np.allclose(sensitivity[good], np.abs(moved[0] - moved[1])[good] / 2e-4, rtol=5e-3)
    assert not np.allclose(sensitivity[good], sensitivity[good].mean(), rtol=0.1)


def test_candidates_and_neighbours_are_chosen():
    """A pixel without a candidate gets 0 and infinity; ties of views by order, without the view itself."""
    depths = np.array([[1.0, 2, 3, 4, 9], [5, 6, 7, 8, 9]])
    sensitivities = np.array([[0.2, 0.1, 0.3, np.inf, 0.1], [0.1, 0.3, 0.1, 0.5, 0.1]])
    valid = np.array([[True, True, True, True, False], [True, True, False, False, False]])
    depth, sensitivity = least_sensitive(depths, sensitivities, valid)
    assert depth.tolist() == [5, 2, 3, 4, 0] and sensitivity.tolist() == [0.1, 0.1, 0.3, np.inf, np.inf]
    views = []
    for x in (0.0, 3.0, 1.0, -1.0):
        viewmat = np.eye(4)
        viewmat[0, 3] = -x
        views.append(View(str(x), Camera(viewmat, np.eye(3), 4, 4), np.zeros((4, 4, 3), np.float32)))
    assert nearest_views(views, 0, 9) == [2, 3, 1] and nearest_views(views, 1, 2) == [2, 0]


def test_depth_of_a_view_from_flow():
    """Exact flow passes the checks mostly, and is right where it passes; missing flow is a note, not a failure."""
    views, depths = still_life()
    flow = exact_flow(views, depths)
    found = flow_depth(views, 1, flow)
    error = np.abs(found.depth / depths[1] - 1)[found.valid]
    assert found.valid.mean() > 0.8 and np.quantile(error, 0.99) < 0.01 and not found.notes
    assert (found.depth[~found.valid] == 0).all() and np.isinf(found.sensitivity[~found.valid]).all()
    nothing = flow_depth(views, 0, lambda i, j: None)
    assert nothing.valid.mean() == 0 and nothing.notes == ("no flow to 001.png", "no flow to 002.png")
    one_way = flow_depth(views, 0, lambda i, j: flow(i, j) if i == 0 else None)
    assert one_way.valid.mean() > 0.8 and "not checked by a round trip" in one_way.notes[0]
    aside = flow_depth(views, 0, lambda i, j: flow(i, j) + np.float32([0, 9]) if i == 0 else None)
    assert aside.valid.mean() < 0.01
    unknown = flow_depth(views, 0, lambda i, j: np.full((120, 160, 2), np.nan, np.float32))
    assert unknown.valid.mean() == 0 and "survives" in unknown.notes[0]


# Flow from files, from OpenCV and from a network.


@pytest.mark.parametrize("raw, reason", [
    (None, "cannot be read"), (b"PIEH", "not a Middlebury"), (b"JUNK" + bytes(20), "not a Middlebury"),
    (b"PIEH" + struct.pack("<ii", -4, 3), "-4 x 3"), (b"PIEH" + struct.pack("<ii", 2**30, 2**30) + bytes(8), "sides must be"),
    (b"PIEH" + struct.pack("<ii", 2, 2) + bytes(31), "43 bytes"), (b"PIEH" + struct.pack("<ii", 2, 2) + bytes(33), "45 bytes"),
])  # fmt: skip
def test_malformed_flo_is_named(tmp_path, raw, reason):
    if raw is not None:
        (tmp_path / "bad.flo").write_bytes(raw)
    with pytest.raises(DataError, match=rf"bad\.flo.*{reason}"):
        read_flo(tmp_path / "bad.flo")


def test_flow_is_measured_on_its_way_back():
    """Half a pixel off shows; a match outside never returns."""
    pixels = np.array([[2.5, 3.5], [7.5, 3.5], [9.5, 3.5]])
    back = np.full((8, 10, 2), [-2.0, 0.5], np.float32)
    distance = round_trip(pixels + np.array([2, -0.5]), pixels, back)
    assert np.allclose(distance[:2], 0, atol=1e-6) and distance[2] == np.inf
    assert np.allclose(round_trip(pixels[:2] + np.array([2, 0]), pixels[:2], back), 0.5, atol=1e-6)
    ramp = np.zeros((8, 10, 2), np.float32)
    ramp[..., 0] = -0.25 * (np.arange(10) + 0.5)
    assert np.allclose(round_trip(pixels[:2] / 0.75 * [1, 0.75], pixels[:2], ramp)[:1], 0, atol=0.01)
    assert (round_trip(np.full((2, 2), np.nan), pixels[:2], back) == np.inf).all()


def test_folder_and_files_of_flow(tmp_path):
    """Both naming schemes are found and resized; a missing pair is None, a folder without flow an error."""
    views, depths = still_life()
    with pytest.raises(DataError, match=r"000-to-002\.flo"):
        flow_between(views, str(tmp_path))
    flow = exact_flow(views, depths)
    write_flo(tmp_path / "000-to-001.flo", flow(0, 1))
    write_flo(tmp_path / "001_1_0.flo", resize_flow(flow(1, 0), 320, 240))
    between = flow_between(views, str(tmp_path))
    assert np.array_equal(between(0, 1), flow(0, 1)) and between(0, 1) is between(0, 1) and between(2, 0) is None
    assert np.median(np.abs(between(1, 0) - flow(1, 0))) < 0.02
    assert flo_names(views, 0, 2) == ["000-to-002.flo", "000_0_2.flo", "000.png_0_2.flo"]
    # every bit comes back; what is not finite comes back as unknown
    flow = np.random.default_rng(0).normal(0, 30, (5, 7, 2)).astype(np.float32)
    flow[2, 3] = np.nan, 1
    write_flo(tmp_path / "a.flo", flow)
    again = read_flo(tmp_path / "a.flo")
    unknown = np.isnan(again).all(2)
    assert unknown.sum() == 1 and unknown[2, 3] and np.array_equal(again[~unknown], flow[~unknown])


@pytest.mark.parametrize("kind, limit", [("dis", 0.5), ("deepflow", 1.0), ("sparse", 2.0)])
def test_computed_flow_is_near_the_true_one(kind, limit):
    """On ray-cast neighbours half of all pixels are within the limit [px], also with a smaller second image."""
    views, depths = still_life()
    found, true = flow_between(views, kind)(0, 1), exact_flow(views, depths)(0, 1)
    assert found.shape == true.shape and np.median(np.linalg.norm(true, axis=2)) > 3
    assert np.median(np.linalg.norm(found - true, axis=2)) < limit
    if kind == "dis":
        c = views[1].camera
        small = Camera(c.viewmat, np.diag([0.5, 0.5, 1]) @ c.K, c.width // 2, c.height // 2)
        image = cv2.resize(views[1].image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        pair = [views[0], View("small.png", small, image)]
        half = exact_flow(pair, [depths[0]])(0, 1)
        assert np.median(np.linalg.norm(flow_between(pair, kind)(0, 1) - half, axis=2)) < limit
    gray = [View(n, views[0].camera, np.full((120, 160, 3), 0.5, np.float32)) for n in ("a.png", "b.png")]
    assert kind != "sparse" or flow_between(gray, kind)(0, 1) is None


def network(path, weights: np.ndarray, bias: np.ndarray, sides=("h", "w"), inputs=("a", "b")) -> str:
    nodes = [nw.node("Sub", [inputs[-1], "a"], ["d"]), nw.node("Conv", ["d", "k", "o"], ["flow"])]
    tensors = [nw.tensor("k", weights.reshape(2, 3, 1, 1)), nw.tensor("o", bias)]
    images = [nw.value(n, (1, 3, *sides)) for n in inputs]
    return nw.write(path, nw.model(nw.graph(nodes, tensors, images, [nw.value("flow", (1, 2, *sides))])))


def test_network_of_known_flow(tmp_path):
    """Of images of one colour in 0 to 255, at multiples of 8 px or at the size that the network fixes; flow is scaled back."""
    camera = Camera(np.eye(4), np.eye(3), 20, 13)
    views = [View(f"{r}.png", camera, np.full((13, 20, 3), [r, 0.5, 0.1], np.float32)) for r in (0.25, 0.75)]
    weights, bias = np.array([[1.0, 0, 0], [0, 0, 0]]), np.array([0.0, -2])
    for sides, (w, h) in ((("h", "w"), (24, 16)), ((39, 40), (40, 39))):
        flow = flow_between(views, network(tmp_path / "net.onnx", weights, bias, sides))(0, 1)
        assert flow.shape == (13, 20, 2) and np.allclose(flow, [0.5 * 255 * 20 / w, -2 * 13 / h], atol=1e-4)


def test_files_that_are_no_flow_network(tmp_path):
    views, _ = still_life()
    with pytest.raises(DataError, match="junk"):
        flow_between(views, nw.write(tmp_path / "junk.onnx", b"no network"))
    with pytest.raises(DataError, match="two images"):
        flow_between(views, network(tmp_path / "one.onnx", np.zeros((2, 3)), np.zeros(2), inputs=("a",)))
    shape = (1, 3, "h", "w")
    graph = nw.graph([nw.node("Add", ["a", "b"], ["y"])], [], [nw.value(n, shape) for n in "ab"], [nw.value("y", shape)])
    with pytest.raises(DataError, match="export it upsampled"):
        flow_between(views, nw.write(tmp_path / "sum.onnx", nw.model(graph)))(0, 1)
    with pytest.raises(UsageError, match="deepflow"):
        flow_between(views, str(tmp_path / "nowhere"))


@pytest.mark.parametrize(("first", "second"), [(2, 2), (31, 33), (64, 1), (100, 65)])
def test_matches_pass_lowes_test_of_exact_distances(first, second, device):
    generator = np.random.default_rng(first)
    a, b = (generator.integers(0, 256, (n, 128)).astype(np.uint8) for n in (first, second))
    a[: len(b) // 2] = np.clip(b[: len(b) // 2][: len(a)].astype(int) + generator.integers(-9, 9), 0, 255)[: len(a)]
    a[0], a[-1], b[0], b[-1] = 3, 255, 0, b[len(b) // 2]
    squares = np.square(a[:, None].astype(int) - b).sum(-1)
    order = np.argsort(squares, axis=1, kind="stable")
    wanted = [(i, o[0]) for i, o in enumerate(order) if len(b) > 1 and squares[i, o[0]] < 0.64 * squares[i, o[1]]]
    assert len(wanted) >= (len(b) > 1) and _ratio_matches(a, b).tolist() == [list(map(int, w)) for w in wanted]
    if len(b) > 1:  # on any device, also where not all fit at a time
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(flows, "AT_ONCE", 40 * len(b))
            patch.setattr(flows, "_two_nearest", lambda a, b: flows._two_nearest_cuda(a, b, device))
            assert _ratio_matches(a, b).tolist() == [list(map(int, w)) for w in wanted]
    assert _ratio_matches(a, None).shape == _ratio_matches(a[:1], b).shape == (0, 2)
