"""Parts of the real capture that need no download: calibration, lenses, background, masks."""

import numpy as np

from experiments.real_capture import VideoCamera, background, careful_mask, read_cameras

PIXEL = 1e-6
CALIBRATION = """<calibration><cameras><camera serial="cam07">
<fov_video bottom="1919" left="8" right="1087" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0"
 x="0" y="-3000" z="1500"/>
<intrinsic centerPointU="34560" centerPointV="61440" focalLengthU="107520" focalLengthV="107520"
 radialDistortion1="-0.05" radialDistortion2="0.1"
 tangentalDistortion1="0.001" tangentalDistortion2="0.002"/></camera></cameras></calibration>"""


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
