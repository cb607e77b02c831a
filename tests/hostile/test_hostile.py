"""Hostile files: read in a process of their own, each ends in one line, in bounded memory and time, and nothing else happens.

`python tests/hostile/test_hostile.py FOLDER` runs them and prints the figures of docs/security.md.
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
"""Of the list that these tests began with; 8 is tests/io/test_atomic.py, 9 the checks of arrays in tests/avatar."""


def run_cases(folder: Path, names: list[str]) -> dict[str, dict]:
    """Results by name; a case that ends the process is "died", and a new process goes on behind it."""
    results, waiting, attempt = {}, list(names), 0
    while waiting:
        place = folder / f"run{attempt}"
        place.mkdir(parents=True)
        (place / "names.json").write_text(json.dumps(waiting))
        command = [sys.executable, str(HERE / "worker.py"), str(place), str(place / "names.json")]
        environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "JAX_PLATFORMS": "cpu"}
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=WORKER_SECONDS, check=False
            )
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
            results[begun] = {
                "name": begun,
                "outcome": "died",
                "message": f"{ending} {errors[-300:]}",
                "path": "",
                "seconds": 0,
            }
        waiting, attempt = [name for name in waiting if name not in results], attempt + 1
    return results


def all_cases():
    sys.path[:0] = [str(HERE), *(str(HERE.parent / name) for name in ("network", "data/datasets", ""))]
    import hostile_cases

    return hostile_cases.all_cases()


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


CASES = all_cases()
READERS = sorted({case.reader for case in CASES})
FUZZED = int(os.environ.get("HUMANGS_FUZZ_INPUTS", "10000"))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return run_cases(tmp_path_factory.mktemp("hostile"), [case.name for case in CASES])


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_every_file_ends_in_one_line(results, reader):
    faults = [fault(case, results[case.name]) for case in CASES if case.reader == reader]
    assert not any(faults), "\n".join(filter(None, faults))


@pytest.mark.slow
@pytest.mark.parametrize("item", ITEMS)
def test_each_item_of_the_list_stays_closed(results, item):
    mine = [case for case in CASES if case.item == item]
    assert mine and not any(fault(case, results[case.name]) for case in mine)


def test_there_are_enough():
    assert len(CASES) >= 400


@pytest.mark.slow
def test_the_fuzzer_finds_nothing(tmp_path):
    command = [sys.executable, str(HERE / "fuzz.py"), str(tmp_path), str(FUZZED)]
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    figures = json.loads(done.stdout.splitlines()[-1])
    assert not {name: each["found"] for name, each in figures.items() if each["found"]}
    assert len(figures) >= 45 and all(each["inputs"] >= FUZZED for each in figures.values())


def main():
    results = run_cases(Path(sys.argv[1]), [case.name for case in CASES])
    faults = [text for case in CASES if (text := fault(case, results[case.name]))]
    print("\n".join(faults))
    slow = sorted(results.values(), key=lambda result: -result["seconds"])[:8]
    print("\n".join(f"{each['seconds']:.2f} s  {each['name']}" for each in slow))
    large = sorted(results.values(), key=lambda result: -result.get("bytes", 0))[:8]
    print("\n".join(f"{each.get('bytes', 0) >> 20} MiB  {each['name']}" for each in large))
    print(Counter(result["outcome"] for result in results.values()))
    print(f"{len(CASES)} files, {len({case.reader for case in CASES})} readers, {len(faults)} faults")


if __name__ == "__main__":
    main()
