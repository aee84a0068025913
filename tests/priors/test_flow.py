"""Flow from files, from OpenCV and from a network, and depth from its matches."""

import dataclasses
import struct
from pathlib import Path

import numpy as np
import pytest

from tests.priors.rigs import rig, still_life, write_flo
from warpgs.errors import DataError, UsageError
from warpgs.geometry import back_project, project_points
from warpgs.priors.flow import (
    EpipolarConfig,
    blend,
    epipolar_depth,
    flo_names,
    flow_between,
    flow_depth,
    fundamental,
    nearest_views,
    pixel_grid,
    read_flo,
    resize_flow,
    round_trip,
)
from warpgs.priors.sweep import plane_homography, project_inverse
from warpgs.scene import Camera, View

# Depth from matches: exact where geometry is, rejected where it is not, blended as said.


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


def test_only_pinholes_have_epipolar_lines():
    """Another camera model is refused on either side, instead of a depth by the wrong geometry."""
    a, b, _ = rig()
    fisheye = dataclasses.replace(b, model="fisheye")
    for pair in ((a, fisheye), (fisheye, a)):
        for op, more in ((fundamental, ()), (plane_homography, (0.3,)), (project_inverse, (np.zeros((1, 2)), np.ones(1)))):
            with pytest.raises(UsageError, match="only pinhole cameras are supported here, not 'fisheye'"):
                op(*pair, *more)


def test_pixel_centres_are_at_one_half():
    """Pixels go row by row, the first at (0.5, 0.5)."""
    pixels = pixel_grid(rig()[0])
    assert pixels.shape == (64 * 48, 2) and pixels[[0, 1, 64]].tolist() == [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]]


def test_depth_is_exact_on_a_synthetic_rig():
    """Random depths come back to a relative 1e-9 with no residual; points outside the image are not valid."""
    a, b, _ = rig()
    depths = true_depths(64 * 48)
    matches = matches_of(a, b, depths)
    depth, residual, _, valid = epipolar_depth(a, b, pixel_grid(a), matches)
    assert np.max(np.abs(depth / depths - 1)) < 1e-9
    assert residual.max() < 1e-9
    inside = (matches >= 0).all(1) & (matches[:, 0] < 64) & (matches[:, 1] < 48)
    assert np.array_equal(valid, inside) and 100 < inside.sum() < len(inside)


def test_a_match_beside_its_line_is_judged_by_its_foot():
    """A match moved at a right angle to its line keeps its depth; the residual is the distance moved."""
    a, b, _ = rig()
    depths, pixels = true_depths(64 * 48), pixel_grid(a)
    lines = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ fundamental(a, b)[0].T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    push = np.random.default_rng(1).uniform(-3, 3, len(pixels))
    depth, residual, _, _ = epipolar_depth(a, b, pixels, matches_of(a, b, depths) + push[:, None] * normals)
    assert np.allclose(residual, np.abs(push), atol=1e-9)
    assert np.allclose(depth, depths, rtol=1e-9)


def test_rays_that_meet_behind_a_camera_are_rejected():
    """A match beyond the vanishing point has a negative depth, which norms alone would call positive."""
    a, b, _ = rig()
    pixels = pixel_grid(a)
    behind = matches_of(a, b, -true_depths(len(pixels)))
    depth, residual, _, valid = epipolar_depth(a, b, pixels, behind)
    assert (depth < 0).all() and residual.max() < 1e-6 and not valid.any()


