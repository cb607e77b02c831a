"""Every command that writes, whole and real but for what it computes: each run is a process of its
own, made by a fork.

A process that has imported everything and started no backend of JAX is forked, so that a run takes
a second instead of ten. What costs minutes (fits, reconstruction, rendering, training steps) is
answered by stand-ins at once; options, checks, readers, writers, the training loop and its
checkpoints are the package's own. A run tells the files that it changes, and can be killed at any
of these moments.
"""

import contextlib
import dataclasses
import fnmatch
import hashlib
import importlib
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from unittest import mock

from stand_ins import WORK, make_inputs, stand_ins

SECONDS = 300
"""Longest that a run may take on a busy machine."""
CHANGES = {
    "open": (),
    "os.rename": (2, 3),
    "os.remove": (1,),
    "os.mkdir": (2,),
    "os.rmdir": (1,),
    "subprocess.Popen": (),
}
"""Events of Python that change files, and which of their arguments are descriptors of folders."""


@dataclasses.dataclass(frozen=True)
class Command:
    """arguments: with {inputs} for the folder of inputs and {v} for 1 or 2, the number of the
    variant.

    copies: inputs that are copied into the place first. first: arguments of the run that made what
    is there before, None for nothing. varies: files that no two runs write equally, as patterns;
    `own`: those whose names differ, too; `often`: those that one run writes several times. once: it
    refuses a place where it has come to its end.
    """

    name: str
    arguments: str
    copies: tuple[str, ...] = ()
    first: str | None = ""
    varies: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    often: tuple[str, ...] = ()
    once: bool = False

    def words(self, inputs: Path, variant: int) -> list[str]:
        text = self.first if variant == 1 and self.first else self.arguments
        return [word.format(inputs=inputs, v=variant) for word in text.split()]


CAPTURE = "--keypoints {inputs}/keypoints.npz --overwrite"
RUN = ("run/checkpoints/*", "run/tensorboard/*")
SYNTH = (
    "synth --out people --subjects {} --size 128 --views 2 --close-views 0 --workers 1 --held-out 1"
)
COMMANDS = (
    Command(
        "import",
        "import cameras {inputs}/transforms.json --images {inputs}/photos --out new --scale {v}"
        " --overwrite",
    ),
    Command("fit in place", f"fit capture {CAPTURE}", copies=("capture",)),
    Command("fit --refine", "fit capture --refine --overwrite", copies=("capture",)),
    Command("check", "check {inputs}/capture --out check.png"),
    Command("demo", "demo --out demo --refine 0 --size 16", varies=("demo/report.json",)),
    Command("reconstruct", "reconstruct {inputs}/capture --out me.npz --no-check"),
    Command(
        "refine",
        "refine {inputs}/avatar1.npz {inputs}/capture --limit 1steps --out me.npz --no-check",
    ),
    Command("animate mp4", "animate {inputs}/avatar1.npz --out me.mp4 --size 16"),
    Command("render", "render {inputs}/avatar1.npz --out views --views 3 --size 16 --exr"),
    Command("export ply", "export {inputs}/avatar{v}.npz --out me.ply"),
    Command("export html", "export {inputs}/avatar{v}.npz --html me.html"),
    Command("synth", SYNTH.format(2), first=SYNTH.format(1)),
    Command(
        "train",
        "train {inputs}/people --out run --config {inputs}/train.json --validation {inputs}/people",
        first=None,
        varies=("run/log.jsonl",),
        own=RUN,
        often=("run/*.safetensors",),
    ),
    Command(
        "start",
        "start {inputs}/photos --cameras {inputs}/transforms.json --keypoints"
        " {inputs}/keypoints.npz --out begun --without-masks --no-browser",
        first=None,
        # a run that goes on shows the photos of the folder; the stand-in of a fit makes up its own
        varies=("begun/check.png",),
        often=("begun/capture.json",),
        once=True,
    ),
    Command(
        "preprocess",
        "preprocess avatarrex {inputs}/videos --out set --body {inputs}/SMPLX_TINY.npz --size 16"
        " --every 1",
    ),
    Command(
        "evaluate",
        "evaluate {inputs}/capture --predictions {inputs}/capture/images --json a.json --html"
        " a.html --csv a.csv --markdown a.md --latex a.tex",
    ),
    Command("convert", "convert {inputs}/any.pt --out w.safetensors --losses l.safetensors"),
)


