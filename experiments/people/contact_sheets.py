"""Contact sheets of synthetic people: front and back, all around, close-ups, sequences.

    python experiments/people/contact_sheets.py --out docs/images [--subjects 64] [--sheets front_back views close sequences]

Writes people_front_back.jpg (subjects, front over back), people_views.jpg (16 subjects over 8 views), people_close.jpg (8 heads
from two sides, 8 hands) and people_sequences.jpg (8 sequences of 8 frames). All four take 90 s of one CPU core. People are those
of the demo seeds; the same command gives the same images bit for bit on the same machine.
"""

import argparse
from pathlib import Path

SHEETS = ("front_back", "views", "close", "sequences")
FRONT_BACK_SIZE, VIEW_SIZE, CLOSE_SIZE = (184, 228), (148, 176), (256, 256)
"""Width and height of one image, pixels."""
COLUMNS = 16
MOTION_FRAMES = 75
QUALITY = 85
TELE = 0.42
"""Vertical field of view of images that show the whole person, radians."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder to write into")
    parser.add_argument("--subjects", type=int, default=64, help="people on the first sheet")
    parser.add_argument("--view-subjects", type=int, default=16, help="people on the sheet of 8 views")
    parser.add_argument("--close-ups", type=int, default=8, help="heads and hands")
    parser.add_argument("--sequences", type=int, default=8, help="sequences of 8 frames")
    parser.add_argument("--first", type=int, default=0, help="index of the first person within the demo seeds")
    parser.add_argument("--sheets", nargs="+", choices=SHEETS, default=SHEETS, help="which sheets")
    parser.add_argument("--scale", type=float, default=1.0, help="size of the pictures")
    parser.add_argument("--suffix", default=".jpg", choices=[".jpg", ".png"], help="kind of file")
    arguments = parser.parse_args()

    from humangs_jax.body.library import load_body

    body = load_body()
    arguments.out.mkdir(parents=True, exist_ok=True)
    makers = {"front_back": front_back, "views": all_around, "close": close_ups, "sequences": sequences}
    for name in arguments.sheets:
        sheet = makers[name](body, arguments)
        file = arguments.out / f"people_{name}{arguments.suffix}"
        _write(file, sheet)
        print(f"{file}: {sheet.shape[1]} x {sheet.shape[0]}, {file.stat().st_size / 1e3:.0f} kB")


def front_back(body, arguments):
    """Rows of people from the front, each over a row of the same people from behind."""
    import numpy as np

    cells = []
    for seed in _seeds(arguments, arguments.subjects):
        posed = _person(seed, body)
        turn = posed.rotations[0, 1]
        cells.append([_whole(posed, turn + a, FRONT_BACK_SIZE, arguments.scale) for a in (0.25, np.pi + 0.25)])
    rows = []
    for start in range(0, len(cells), COLUMNS):
        chosen = cells[start : start + COLUMNS]
        rows += [[pair[0] for pair in chosen], [pair[1] for pair in chosen]]
    return _grid(rows)


def all_around(body, arguments):
    """One row a person, eight views around; two people side by side."""
    import numpy as np

    rows = []
    for seed in _seeds(arguments, arguments.view_subjects, offset=100):
        posed = _person(seed, body)
        azimuths = posed.rotations[0, 1] + np.arange(8) * (np.pi / 4)
        rows.append([_whole(posed, a, VIEW_SIZE, arguments.scale) for a in azimuths])
    half = (len(rows) + 1) // 2
    return _grid([a + b for a, b in zip(rows[:half], rows[half:] or rows[:half], strict=False)])


def close_ups(body, arguments):
    """A row of heads, a row of the same heads from the side, a row of hands."""
    from humangs_jax.people import kinematics as poses

    rows = [[], [], []]
    for seed in _seeds(arguments, arguments.close_ups, offset=200):
        posed = _person(seed, body)
        world, joints = poses.joint_positions(posed.subject.build, posed.rotations.astype(float))
        joints = joints + posed.translation
        facing = _azimuth(world[poses.HEAD] @ [0, 0, 1])
        middle = joints[poses.HEAD] + world[poses.HEAD] @ [0, 0.085, 0.02]
        rows[0].append(_near(posed, middle, 0.17, facing + 0.35, 0.05, arguments.scale))
        rows[1].append(_near(posed, middle, 0.17, facing + 1.6, 0.05, arguments.scale))
        hand = poses.LEFT_WRIST if seed % 2 else poses.RIGHT_WRIST
        knuckles = joints[poses.LEFT_HAND + 3 if seed % 2 else poses.RIGHT_HAND + 3]
        outwards = _azimuth(knuckles - joints[poses.SPINE2])
        rows[2].append(_near(posed, 0.4 * joints[hand] + 0.6 * knuckles, 0.15, outwards, 0.1, arguments.scale))
    return _grid(rows)


def sequences(body, arguments):
    """One row a sequence, eight frames over two and a half seconds, the camera beside the walker; two sequences side by side."""
    import numpy as np

    from humangs_jax.people.rendering import pose_subject
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import sample_motion

    rows = []
    for seed in _seeds(arguments, arguments.sequences, offset=300):
        subject = make_subject(seed, body)
        motion = sample_motion(subject, MOTION_FRAMES)
        rotations, translations = np.asarray(motion.rotations), np.asarray(motion.translations)
        frames = np.linspace(0, len(rotations) - 1, 8).astype(int)
        start = pose_subject(subject, rotations[0], translations[0])
        facing = _azimuth(poses_world(subject, rotations[0]) @ [0, 0, 1])
        posed = [start if i == 0 else pose_subject(subject, rotations[i], translations[i]) for i in frames]
        rows.append([_whole(p, facing + 0.7, VIEW_SIZE, arguments.scale) for p in posed])
    half = (len(rows) + 1) // 2
    return _grid([a + b for a, b in zip(rows[:half], rows[half:] or rows[:half], strict=False)])


def poses_world(subject, rotations):
    """(3, 3) rotation of the pelvis."""
    from humangs_jax.people import kinematics as poses

    return poses.joint_positions(subject.build, rotations.astype(float))[0][poses.PELVIS]


def _seeds(arguments, count, offset=0):
    from humangs_jax.people.seeds import DEMO

    return [DEMO[arguments.first + offset + i] for i in range(count)]


def _person(seed, body, pose=0):
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import sample_pose

    return sample_pose(make_subject(seed, body), pose)


def _azimuth(direction):
    import numpy as np

    return float(np.arctan2(direction[0], direction[2]))


def _camera(target, distance, azimuth, elevation, fov, size, scale):
    import jax.numpy as jnp

    from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

    width, height = (2 * round(s * scale / 2) for s in size)
    K = intrinsics_from_fov(fov, width, height)
    azimuths = jnp.asarray([azimuth], jnp.float32)
    return orbit(jnp.asarray(target, jnp.float32), float(distance), azimuths, float(elevation), K, width, height)[0]


def _whole(posed, azimuth, size, scale):
    """The whole person, feet near the lower edge; all people at one scale, 2.3 metres to the image's height."""
    import numpy as np

    from humangs_jax.people.rendering import render_view

    low, high = posed.vertices.min(0), posed.vertices.max(0)
    reach = max(2.25, 1.1 * (high[1] - low[1]))
    target = [0.5 * (low[0] + high[0]), low[1] + 0.455 * reach, 0.5 * (low[2] + high[2])]
    distance = 0.5 * reach / np.tan(0.5 * TELE) + 0.3
    return render_view(posed, _camera(target, distance, azimuth, 0.05, TELE, size, scale))[0]


def _near(posed, target, reach, azimuth, elevation, scale):
    """A close-up of `reach` metres around a point, from a metre away."""
    import numpy as np

    from humangs_jax.people.rendering import render_view

    fov = 2 * np.arctan(reach / 1.2)
    return render_view(posed, _camera(target, 1.2, azimuth, elevation, fov, CLOSE_SIZE, scale))[0]


def _grid(rows):
    """(h, w, 3) image of rows of images of one size; short rows are filled with white."""
    import numpy as np

    columns = max(len(row) for row in rows)
    blank = np.ones_like(rows[0][0])
    return np.concatenate([np.concatenate(row + [blank] * (columns - len(row)), axis=1) for row in rows], axis=0)


def _write(file, picture):
    import imageio.v3 as iio
    import numpy as np

    pixels = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    if file.suffix == ".jpg":
        iio.imwrite(file, pixels, quality=QUALITY)
    else:
        iio.imwrite(file, pixels)


if __name__ == "__main__":
    main()
