"""People of several views are told apart by how their landmarks triangulate."""

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.data.keypoints.sets import COCO_17
from humangs_jax.fitting.who_is_who import Match, Seen, in_order_of_time, match_people
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

SIZE, NOISE = 512, 4.0
"""Pixels of the photos and of the noise: a hundredth of a person's height."""
AROUND = jnp.asarray([0.0, 1.3, 3.0, 4.4])
"""Azimuths of the cameras: no two stand opposite each other."""
MIRROR = np.asarray(COCO_17.mirror)


def seen(people, views=4, seed=0):
    """Views of people (n, 17, 3) metres, each in another order; the order of view 0 is the given one."""
    rng = np.random.default_rng(seed)
    cameras = orbit(jnp.zeros(3), 3.5, AROUND[:views], 0.1, intrinsics_from_fov(0.6, SIZE, SIZE), SIZE, SIZE)
    found, orders = [], []
    for v in range(views):
        K, transform = np.asarray(cameras.K[v], float), np.asarray(cameras.cam_from_world[v], float)
        local = people @ transform[:3, :3].T + transform[:3, 3]
        pixels = (local @ K.T)[..., :2] / local[..., 2:] + rng.normal(0, NOISE, (*people.shape[:2], 2))
        order = np.arange(len(people)) if v == 0 else rng.permutation(len(people))
        rows = np.concatenate([pixels, np.ones((*people.shape[:2], 1))], axis=-1)[order]
        found.append(Seen(K, transform, tuple(rows)))
        orders.append(order)
    return found, orders


def somebody(seed, x=0.0):
    """A standing person: left and right are 30 cm apart."""
    rng = np.random.default_rng(seed)
    height = np.asarray([0.8, *[0.85] * 2, *[0.8] * 2, *[0.6] * 2, *[0.3] * 2, *[0.05] * 2, *[0.0] * 2, *[-0.4] * 2])
    height = np.concatenate([height, [-0.8] * 2])
    side = np.asarray([0.0] + [1, -1] * 8) * np.asarray([0, *[0.04] * 4, *[0.2] * 2, *[0.3] * 4, *[0.13] * 6])
    points = np.stack([side + x, height, rng.normal(0, 0.08, 17)], axis=-1)
    return points + rng.normal(0, 0.03, (17, 3))


@pytest.mark.parametrize("views", [2, 4])
def test_two_people_are_matched_whatever_their_order(views):
    people, orders = seen(np.stack([somebody(0, -0.5), somebody(1, 0.5)]), views)
    matches = match_people(people, COCO_17.mirror)
    assert len(matches) == 2
    for match in matches:
        assert len({int(orders[v][m]) for v, m in enumerate(match.members)}) == 1
        assert not any(match.mirrored) and match.error < 0.03


@pytest.mark.parametrize("wrong", [0, 2])
def test_a_view_that_exchanges_left_and_right_is_found_by_the_others(wrong):
    views, _ = seen(somebody(2)[None])
    views[wrong] = views[wrong]._replace(people=(views[wrong].people[0][MIRROR],))
    (match,) = match_people(views, COCO_17.mirror)
    assert match.members == (0, 0, 0, 0)
    assert [i for i, mirrored in enumerate(match.mirrored) if mirrored] == [wrong]


def test_somebody_whom_one_view_alone_shows_stays_alone():
    views, _ = seen(somebody(3)[None])
    stranger = somebody(4, 0.7)[:, :2] * [250, -250] + 256
    views[1] = views[1]._replace(people=(np.c_[stranger, np.ones(17)], *views[1].people))
    first, last = match_people(views, COCO_17.mirror)
    assert first.members == (0, 1, 0, 0) and last.members == (None, 0, None, None)


def test_nobody_and_one_view():
    views, _ = seen(somebody(5)[None], views=1)
    assert [match.members for match in match_people(views, COCO_17.mirror)] == [(0,)]
    assert match_people([views[0]._replace(people=())], COCO_17.mirror) == []


def test_people_are_followed_over_time_by_where_they_are():
    at = lambda x: Match((0, 0), (False, False), 0.0, np.asarray([x, 0.0, 0.0]))
    alone = Match((0, None), (False, False), float("inf"), np.full(3, np.nan))
    a, b, later = in_order_of_time([[at(0.0), at(1.0)], [at(1.2), at(0.1)], [at(0.2), alone, at(5.0)]])
    assert [m.center[0] for m in a if m] == [0.0, 1.0] and a[2:] == [None, None]
    assert [m.center[0] for m in b if m] == [0.1, 1.2]
    assert later[0].center[0] == 0.2 and later[1] is None and later[2] is alone and later[3].center[0] == 5.0
