"""Kills every command that writes at random moments: python kills.py FOLDER [--moments 10] [--json FILE] [COMMAND ...]
Interrupts them instead, as Ctrl-C does: python kills.py FOLDER --interrupts 100 [--json FILE] [COMMAND ...]

A run is killed with SIGKILL, its whole group of processes, just before one of its changes of files, some time after one, or at
any time. Then no file under a final name may be half-written or lost, and the next run has to make what a run that nobody
disturbed makes, and to remove what the killed one left. See `writers` for what the commands compute meanwhile.

A run that is interrupted, at any time, has to exit with 130 and one line, and to leave nothing half-written and no temporary name
itself; after the last of them the next run has to work. The commands take turns, so that a record (--json) can be continued.
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

LONGEST = 1.0
"""Seconds after a change of a file at which a run is killed, at most."""
INTERRUPTED, TURN = 130, 10
"""The exit status of a command that was interrupted; interrupts until the next command has its turn."""
BEFORE, AFTER = 0.45, 0.85
"""Shares of the moments just before a change, and up to some time after one; the rest is at any time."""


def moments(changes: list, count: int, generator: random.Random) -> list[Moment]:
    times = [when for when, *_ in changes]
    found = []
    for _ in range(count):
        at, kind = generator.randrange(len(times)), generator.random()
        gap = (times[at + 1] if at + 1 < len(times) else times[-1] + 0.1) - times[at]
        if kind < BEFORE:
            found.append(Moment(at, 0.0))
        elif kind < AFTER:
            found.append(Moment(at, generator.uniform(1e-6, min(gap, LONGEST))))
        else:
            found.append(Moment(None, generator.uniform(0, times[-1])))
    return found


def run_undisturbed(command: Command, place: Path, kept: Path, inputs: Path) -> tuple[dict, writers.Run, dict]:
    """The files before a run, the run, and the files after it. `kept` becomes a copy of the place before."""
    if command.first is not None:
        assert writers.run(command, place, inputs, 1).code == 0, command.name
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(place, kept)
    before = writers.snapshot(place)[0]
    undisturbed = writers.run(command, place, inputs, 2)
    assert undisturbed.code == 0, (command.name, undisturbed.errors)
    return before, undisturbed, writers.snapshot(place)[0]


def kill(command: Command, folder: Path, inputs: Path, count: int, seed: int = 0) -> dict:
    """Kills a command at `count` moments. Returns figures and faults."""
    began, faults, killed, left = time.monotonic(), [], 0, 0
    place, kept = writers.place_of(command, folder, inputs, "whole"), folder / "before"
    before, undisturbed, expected = run_undisturbed(command, place, kept, inputs)
    faults += writers.unlike(command, place, expected)
    for moment in moments(undisturbed.changes, count, random.Random(f"{command.name} {seed}")):
        shutil.rmtree(place)
        shutil.copytree(kept, place)
        augmented = writers.run(command, place, inputs, 2, moment)
        found = [] if augmented.code in (None, 0) else [f"exit status {augmented.code}: {augmented.errors[-500:]}"]
        killed += augmented.code is None
        left += bool(writers.snapshot(place)[1])
        found += writers.half_written(command, place, before, expected)
        found += writers.next_run(command, place, inputs, expected)
        faults += [f"{dataclasses.astuple(moment)}: {fault}" for fault in found]
    return {
        "changes_of_files": len(undisturbed.changes),
        "killed": killed,
        "came_to_their_end": count - killed,
        "left_something": left,
        "faults": faults,
        "seconds": round(time.monotonic() - began),
    }


def interrupt(command: Command, folder: Path, inputs: Path, count: int, seed: int) -> dict:
    """Interrupts a command a number of times; at most twice as many runs may end before. Returns figures and faults."""
    began, faults, codes = time.monotonic(), [], {0: 0, INTERRUPTED: 0}
    place, kept = writers.place_of(command, folder, inputs, "interrupted"), folder / "before"
    before, undisturbed, expected = run_undisturbed(command, place, kept, inputs)
    last = undisturbed.changes[-1][0]
    generator = random.Random(f"{command.name} {seed}")
    while codes[INTERRUPTED] < count and codes[0] < 2 * count:
        shutil.rmtree(place)
        shutil.copytree(kept, place)
        moment = Moment(None, generator.uniform(0, last), signal.SIGINT)
        augmented = writers.run(command, place, inputs, 2, moment)
        found = writers.half_written(command, place, before, expected)
        found += [f"{name}: left behind" for name in writers.snapshot(place)[1]]
        lines = writers.error_lines(augmented.errors)
        if augmented.code not in codes or (augmented.code and lines[-1:] != ["humangs: interrupted"]):
            found.append(f"exit status {augmented.code}: {augmented.errors[-500:]}")
        codes[augmented.code] = codes.get(augmented.code, 0) + 1
        faults += [f"{moment.seconds:.3f} s: {fault}" for fault in found]
    faults += writers.next_run(command, place, inputs, expected)
    seconds = round(time.monotonic() - began)
    return {"interrupted": codes[INTERRUPTED], "came_to_their_end": codes[0], "faults": faults, "seconds": seconds}


def interrupt_all(folder: Path, count: int, names: list[str], record: Path | None = None) -> dict[str, dict]:
    """Figures by command. The record grows by `TURN` interrupts at a time until each command has the number asked for."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    writers.prepare(folder / "inputs")
    figures = json.loads(record.read_text()) if record is not None and record.exists() else {}
    none = {"interrupted": 0, "came_to_their_end": 0, "faults": [], "seconds": 0, "turns": 0}
    chosen = [command for command in COMMANDS if not names or command.name in names]
    failed = set()
    while due := [c for c in chosen if c.name not in failed and figures.get(c.name, none)["interrupted"] < count]:
        for command in due:
            own = figures.get(command.name, none)
            turn = min(TURN, count - own["interrupted"])
            try:
                found = interrupt(command, folder, folder / "inputs", turn, own["turns"]) | {"turns": 1}
            except AssertionError as error:  # of a machine that is too busy: next time
                print(command.name, error, flush=True)
                failed.add(command.name)
                continue
            figures[command.name] = {key: own[key] + found[key] for key in none}
            print(command.name, figures[command.name], flush=True)
            if record is not None:
                record.write_text(json.dumps(figures, indent=1) + "\n")
    return figures


