"""The coarse start: a Gaussian per confirmed pixel, merged, filled, and honest where there is nothing to confirm."""

import numpy as np
import pytest

from tests.priors.flo_files import write_flo
from tests.priors.rigs import still_life
from tests.scenes import photos, ring
from warpgs.errors import UsageError
from warpgs.geometry import back_project, in_image, project_points
from warpgs.pipeline.model.depth_points import coarse_points, depth_bounds, in_free_space, merge, merge_cells
from warpgs.pipeline.model.start import InitConfig, initial_points
from warpgs.scene import Camera, PointCloud, View, ViewDepth


def known(valid_fraction: float = 1.0, cut: int = 0) -> tuple[list[View], list[ViewDepth]]:
    """Views with their exact depth, valid at random pixels; ``cut`` columns on the left are not."""
    views, depths = still_life()
    generator = np.random.default_rng(0)
    out = []
    for d in depths:
        valid = generator.uniform(size=d.shape) < valid_fraction
        valid[:, :cut] = False
        out.append(ViewDepth(np.where(valid, d, 0).astype(np.float32), valid, np.where(valid, 1, np.inf).astype(np.float32)))
    return views, out


def test_every_confirmed_pixel_becomes_a_point():
    """As many points as pixels, each projecting to its pixel with its colour, view by view; coverage is told."""
    views, depths = known(0.3)
    cloud, notes = coarse_points(views, depths, merge_px=0, fill_px=0, source="flow")
    counts = [int(d.valid.sum()) for d in depths]
    assert len(cloud) == sum(counts)
    first = slice(0, counts[0])
    pixels, z = project_points(views[0].camera, cloud.points[first])
    rows, columns = np.nonzero(depths[0].valid)
    assert np.allclose(pixels, np.stack([columns, rows], 1) + 0.5, atol=1e-4)
    assert np.allclose(z, depths[0].depth[rows, columns])
    assert np.array_equal(cloud.colors[first], views[0].image[rows, columns])
    assert notes[0] == f"000.png: {100 * depths[0].coverage:.0f} % of pixels by flow"
    assert notes[-1] == f"{len(cloud):,} points from {len(cloud):,} pixels by flow, 0 filled in"


def test_views_whose_depth_was_not_searched_for_neither_fill_nor_hide():
    """The start is that of the searched views alone: the work for each of many views is bounded."""
    views, depths = known(0.5)
    none = np.zeros_like(depths[0].valid)
    unsearched = ViewDepth(np.zeros_like(depths[0].depth), none, np.full(none.shape, np.inf, np.float32), (), False)
    few, _ = coarse_points(views[:2], depths[:2], merge_px=0, fill_px=4, source="sweep")
    more, notes = coarse_points([*views[:2], views[2]], [*depths[:2], unsearched], merge_px=0, fill_px=4, source="sweep")
    assert np.array_equal(few.points, more.points) and "filled" not in notes[2] and "filled" in notes[1]


def test_points_of_the_reconstruction_fill_what_no_depth_confirms():
    """Those that two views saw, where there are none of the sweep's; the others and those seen once are left out."""
    views, depths = known(cut=40)
    names = [v.name for v in views]
    rows, columns = np.mgrid[10:60:10, 5:35:10].reshape(2, -1)
    z = known()[1][0].depth[rows, columns]
    inside = back_project(views[0].camera, np.stack([columns, rows], 1) + 0.5, z)
    seen = [sum(in_image(v.camera, p[None])[0] for v in views) >= 2 for p in inside]
    points = np.concatenate([inside, inside + 0.01])
    tracks = (*(frozenset(names) for _ in inside), *(frozenset(names[:1]) for _ in inside))
    cloud = PointCloud(points, np.full((len(points), 3), 0.25, np.float32), tracks)
    bare, _ = coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep")
    more, notes = coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep", known=cloud)
    added = more.points[len(bare) :]
    assert 0 < len(added) <= sum(seen) and f"{len(added)} from the reconstruction" in notes[-1]
    assert np.abs(added[:, None] - inside[None]).sum(2).min(1).max() < 1e-9
    unknown = PointCloud(points, cloud.colors)
    assert len(coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep", known=unknown)[0]) == len(bare)
    filled, _ = coarse_points(views, depths, merge_px=4, fill_px=8, source="sweep", known=cloud)
    without, _ = coarse_points(views, depths, merge_px=4, fill_px=8, source="sweep")
    assert len(filled) >= len(without)


def test_merging_takes_the_mean_of_a_cell():
    """Points in one cell become their mean; a far point has a wider cell; grids of unequal fineness do not mix."""
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [1.2, 0.1, 0.1], [0.2, 0.2, 0.2]])
    cells = merge_cells(points, np.array([1.0, 1.1, 0.9, 4.0]))
    assert cells[0] == cells[1] and len(set(cells.tolist())) == 3
    cloud = merge(points, points.astype(np.float32), cells)
    assert len(cloud) == 3 and np.abs(cloud.points - 0.2).sum(1).min() < 1e-12
    assert np.allclose(cloud.points, cloud.colors)


