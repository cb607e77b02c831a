"""Hostile files end in one line, in bounded memory and time, and nothing else happens.

Some files of each item are read here, all of them in another process (`worker`), by the slow
tests. `python tests/hostile/test_hostile.py FOLDER` reads all files and prints the figures of
docs/security.md. That nothing is half-written is in tests/io/test_atomic.py.
HUMANGS_HOSTILE_SEED=N makes the randomly damaged files from other seeds.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from humangs_jax.core.progress import printable

HERE = Path(__file__).parent
sys.path[:0] = [
    str(HERE),
    *(str(HERE.parent / name) for name in ("network", "capture", "data/datasets", "")),
]

from attacks_pickles import PICKLES, body_pickle  # noqa: E402
from hostile_cases import all_cases  # noqa: E402
from readers import FORMATS  # noqa: E402

WORKER_SECONDS = 1800
LONGEST_LINE = 1500
ITEMS = {
    1: "a file runs code or damages memory",
    2: "a path leaves its folder",
    3: "damaged contents are noticed by a checksum",
    4: "no other format, and no process",
    5: "memory and time",
    6: "one line, not a traceback",
    7: "arrays of avatars and bodies",
}
"""Of the list that these tests began with; 8 is tests/io/test_atomic.py, 9 the checks of arrays
in tests/avatar.
"""
CASES = all_cases()
FUZZED = int(os.environ.get("HUMANGS_FUZZ_INPUTS", "10000"))
"""Files for each reader; docs/results has the figures of more."""
EVERY = 12
HEAVY = (
    *(
        "GiB",
        "million",
        "bomb",
        "100,000",
        "100 MB",
        "digits",
        "8,000",
        "13,000",
        "30,000",
        "60,000,000",
        "300,000",
    ),
    *("5,000 photos", "white photos", "scans", "nodes", "MB"),
)
"""Files that a reader which has become careless would take minutes or gigabytes for."""


def program(
    script: str, *arguments: object, seconds: float | None = None
) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(HERE / script), *map(str, arguments)]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=seconds, check=False
    )


def run_cases(folder: Path, names: list[str]) -> dict[str, dict]:
    """Results by name; a case that ends the process is "died", and a new process goes on behind
    it.
    """
    results, waiting, attempt = {}, list(names), 0
    while waiting:
        place = folder / f"run{attempt}"
        place.mkdir(parents=True)
        (place / "names.json").write_text(json.dumps(waiting))
        try:
            done = program("worker.py", place, place / "names.json", seconds=WORKER_SECONDS)
            ending, errors = f"exit status {done.returncode}", done.stderr[-2000:]
        except subprocess.TimeoutExpired:
            ending, errors = "did not end", ""
        file, begun = place / "results.jsonl", None
        for line in file.read_text().splitlines() if file.exists() else ():
            record = json.loads(line)
            begun = record.get("begun", begun)
            if "outcome" in record:
                results[record["name"]], begun = record, None
        if begun is None and len(waiting) == len([name for name in waiting if name not in results]):
            raise RuntimeError(f"the worker read nothing: {ending}\n{errors}")
        if begun is not None:
            died = {
                "outcome": "died",
                "message": f"{ending} {errors[-300:]}",
                "path": "",
                "seconds": 0,
            }
            results[begun] = {"name": begun} | died
        waiting, attempt = [name for name in waiting if name not in results], attempt + 1
    return results


def fault(case, result: dict) -> str:
    """What is wrong with a result, or nothing."""
    outcome, message = result["outcome"], result["message"]
    if outcome not in ("read", "refused") or (case.expect != "either" and outcome != case.expect):
        return f"{case.name}: expected {case.expect}, got {outcome}: {message[-600:]}"
    if outcome == "refused":
        path = Path(result["path"])
        folder = path if path.is_dir() else path.parent
        if message != printable(message) or len(message) > LONGEST_LINE:
            return f"{case.name}: not one line, or with characters that a terminal acts on: {message!r}"
        if str(folder) not in message:
            return f"{case.name}: no file is named: {message}"
    return ""


@pytest.mark.parametrize("item", ITEMS)
def test_some_files_of_each_item(item, tmp_path):
    light = [
        case for case in CASES if case.item == item and not any(word in case.name for word in HEAVY)
    ]
    faults = []
    for number, case in enumerate(light[::EVERY] if len(light) > 60 else light):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = case.make(folder)
        result = {"outcome": "read", "message": "", "path": str(path)}
        try:
            FORMATS[case.reader].read(path)
        except (ValueError, OSError) as error:
            result |= {"outcome": "refused", "message": str(error)}
        faults.append(fault(case, result))
    assert faults and not any(faults), "\n".join(filter(None, faults))


def test_every_pickle_of_an_attack_is_refused(tmp_path, monkeypatch):
    """Or its values are no arrays; in both cases nothing of it runs."""
    monkeypatch.chdir(tmp_path)
    for kind, instructions in PICKLES.items():
        for reader in ("pickle", "pickled tensors"):
            (tmp_path / "a.pkl").write_bytes(body_pickle(instructions))
            try:
                FORMATS[reader].read(tmp_path / "a.pkl")
            except ValueError as error:
                assert str(error).startswith(str(tmp_path)), kind
            else:
                assert reader == "pickled tensors", kind
    assert os.listdir(tmp_path) == ["a.pkl"]


@pytest.mark.parametrize("name", [name for name, each in FORMATS.items() if each.make is not None])
def test_honest_files_are_read(name, tmp_path):
    FORMATS[name].read(FORMATS[name].make(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("reader", sorted({case.reader for case in CASES}))
def test_every_file_ends_in_one_line(tmp_path, reader):
    own = [case for case in CASES if case.reader == reader]
    results = run_cases(tmp_path, [case.name for case in own])
    faults = [fault(case, results[case.name]) for case in own]
    assert not any(faults), "\n".join(filter(None, faults))


@pytest.mark.slow
def test_the_fuzzer_finds_nothing(tmp_path):
    done = program("fuzz.py", tmp_path, FUZZED)
    assert done.returncode == 0, done.stderr[-2000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    assert not {name: each["found"] for name, each in figures.items() if each["found"]}
    assert len(figures) >= 45 and all(each["inputs"] >= FUZZED for each in figures.values())


def main():
    results = run_cases(Path(sys.argv[1]), [case.name for case in CASES])
    faults = [text for case in CASES if (text := fault(case, results[case.name]))]
    print("\n".join(faults))
    for key, unit in (("seconds", 1), ("bytes", 1 << 20)):
        most = sorted(results.values(), key=lambda result, key=key: -result.get(key, 0))[:8]
        print(
            "\n".join(
                f"{each.get(key, 0) / unit:.2f} {key if unit == 1 else 'MiB'}  {each['name']}"
                for each in most
            )
        )
    print(Counter(result["outcome"] for result in results.values()))
    print(
        f"{len(CASES)} files, {len({case.reader for case in CASES})} readers, {len(faults)} faults"
    )


if __name__ == "__main__":
    main()
