"""Kills commands that write at random moments: python kills.py FOLDER [COMMAND ...] [--count 10]
[--json FILE] Interrupts them instead, as Ctrl-C does: python kills.py FOLDER [COMMAND ...]
--interrupts [--count 10] [--json FILE]

A run is killed with SIGKILL, its whole group of processes, just before one of its changes of files,
until a second after one, or at any time. Then no file under a final name may be half-written or
lost, and the next run has to make what a run that nobody disturbed makes, and to remove what the
killed one left. See `writers` for what the commands compute meanwhile.

A run that is interrupted, at any time, has to exit with 130 and one line, and to leave nothing
half-written and no temporary name itself; after the last of them the next run has to work.
"""

import argparse
import dataclasses
import json
import random
import shutil
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import writers
from writers import COMMANDS, Command, Moment

INTERRUPTED = 130
"""The exit status of a command that was interrupted."""


def some_moment(changes: list, generator: random.Random, interrupt: bool) -> Moment:
    times = [when for when, *_ in changes]
    at, kind, seconds = (
        generator.randrange(len(times)),
        generator.random(),
        generator.uniform(0, times[-1]),
    )
    if interrupt:
        return Moment(seconds=seconds, by=signal.SIGINT)
    if kind < 0.45:
        return Moment(event=at)
    gap = min(1.0, ([*times, times[-1] + 0.1][at + 1]) - times[at])
    return (
        Moment(event=at, seconds=generator.uniform(1e-6, gap))
        if kind < 0.85
        else Moment(seconds=seconds)
    )


def run_undisturbed(
    command: Command, place: Path, kept: Path, inputs: Path
) -> tuple[dict, writers.Run, dict]:
    """The files before a run, the run, and the files after it.

    `kept` becomes a copy of the place before.
    """
    if command.first is not None:
        assert writers.run(command, place, inputs, 1).code == 0, command.name
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(place, kept)
    before = writers.snapshot(place)[0]
    undisturbed = writers.run(command, place, inputs, 2)
    assert undisturbed.code == 0, (command.name, undisturbed.errors)
    return before, undisturbed, writers.snapshot(place)[0]


def disturb(command: Command, folder: Path, inputs: Path, count: int, interrupt: bool) -> dict:
    """Disturbs a command at `count` moments, some of which its end comes before.

    Returns figures and faults.
    """
    began, hit, left = time.monotonic(), 0, 0
    place, kept = writers.place_of(command, folder, inputs, "disturbed"), folder / "before"
    before, undisturbed, expected = run_undisturbed(command, place, kept, inputs)
    faults = writers.unlike(command, place, expected)
    generator = random.Random(command.name)
    for _ in range(count):
        moment = some_moment(undisturbed.changes, generator, interrupt)
        shutil.rmtree(place)
        shutil.copytree(kept, place)
        ending = writers.run(command, place, inputs, 2, moment)
        temporary = writers.snapshot(place)[1]
        found = writers.half_written(command, place, before, expected)
        said = writers.error_lines(ending.errors)[-1:]
        if ending.code not in (0, INTERRUPTED if interrupt else None) or (
            ending.code and said != ["humangs: interrupted"]
        ):
            found.append(f"exit status {ending.code}: {ending.errors[-500:]}")
        found += [f"{name}: left behind" for name in temporary if interrupt]
        found += [] if interrupt else writers.next_run(command, place, inputs, expected)
        hit, left = hit + (ending.code != 0), left + bool(temporary)
        faults += [f"{dataclasses.astuple(moment)}: {fault}" for fault in found]
    faults += writers.next_run(command, place, inputs, expected) if interrupt else []
    return {
        "changes_of_files": len(undisturbed.changes),
        "interrupted" if interrupt else "killed": hit,
        "came_to_their_end": count - hit,
        "left_something": left,
        "faults": faults,
        "seconds": round(time.monotonic() - began),
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("commands", nargs="*", help="default: all")
    parser.add_argument("--count", type=int, default=10, help="of moments, for each command")
    parser.add_argument("--interrupts", action="store_true", help="instead of kills")
    parser.add_argument(
        "--json", type=Path, help="record of the figures by command; an earlier one is continued"
    )
    parser.add_argument(
        "--page", type=Path, help="page whose table is written, with its docs/results"
    )
    arguments = parser.parse_args()
    folder, record = arguments.folder, arguments.json
    figures = json.loads(record.read_text()) if record is not None and record.exists() else {}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    writers.prepare(folder / "inputs")
    for command in (
        command for command in COMMANDS if command.name in (arguments.commands or [command.name])
    ):
        found = disturb(command, folder, folder / "inputs", arguments.count, arguments.interrupts)
        figures[command.name] = found
        print(command.name, found, flush=True)
        if record is not None:
            record.write_text(json.dumps(figures, indent=1) + "\n")
    if arguments.page is not None:
        write_page(arguments.page, "interrupts" if arguments.interrupts else "kills", figures)
    sys.exit(any(each["faults"] for each in figures.values()))


def write_page(page: Path, table: str, figures: dict[str, dict]) -> None:
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from experiments.results import markdown_table, publish

    total = lambda key: sum(each[key] for each in figures.values())
    row = {"commands that write": len(figures)}
    if table == "kills":
        row |= {"changes of files in one run": total("changes_of_files"), "killed": total("killed")}
        row |= {"left a temporary name": total("left_something")}
        fault = "half-written, lost, or the next run failed"
    else:
        fewest = min(each["interrupted"] for each in figures.values())
        row |= {"interrupted, exit 130": f"{total('interrupted'):,}", "fewest of a command": fewest}
        row |= {"came to their end before": total("came_to_their_end")}
        fault = "another exit status, left something, or the next run failed"
    row[fault] = sum(len(each["faults"]) for each in figures.values())
    publish(page, table, markdown_table(list(row), [list(row.values())], "r" * len(row)), figures)


if __name__ == "__main__":
    main()
