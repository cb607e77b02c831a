"""Joints from the rays of several cameras, with left and right exchanged in some views."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import model_of, observe, person

from humangs_jax.capture.fitting.fit_capture import examine
from humangs_jax.capture.fitting.residuals.keypoints import group_by_frame
from humangs_jax.capture.fitting.swaps import find_exchanged_hands, find_swaps
from humangs_jax.capture.fitting.triangulation import (
    Match,
    Seen,
    in_order_of_time,
    match_people,
    reprojection_errors,
    triangulate,
    triangulate_robustly,
)
from humangs_jax.capture.keypoints.keypoints import (
    COCO_17,
    COCO_WHOLEBODY_133,
    Keypoints,
    hand_names,
)
from humangs_jax.core.pytree import replace
from humangs_jax.data.photos import Photos
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

EXACT = 2e-4  # metres: float32 pixels of 512 at 3 metres
KNOWN = np.asarray(model_of().known)

plain, robust = (jax.jit(jax.vmap(f)) for f in (triangulate, triangulate_robustly))


def scene(**changes):
    joints, _, seen = observe(["standing", "crouching"], **changes)
    return joints, seen


def truth(joints):
    """Returns (rows, places) of the landmarks that are joints: both knees and wrists."""
    names = ("left_knee", "right_knee", "left_wrist", "right_wrist")
    rows = [model_of().names.index(name) for name in names]
    return rows, joints[:, [model_of().joint_names.index(name) for name in names]]


@pytest.mark.slow
@pytest.mark.parametrize("method", [plain, robust], ids=["plain", "robust"])
@pytest.mark.parametrize("views", [2, 12])  # 12: more pairs than are looked at together
def test_exact_points_are_found(method, views):
    joints, seen = scene(views=views)
    points, counts = method(seen)[:2]
    rows, expected = truth(joints)
    np.testing.assert_allclose(np.asarray(points)[:, rows], expected, atol=EXACT)
    assert (np.asarray(counts)[:, KNOWN] == views).all()
    assert (np.asarray(counts)[:, ~KNOWN] == 0).all()


@pytest.mark.slow
def test_a_wrong_view_is_left_out():
    joints, seen = scene(views=4)
    off = replace(seen, points=seen.points.at[:, 2].add(80.0))
    rows, expected = truth(joints)
    error = lambda found: np.linalg.norm(np.asarray(found[0])[:, rows] - expected, axis=-1).max()
    assert error(robust(off)) < EXACT < 0.05 < error(plain(off))
    weights = np.asarray(robust(off)[2])
    assert (weights[:, 2][:, KNOWN] == 0).all() and (weights[:, [0, 1, 3]][:, :, KNOWN] > 0).all()


def test_what_no_two_views_agree_on_is_unknown():
    _, seen = scene(views=2)
    apart = replace(seen, points=seen.points.at[:, 0, :, 1].add(120.0))
    _, counts, weights = robust(apart)
    assert (np.asarray(counts)[:, KNOWN] == 0).mean() > 0.8  # some agree by chance, far away
    assert np.isfinite(weights).all()


def test_of_noisy_points_the_pixels_errors_are_least():
    """Cameras have several focal lengths; no other point has smaller squared pixel errors."""
    _, seen = scene(views=4)
    one, scale = jax.tree.map(lambda leaf: leaf[0], seen), jnp.asarray([1.0, 4.0, 0.3, 2.0])
    middle, noise = one.K[:, None, :2, 2], np.random.default_rng(0).normal(0, 3, one.points.shape)
    K = one.K.at[:, :2, :2].multiply(scale[:, None, None])
    one = replace(one, points=(one.points - middle) * scale[:, None, None] + middle + noise, K=K)
    points = triangulate(one)[0]
    cost = lambda points: np.square(reprojection_errors(one, points)).sum(axis=0)[KNOWN]
    moves = 0.004 * np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)  # metres
    least = np.min([cost(points + move) for move in moves], axis=0)
    assert (cost(points) < least).all()


def test_one_view_has_no_points_in_space_and_parallel_rays_stay_finite():
    points, counts, _ = robust(scene(views=1)[1])
    assert not np.asarray(counts).any() and np.isfinite(points).all()
    _, seen = scene(views=2)
    same = jax.tree.map(lambda leaf: leaf.at[:, 1].set(leaf[:, 0]) if leaf.ndim > 1 else leaf, seen)
    assert np.isfinite(plain(same)[0]).all() and np.isfinite(robust(same)[0]).all()


def test_a_point_behind_a_camera_is_no_match():
    _, seen = scene(views=2)
    one = jax.tree.map(lambda leaf: leaf[0], seen)
    rotation, translation = (
        np.asarray(one.cam_from_world[0, :3, :3]),
        np.asarray(one.cam_from_world[0, :3, 3]),
    )
    behind = -rotation.T @ translation - 3 * rotation[2]
    errors = reprojection_errors(one, jnp.asarray(np.broadcast_to(behind, (133, 3)), jnp.float32))
    assert (np.asarray(errors)[0] > 1e5).all()


# Swaps
# --------------------------------------------------------------------------------------------------

MIRROR = list(COCO_17.mirror)


def seen(capture, keypoints):
    photos = Photos(capture.images, None, capture.cameras, capture.frames, capture.names)
    return (
        *group_by_frame(photos, keypoints)[:1],
        keypoints.set,
        group_by_frame(photos, keypoints)[1],
    )


def found(capture, keypoints):
    return find_swaps(*seen(capture, keypoints), capture.names)


def changed(keypoints, order=None, flipped=()):
    """Returns the keypoints with views in another order and some views mirrored."""
    order = np.arange(len(keypoints.points)) if order is None else np.asarray(order)
    points, confidences = keypoints.points[order].copy(), keypoints.confidences[order].copy()
    for view in flipped:
        points[view], confidences[view] = points[view][MIRROR], confidences[view][MIRROR]
    return Keypoints(points, confidences, keypoints.set)


@pytest.mark.slow
@pytest.mark.parametrize("views", [2, 3, 4, 8])
def test_nothing_is_found_where_nothing_is_wrong(views):
    for seed in range(4):
        assert found(*person(seed, 4, views, outliers=0.2)) == ()


@pytest.mark.slow
@pytest.mark.parametrize(("views", "outliers"), [(3, 0.0), (4, 0.1), (8, 0.1)])
def test_sides_of_single_views(views, outliers):
    capture, keypoints = person(10, 4, views, outliers=outliers)
    swapped = [1, views, 3 * views + 2]  # in frames 0, 1 and 3
    swaps = found(capture, changed(keypoints, flipped=swapped))
    assert {(swap.kind, swap.views, swap.instead) for swap in swaps} == {
        ("sides", (capture.names[view],), ()) for view in swapped
    }
    assert "view m1v0: left and right of the keypoints seem exchanged" in [
        str(swap) for swap in swaps
    ]


@pytest.mark.slow
def test_of_two_views_either_may_be_the_wrong_one():
    capture, keypoints = person(11, 4, 2)
    swaps = found(capture, changed(keypoints, flipped=[0, 5]))
    assert {frozenset((*swap.views, *swap.instead)) for swap in swaps} == {
        frozenset(("m0v0", "m0v1")),
        frozenset(("m2v0", "m2v1")),
    }
    assert "instead)" in str(swaps[0])


def test_of_four_views_two_and_two():
    capture, keypoints = person(12, 4, 4)
    swaps = found(capture, changed(keypoints, flipped=[0, 3]))
    assert len(swaps) == 2
    assert {name for swap in swaps for name in (*swap.views, *swap.instead)} == {
        "m0v0",
        "m0v1",
        "m0v2",
        "m0v3",
    }
    assert {frozenset(swap.views) for swap in swaps} in (
        {frozenset(("m0v0",)), frozenset(("m0v3",))},
        {frozenset(("m0v1",)), frozenset(("m0v2",))},
    )


@pytest.mark.parametrize("views", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_cameras_of_two_views(views):
    capture, keypoints = person(13, 4, views, outliers=0.1)
    order = np.arange(4 * views)
    order[[0, 2]] = [2, 0]
    (swap,) = found(capture, changed(keypoints, order))
    assert (swap.kind, swap.views, swap.instead, swap.frames) == (
        "cameras",
        ("m0v0", "m0v2"),
        (),
        1,
    )
    assert str(swap) == "the cameras (or the photos) of views m0v0 and m0v2 seem exchanged"


def test_evenly_spaced_cameras_have_two_explanations():
    """Turning all cameras by half makes exchanges in some views those in the opposite ones."""
    capture, keypoints = person(13, 4, 4, even=True)
    order = np.arange(16)
    order[[0, 2]] = [2, 0]
    (swap,) = found(capture, changed(keypoints, order))
    assert {" and ".join(swap.views), *swap.instead} == {"m0v0 and m0v2", "m0v1 and m0v3"}
    assert str(swap).endswith("instead)")


def test_cameras_that_stand_still_are_reported_once():
    capture, keypoints = person(15, 4, 4, still=True, outliers=0.1)
    order = (np.arange(16).reshape(4, 4)[:, [0, 3, 2, 1]]).ravel()
    (swap,) = found(capture, changed(keypoints, order))
    assert (swap.kind, swap.views, swap.frames) == ("cameras", ("m0v1", "m0v3"), 4)
    assert str(swap).endswith("seem exchanged, as in 4 frames")
    order = np.arange(16)  # photos of one frame
    order[[5, 6]] = [6, 5]
    (swap,) = found(capture, changed(keypoints, order))
    assert (swap.kind, swap.views, swap.frames) == ("cameras", ("m1v1", "m1v2"), 1)


@pytest.mark.slow
def test_both_at_once():
    capture, keypoints = person(17, 4, 8)
    order = np.arange(32)
    order[[8, 12]] = [12, 8]
    swaps = found(capture, changed(keypoints, order, flipped=[1, 10]))
    assert {(swap.kind, swap.views) for swap in swaps} == {
        ("cameras", ("m1v0", "m1v4")),
        ("sides", ("m0v1",)),
        ("sides", ("m1v2",)),
    }


def test_one_view_and_views_that_are_missing():
    capture, keypoints = person(18, 4, 3)
    alone = capture.select([0, 3, 6, 9])
    assert found(alone, changed(keypoints, [0, 3, 6, 9], flipped=[1])) == ()
    some = [0, 1, 2, 4, 5, 6, 7, 8, 9]  # frame 1 has two views, frame 3 has one
    swaps = found(capture.select(some), changed(changed(keypoints, flipped=[8]), some))
    assert [swap.views for swap in swaps] == [("m2v2",)]
    blind = dataclasses.replace(keypoints, confidences=np.zeros_like(keypoints.confidences))
    assert found(capture, blind) == ()


def with_exchanged_hands(keypoints, view):
    sides = (*hand_names("left"), *hand_names("right"))
    hands = [i for i, name in enumerate(COCO_WHOLEBODY_133.names) if name in sides]
    points = keypoints.points.copy()
    points[view, hands] = points[view, np.asarray(COCO_WHOLEBODY_133.mirror)[hands]]
    return dataclasses.replace(keypoints, points=points)


def test_hands_at_each_others_wrists():
    capture, keypoints = person(0, 1, 3, kind=COCO_WHOLEBODY_133)
    assert find_exchanged_hands(keypoints, capture.names) == ()
    exchanged = with_exchanged_hands(keypoints, 2)
    (swap,) = find_exchanged_hands(exchanged, capture.names)
    assert (
        str(swap)
        == "view m0v2: the keypoints of the hands seem exchanged: each lies at the other wrist"
    )
    assert find_exchanged_hands(person(0, 1, 2)[1], capture.names) == ()


@pytest.mark.slow
def test_where_hands_are_exchanged_the_body_is_right():
    capture, keypoints = person(0, 1, 3, kind=COCO_WHOLEBODY_133)
    exchanged = with_exchanged_hands(keypoints, 2)
    assert [swap.kind for swap in found(capture, exchanged)] == ["sides"]
    assert [swap.kind for swap in examine(capture, exchanged).report.swaps] == ["hands"]


# People of several views are separated by how their landmarks triangulate
# --------------------------------------------


SIZE, NOISE = 512, 4.0
"""Pixels of the photos, and of the noise: a hundredth of a person's height."""
AROUND = jnp.asarray([0.0, 1.3, 3.0, 4.4])
"""Azimuths of the cameras; no two are opposite each other."""
MIRRORED = np.asarray(COCO_17.mirror)


