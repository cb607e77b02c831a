"""Files and folders appear whole or not at all, and what was there before is never lost."""

import contextlib
import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from humangs_jax.io import atomic

MARK = "a.txt"
"""A file that all folders of these tests hold."""


class Interrupted(BaseException):
    pass


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def folder_with(path, text):
    path.mkdir(parents=True)
    (path / "a.txt").write_text(text)
    return path


def writes(text):
    return lambda temporary: folder_with(temporary, text)


def writes_into(text):
    return lambda temporary: (temporary / "a.txt").write_text(text)


@pytest.fixture
def dead_process():
    """Returns the id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def leftover(path, kind, pid, machine=atomic.MACHINE, suffix=""):
    return path.with_name(f".{path.name}.{kind}-{machine}-{pid}-0123abcd{suffix}")


@pytest.mark.parametrize("error", [OSError, Interrupted])
def test_a_failed_write_changes_nothing(tmp_path, error):
    (tmp_path / "file.txt").write_text("old")
    folder_with(tmp_path / "folder", "old")

    def fail_file(temporary):
        temporary.write_text("half")
        raise error

    def fail_folder(temporary):
        folder_with(temporary, "half")
        raise error

    with pytest.raises(error):
        atomic.replace_file(tmp_path / "file.txt", fail_file)
    with pytest.raises(error):
        atomic.replace_folder(tmp_path / "folder", fail_folder, mark=MARK)
    with pytest.raises(error):
        atomic.add_files(tmp_path / "folder", lambda temporary: fail_file(temporary / "a.txt"))
    assert names(tmp_path) == ["file.txt", "folder"]
    assert (
        (tmp_path / "file.txt").read_text() == (tmp_path / "folder" / "a.txt").read_text() == "old"
    )


def test_writes_replace_and_leave_nothing_temporary(tmp_path):
    for text in ("one", "two"):
        atomic.write_text(tmp_path / "file.txt", text)
        atomic.replace_folder(tmp_path / "deep" / "folder", writes(text), mark=MARK)
        assert (
            (tmp_path / "file.txt").read_text()
            == (tmp_path / "deep" / "folder" / "a.txt").read_text()
            == text
        )
    # files are added beside others, and some are left out
    (tmp_path / "deep" / "folder" / "mine.txt").write_text("kept")
    atomic.add_files(
        tmp_path / "deep" / "folder",
        lambda temporary: atomic.write_text(temporary / "a.txt", "three"),
    )
    assert (tmp_path / "deep" / "folder" / "a.txt").read_text() == "three"
    assert names(tmp_path) == ["deep", "file.txt"] and names(tmp_path / "deep") == ["folder"]
    assert names(tmp_path / "deep" / "folder") == ["a.txt", "mine.txt"]
    deeper = lambda temporary: folder_with(temporary / "b" / "c", "four")
    atomic.add_files(tmp_path / "deep" / "folder", deeper, without=("mine.txt", "none.txt"))
    assert names(tmp_path / "deep" / "folder") == ["a.txt", "b"] and names(tmp_path / "deep") == [
        "folder"
    ]
    assert (tmp_path / "deep" / "folder" / "b" / "c" / "a.txt").read_text() == "four"
    # folders that do not exist are made
    atomic.add_files(tmp_path / "deep" / "new", writes_into("five"))
    assert (tmp_path / "deep" / "new" / "a.txt").read_text() == "five"
    atomic.write_text(tmp_path / "none" / "yet" / "file.txt", "text")
    assert (tmp_path / "none" / "yet" / "file.txt").read_text() == "text" and names(
        tmp_path / "none" / "yet"
    ) == ["file.txt"]
    with pytest.raises(NotADirectoryError, match=r"file\.txt: is no folder, or lies in a file"):
        atomic.write_text(tmp_path / "file.txt" / "b.txt", "text")


def test_a_folder_that_was_made_for_a_file_that_failed_goes_again(tmp_path):
    (tmp_path / "there").mkdir()
    for place in ("new/and/deep/a.txt", "there/new/a.txt", "there/a.txt"):
        with pytest.raises(ZeroDivisionError):
            atomic.replace_file(
                tmp_path / place, lambda temporary: temporary.write_text(str(1 / 0))
            )
    assert names(tmp_path) == ["there"] and not names(tmp_path / "there")


@pytest.mark.parametrize("renames", [0, 1])
def test_an_interrupt_between_the_renames_loses_nothing(tmp_path, monkeypatch, renames):
    """After an interrupt before the `renames`-th rename the old folder is back in its place."""
    folder, calls, rename = folder_with(tmp_path / "folder", "old"), [], Path.rename

    def interrupted(self, target):
        calls.append(self)
        if len(calls) == renames + 1:
            raise Interrupted
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(Interrupted):
        atomic.replace_folder(folder, writes("new"), mark=MARK)
    assert names(tmp_path) == ["folder"] and (folder / "a.txt").read_text() == "old"


@pytest.mark.parametrize("moves", [0, 1, 2])
def test_an_interrupt_between_moves_deletes_no_old_file(tmp_path, monkeypatch, moves):
    """Outdated files go last: a process that is killed before leaves an old or a new file of each
    name. Files that must not lie beside the new ones go first.
    """
    old, new = ("a.png", "b.png", "c.png"), ("a.png", "b.png")
    for name in (*old, "invalid"):
        (tmp_path / name).write_text("old")
    replace, moved = Path.replace, []

    def interrupted(self, target):
        if len(moved) == moves:
            raise Interrupted
        moved.append(target)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    write = lambda folder: [(folder / name).write_text("new") for name in new]
    with pytest.raises(Interrupted) if moves < 2 else contextlib.nullcontext():
        atomic.add_files(tmp_path, write, without=old, invalid=("invalid",))
    texts = {name: (tmp_path / name).read_text() for name in names(tmp_path)}
    expected = {name: "new" if i < moves else "old" for i, name in enumerate(old)}
    assert texts == (expected if moves < 2 else dict.fromkeys(new, "new"))


def test_an_interrupt_while_the_old_folder_is_deleted_leaves_nothing_of_it(tmp_path, monkeypatch):
    folder, remove = folder_with(tmp_path / "folder", "old"), shutil.rmtree

    def interrupted(path, **options):
        if ".old-" in path.name:
            signal.raise_signal(signal.SIGINT)
        remove(path, **options)

    monkeypatch.setattr(atomic.shutil, "rmtree", interrupted)
    # shells start what runs in the background without it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            atomic.replace_folder(folder, writes("new"), mark=MARK)
    finally:
        signal.signal(signal.SIGINT, before)
    assert names(tmp_path) == ["folder"] and (folder / "a.txt").read_text() == "new"


def test_a_full_disk_names_what_was_to_be_written(tmp_path):
    def fill(temporary):
        temporary = temporary if temporary.suffix else temporary / "deep" / "a.txt"
        temporary.parent.mkdir(parents=True, exist_ok=True)
        atomic.replace_file(
            temporary, lambda inner: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left"))
        )

    def say(temporary):
        raise OSError(f"{temporary}: ffmpeg failed")

    for write in (fill, say):
        for call in (
            lambda path, write=write: atomic.replace_file(path.with_suffix(".mp4"), write),
            lambda path, write=write: atomic.replace_folder(path, write, mark=MARK),
            lambda path, write=write: atomic.add_files(path, write),
        ):
            with pytest.raises(OSError, match=r"target(\.mp4)?.*") as error:
                call(tmp_path / "target")
            assert str(tmp_path / "target") in str(error.value) and ".new-" not in str(error.value)
    assert names(tmp_path) == []
    source = tmp_path / "source"
    with pytest.raises(FileNotFoundError, match="source"):  # that of an input is not ours
        atomic.replace_file(
            tmp_path / "file", lambda temporary: temporary.write_bytes(source.read_bytes())
        )


def test_if_one_of_several_files_fails_none_appears(tmp_path):
    (tmp_path / "a.csv").write_text("old")

    def full(temporary):
        raise OSError(errno.ENOSPC, "No space left", str(temporary))

    with pytest.raises(OSError, match=r"No space left: '.*b\.html'"):
        atomic.replace_files(
            {tmp_path / "a.csv": lambda path: path.write_text("new"), tmp_path / "b.html": full}
        )
    assert names(tmp_path) == ["a.csv"] and (tmp_path / "a.csv").read_text() == "old"
    atomic.write_texts({tmp_path / "a.csv": "new", tmp_path / "b.html": "whole"})
    assert names(tmp_path) == ["a.csv", "b.html"] and (tmp_path / "a.csv").read_text() == "new"


def unreplaceable(monkeypatch, name):
    """Makes files of this name ones that cannot be replaced."""
    replace = Path.replace

    def refused(self, target):
        if Path(target).name == name:
            raise PermissionError(errno.EPERM, "Operation not permitted", str(self), str(target))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refused)


@pytest.mark.parametrize("links", [True, False])
def test_if_one_of_several_files_cannot_be_renamed_all_are_as_before(tmp_path, monkeypatch, links):
    for name in ("a.csv", "c.html"):
        (tmp_path / name).write_text("old")
    texts = {tmp_path / name: "new" for name in ("a.csv", "b.csv", "c.html", "d.csv")}
    if not links:
        monkeypatch.setattr(atomic.os, "link", no_links)
    with monkeypatch.context() as patch:
        unreplaceable(patch, "c.html")
        with pytest.raises(PermissionError, match=r"not permitted: '[^']*/c\.html'$"):
            atomic.write_texts(texts)
    assert names(tmp_path) == ["a.csv", "c.html"]
    assert {path.read_text() for path in tmp_path.iterdir()} == {"old"}
    atomic.write_texts(texts)
    assert names(tmp_path) == ["a.csv", "b.csv", "c.html", "d.csv"]
    assert {path.read_text() for path in tmp_path.iterdir()} == {"new"}


def no_links(*names, **options):
    raise OSError(errno.EPERM, "no hard links on this disk")


def test_a_folder_in_the_place_of_a_file_is_found_before_the_first_rename(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text("old")
    (tmp_path / "b.html").mkdir()
    monkeypatch.setattr(Path, "replace", lambda *paths: pytest.fail("a file was renamed"))
    with pytest.raises(IsADirectoryError, match=r"'[^']*/b\.html'$"):
        atomic.write_texts({tmp_path / "a.csv": "new", tmp_path / "b.html": "new"})
    with pytest.raises(IsADirectoryError, match=r"'[^']*/b\.html'$"):
        atomic.add_files(
            tmp_path, lambda folder: (folder / "b.html").write_text("new"), invalid=("a.csv",)
        )
    assert names(tmp_path) == ["a.csv", "b.html"] and (tmp_path / "a.csv").read_text() == "old"


def test_if_one_of_the_added_files_cannot_be_moved_all_are_as_before(tmp_path, monkeypatch):
    for name in ("a", "c", "invalid", "outdated"):
        (tmp_path / name).write_text("old")

    def write(folder):
        (folder / "deep").mkdir()
        for name in ("a", "b", "c", "deep/d"):
            (folder / name).write_text("new")

    unreplaceable(monkeypatch, "d")
    with pytest.raises(PermissionError, match=r"not permitted: '[^']*/deep/d'$"):
        atomic.add_files(tmp_path, write, without=("outdated",), invalid=("invalid",))
    assert names(tmp_path) == ["a", "c", "invalid", "outdated"]
    assert {path.read_text() for path in tmp_path.iterdir()} == {"old"}
    # a file in the place of a folder is found before the first move
    (tmp_path / "deep").write_text("old")
    with pytest.raises(NotADirectoryError, match="deep: is no folder"):
        atomic.add_files(tmp_path, write, invalid=("invalid",))
    assert {path.read_text() for path in tmp_path.iterdir()} == {"old"}


def test_an_invalid_file_of_a_user_is_not_deleted(tmp_path):
    (tmp_path / "invalid").write_text("dear")
    with pytest.raises(ValueError, match="invalid: exists, and was not written by humangs"):
        atomic.add_files(
            tmp_path, writes_into("new"), invalid=("invalid",), ours=lambda file: False
        )
    assert names(tmp_path) == ["invalid"] and (tmp_path / "invalid").read_text() == "dear"
    atomic.add_files(tmp_path, writes_into("new"), invalid=("invalid",), ours=lambda file: True)
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_folder_has_one_writer_at_a_time(tmp_path, replaced):
    place = tmp_path / "place"
    if not replaced:
        place.mkdir()
    code = "import sys; from humangs_jax.io import atomic\n"
    code += (
        f"with atomic.only_writer(sys.argv[1], replaced={replaced}): print('held', flush=True);"
        " input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, place], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        with pytest.raises(BlockingIOError, match=f"{place}: another process is writing here"):
            atomic.only_writer(place, replaced=replaced).__enter__()
        other.kill()
    with atomic.only_writer(place, replaced=replaced):
        atomic.replace_folder(tmp_path / "place", writes("whole"), mark=MARK)
    assert names(tmp_path) == ["place"]


def test_places_are_checked_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file", tmp_path / "new" / "deep"):
        atomic.check_writable(path)
    for path in (
        tmp_path / "file" / "deep" / "a.npz",
        Path("/proc/new/deep"),
        Path("/proc/version"),
    ):
        with pytest.raises(OSError, match=f"{path}: cannot write to "):
            atomic.check_writable(path)
    assert names(tmp_path) == ["file"]


def test_what_killed_processes_left_is_swept(tmp_path, dead_process):
    target = tmp_path / "folder"
    folder_with(leftover(target, "new", dead_process), "half")
    leftover(tmp_path / "file", "new", dead_process, suffix=".npz").write_text("half")
    folder_with(leftover(target, "new", os.getpid()), "of this process")
    folder_with(leftover(target, "new", dead_process, machine="00000000"), "of another machine")
    old = folder_with(
        leftover(target, "new", dead_process, machine="00000001"), "of another machine, long ago"
    )
    for path in (old / "a.txt", old):
        os.utime(path, (0, 0))
    (tmp_path / ".hidden").write_text("not ours")
    atomic.add_files(tmp_path / "other", writes_into("new"))
    folder_with(
        leftover(tmp_path / "other", "new", dead_process),
        "of one that was killed after it had made the folder",
    )
    atomic._sweep.cache_clear()  # a new process sweeps
    atomic.add_files(tmp_path / "other", writes_into("newer"))
    assert not leftover(tmp_path / "other", "new", dead_process).exists()
    shutil.rmtree(tmp_path / "other")
    folder_with(leftover(target, "new", dead_process), "half")
    atomic._sweep.cache_clear()
    atomic.replace_folder(target, writes("new"), mark=MARK)
    assert len(names(tmp_path)) == 4
    assert ".hidden" in names(tmp_path) and leftover(target, "new", os.getpid()).is_dir()
    assert leftover(target, "new", dead_process, machine="00000000").is_dir()


def test_what_may_still_be_written_is_not_swept(tmp_path):
    """A process that runs on this machine writes as long as it likes. In a folder of another
    machine, a file may change while the folder keeps its time.
    """
    target = tmp_path / "folder"
    mine = folder_with(leftover(target, "new", os.getppid()), "of a process that runs")
    theirs = folder_with(leftover(target, "new", 1, machine="00000000") / "deep", "of a long write")
    for path in (mine / "a.txt", mine, theirs, theirs.parent):
        os.utime(path, (0, 0))
    atomic.write_text(tmp_path / "a.txt", "")
    assert (mine / "a.txt").is_file() and (theirs / "a.txt").is_file()
    os.utime(theirs / "a.txt", (0, 0))
    atomic._sweep.cache_clear()  # a new process sweeps
    atomic.write_text(tmp_path / "a.txt", "")
    assert (mine / "a.txt").is_file() and not theirs.parent.exists()


def test_a_folder_that_a_killed_process_moved_aside_is_put_back(tmp_path, dead_process):
    target = tmp_path / "folder"
    folder_with(leftover(target, "old", dead_process), "old")

    def fail(temporary):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        atomic.replace_folder(target, fail, mark=MARK)
    assert names(tmp_path) == ["folder"] and (target / "a.txt").read_text() == "old"


def test_links_files_and_the_working_folder_are_refused_before_the_work(tmp_path, monkeypatch):
    folder_with(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    monkeypatch.chdir(tmp_path / "real")
    never = lambda temporary: pytest.fail("the work has begun")
    for folder, problem in (
        (tmp_path / "link", "symbolic link"),
        (tmp_path / "real" / "a.txt", "is a file"),
        (Path("."), "working folder"),
        (Path(".."), "working folder"),
        (Path("/"), "working folder"),
        (tmp_path / "real", "working folder"),
    ):
        with pytest.raises(ValueError, match=problem):
            atomic.replace_folder(folder, never, mark=MARK)
    assert (tmp_path / "real" / "a.txt").read_text() == "old"


def test_only_folders_of_the_kind_are_replaced_and_none_that_holds_an_input(tmp_path):
    folder, thesis = folder_with(tmp_path / "docs", "of our kind"), tmp_path / "docs" / "thesis.tex"
    thesis.write_text("dear")
    (tmp_path / "docs" / "deep").mkdir()
    (tmp_path / "docs" / "deep" / "b.txt").write_text("b")
    assert (
        atomic.contents(folder) == "a.txt, deep (1 file), thesis.tex"
        and atomic.contents(tmp_path / "none") == ""
    )
    never = lambda temporary: pytest.fail("the work has begun")
    with pytest.raises(ValueError, match=r"holds no capture\.json: refusing"):
        atomic.replace_folder(folder, never, mark="capture.json")
    with pytest.raises(ValueError, match=r"which deletes a\.txt, deep \(1 file\), thesis\.tex"):
        atomic.check_replaceable(folder, overwrite=False, mark=MARK)
    atomic.check_replaceable(folder, mark=MARK, inputs=(tmp_path / "scan.obj", None))
    (tmp_path / "link").symlink_to(thesis)
    (folder / "linked").symlink_to(tmp_path / "elsewhere")
    for given in (thesis, folder, folder / "deep" / "..", tmp_path / "link", folder / "linked"):
        with pytest.raises(ValueError, match="lies in it and would be deleted"):
            atomic.check_replaceable(folder, mark=MARK, inputs=(None, given))
    (tmp_path / "loop").symlink_to("loop")
    # whoever reads it says what is wrong
    atomic.check_replaceable(folder, mark=MARK, inputs=(tmp_path / "loop",))
    assert thesis.read_text() == "dear"


def test_places_where_nothing_can_be_written_are_refused_before_the_work(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="mount point"):
        atomic.check_replaceable("/proc")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be written to"):
        atomic.check_replaceable(tmp_path / "file" / "deep" / "folder")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(ValueError, match="cannot be written to"):
        atomic.check_replaceable(tmp_path / "deep" / "folder")


def test_several_writers_of_one_folder_end_with_one_of_theirs(tmp_path):
    failed, target = [], tmp_path / "folder"

    def write(number):
        try:
            for _ in range(20):
                atomic.replace_folder(target, writes(str(number)), mark=MARK)
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (
        failed == [] and names(tmp_path) == ["folder"] and (target / "a.txt").read_text() in "0123"
    )


WRITE_FOR_EVER = """
import pathlib, sys
from humangs_jax.io import atomic
out, kind = pathlib.Path(sys.argv[1]), sys.argv[2]
whole = {"a.txt": "whole " * 1000, "b.txt": "whole " * 1000}
def write(folder):
    folder.mkdir(exist_ok=True)
    for name, text in whole.items():
        (folder / name).write_text(text)
