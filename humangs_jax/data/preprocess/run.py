"""A whole set: which subjects are due, several at a time, what is finished, and the lists and the manifest over all of it.

    OUT/manifest.json            settings, finished scenes with what is known of them, skipped ones with the reason, the split
    OUT/NAME/                    a scene or a capture, see `scenes`
    OUT/skipped/NAME.json        why one was skipped; it is tried again by the next run
    OUT/train.json, test.json, evaluation_N.json    of the layout "scenes"

Finished folders are kept, so that the same command continues an interrupted set. Shards of one set may run at the same time; each
ends by making lists and manifest of what is there. A run without shards, after them, finds nothing to make and lists everything.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from humangs_jax.core.processes import in_processes
from humangs_jax.core.progress import bar
from humangs_jax.data.capture_checks import CaptureError, checked_json, required
from humangs_jax.data.datasets.bodies import FileBody
from humangs_jax.data.datasets.opening import VIDEOS
from humangs_jax.data.datasets.scene_list import write_list
from humangs_jax.data.datasets.thuman import ThumanSet, open_thuman
from humangs_jax.data.preprocess.protocol import INPUT_COUNTS, TARGETS, evaluation_indices, split_ids
from humangs_jax.data.preprocess.scenes import SCENE, Settings, write_scan, write_video
from humangs_jax.io.reading import shown, write_json

MANIFEST, SKIPPED = "manifest.json", "skipped"
FORMAT, VERSION = "humangs-dataset", 1


@dataclasses.dataclass(frozen=True)
class Report:
    """What is in a set after a run. made: in this run. scenes, views: in all. skipped: name -> reason."""

    out: Path
    made: int
    scenes: int
    views: int
    skipped: dict[str, str]

    def __str__(self) -> str:
        lines = [f"{self.out}: {self.scenes} scenes, {self.views} views ({self.made} scenes made now)"]
        return "\n".join(lines + [f"skipped {name}: {reason}" for name, reason in self.skipped.items()])


def preprocess(
    source: str | Path,
    out: str | Path,
    body_file: str | Path,
    settings: Settings,
    shard: tuple[int, int] = (0, 1),
    workers: int = 1,
    progress: bool = True,
) -> Report:
    """Make or continue a set.

    Arguments: source: the data set; of "thuman" the folder that holds model/ and smplx/. body_file: the model of its
    fits. shard: (i, n): the i-th of n parts, from 0. workers: processes, for scans.
    Raises: ValueError if there is nobody, `out` holds another set, or (at the end) nobody could be made.
    """
    source, out = Path(source).resolve(), Path(out)
    index, count = shard
    if not 0 <= index < count:
        raise ValueError(f"shard {index}/{count}: expected a number from 0 to {count - 1}")
    if out.resolve() == source or source in out.resolve().parents:
        raise ValueError(f"{out}: lies in the data set {source}: expected another place")
    names, absent = _subjects(source, settings)
    body = FileBody.load(body_file)
    _begin(out, settings)
    for name, reason in absent.items():
        _skip(out, name, reason)
    due = [name for name in names[index::count] if not (out / name / settings.mark).is_file()]
    make = _make_scans if settings.kind == "thuman" else _make_videos
    made = 0
    try:
        for name, error in make(source, out, due, body, settings, workers, progress):
            if error is None:
                made += 1
                (out / SKIPPED / f"{name}.json").unlink(missing_ok=True)
            else:
                _skip(out, name, error)
    finally:
        manifest = _finish(out, [*names, *absent], settings)
    counts = manifest["counts"]
    if due and not counts["scenes"]:
        reason = next(iter(manifest["skipped"].values()), "nothing was made")
        raise ValueError(f"{out}: none of {len(names)} subjects could be made; the first one: {reason}")
    return Report(out, made, counts["scenes"], counts["views"], manifest["skipped"])


def _subjects(source, settings):
    """Names of the subjects, and why some lack a file."""
    if settings.kind == "thuman":
        found = open_thuman(source)
        return list(found.names), found.skipped
    folders = VIDEOS[settings.kind][0](source)
    if not folders:
        raise CaptureError(source, "", f"no subject in the layout of {settings.kind} (docs/datasets.md)")
    return [folder.name for folder in folders], {}


def _make_videos(source, out, due, body, settings, workers, progress) -> Iterator[tuple[str, str | None]]:
    """One after the other; photos are decoded by threads."""
    find, open_subject = VIDEOS[settings.kind]
    folders = {folder.name: folder for folder in find(source)}
    for name in due:
        try:
            subject = open_subject(folders[name], body)
            total = int((subject.frames % settings.every == 0).sum())
            with bar(total=total, desc=name, unit="photo", shown=progress) as shown:
                write_video(out / name, name, subject, body, settings, shown.update)
        except (ValueError, ArithmeticError) as error:  # not OSError: a full disk ends everything
            yield name, str(error)
        else:
            yield name, None


def _make_scans(source, out, due, body, settings, workers, progress) -> Iterator[tuple[str, str | None]]:
    """Several processes, which have one thread each."""
    with bar(total=len(due), desc="scans", shown=progress) as shown:
        for name, error in _in_processes(source, out, due, body, settings, min(workers, len(due))):
            shown.update()
            yield name, error


def _in_processes(source, out, due, body, settings, workers):
    if workers <= 1:
        for name in due:
            yield name, _attempt_scan(source, out, name, body, settings)
        return
    tasks = {name: (source, out, name, settings) for name in due}
    yield from in_processes(_work, tasks, workers, _load_body, body.file)


_worker: dict[str, Any] = {}


def _load_body(file):
    _worker["body"] = FileBody.load(file)


def _work(source, out, name, settings):
    return _attempt_scan(source, out, name, _worker["body"], settings)


def _attempt_scan(source, out, name, body, settings):
    try:
        write_scan(out / name, name, ThumanSet(source, (name,), {}), body, settings)
    except (ValueError, ArithmeticError) as error:
        return str(error)


# Lists and manifest -----------------------------------------------------------------------------------------------------


def _begin(out, settings):
    """Raises: ValueError if the folder holds a set of other settings."""
    file, asked = out / MANIFEST, _plain(settings)
    if not file.is_file():
        if out.is_dir() and any(not entry.name.startswith(".") for entry in out.iterdir()):
            raise ValueError(f"{out}: the folder is not empty and holds no {MANIFEST}: choose another one")
        out.mkdir(parents=True, exist_ok=True)
        write_json(file, {"format": FORMAT, "version": VERSION, "settings": asked})
        return
    content = checked_json(file)
    if (
        not isinstance(content, dict)
        or content.get("format") != FORMAT
        or not isinstance(content.get("settings"), dict)
    ):
        raise CaptureError(file, "format", f"expected a manifest of {FORMAT!r}")
    earlier = content["settings"]
    changed = [
        f"{key} {shown(earlier.get(key))} -> {shown(value)}"
        for key, value in asked.items()
        if earlier.get(key) != value
    ]
    if changed:
        problem = f"written with settings other than asked for now ({', '.join(changed)}): choose another folder"
        raise CaptureError(file, "settings", problem)


def _plain(settings):
    return dataclasses.asdict(settings) | {"factors": list(settings.factors)}


def _skip(out, name, reason):
    (out / SKIPPED).mkdir(exist_ok=True)
    write_json(out / SKIPPED / f"{name}.json", {"reason": reason})


def _finish(out: Path, names: Sequence[str], settings: Settings) -> dict[str, Any]:
    """Lists and manifest of what is there; again if other shards have added to it meanwhile."""
    done, manifest = None, {}
    for _ in range(2):  # not until nothing is added: that may be hours
        if (found := _finished(out, settings)) != done:
            done = found
            scenes = {name: _read_scene(out / name / SCENE, settings) for name in done}
            manifest = _write_lists(out, names, scenes, settings)
    return manifest


def _finished(out, settings):
    return sorted(path.parent.name for path in out.glob(f"*/{settings.mark}") if not path.parent.name.startswith("."))


def _read_scene(file, settings):
    """What a finished folder says of itself. Raises: CaptureError naming file and key."""
    content = checked_json(file)
    known = _of_kind(content, "known", dict, file)
    _of_kind(known, "views", int, file, "known.")
    for reason in _of_kind(known, "missing", dict, file, "known.") if "missing" in known else ():
        _of_kind(known["missing"], reason, int, file, "known.missing.")
    if "unreadable" in known:
        _of_kind(known, "unreadable", dict, file, "known.")
    if settings.layout == "scenes":
        _of_kind(_of_kind(content, "entry", dict, file), "frames", list, file, "entry.")
    return content


def _of_kind(mapping, key, kind, file, prefix=""):
    value = required(mapping, key, file, prefix) if isinstance(mapping, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise CaptureError(file, prefix + key, f"expected {_KINDS[kind]}, got {type(value).__name__}")
    return value


_KINDS = {dict: "a JSON object", list: "a list", int: "a whole number", str: "a text"}


def _write_lists(out, names, scenes, settings):
    skipped = {
        file.stem: _of_kind(checked_json(file), "reason", str, file)
        for file in sorted((out / SKIPPED).glob("*.json"))
        if file.stem not in scenes
    }
    train, test = split_ids(names, settings.train, settings.test) if settings.kind == "thuman" else ([], sorted(names))
    split = {"train": [name for name in train if name in scenes], "test": [name for name in test if name in scenes]}
    if settings.layout == "scenes":
        for part, chosen in split.items():
            if chosen or part == "test":
                write_list(out / f"{part}.json", [scenes[name]["entry"] for name in chosen])
        counts = {name: len(scenes[name]["entry"]["frames"]) for name in split["test"]}
        for inputs in INPUT_COUNTS:
            if counts and min(counts.values()) >= inputs + TARGETS:
                write_json(out / f"evaluation_{inputs}.json", evaluation_indices(counts, inputs), indent=None)
    known = {name: scene["known"] for name, scene in scenes.items()}
    counts = {
        "scenes": len(scenes),
        "views": sum(each["views"] for each in known.values()),
        "skipped": len(skipped),
        "unreadable_photos": sum(len(each.get("unreadable", ())) for each in known.values()),
        "missing_photos": sum(sum(each.get("missing", {}).values()) for each in known.values()),
    }
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "settings": _plain(settings),
        "counts": counts,
        "split": split,
        "scenes": known,
        "skipped": skipped,
    }
    write_json(out / MANIFEST, manifest)
    return manifest
