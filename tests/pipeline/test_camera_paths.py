"""Paths of films: what the cameras are is found from their poses, and every frame sees what matters."""

import math

import numpy as np
import pytest

from tests.scenes import ring
from warpgs.errors import UsageError
from warpgs.geometry import look_at, project_points
from warpgs.pipeline.films.paths import (
    BY_KIND,
    Keyframe,
    camera_path,
    common_up,
    framed,
    path_of,
    rig_of,
    through,
    tour_of,
    up_of,
)
from warpgs.scene import Camera

K = np.array([[50.0, 0, 20], [0, 55, 15], [0, 0, 1]])
TARGET = np.array([3.0, -1.0, 7.0])
UP = np.array([0.3, -0.9, 0.1]) / math.sqrt(0.91)


def rolled(camera: Camera, degrees: float) -> Camera:
    """The camera turned about its axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return Camera(turn @ camera.viewmat, camera.K, camera.width, camera.height)


def around(azimuths, elevation: float = 20.0, distance: float = 4.0) -> list[Camera]:
    """Cameras that look at the target from azimuths and an elevation about a slanted upward direction [deg]."""
    a, e = np.cross(UP, [0, 0, 1.0]), math.radians(elevation)
    a /= np.linalg.norm(a)
    b = np.cross(UP, a)
    eyes = [
        TARGET + distance * (math.cos(e) * (math.cos(t) * a + math.sin(t) * b) + math.sin(e) * UP) for t in np.radians(azimuths)
    ]
    return [Camera(look_at(eye, TARGET, UP), K, 40, 30) for eye in eyes]


def one_way(count: int = 6) -> list[Camera]:
    """Parallel cameras on a small grid."""
    return [
        Camera(look_at(np.array([x, y, 0.0]), np.array([x, y, 1.0]), np.array([0, -1.0, 0])), K, 40, 30)
        for x, y in [(0.3 * (i % 3), 0.2 * (i // 3)) for i in range(count)]
    ]


def room(count: int = 10) -> list[Camera]:
    """Cameras that stand in a small circle and look outwards."""
    inner = around(360 * np.arange(count) / count, 0.0, 0.3)
    return [Camera(look_at(c.center, 2 * c.center - TARGET, UP), K, 40, 30) for c in inner]


def walk(count: int = 12) -> list[Camera]:
    """Cameras along a corridor and round a corner and back, looking where they go."""
    corners = np.array([[0, 0, 0], [0, 0, 9.0], [9, 0, 9], [9, 0, 0]])
    at = np.linspace(0, 2.999, count)
    eyes = [corners[int(t)] + (t % 1) * (corners[int(t) + 1] - corners[int(t)]) for t in at]
    ways = [corners[int(t) + 1] - corners[int(t)] for t in at]
    return [Camera(look_at(e, e + w, np.array([0, -1.0, 0])), K, 40, 30) for e, w in zip(eyes, ways)]


@pytest.mark.parametrize(
    ("cameras", "kind", "all_round"),
    [
        (around(np.arange(0, 360, 30)), "ring", True),
        (around([0, 110, 235]), "ring", True),
        (around(np.arange(0, 360, 45), elevation=65), "ring", True),
        (around(np.arange(0, 190, 20)), "ring", False),
        (around(np.arange(0, 70, 12)), "forward", False),
        (ring(5), "forward", False),
        (one_way(), "forward", False),
        (one_way(1), "forward", False),
        (room(), "room", True),
        (walk(), "free", False),
    ],
)
def test_the_rig_is_found(cameras, kind, all_round):
    rig = rig_of(cameras, 2.0)
    assert rig.kind == kind and rig.kind in BY_KIND
    if kind != "free":
        assert (rig.span is None) == all_round
    if kind in ("ring", "forward"):
        assert all(rig.reach(c) > 0 for c in cameras)


def test_a_film_of_one_side_stays_near_the_photographs():
    """Over a wide arc it goes from one to the next; a spiral is as far from the scene as their mean place, and among them."""
    wide, narrow = around(np.arange(0, 70, 12)), around(np.arange(0, 31, 6))
    assert [path_of(rig_of(c, 2.0)) for c in (wide, narrow)] == ["interpolate", "spiral"]
    rig = rig_of(narrow, 2.0)
    centers = np.array([c.center for c in narrow])
    ahead = rig.center - centers.mean(0)
    ahead /= np.linalg.norm(ahead)
    eyes = np.array([c.center for c in camera_path("spiral", rig, narrow, 40)])
    np.testing.assert_allclose((eyes - centers.mean(0)) @ ahead, 0, atol=1e-9)
    assert np.linalg.norm(eyes - centers.mean(0), axis=1).max() < np.linalg.norm(centers - centers.mean(0), axis=1).max()


@pytest.mark.parametrize("roll", [(0, 0), (90, 90), (90, -90), (3, -4)])
@pytest.mark.parametrize("kind", ["turntable", "spiral"])
def test_a_ring_is_circled_level_whatever_way_the_photographs_lie(kind, roll):
    """Every frame has the object at its centre, upright, from the distance and height of the cameras; sides are swapped."""
    cameras = [rolled(c, roll[i % 2]) for i, c in enumerate(around(np.arange(0, 360, 24)))]
    rig = rig_of(cameras, 1.0)
    assert rig.turned == (abs(roll[0]) == 90) and np.abs(rig.up - UP).max() < 1e-6
    for up in (up_of(cameras, TARGET + 0.1 * np.eye(3)), common_up(cameras)):
        assert np.abs(up - UP).max() < 1e-6
    path = camera_path(kind, rig, cameras, 9)
    for c in path:
        seen = c.viewmat[:3, :3] @ TARGET + c.viewmat[:3, 3]
        # focus_point is pulled to the mean centre by a millionth of the distance between them
        assert np.abs(seen[:2]).max() < 1e-4 and seen[2] == pytest.approx(4, rel=1e-5)
        assert -c.viewmat[1, :3] @ UP > 0.9 and abs(c.viewmat[0, :3] @ UP) < 1e-6
        assert (c.center - TARGET) @ UP == pytest.approx(4 * math.sin(math.radians(20)), rel=1e-4)
        assert (c.width, c.height) == ((30, 40) if rig.turned else (40, 30))
    azimuths = np.unwrap([math.atan2(*((c.center - TARGET) @ np.stack([rig.first, np.cross(UP, rig.first)]).T)) for c in path])
    turned = abs(azimuths[-1] - azimuths[0]) * 9 / 8
    assert turned == pytest.approx((2 if kind == "spiral" else 1) * 2 * math.pi, rel=1e-6)


@pytest.mark.parametrize("rolls", [(90, -90), (92, 92), (88, 88), (180, 0)])
def test_up_is_the_side_that_people_stand_on(rolls):
    """Where photographs do not agree on what is up, cameras stand above what they look at; also in a world upside down."""
    cameras = [rolled(c, rolls[i % 2]) for i, c in enumerate(around(np.arange(0, 360, 24)))]
    flip = np.diag([1.0, -1, -1, 1])
    flipped = [Camera(c.viewmat @ flip, c.K, c.width, c.height) for c in cameras]
    assert rig_of(cameras, 1.0).up @ UP > 0.999 and rig_of(flipped, 1.0).up @ (flip[:3, :3] @ UP) > 0.999


@pytest.mark.parametrize("cameras", [around(np.arange(0, 190, 20)), around(np.arange(0, 50, 12))])
def test_a_turntable_never_goes_where_no_camera_was(cameras):
    """It swings through the cameras' azimuths and back, with the object in every frame."""
    rig = rig_of(cameras, 4.0)
    path = camera_path("turntable", rig, cameras, 40)
    nearest = [min(np.linalg.norm(c.center - v.center) for v in cameras) for c in path]
    assert max(nearest) < 1.0 and max(np.linalg.norm(a.center - b.center) for a, b in zip(path, path[1:] + path[:1])) < 0.9
    for c in path:
        pixels, z = project_points(c, TARGET[None])
        assert z[0] > 0 and (0 < pixels[0]).all() and (pixels[0] < (c.width, c.height)).all()


