"""Make the capture folder that ships with the package: a synthetic person of the demo seeds, four photos and held-out views.

    python experiments/assets/build_demo_capture.py [--seed 3000002] [--out humangs_jax/assets/demo_capture]

About 10 s on 2 CPU cores. The person's seed lies outside of every range that training draws from.
"""

import argparse
from pathlib import Path

ASSETS = Path(__file__).parents[2] / "humangs_jax" / "assets"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=3_000_002, help="of the demo range, see people/seeds.py")
    parser.add_argument("--out", type=Path, default=ASSETS / "demo_capture", help="folder to write")
    arguments = parser.parse_args()

    from humangs_jax.body.library import load_body
    from humangs_jax.people.seeds import split_of
    from humangs_jax.people.writer import Layout, write_person

    if split_of(arguments.seed) != "demo":
        parser.error(f"--seed {arguments.seed} belongs to the {split_of(arguments.seed)} people")
    write_person(arguments.out, arguments.seed, load_body(), Layout(512, views=4, held_out_views=6))
    print(f"{arguments.out}: written")


if __name__ == "__main__":
    main()