def seen_in(people, views=4, seed=0):
    """Returns (views, orders) of people (n, 17, 3), metres.

    Each view lists the people in another order; that of view 0 is the given one.
    """
    rng = np.random.default_rng(seed)
    cameras = orbit(
        jnp.zeros(3), 3.5, AROUND[:views], 0.1, intrinsics_from_fov(0.6, SIZE, SIZE), SIZE, SIZE
    )
    found, orders = [], []
    for v in range(views):
        K, transform = np.asarray(cameras.K[v], float), np.asarray(cameras.cam_from_world[v], float)
        local = people @ transform[:3, :3].T + transform[:3, 3]
        pixels = (local @ K.T)[..., :2] / local[..., 2:] + rng.normal(
            0, NOISE, (*people.shape[:2], 2)
        )
        order = np.arange(len(people)) if v == 0 else rng.permutation(len(people))
        rows = np.concatenate([pixels, np.ones((*people.shape[:2], 1))], axis=-1)[order]
        found.append(Seen(K, transform, tuple(rows)))
        orders.append(order)
    return found, orders


def somebody(seed, x=0.0):
    """Returns joints of a standing person, whose left and right are 30 cm apart."""
    rng = np.random.default_rng(seed)
    height = np.asarray(
        [0.8, *[0.85] * 2, *[0.8] * 2, *[0.6] * 2, *[0.3] * 2, *[0.05] * 2, *[0.0] * 2, *[-0.4] * 2]
    )
    height = np.concatenate([height, [-0.8] * 2])
    side = np.asarray([0.0] + [1, -1] * 8) * np.asarray(
        [0, *[0.04] * 4, *[0.2] * 2, *[0.3] * 4, *[0.13] * 6]
    )
    points = np.stack([side + x, height, rng.normal(0, 0.08, 17)], axis=-1)
    return points + rng.normal(0, 0.03, (17, 3))