def test_merged_cloud_is_about_as_dense_as_asked():
    """Four-pixel cells leave roughly one point per sixteen pixels and view that sees it, and stay on the surface."""
    views, depths = known()
    full = sum(d.valid.sum() for d in depths)
    cloud, _ = coarse_points(views, depths, merge_px=4, fill_px=0, source="flow")
    assert full / 80 < len(cloud) < full / 12
    pixels, z = project_points(views[1].camera, cloud.points)
    at = np.floor(pixels[in_image(views[1].camera, cloud.points)]).astype(int)
    behind = z[in_image(views[1].camera, cloud.points)] / depths[1].depth[at[:, 1], at[:, 0]]
    assert (behind > 0.97).mean() > 0.95
    again, _ = coarse_points(views, depths, merge_px=4, fill_px=0, source="flow")
    assert np.array_equal(cloud.points, again.points)


def test_filled_points_come_last_and_hide_nothing():
    """What no view confirms gets coarse points near the true surface, and none before a depth that another view found."""
    views, depths = known(cut=40)
    bare, _ = coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep")
    cloud, notes = coarse_points(views, depths, merge_px=4, fill_px=8, source="sweep")
    assert np.array_equal(cloud.points[: len(bare)], bare.points) and len(cloud) > len(bare)
    assert (
        "75 % of pixels by sweep, " in notes[0]
        and "filled" in notes[0]
        and notes[-1].endswith(f"{len(cloud) - len(bare)} filled in")
    )
    filled = cloud.points[len(bare) :]
    assert not any(in_free_space(filled, views[j : j + 1], [0.93 * depths[j].depth], -1).any() for j in range(3))
    colors = cloud.colors[len(bare) :]
    assert colors.min() >= 0 and colors.max() <= 1


def test_free_space_is_before_a_surface():
    """Nearer than the surface: hides it. On it, behind it, in the view itself, or where nothing was found: does not."""
    camera = Camera(np.eye(4), np.array([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]]), 10, 10)
    views = [View("a", camera, np.zeros((10, 10, 3), np.float32))] * 2
    depth = np.full((10, 10), 4.0)
    depth[:, :5] = 0
    points = np.array([[0.1, 0, 2], [0.1, 0, 3.9], [0.1, 0, 6], [-0.1, 0, 2], [50, 0, 2]])
    assert in_free_space(points, views, [depth, depth], 0).tolist() == [True, False, False, False, False]
    assert not in_free_space(points, views[:1], [depth], 0).any()


def test_objects_on_black_get_points_on_the_object_only():
    """Neither confirmed nor filled points in the black around an object."""
    camera = ring(1)[0]
    y, x = np.mgrid[:32, :40] + 0.5
    ball = (x - 20) ** 2 + (y - 16) ** 2 < 64
    view = View("a", camera, np.where(ball[..., None], 0.8, 0).astype(np.float32).repeat(3, 2))
    valid = ball & (x < 20) | (x < 4)
    depth = ViewDepth(np.where(valid, 2, 0).astype(np.float32), valid, np.ones(valid.shape, np.float32))
    cloud, notes = coarse_points([view], [depth], merge_px=0, fill_px=2, source="flow")
    assert (cloud.colors == np.float32(0.8)).all() and "50 % of the foreground by flow, 50 % filled" in notes[0]