def test_a_spiral_to_one_side_looks_at_one_point_and_closes():
    """All cameras see the middle of the scene, and the last is near the first."""
    cameras = ring(5)
    rig = rig_of(cameras, 2.2)
    path = camera_path("spiral", rig, cameras, 40)
    for c in path:
        pixels, z = project_points(c, rig.center[None])
        assert z[0] > 0 and abs(pixels[0] - c.K[:2, 2]).max() < 1e-6
        assert np.allclose(c.viewmat[:3, :3] @ c.viewmat[:3, :3].T, np.eye(3), atol=1e-12)
    steps = [np.linalg.norm(a.center - b.center) for a, b in zip(path, path[1:] + path[:1])]
    assert max(steps) < 0.5


@pytest.mark.parametrize(("roll", "azimuths"), [(0, [0, 110, 235]), (90, [0, 110, 235]), (-90, [10, 80, 150, 290])])
def test_three_photographs_are_enough_to_know_what_is_up(roll, azimuths):
    """Any three centres lie in a plane, which says nothing where the photographs were taken from different heights."""
    rig = rig_of([rolled(c, roll) for c in around(azimuths)], 1.0)
    assert rig.turned == (roll != 0) and rig.up @ UP > 0.999
    heights = [around([a], e)[0] for a, e in zip(azimuths, (0, 50, 10, 40))]
    assert not rig_of(heights, 1.0).turned and rig_of(heights, 1.0).up @ UP > 0.9


def test_close_photographs_from_below_do_not_tilt_a_film():
    """Eight cameras on an arc and two below, nearer to the subject: a plane through them leans, but the cameras are level."""
    cameras = [*around(np.linspace(-55, 50, 8), 5.0), *around([-10, 15], -20.0, 1.6)]
    cameras = [rolled(c, 4 * (-1) ** i) for i, c in enumerate(cameras)]
    assert rig_of(cameras, 4.0).up @ UP > math.cos(math.radians(5))