@pytest.mark.parametrize("views", [2, 4])
def test_two_people_are_matched_whatever_their_order(views):
    people, orders = seen_in(np.stack([somebody(0, -0.5), somebody(1, 0.5)]), views)
    matches = match_people(people, COCO_17.mirror)
    assert len(matches) == 2
    for match in matches:
        assert len({int(orders[v][m]) for v, m in enumerate(match.members)}) == 1
        assert not any(match.mirrored) and match.error < 0.03


@pytest.mark.parametrize("wrong", [0, 2])
def test_a_view_that_exchanges_left_and_right_is_found_by_the_others(wrong):
    views, _ = seen_in(somebody(2)[None])
    views[wrong] = views[wrong]._replace(people=(views[wrong].people[0][MIRRORED],))
    (match,) = match_people(views, COCO_17.mirror)
    assert match.members == (0, 0, 0, 0)
    assert [i for i, mirrored in enumerate(match.mirrored) if mirrored] == [wrong]


def test_a_person_in_one_view_only_is_matched_to_nobody():
    views, _ = seen_in(somebody(3)[None])
    stranger = somebody(4, 0.7)[:, :2] * [250, -250] + 256
    views[1] = views[1]._replace(people=(np.c_[stranger, np.ones(17)], *views[1].people))
    first, last = match_people(views, COCO_17.mirror)
    assert first.members == (0, 1, 0, 0) and last.members == (None, 0, None, None)
    assert [match.members for match in match_people(views[:1], COCO_17.mirror)] == [(0,)]
    assert match_people([views[0]._replace(people=())], COCO_17.mirror) == []


