"""Every command that writes, on a full or read-only disk: python disks.py FOLDER [COMMAND ...]

Disks are mounted in memory where this process may; elsewhere files get a largest size, and folders
lose the right to be written. A run ends with exit status 0, or with 2 and one line that names the
place; then everything is as before, nothing is left over, and the next run makes what it should.
That a disk is read-only is said before the work begins.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import writers
from kills import run_undisturbed
from writers import COMMANDS, Command

SIZE = 256 << 20
"""Bytes of a disk; what `demo` writes has to fit twice."""
SHARES = (0.0, 0.3, 0.6)
"""Of the bytes of what a command writes: so much is free."""
LEAST = 1 << 10
"""Bytes that a file may have where no disk can be mounted, at least: what a run says goes to a
file, too.
"""
GROWS = ("run", "people", "set", "begun")
"""What training, `synth`, `preprocess` and the stages of `start` have finished stays, and the next
run goes on from there.
"""


class Disk:
    """A disk of its own at a folder, if this process may mount one."""

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "humangs", str(folder)]
        self.mounted = (
            os.geteuid() == 0
            and subprocess.run(command, capture_output=True, check=False).returncode == 0
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.mounted:
            subprocess.run(["umount", "-l", str(self.folder)], check=True)

    def set(self, options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.folder)], check=True)

    def leave(self, free: int | None) -> None:
        """So many bytes are free; None: as many as at first."""
        status = os.statvfs(self.folder)
        used = (status.f_blocks - status.f_bfree) * status.f_frsize
        self.set(f"size={SIZE if free is None else max(used + free, status.f_frsize)}")

    def read_only(self, place: Path, only: bool) -> bool:
        """Whether that could be done."""
        if self.mounted:
            self.set("ro" if only else "rw")
        elif os.geteuid():
            place.chmod(0o555 if only else 0o755)
        return self.mounted or os.geteuid() != 0


def refused(ending: writers.Run, names: list[str]) -> list[str]:
    """What is wrong with how a run failed. names: one of these is in its line."""
    lines = writers.error_lines(ending.errors)
    found = [] if ending.code in (1, 2) else [f"exit status {ending.code}"]
    if len(lines) != 1 or not any(name in lines[0] for name in names):
        found.append(f"not one line that names the place: {lines}")
    return found


def targets(expected: dict) -> list[str]:
    """What a line may name: files and folders directly in the place."""
    return sorted({Path(name).parts[0] for name in expected})


def begun(command: Command, folder: Path, inputs: Path):
    """A place as it is before the run that is looked at; its state then and after an undisturbed
    run; bytes of the latter.
    """
    place, kept = writers.place_of(command, folder, inputs, "place"), folder / "kept"
    before, _, expected = run_undisturbed(command, place, kept, inputs)
    size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
    shutil.rmtree(place)
    shutil.move(kept, place)
    return place, before, expected, size


def changed(place: Path, before: dict) -> list[str]:
    final, other = writers.snapshot(place)
    names = {
        name
        for name in before | final
        if before.get(name) != final.get(name) and name.split("/")[0] not in GROWS
    }
    return [f"{name}: changed" for name in sorted(names)] + [
        f"{name}: left over" for name in other if "orbax" not in name
    ]


def full(command: Command, disk: Disk, inputs: Path) -> list[str]:
    faults = []
    place, before, expected, size = begun(command, disk.folder, inputs)
    saved = inputs.with_name("saved")
    shutil.rmtree(saved, ignore_errors=True)
    shutil.copytree(place, saved)
    for share in SHARES:
        shutil.rmtree(place)
        shutil.copytree(saved, place)
        if disk.mounted:
            disk.leave(int(share * size))
        ending = writers.run(
            command,
            place,
            inputs,
            2,
            most=None if disk.mounted else max(LEAST, int(share * size / 4)),
        )
        found = (
            [] if ending.code == 0 else refused(ending, targets(expected)) + changed(place, before)
        )
        if disk.mounted:
            disk.leave(None)
        found += writers.next_run(command, place, inputs, expected)
        faults += [f"full, {share:.0%} of {size} bytes free: {fault}" for fault in found]
    return faults


def read_only(command: Command, disk: Disk, inputs: Path) -> list[str]:
    place, before, expected, _ = begun(command, disk.folder, inputs)
    if not disk.read_only(place, True):
        return []
    ending = writers.run(command, place, inputs, 2)
    faults = refused(ending, targets(expected)) + changed(place, before)
    faults += [f"found after {ending.work}"] if ending.work else []
    disk.read_only(place, False)
    return [f"read-only: {fault}" for fault in faults]


def main():
    folder, names = Path(sys.argv[1]), sys.argv[2:]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    inputs = folder / "inputs"
    writers.prepare(inputs)
    faults = {}
    with Disk(folder / "disk") as disk:
        print("disks are mounted" if disk.mounted else "no disk can be mounted", flush=True)
        for command in COMMANDS:
            if names and command.name not in names:
                continue
            found = full(command, disk, inputs) + read_only(command, disk, inputs)
            faults[command.name] = found
            print(json.dumps({command.name: found}), flush=True)
    sys.exit(any(faults.values()))


if __name__ == "__main__":
    main()