def test_in_a_room_a_film_looks_around():
    """From the middle, level, all the way round."""
    cameras = room()
    path = camera_path("turntable", rig_of(cameras, 2.0), cameras, 8)
    assert all(np.allclose(c.center, TARGET, atol=1e-9) and abs(c.viewmat[2, :3] @ UP) < 1e-6 for c in path)
    assert np.linalg.norm(np.mean([c.viewmat[2, :3] for c in path], axis=0)) < 1e-6


@pytest.mark.parametrize(
    ("cameras", "closed"),
    [(around(np.arange(0, 360, 40)), True), (ring(6), False), (walk(), False)],
    ids=["ring", "arc", "walk"],
)
def test_a_tour_passes_through_the_cameras(cameras, closed):
    """At a keyframe's time the path is that camera, and from frame to frame it neither jumps nor jerks."""
    rig = rig_of(cameras, 2.0)
    tour = tour_of(cameras, [rig.reach(c) for c in cameras], 4.0, 100)
    assert {id(k.camera) for k in tour.keyframes} == {id(c) for c in cameras} and tour.closed is closed
    end = tour.keyframes[-1].seconds
    assert end == pytest.approx(4.0)
    path = through(tour.keyframes, 2001)
    for key in tour.keyframes:
        at = path[round(key.seconds / end * 2000)]
        assert np.linalg.norm(at.center - key.camera.center) < 0.03 and at.viewmat[2] @ key.camera.viewmat[2] > 0.999
    eyes = np.array([c.center for c in path])
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert steps.max() < 20 * np.median(steps)
    assert np.linalg.norm(np.diff(eyes, 2, axis=0), axis=1).max() < 0.15 * np.median(steps)
    assert np.allclose(path[0].viewmat, cameras[0].viewmat, atol=1e-9) or not tour.by_name


def test_a_tour_around_an_object_keeps_it_in_every_frame():
    """Between two far views of a ring the path goes around, not through."""
    cameras = around([0, 70, 140, 220, 290])
    rig = rig_of(cameras, 2.0)
    tour = tour_of(cameras, [rig.reach(c) for c in cameras], 2.0, 100)
    for c in through(tour.keyframes, 60, closed=tour.closed):
        seen = c.viewmat[:3, :3] @ TARGET + c.viewmat[:3, 3]
        assert np.abs(seen[:2]).max() < 1e-4 and abs(seen[2] - 4) < 0.05


def test_a_tour_of_views_whose_names_say_nothing_goes_from_neighbour_to_neighbour():
    """And of too many views it passes through some."""
    azimuths = np.arange(0, 300, 20)
    shuffled = around(azimuths[np.random.default_rng(0).permutation(15)])
    tour = tour_of(shuffled, [0.0] * 15, 4.0, 100)
    legs = [np.linalg.norm(a.camera.center - b.camera.center) for a, b in zip(tour.keyframes, tour.keyframes[1:])]
    assert not tour.by_name and len(legs) == 14 and max(legs) < 1.5
    assert tour_of(around(azimuths), [0.0] * 15, 4.0, 100).by_name
    some = tour_of(around(azimuths), [0.0] * 15, 4.0, 6)
    assert len(some.keyframes) - some.closed == 6


def test_a_closed_spline_has_no_corner_where_it_closes():
    """Neither in position nor in rotation, whose quaternion comes back as its opposite."""
    keys = around([0, 90, 180, 270, 0])
    frames = 400
    path = through([Keyframe(c, float(i)) for i, c in enumerate(keys)], frames, closed=True)
    eyes, axes = np.array([c.center for c in path]), np.array([c.viewmat[:3, :3] for c in path])
    for values in (eyes, axes.reshape(frames, 9)):
        speed = np.diff(np.concatenate([values, values[:2]]), axis=0)
        assert np.abs(np.diff(speed, axis=0)).max() < 0.1 * np.abs(speed).max()


def test_size_and_field_of_view():
    """A new size keeps the vertical field of view and where the axis meets the image, and square pixels stay square."""
    camera = ring(1)[0]
    wide = framed(camera, (160, 64), None)
    assert wide.K[0, 0] == wide.K[1, 1] == pytest.approx(2 * camera.K[1, 1]) and (wide.width, wide.height) == (160, 64)
    assert framed(camera, (80, 64)).K == pytest.approx(camera.K * [[2], [2], [1]])
    near = framed(camera, None, math.radians(40))
    assert 2 * math.degrees(math.atan(0.5 * near.height / near.K[1, 1])) == pytest.approx(40)
    assert framed(camera) == camera
    turned = framed(Camera(camera.viewmat, K, 40, 30), turned=True)
    assert turned.K.tolist() == [[55, 0, 15], [0, 50, 20], [0, 0, 1]] and (turned.width, turned.height) == (30, 40)


def test_unknown_paths_are_refused():
    rig = rig_of(ring(3), 1.0)
    with pytest.raises(UsageError, match="neither turntable nor spiral"):
        camera_path("zigzag", rig, ring(3), 5)
    with pytest.raises(UsageError, match="at least 1 frame"):
        camera_path("turntable", rig, ring(3), 0)
