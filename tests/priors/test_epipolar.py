"""Depth from matches: exact where geometry is, rejected where it is not, blended as said."""

import dataclasses

import numpy as np
import pytest

from tests.priors.rigs import rig, still_life
from warpgs.errors import UsageError
from warpgs.geometry import back_project, project_points
from warpgs.priors.flow import (
    EpipolarConfig,
    blend,
    epipolar_depth,
    flow_depth,
    fundamental,
    nearest_views,
    pixel_grid,
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