def test_people_are_followed_over_time_by_where_they_are():
    match_at = lambda x: Match((0, 0), (False, False), 0.0, np.asarray([x, 0.0, 0.0]))
    alone = Match((0, None), (False, False), float("inf"), np.full(3, np.nan))
    a, b, later = in_order_of_time(
        [
            [match_at(0.0), match_at(1.0)],
            [match_at(1.2), match_at(0.1)],
            [match_at(0.2), alone, match_at(5.0)],
        ]
    )
    assert [m.center[0] for m in a if m] == [0.0, 1.0] and a[2:] == [None, None]
    assert [m.center[0] for m in b if m] == [0.1, 1.2]
    assert (
        later[0].center[0] == 0.2
        and later[1] is None
        and later[2] is alone
        and later[3].center[0] == 5.0
    )


def places(*xs):
    return [Match((0, 0), (False, False), 0.0, np.asarray([x, 0.0, 0.0])) for x in xs]


@pytest.mark.parametrize(
    ("before", "after", "linked"),
    [
        ((0.0,), (0.9,), [0]),
        ((0.0, 0.8), (0.3, 1.1), [0, 1]),
        ((0.0, 0.8), (1.1, 0.3), [1, 0]),
        # one walked to where the other was, whose way is too long
        ((0.0, 1.0), (-1.4, -0.4), [None, None]),
        ((0.0, 0.4), (0.2, 9.0), [None, None]),  # who of them went away?
        ((0.0,), (0.1, 0.2), [None]),
    ],
)
def test_of_ways_that_are_as_short_none_is_taken(before, after, linked):
    _, second = in_order_of_time([places(*before), places(*after)])
    found = [
        None if match is None else after.index(match.center[0]) for match in second[: len(before)]
    ]
    assert found == linked