def kill_all(folder: Path, count: int, names: list[str], record: Path | None = None, seed: int = 0) -> dict[str, dict]:
    """Figures by command. A record is continued: commands that are killed again replace what it has of them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    writers.prepare(folder / "inputs")
    figures = json.loads(record.read_text())["commands"] if record is not None and record.exists() else {}
    for command in COMMANDS:
        if (names and command.name not in names) or count == 0:
            continue
        figures[command.name] = kill(command, folder, folder / "inputs", count, seed)
        print(command.name, figures[command.name], flush=True)
        if record is not None:
            totals = {key: sum(each[key] for each in figures.values()) for key in ("killed", "left_something")}
            record.write_text(json.dumps({"commands": figures} | totals, indent=1) + "\n")
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("commands", nargs="*", help="default: all")
    parser.add_argument("--moments", type=int, default=10, help="for each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="record of the figures by command; an earlier one is continued")
    parser.add_argument("--page", type=Path, help="page whose table kills is written, with its docs/results/kills.json")
    parser.add_argument("--interrupts", type=int, help="number of interrupts of each command, instead of kills")
    arguments = parser.parse_args()
    folder, names, record = arguments.folder, arguments.commands, arguments.json
    if arguments.interrupts is not None:
        table, figures = "interrupts", interrupt_all(folder, arguments.interrupts, names, record)
    else:
        table, figures = "kills", kill_all(folder, arguments.moments, names, record, arguments.seed)
    if arguments.page is not None:
        write_page(arguments.page, table, figures)
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
