"""The parts of the real capture that need no download: its calibration, lenses, background and
careful masks.
"""

import numpy as np
import pytest

from experiments.real_capture import VideoCamera, background, careful_mask, read_cameras
from experiments.real_person import section
from experiments.real_rooms import camera_errors, seen_from, to_reference
from humangs_jax.capture.fitting.triangulation import Similarity
from humangs_jax.geometry.camera import Camera, stack_cameras

PIXEL = 1e-6
FLOAT32 = 1e-4
CALIBRATION = """<calibration><cameras><camera serial="cam07">
<fov_video bottom="1919" left="8" right="1087" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0" x="0" y="-3000" z="1500"/>
<intrinsic centerPointU="34560" centerPointV="61440" focalLengthU="107520" focalLengthV="107520" radialDistortion1="-0.05"
 radialDistortion2="0.1" tangentalDistortion1="0.001" tangentalDistortion2="0.002"/></camera></cameras></calibration>"""


def test_a_camera_of_the_file_looks_at_what_is_before_it(tmp_path):
    file = tmp_path / "Calib.qca.txt"
    file.write_text(CALIBRATION)
    camera = read_cameras(file)["cam07"]
    # z up there, y up here: the camera stands 3 m behind the origin, 1.5 m high
    seen = camera.cam_from_world @ np.asarray([0, 1.5, 0, 1])
    np.testing.assert_allclose(seen, [0, 0, 3, 1], atol=1e-9)
    above = camera.cam_from_world @ np.asarray([0, 2.0, 0, 1])
    assert above[1] < 0
    np.testing.assert_allclose(camera.K, [[1680, 0, 532.5], [0, 1680, 960.5], [0, 0, 1]])


def test_undistorting_is_the_inverse():
    K = np.asarray([[1680, 0, 544.5], [0, 1680, 960.5], [0, 0, 1.0]])
    camera = VideoCamera(K, np.eye(4), np.asarray([-0.05, 0.14, 6e-4, 7e-4]))
    pixels = np.random.default_rng(0).uniform(0, [1088, 1920], (50, 2))
    bent = camera.distorted(pixels)
    assert np.abs(bent - pixels).max() > 1
    np.testing.assert_allclose(camera.undistorted(bent), pixels, atol=PIXEL)


def test_the_careful_mask_is_what_moved():
    rng = np.random.default_rng(0)
    room = np.tile(rng.uniform(0.4, 0.6, (1, 120, 3)), (120, 1, 1))
    photos, masks = [], []
    for left in (0, 60, 90, 30):
        photo, mask = room.copy(), np.zeros((120, 120))
        photo[20:100, left : left + 26], mask[20:100, left : left + 26] = [0.9, 0.1, 0.1], 1
        photo[100:110, left : left + 26] *= 0.8  # a shadow
        photos.append(np.round(255 * photo).astype(np.uint8))
        masks.append(np.roll(mask, 4, axis=1))
    found, known = background(photos, masks)
    assert np.abs(found - room)[known].max() < 0.01
    careful = careful_mask(photos[-1] / 255, found, np.ones((120, 120), bool), masks[-1]) > 0.5
    true = np.zeros((120, 120), bool)
    true[20:100, 30:56] = True
    assert careful[true].all()
    # the blurred edge is neither: two pixels of a video, of which a crop has half as many
    assert (np.abs(np.argwhere(careful).min(0) - [20, 30]) <= 2).all()
    assert (np.abs(np.argwhere(careful).max(0) - [99, 55]) <= 2).all()


def rotation(rng):
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return turn * np.sign(np.linalg.det(turn))


def test_cameras_are_compared_after_one_similarity():
    rng = np.random.default_rng(0)
    move, own, there = Similarity(1.1, rotation(rng), rng.normal(size=3)), [], []
    for _ in range(4):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation(rng), [0, 0, 3]
        moved = matrix @ move.matrix()  # from the other world, 1.1 times as large
        moved[:3] /= move.scale
        K = [[500, 0, 256], [0, 500, 256], [0, 0, 1]]
        there.append(Camera.from_opencv(K, matrix, 512, 512))
        own.append(Camera.from_opencv(K, moved, 512, 512))
    own, there = stack_cameras(own), stack_cameras(there)
    degrees, centimetres = camera_errors(own, there)
    assert degrees.max() < 0.05  # arccos of 1 in float32
    assert centimetres.max() < 100 * FLOAT32
    assert to_reference(own, there).scale == pytest.approx(1.1, rel=FLOAT32)
    # the fourth camera, found by the other three
    found = seen_from(own[np.asarray([0, 1, 2])], (0, 1, 2), there, 3)
    np.testing.assert_allclose(found.cam_from_world[0], own.cam_from_world[3], atol=FLOAT32)


def test_rows_are_means_over_their_cases_in_the_table_of_their_kind():
    cases = {
        "33": {"iou": 0.7, "psnr": 19.5, "each_iou": [0.7, 0.8]},
        "66": {"iou": 0.8, "psnr": 20.5, "each_iou": [0.9]},
    }
    text = section(
        {"calibrated, fit, detected": cases, "start": {"0": {"first": 125.0, "load": 2.0}}}
    )
    assert (
        "| calibrated, fit, detected | 2 | 0.750 | - | 20.0 | - |" in text
        and "| start | 1 | 125 | - | - | - | 2 |" in text
    )