# Runs
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Moment:
    """When a run is killed: just before its `event`-th change of a file, some seconds after that,
    or after the start.

    by: the signal; SIGINT, as Ctrl-C in a terminal, after seconds, and the start is that of the
    command line.
    """

    event: int | None = None
    seconds: float = 0.0
    by: int = signal.SIGKILL


@dataclasses.dataclass(frozen=True)
class Run:
    """How a run ended. code: None if it was killed.

    changes: (seconds since the start, event, path). work: stand-ins called.
    """

    code: int | None
    out: str
    errors: str
    changes: list
    work: list


class Changes:
    """The audit hook of a run: notes changes of files in the place, and kills the run, its group of
    processes, at one.
    """

    def __init__(self, place: Path, moment: Moment | None):
        self.place, self.moment, self.seen = str(place), moment, []
        self.start = time.monotonic()
        sys.addaudithook(self.audit)

    def audit(self, event, arguments):
        if event not in CHANGES:
            return
        if event == "open":
            path, mode, flags = arguments
            if not (
                any(c in (mode or "") for c in "wax+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR)
            ):
                return
        path = arguments[0]
        if event == "subprocess.Popen":
            path = "."
        if not isinstance(path, str | bytes | os.PathLike):
            return
        folder = max((arguments[i] for i in CHANGES[event]), default=-1)
        path = os.fsdecode(path)
        base = self.place if folder == -1 else os.readlink(f"/proc/self/fd/{folder}")
        if not os.path.join(base, path).startswith(self.place):
            return
        self.seen.append((time.monotonic() - self.start, event, path))
        if self.moment is not None and self.moment.event == len(self.seen) - 1:
            if not self.moment.seconds:
                os.killpg(0, signal.SIGKILL)
            threading.Timer(self.moment.seconds, os.killpg, (0, signal.SIGKILL)).start()


def start(
    command: Command,
    place: Path,
    inputs: Path,
    variant: int,
    moment: Moment | None = None,
    most: int | None = None,
):
    """Begins a run; most: bytes that a file may have, as on a disk that is full then.

    Returns what `end` wants.
    """
    log = inputs.with_name("logs") / f"{place.name}.{variant}"  # not on a disk that is full
    shutil.rmtree(log, ignore_errors=True)
    log.mkdir(parents=True)
    ready, tell = os.pipe()
    pid = os.fork()
    if pid:
        os.close(tell)
        return pid, ready, log, moment
    code = 70
    try:
        os.close(ready)
        os.setsid()
        for number, name in ((1, "out"), (2, "errors")):
            os.dup2(os.open(log / name, os.O_WRONLY | os.O_CREAT), number)
        os.chdir(place)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        code = perform(command, place, inputs, variant, moment, tell, most, log)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def perform(command, place, inputs, variant, moment, tell, most, log):
    """The command line in this process; its exit status."""
    from humangs_jax import cli

    os.environ["KILLS_INPUTS"] = str(inputs)
    called = []
    for place, replacement in stand_ins(variant).items():
        module, _, name = place.rpartition(".")
        noted = lambda *given, _name=name, _work=replacement, **named: (
            called.append(_name),
            _work(*given, **named),
        )[1]
        mock.patch.object(importlib.import_module(f"humangs_jax.{module}"), name, noted).start()
    sys.argv = ["humangs", *command.words(inputs, variant)]
    if moment is not None and moment.by == signal.SIGINT:
        hear_from_the_start(cli, tell)
    changes, code = Changes(place, moment), 0
    if most is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    try:
        cli.main()
    except SystemExit as ending:
        code = ending.code
    except KeyboardInterrupt:  # behind the end of the command line
        code = 0
    except BaseException:
        traceback.print_exc()
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout.flush()
    sys.stderr.flush()
    if most is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    changes.place = "\0"  # what follows is not of the run
    (log / "changes.json").write_text(json.dumps([changes.seen, sorted(WORK & set(called))]))
    return code


def hear_from_the_start(cli, tell):
    """Says when the command line begins; an interrupt before it comes then.

    The audit hook is Python that a user's run does not have, also where extensions allow no
    exception: none is raised in it.
    """
    from humangs_jax.cli import screen

    importing, hook = screen._importing, Changes.audit.__code__
    mock.patch.object(
        screen, "_importing", lambda frame: frame.f_code is hook or importing(frame)
    ).start()
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # shells start what runs in the background without it
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    prepare = cli._prepare

    def begins(verbose):
        os.write(tell, b"!")
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        prepare(verbose)

    mock.patch.object(cli, "_prepare", begins).start()


def end(begun) -> Run:
    """Waits for a run, kills it at its moment."""
    pid, ready, log, moment = begun
    if moment is not None and moment.event is None:
        if moment.by == signal.SIGINT:
            assert select.select([ready], [], [], SECONDS)[0], f"{log}: did not begin"
            os.read(ready, 1)
        if not select.select([ready], [], [], moment.seconds)[0]:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, moment.by)
    ended = select.select([ready], [], [], SECONDS)[0]  # the end of the pipe is that of the process
    os.close(ready)
    if not ended:
        os.killpg(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    assert ended, f"{log}: did not end"
    changes = log / "changes.json"
    code = None if os.WIFSIGNALED(status) else os.waitstatus_to_exitcode(status)
    texts = [
        (log / name).read_text() if (log / name).exists() else "" for name in ("out", "errors")
    ]
    return Run(
        code,
        *texts,
        *(json.loads(changes.read_text()) if changes.exists() and code is not None else ([], [])),
    )


def run(*arguments, **options) -> Run:
    return end(start(*arguments, **options))


def prepare(inputs: Path) -> None:
    """Writes the inputs of all commands, in a process of its own."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            make_inputs(inputs)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    assert os.waitpid(pid, 0)[1] == 0, "the inputs could not be made"


# States
# --------------------------------------------------------------------------------------------------


def temporary(part: str) -> bool:
    """Whether a name in a path is one that `atomic` or Orbax gives what is not finished."""
    from humangs_jax.io.atomic import _TEMPORARY

    lock = part.startswith(".") and part.endswith(".lock")
    return lock or _TEMPORARY.fullmatch(part) is not None or ".orbax-checkpoint-tmp" in part


def snapshot(place: Path) -> tuple[dict[str, str], dict[str, str]]:
    """(path -> hash of the files under final names, of those under temporary ones)."""
    final, other = {}, {}
    for path in sorted(place.rglob("*")):
        relative = path.relative_to(place)
        kind = other if any(temporary(part) for part in relative.parts) else final
        if path.is_file():
            kind[str(relative)] = hashlib.sha256(contents(path)).hexdigest()
        elif kind is other:
            kind[f"{relative}/"] = ""
    return final, other


def contents(path: Path) -> bytes:
    """The bytes of a file; of weights in one order: their header is written in another one by each
    run.
    """
    data = path.read_bytes()
    if path.suffix != ".safetensors" or not weights_are_whole(data):
        return data
    size = 8 + int.from_bytes(data[:8], "little")
    return json.dumps(json.loads(data[8:size]), sort_keys=True).encode() + data[size:]


def weights_are_whole(data: bytes) -> bool:
    try:
        size = 8 + int.from_bytes(data[:8], "little")
        header = json.loads(data[8:size])
        return size + max(
            each["data_offsets"][1] for name, each in header.items() if name != "__metadata__"
        ) == len(data)
    except (ValueError, LookupError):
        return False


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns)


def whole(path: Path) -> bool:
    """Whether a file that no two runs write equally is complete: a log may end in a part of a
    line.
    """
    if path.suffix == ".safetensors":
        return weights_are_whole(path.read_bytes())
    if path.suffix == ".png":  # which ends in a chunk of this name and its checksum
        return path.read_bytes()[-8:-4] == b"IEND"
    text = path.read_text()
    lines = text.splitlines() if path.suffix == ".jsonl" else [text]
    for line in lines[:-1] if path.suffix == ".jsonl" and not text.endswith("\n") else lines:
        try:
            json.loads(line)
        except ValueError:
            return False
    return True


def half_written(command: Command, place: Path, before: dict, after: dict) -> list[str]:
    """What is wrong with a place between two states: files under final names that are neither old
    nor new, or lost.
    """
    final, other = snapshot(place)
    found = []
    for name, content in final.items():
        if matches(name, command.own):
            continue
        if matches(name, command.varies + command.often):
            if not whole(place / name):
                found.append(f"{name}: half-written")
        elif content not in (before.get(name), after.get(name)):
            found.append(f"{name}: neither old nor new")
    for name in before.keys() & after.keys() - final.keys():
        if before[name] not in other.values():  # moved aside, to be put back
            found.append(f"{name}: lost")
    return found


def unlike(command: Command, place: Path, expected: dict) -> list[str]:
    """What is wrong with a place after a run that came to its end."""
    final, other = snapshot(place)
    found = [f"{name}: left over" for name in other]
    compared = lambda names: {name for name in names if not matches(name, command.own)}
    found += [f"{name}: missing" for name in compared(expected.keys() - final.keys())]
    found += [f"{name}: too much" for name in compared(final.keys() - expected.keys())]
    for name in compared(final.keys() & expected.keys()):
        same = (
            whole(place / name) if matches(name, command.varies) else final[name] == expected[name]
        )
        found += [] if same else [f"{name}: not what the command writes"]
    if (place / "run").is_dir():
        found += unlike_a_run(place / "run")
    return found


def next_run(command: Command, place: Path, inputs: Path, expected: dict) -> list[str]:
    """What is wrong with the run after one that was killed or failed, and with what is there
    then.
    """
    finished = command.once and not unlike(command, place, expected)
    ending = run(command, place, inputs, 2)
    found = (
        []
        if ending.code == (2 if finished else 0)
        else [f"exit status {ending.code}: {ending.errors[-500:]}"]
    )
    return [f"the next run: {fault}" for fault in found + unlike(command, place, expected)]


def unlike_a_run(out: Path) -> list[str]:
    steps = sorted(path.name for path in (out / "checkpoints").iterdir())
    losses = [
        json.loads(line)["step"]
        for line in (out / "log.jsonl").read_text().splitlines()
        if '"loss"' in line
    ]
    # one that was interrupted at 5 has saved that step, and two are kept
    good = {"4", "6"} <= set(steps) or {"5", "6"} <= set(steps)
    found = [] if good and all(step.isdecimal() for step in steps) else [f"checkpoints {steps}"]
    return found + (
        [] if losses == sorted(set(losses)) and losses[-1] == 6 else [f"steps in the log: {losses}"]
    )


def place_of(command: Command, folder: Path, inputs: Path, name: str) -> Path:
    """A new place for runs of a command, with copies of what they change."""
    place = folder / f"{command.name.replace(' ', '_')}_{name}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    for each in command.copies:
        shutil.copytree(inputs / each, place / each)
    return place


def error_lines(text: str) -> list[str]:
    """Lines of stderr that are no progress bar."""
    return [
        line
        for line in re.split(r"[\r\n]+", text)
        if line.strip() and not re.search(r"\d+%\||\d+it \[|it/s", line)
    ]