def test_bounds_come_from_known_points():
    """Percentiles of the points in the image, widened; too few of them: the default."""
    camera = Camera(np.eye(4), np.array([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]]), 10, 10)
    view = View("a", camera, np.zeros((10, 10, 3), np.float32))
    points = np.stack([np.zeros(101), np.zeros(101), np.linspace(2, 4, 101)], 1)
    near, far = depth_bounds(view, points, (1, 2))
    assert near == pytest.approx(2.04 / 1.3) and far == pytest.approx(3.96 * 3)
    assert depth_bounds(view, points[:5], (1, 2)) == depth_bounds(view, -points, (1, 2)) == (1, 2)


@pytest.mark.parametrize("source", ["sweep", "flow"])
def test_start_from_confirmed_depth(source):
    """From photographs alone to points on the surfaces, the same every time, with a line per view."""
    views, depths = still_life()
    config = InitConfig(source=source, flow="dis", fill_px=0)
    cloud, how, *_ = initial_points(views, None, config, np.random.default_rng(0))
    assert len(cloud) > 1000 and f"by {source}" in how and how.count(" % of pixels") == 3
    pixels, z = project_points(views[1].camera, cloud.points)
    seen = in_image(views[1].camera, cloud.points)
    at = np.floor(pixels[seen]).astype(int)
    ratio = z[seen] / depths[1][at[:, 1], at[:, 0]]
    assert (np.abs(ratio - 1) < 0.03).mean() > 0.6
    again, *_ = initial_points(views, None, config, np.random.default_rng(0))
    assert np.array_equal(cloud.points, again.points)


def test_fallbacks_are_said(tmp_path):
    """A single view, flow that knows nothing, and views that see nothing in common: random points, and why."""
    views, _ = still_life()
    cloud, how, *_ = initial_points(views[:1], None, InitConfig(source="sweep", random_count=300), np.random.default_rng(0))
    assert len(cloud) == 300 and "instead of --init.source sweep: depth needs at least two views" in how
    write_flo(tmp_path / "000-to-001.flo", np.full((120, 160, 2), np.nan, np.float32))
    config = InitConfig(source="flow", flow=str(tmp_path), random_count=300)
    cloud, how, *_ = initial_points(views, None, config, np.random.default_rng(0))
    assert len(cloud) == 300 and "only 0 points survived" in how and "no flow to 002.png" in how and "overlap?" in how
    away = [photos(2)[0]]
    turned = np.diag([-1.0, 1, -1, 1]) @ away[0].camera.viewmat
    noise = np.random.default_rng(0).uniform(size=(32, 40, 3)).astype(np.float32)
    away.append(View("back.png", Camera(turned, away[0].camera.K, 40, 32), noise))
    cloud, how, *_ = initial_points(away, None, InitConfig(source="sweep", random_count=300), np.random.default_rng(0))
    assert len(cloud) == 300 and "no depth agrees with back.png" in how


@pytest.mark.parametrize(
    "bad",
    [{"source": "magic"}, {"merge_px": -1}, {"fill_px": np.nan}, {"opacity": 1}],
)
def test_bad_settings_are_refused(bad):
    """Before any work, with the choices there are."""
    with pytest.raises(UsageError):
        InitConfig(**bad)


def test_cells_too_many_to_number_are_the_same():
    """An outlier so far away that cells have no single number each: the others share cells as they did without it."""
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    near = merge_cells(points, np.full(200, 0.25))
    far = merge_cells(np.concatenate([points, [[1e14, -1e14, 1e14]]]), np.full(201, 0.25))
    assert np.array_equal(far[:200][:, None] == far[:200], near[:, None] == near) and (far[200] != far[:200]).all()