def test_parallax_below_the_floor_is_rejected():
    """Only far points fail the smallest angle; without a baseline, or at the epipole, nothing is valid."""
    a, b, _ = rig()
    pixels = pixel_grid(a)
    depths = np.geomspace(3, 3000, len(pixels))
    floor = 2.0
    *_, valid = epipolar_depth(a, b, pixels, matches_of(a, b, depths), floor)
    world = back_project(a, pixels, depths)
    rays = [world - c.center for c in (a, b)]
    cosine = (rays[0] * rays[1]).sum(1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    angle = np.degrees(np.arccos(cosine))
    assert not valid[angle < floor - 1e-3].any() and valid[angle > floor + 1e-3].any()
    assert not epipolar_depth(a, a, pixels, pixels)[3].any()
    ahead = Camera(a.viewmat.copy(), a.K, 64, 48)
    ahead.viewmat[2, 3] -= 0.5
    epipole = a.K[:2, 2][None]
    assert not epipolar_depth(a, ahead, epipole, epipole)[3].any()


def test_what_is_no_number_is_rejected():
    """NaN and infinite matches are not valid and raise nothing."""
    a, b, _ = rig()
    pixels = pixel_grid(a)[:4]
    matches = np.array([[np.nan, 1], [1, np.inf], [-np.inf, 2], [np.nan, np.nan]])
    assert not epipolar_depth(a, b, pixels, matches)[3].any()


def test_sensitivity_is_the_derivative_along_the_line():
    """It equals the change of the depth with the match moved by 1e-4 px along the line."""
    a, b, _ = rig()
    pixels, depths = pixel_grid(a), true_depths(64 * 48)
    matches = matches_of(a, b, depths)
    _, _, sensitivity, good = epipolar_depth(a, b, pixels, matches)
    lines = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ fundamental(a, b)[0].T
    along = np.stack([-lines[:, 1], lines[:, 0]], 1) / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    h = 1e-4
    moved = [epipolar_depth(a, b, pixels, matches + s * h * along)[0] for s in (1, -1)]
    derivative = np.abs(moved[0] - moved[1]) / (2 * h)
    # the step of half a pixel leaves a relative error of its square
    assert np.allclose(sensitivity[good], derivative[good], rtol=5e-3)
    assert not np.allclose(sensitivity[good], sensitivity[good].mean(), rtol=0.1)


def test_blending_modes():
    """Each mode takes its candidate; a pixel without one gets 0 and infinity."""
    depths = np.array([[1.0, 2, 3, 4, 9], [5, 6, 7, 8, 9]])
    sensitivities = np.array([[0.2, 0.1, 0.3, np.inf, 0.1], [0.1, 0.3, 0.1, 0.5, 0.1]])
    valid = np.array([[True, True, True, True, False], [True, True, False, False, False]])
    depth, sensitivity = blend(depths, sensitivities, valid, "least_sensitive")
    assert depth.tolist() == [5, 2, 3, 4, 0] and sensitivity.tolist() == [0.1, 0.1, 0.3, np.inf, np.inf]
    assert blend(depths, sensitivities, valid, "nearest_first")[0].tolist() == [1, 2, 3, 4, 0]
    assert blend(depths, sensitivities, valid, "mean_valid")[0].tolist() == [3, 4, 3, 4, 0]
    weighted = blend(depths, sensitivities, valid, "inverse_sensitivity")[0]
    assert np.allclose(weighted, [(1 / 0.2 + 5 / 0.1) / 15, (2 / 0.1 + 6 / 0.3) / (10 + 1 / 0.3), 3, 4, 0])
    with pytest.raises(UsageError, match="least_sensitive"):
        blend(depths, sensitivities, valid, "best")


def test_nearest_views_come_first():
    """Views are sorted by distance of the centres, ties by order, without the view itself."""
    views = []
    for x in (0.0, 3.0, 1.0, -1.0):
        viewmat = np.eye(4)
        viewmat[0, 3] = -x
        views.append(View(str(x), Camera(viewmat, np.eye(3), 4, 4), np.zeros((4, 4, 3), np.float32)))
    assert nearest_views(views, 0, 9) == [2, 3, 1] and nearest_views(views, 1, 2) == [2, 0]


def test_round_trip_measures_the_way_back():
    """A constant flow and its opposite return to the start; half a pixel off shows; a match outside never returns."""
    pixels = np.array([[2.5, 3.5], [7.5, 3.5], [9.5, 3.5]])
    back = np.full((8, 10, 2), [-2.0, 0.5], np.float32)
    distance = round_trip(pixels + np.array([2, -0.5]), pixels, back)
    assert np.allclose(distance[:2], 0, atol=1e-6) and distance[2] == np.inf
    assert np.allclose(round_trip(pixels[:2] + np.array([2, 0]), pixels[:2], back), 0.5, atol=1e-6)
    ramp = np.zeros((8, 10, 2), np.float32)
    ramp[..., 0] = -0.25 * (np.arange(10) + 0.5)
    assert np.allclose(round_trip(pixels[:2] / 0.75 * [1, 0.75], pixels[:2], ramp)[:1], 0, atol=0.01)
    assert (round_trip(np.full((2, 2), np.nan), pixels[:2], back) == np.inf).all()


def test_depth_of_a_view_from_exact_flow():
    """Exact flow of a ray-cast scene passes the checks mostly, and is right where it passes."""
    views, depths = still_life()
    flow = exact_flow(views, depths)
    found = flow_depth(views, 1, flow, EpipolarConfig())
    error = np.abs(found.depth / depths[1] - 1)[found.valid]
    assert found.coverage > 0.8 and np.quantile(error, 0.99) < 0.01 and not found.notes
    assert (found.depth[~found.valid] == 0).all() and np.isinf(found.sensitivity[~found.valid]).all()
    nearest = flow_depth(views, 1, flow, EpipolarConfig(blend="nearest_first"))
    both = found.valid & nearest.valid
    assert (found.sensitivity[both] <= nearest.sensitivity[both]).all()
    assert (found.sensitivity[both] < nearest.sensitivity[both]).any()


def test_missing_flow_is_a_note_not_a_failure():
    """Without flow nothing is valid and each pair has a note; without flow back the depth stays, with a note."""
    views, depths = still_life()
    nothing = flow_depth(views, 0, lambda i, j: None, EpipolarConfig())
    assert nothing.coverage == 0 and nothing.notes == ("no flow to 001.png", "no flow to 002.png")
    flow = exact_flow(views, depths)
    one_way = flow_depth(views, 0, lambda i, j: flow(i, j) if i == 0 else None, EpipolarConfig())
    assert one_way.coverage > 0.8 and "not checked by a round trip" in one_way.notes[0]
    unknown = flow_depth(views, 0, lambda i, j: np.full((120, 160, 2), np.nan, np.float32), EpipolarConfig())
    assert unknown.coverage == 0 and "survives" in unknown.notes[0]


@pytest.mark.parametrize("bad", [{"blend": "best"}, {"max_residual": np.nan}, {"min_parallax": 0}, {"near_count": 0}])
def test_bad_settings_are_refused(bad):
    """A UsageError names the setting."""
    with pytest.raises(UsageError):
        EpipolarConfig(**bad)


# Flow from files, from OpenCV and from a network.


def test_flo_round_trip(tmp_path):
    """Every bit comes back; what is not finite comes back as unknown."""
    flow = np.random.default_rng(0).normal(0, 30, (5, 7, 2)).astype(np.float32)
    flow[2, 3] = np.nan, 1
    write_flo(tmp_path / "a.flo", flow)
    again = read_flo(tmp_path / "a.flo")
    unknown = np.isnan(again).all(2)
    assert unknown.sum() == 1 and unknown[2, 3] and np.array_equal(again[~unknown], flow[~unknown])


@pytest.mark.parametrize(
    "raw, reason",
    [
        (b"", "not a Middlebury"),
        (b"PIEH", "not a Middlebury"),
        (b"JUNK" + bytes(20), "not a Middlebury"),
        (b"PIEH" + struct.pack("<ii", 0, 3), "0 x 3"),
        (b"PIEH" + struct.pack("<ii", -4, 3), "-4 x 3"),
        (b"PIEH" + struct.pack("<ii", 2**30, 2**30) + bytes(8), "sides must be"),
        (b"PIEH" + struct.pack("<ii", 2, 2) + bytes(31), "43 bytes"),
        (b"PIEH" + struct.pack("<ii", 2, 2) + bytes(33), "45 bytes"),
    ],
)
def test_malformed_flo_is_named(tmp_path, raw, reason):
    """The file is of another kind, has absurd sizes, too few or too many bytes."""
    (tmp_path / "bad.flo").write_bytes(raw)
    with pytest.raises(DataError, match=reason) as e:
        read_flo(tmp_path / "bad.flo")
    assert "bad.flo" in str(e.value)


def test_missing_flo_is_named(tmp_path):
    """There is no such file."""
    with pytest.raises(DataError, match=r"none\.flo"):
        read_flo(tmp_path / "none.flo")


def test_resize_scales_the_steps():
    """An affine motion stays the same motion at every size, also where the second image has a size of its own."""
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    flow = np.stack([2 + 0.1 * x, -1 + 0.05 * y], 2).astype(np.float32)
    big = resize_flow(flow, 80, 90)
    u, v = np.meshgrid((np.arange(80) + 0.5) / 2, (np.arange(90) + 0.5) / 3)
    inner = (slice(3, -3), slice(3, -3))
    assert np.allclose(
        big[inner], np.stack([2 * (2 + 0.1 * u), 3 * (-1 + 0.05 * v)], 2)[inner], atol=0.01
    )  # OpenCV resamples at 1/32 px
    other = resize_flow(flow, 40, 30, (20, 15))
    assert np.allclose(np.stack([x, y], 2) + other, (np.stack([x, y], 2) + flow) / 2, atol=0.01)
    assert resize_flow(flow, 40, 30) is flow


def test_folder_of_flow(tmp_path):
    """Both naming schemes are found and resized; a missing pair is None, a folder without flow an error."""
    views, depths = still_life()
    with pytest.raises(DataError, match=r"000-to-001\.flo"):
        flow_between(views, str(tmp_path))
    flow = exact_flow(views, depths)
    write_flo(tmp_path / "000-to-001.flo", flow(0, 1))
    write_flo(tmp_path / "001_1_0.flo", resize_flow(flow(1, 0), 320, 240))
    between = flow_between(views, str(tmp_path))
    assert np.array_equal(between(0, 1), flow(0, 1)) and between(0, 1) is between(0, 1)
    assert np.median(np.abs(between(1, 0) - flow(1, 0))) < 0.02
    assert between(2, 0) is None
    assert flo_names(views, 0, 2) == ["000-to-002.flo", "000_0_2.flo", "000.png_0_2.flo"]
    (tmp_path / "002-to-000.flo").write_bytes(b"PIEH")
    with pytest.raises(DataError, match=r"002-to-000"):
        flow_between(views, str(tmp_path))(2, 0)


@pytest.mark.parametrize("kind, limit", [("dis", 0.5), ("deepflow", 1.0), ("sparse", 2.0)])
def test_computed_flow_is_near_the_true_one(kind, limit):
    """On ray-cast neighbours half of all pixels are within the limit [px], also with a smaller second image."""
    import cv2

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


def test_views_without_features_have_no_sparse_flow():
    """Gray images without a match give None."""
    camera = still_life()[0][0].camera
    views = [View(n, camera, np.full((120, 160, 3), 0.5, np.float32)) for n in ("a.png", "b.png")]
    assert flow_between(views, "sparse")(0, 1) is None


def varint(n: int) -> bytes:
    out = b""
    while n >= 0x80:
        out, n = out + bytes([n & 0x7F | 0x80]), n >> 7
    return out + bytes([n])


def message(*fields: tuple[int, object]) -> bytes:
    """Return a protocol-buffer message of numbered fields: whole numbers, bytes or text."""
    out = b""
    for number, value in fields:
        if isinstance(value, int):
            out += varint(number << 3) + varint(value)
        else:
            value = value.encode() if isinstance(value, str) else value
            out += varint(number << 3 | 2) + varint(len(value)) + value
    return out


def network(path: Path, weights: np.ndarray, bias: np.ndarray, sides=("h", "w"), inputs=("a", "b")) -> Path:
    """Return an ONNX file (field numbers of onnx.proto): a 1x1 convolution of the difference b - a of two images."""

    def value(name: str, channels: int) -> bytes:
        dims = [message((1, 1)), message((1, channels))]
        dims += [message((1, s)) if isinstance(s, int) else message((2, s)) for s in sides]
        tensor = message((1, 1), (2, message(*((1, d) for d in dims))))
        return message((1, name), (2, message((1, tensor))))

    def constant(name: str, array: np.ndarray) -> bytes:
        return message(*((1, n) for n in array.shape), (2, 1), (9, array.astype("<f4").tobytes()), (8, name))

    second = inputs[-1]
    nodes = [
        message((1, second), (1, "a"), (2, "d"), (4, "Sub")),
        message((1, "d"), (1, "k"), (1, "o"), (2, "flow"), (4, "Conv")),
    ]
    graph = message(
        *((1, n) for n in nodes), (2, "g"), (5, constant("k", weights.reshape(2, 3, 1, 1))), (5, constant("o", bias)),
        *((11, value(n, 3)) for n in inputs), (12, value("flow", 2)),
    )  # fmt: skip
    path.write_bytes(message((1, 8), (8, message((1, ""), (2, 13))), (7, graph)))
    return path


@pytest.mark.parametrize("value_range, factor", [("255", 255), ("unit", 1), ("signed", 2)])
def test_network_of_known_flow(tmp_path, value_range, factor):
    """With images of one colour, u is the difference of reds in the network's range and v is constant; odd sizes work."""
    camera = Camera(np.eye(4), np.eye(3), 20, 13)
    views = [View(f"{r}.png", camera, np.full((13, 20, 3), [r, 0.5, 0.1], np.float32)) for r in (0.25, 0.75)]
    path = network(tmp_path / "net.onnx", np.array([[1.0, 0, 0], [0, 0, 0]]), np.array([0.0, -2]))
    flow = flow_between(views, str(path), value_range)(0, 1)
    assert flow.shape == (13, 20, 2)
    # run at 24 x 16
    assert np.allclose(flow, [0.5 * factor * 20 / 24, -2 * 13 / 16], atol=1e-4)


def test_network_of_one_size(tmp_path):
    """A network with fixed sides gets images of that size, and its flow is scaled back."""
    camera = Camera(np.eye(4), np.eye(3), 20, 10)
    views = [View(n, camera, np.zeros((10, 20, 3), np.float32)) for n in "ab"]
    path = network(tmp_path / "net.onnx", np.zeros((2, 3)), np.array([4.0, 4]), sides=(40, 40))
    assert np.allclose(flow_between(views, str(path))(0, 1), [2, 1], atol=1e-5)


def test_files_that_are_no_flow_network(tmp_path):
    """The file is no ONNX model, has one input instead of two, or does not exist."""
    views, _ = still_life()
    (tmp_path / "junk.onnx").write_bytes(b"no network")
    with pytest.raises(DataError, match="junk"):
        flow_between(views, str(tmp_path / "junk.onnx"))
    one = network(tmp_path / "one.onnx", np.zeros((2, 3)), np.zeros(2), inputs=("a",))
    with pytest.raises(DataError, match="two images"):
        flow_between(views, str(one))
    with pytest.raises(UsageError, match="deepflow"):
        flow_between(views, str(tmp_path / "nowhere"))
    with pytest.raises(UsageError, match="signed"):
        flow_between(views, "dis", "0..1")
