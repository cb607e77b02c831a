"""A real man from four photos of a moment: how well the body fills his masks, how like him the avatar is where no photo was.

    python experiments/evaluation/real_person.py --data FOLDER --json OUT [--rows ROW ...] [--page docs/real_people.md]

Needs the extra `photos` and `imageio-ffmpeg`. FOLDER: where `pose2sim` is downloaded to and what is made of it stays
(`real_capture.py`). Everything is scored by careful masks, in squares of 512 pixels. Rows:

    calibrated  the published calibration, by the detector's masks and by careful ones. `fit`: from keypoints. `refine`: then
                refined. Held out: cameras and body know all four photos, the avatar three. Unseen: nothing knows the fourth
                photo; where its camera stands is told by cameras that all frames have refined together
    poses       the avatar of one frame in the poses of the others
    uncalibrated  nothing given: cameras from the person
    moments     the same, of photos that each show another moment
    rooms       synthetic people in photographed rooms: true cameras, masks and poses; true cameras alone; photos alone
    start       `humangs start` on four photos of 12 megapixels: seconds, first and when compiled

A run of the same --label goes on where an earlier one stopped.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

TABLE = "real_person"
ROW_NAMES = ("calibrated", "poses", "uncalibrated", "moments", "rooms", "start")
FRAMES = (0, 12, 33, 66, 90)
"""Of the videos: those that are measured."""
MASKS, WAYS = ("detected", "careful"), ("refine", "fit")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="where the videos are or go")
    parser.add_argument(
        "--json", type=Path, required=True, help="numbers are written here; those already there are kept"
    )
    parser.add_argument("--label", default="now", help="of this state of the package")
    parser.add_argument("--rows", nargs="+", choices=ROW_NAMES, default=list(ROW_NAMES))
    parser.add_argument("--frames", type=int, nargs="+", default=list(FRAMES), help="of the videos, 0 to 99")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), help="of finding the body")
    parser.add_argument("--masks", nargs="+", choices=MASKS, default=list(MASKS), help="that photos are cut out by")
    parser.add_argument("--pictures", type=Path, help="JPEG of the avatar from all sides, and walking")
    parser.add_argument("--page", type=Path, help="page whose table is written")
    arguments = parser.parse_args()
    if not all(0 <= frame < 100 for frame in arguments.frames):
        parser.error("--frames: expected 0 to 99")

    from experiments.common.results import publish
    from experiments.evaluation.real_people import draw_sheet
    from experiments.evaluation.real_rows import ROWS, Man, Results, avatar_of, section
    from humangs_jax.core.compiling import enable_compile_cache

    enable_compile_cache()
    results, man = (
        Results(arguments.json, arguments.label),
        Man(arguments.data, arguments.frames, arguments.ways, arguments.masks),
    )
    for row in arguments.rows:
        ROWS[row](results, man)
    if arguments.pictures:
        body = man.body(man.numbers[0], "detected")
        draw_sheet(avatar_of(body), body, arguments.pictures)
    text = section(results.all)
    print(text)
    if arguments.page:
        publish(arguments.page, TABLE, text, results.all)


if __name__ == "__main__":
    main()