SIDEWAYS = np.asarray([200.0, 0.0, 0.0])
"""A move by 200 pixels without a change of visibility."""


def test_people_without_rays_in_common_are_linked_by_the_photos_of_one_camera():
    """Each moment has one view; two people change their order in the list, and a third comes."""
    views, _ = seen_in(np.stack([somebody(0, -0.5), somebody(1, 0.5)]), 1)
    first, second = views[0].people
    guest = first - SIDEWAYS
    shown = [
        [views[0]],
        [views[0]._replace(people=(second + 0.05 * SIDEWAYS, guest, first - 0.05 * SIDEWAYS))],
    ]
    alone = lambda i: Match((i,), (False,), float("inf"), np.full(3, np.nan))
    matches = [[alone(0), alone(1)], [alone(0), alone(1), alone(2)]]
    assert [[m and m.members[0] for m in frame] for frame in in_order_of_time(matches, shown)] == [
        [0, 1, None],
        [2, 0, 1],
    ]
    assert len(in_order_of_time(matches)[0]) == 5  # without the photos nobody is linked
    turned = views[0]._replace(cam_from_world=np.diag([-1.0, 1, -1, 1]) @ views[0].cam_from_world)
    away = in_order_of_time(
        matches, [shown[0], [shown[1][0]._replace(cam_from_world=turned.cam_from_world)]]
    )
    assert len(away[0]) == 5


def test_of_two_who_are_as_near_in_the_photo_neither_is_taken():
    views, _ = seen_in(somebody(0)[None], 1)
    (row,) = views[0].people
    shown = [[views[0]], [views[0]._replace(people=(row + 0.1 * SIDEWAYS, row - 0.1 * SIDEWAYS))]]
    alone = lambda i: Match((i,), (False,), float("inf"), np.full(3, np.nan))
    assert len(in_order_of_time([[alone(0)], [alone(0), alone(1)]], shown)[0]) == 3