kinds = {
    "folder": lambda: atomic.replace_folder(out, write, mark="a.txt"),
    "files": lambda: atomic.add_files(out, write),
    "texts": lambda: atomic.write_texts({out / name: text for name, text in whole.items()}),
}
print("writing", flush=True)
while True:
    kinds[kind]()
"""


@pytest.mark.parametrize("kind", ["folder", "files", "texts"])
def test_killed_at_any_moment_all_is_whole_and_the_next_write_cleans_up(kind, tmp_path):
    target = folder_with(tmp_path / "folder", "old")
    (target / "b.txt").write_text("old")
    for milliseconds in (1, 3, 7, 11):
        command = [sys.executable, "-c", WRITE_FOR_EVER, str(target), kind]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            time.sleep(milliseconds / 1000)
            process.kill()
        atomic._sweep.cache_clear()  # a new process sweeps
        with pytest.raises(OSError, match="disk full"):
            atomic.replace_folder(
                target, lambda temporary: (_ for _ in ()).throw(OSError("disk full")), mark=MARK
            )
        atomic.write_texts({target / "a.txt": "old", target / "c.txt": ""})
        (target / "c.txt").unlink()
        assert names(tmp_path) == ["folder"] and names(target) == ["a.txt", "b.txt"]
        assert (target / "b.txt").read_text() in ("old", "whole " * 1000)


WRITES_ITSELF = {
    "training/loop.py": "lines that are added to a log",
    "avatar/layers.py": "into the temporary file of replace_file",
    "capture/calibration/videos.py": "into a temporary folder",
    "capture/calibration/importing.py": "copies into the temporary folder of replace_folder",
    "capture/fitting/files.py": "a copy into the temporary folder of add_files",
    "capture/detection/people.py": "nothing, to /dev/null",
    "io/arrays.py": "into the temporary file of replace_file",
    "core/processes.py": "a switch of /proc",
}
"""Modules other than `io/atomic.py` that open a file to write, with the reason."""
WRITING = re.compile(
    r"(?<!atomic)\.write_(text|bytes)\(|open\([^()]*\"(w|a|x)b?\"|np\.save|\.tofile\("
    r"|shutil\.(copy|move)"
)


def test_nothing_else_writes_files():
    """What `io.atomic` writes is whole at any moment."""
    package = Path(atomic.__file__).parents[1]
    found = {
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if WRITING.search(path.read_text())
    }
    assert found - {"io/atomic.py"} == set(WRITES_ITSELF)


def test_names_that_are_no_utf8_stay_what_they_are_in_text(tmp_path):
    name = os.fsdecode(b"caf\xe9.png")
    atomic.write_text(tmp_path / os.fsdecode(b"caf\xe9.mtl"), f"map_Kd {name}\n")
    (file,) = tmp_path.iterdir()
    assert os.fsencode(file.name) == b"caf\xe9.mtl" and file.read_bytes() == b"map_Kd caf\xe9.png\n"
    atomic.write_text(tmp_path / "half.txt", "half \ud800, caf\u00e9")
    assert (tmp_path / "half.txt").read_bytes().decode() == "half \\ud800, caf\u00e9"


def test_the_file_that_is_to_be_last_is_moved_last(tmp_path, monkeypatch):
    """If it was not there before, it tells that all others are in place."""
    moved, replace = [], Path.replace

    def noted(self, target):
        moved.append(Path(target).name)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", noted)
    names = ("a.json", "body.npz", "c.json")

    def write(folder):
        return (
            folder.mkdir(exist_ok=True),
            [(folder / name).touch() for name in names],
        )

    atomic.add_files(tmp_path / "me", write, last="body.npz")
    assert moved == ["a.json", "c.json", "body.npz"]


def test_a_lock_that_nobody_holds_is_removed(tmp_path):
    lock = tmp_path / ".me.lock"
    lock.touch()
    atomic.remove_abandoned_lock(tmp_path / "me")
    assert not lock.exists()
    with atomic.only_writer(tmp_path / "me", replaced=True):
        atomic.remove_abandoned_lock(tmp_path / "me")
        assert lock.exists()
    atomic.remove_abandoned_lock(tmp_path / "me")
