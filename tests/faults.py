"""Puts faults into the package, one at a time, and says which of them no test finds.

python tests/faults.py [PART OF A MODULE'S NAME]

A fault replaces a text of a module by another text while the module is imported; no file changes.
`TESTS` says which tests must find the faults of a module.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ATOMIC, PICKLE, TENSORS = "io.atomic", "io.restricted_pickle", "io.tensors"
TESTS = {
    ATOMIC: ["tests/io/test_atomic.py"],
    PICKLE: [
        "tests/hostile/test_hostile.py",
        "tests/network/test_torch_file.py",
        "-k",
        "pickle or torch",
        "-m",
        "slow or not slow",
    ],
    TENSORS: ["tests/network/test_torch_file.py"],
    "body.kinematics": ["tests/body/test_kinematics.py"],
    "motion.clips": ["tests/motion/test_motion_skeletons.py"],
}
"""Arguments of pytest, by module: the tests that must find its faults."""
FAULTS = [
    # what is there is lost, or half of it is written
    (ATOMIC, "aside.rename(folder)\n            raise", "raise"),
    (ATOMIC, "temporary.rename(folder)\n            return", "folder.mkdir()\n            return"),
    (ATOMIC, "_being_written.discard(temporary.absolute())\n        _remove(temporary)", "pass"),
    (ATOMIC, "            else:\n                _remove(entry)", ""),
    (ATOMIC, "entry.rename(original)", "_remove(entry)"),
    (ATOMIC, "                    old.replace(path)", "                    pass"),
    (ATOMIC, "path.is_dir() and not path.is_symlink()", "False"),
    (ATOMIC, "return time.time() - last_change > ABANDONED_SECONDS", "return False"),
    (ATOMIC, 'in (path, *path.rglob("*"))', "in (path,)"),
    (ATOMIC, "if machine == MACHINE and", "if"),
    (ATOMIC, "return path.exists() and not _runs(pid)", "pass"),
    (ATOMIC, "new.sort(key=lambda file: file == Path(last))", "pass"),
    (ATOMIC, "{Path(file) for file in without}.difference(new)", "{Path(f) for f in without}"),
    (ATOMIC, "folder.is_symlink()", "False"),
    (ATOMIC, "Path.cwd().is_relative_to(place)", "False"),
    (ATOMIC, "os.path.ismount(folder)", "False"),
    (ATOMIC, "if mark not in entries:", "if False:"),
    (ATOMIC, "if not overwrite:", "if False:"),
    (ATOMIC, "fcntl.LOCK_EX | at_once", "fcntl.LOCK_SH | at_once"),
    (ATOMIC, "raise OSError(error.errno, error.strerror, str(path)) from error", "raise"),
    (ATOMIC, "tempfile.TemporaryFile(dir=place).close()", "pass"),
    (ATOMIC, "for each in new:  # the innermost first", "for each in ():"),
    # a pickle runs, or takes more than it holds
    (PICKLE, "if key not in self.names:", "if key[0] not in ('os', *[k[0] for k in self.names]):"),
    (PICKLE, "abs(argument) >= LARGEST_INTEGER", "abs(argument) < 0"),
    (PICKLE, "if not 0 <= index <= self.count or not self.stack:", "if not self.stack:"),
    (PICKLE, "key is None or key > LARGEST_KEY", "key is None"),
    (PICKLE, "self.memo[index] = self.stack[-1] or 0", "self.memo[index] = 0"),
    (PICKLE, "if within and (end > self.frame_end", "if within and (False"),
    (PICKLE, "made = 1 + sum(part or 0 for part in taken)", "made = 1"),
    (PICKLE, "if self.file.tell() != self.seen:", "if self.file.tell() == self.seen:"),
    (PICKLE, "!= len(data):", "> len(data):"),
    (PICKLE, 'encoding not in ("latin1", "latin-1")', "False"),
    (PICKLE, "depth > 8 or left < 0", "left < 0"),
    (PICKLE, "if not dtype.itemsize:", "if dtype.itemsize > 4:"),
    # a file of tensors gives others, or more
    (TENSORS, 'if f"{root}byteorder" in members and', "if False and"),
    (TENSORS, "> LARGEST_RATIO * size", "> 10**9 * size"),
    (TENSORS, "if count > len(data) or (count and last >= len(data)):", "if count > len(data):"),
    (TENSORS, "if len(shape) != len(strides) or len(shape) > MOST_AXES:", "if False:"),
    (TENSORS, "self.kinds.setdefault(pid[2], pid[1].name) != pid[1].name", "False"),
    (TENSORS, "if left < 0:", "if left is None:"),
    (TENSORS, "(array.astype(np.uint32) << 16)", "(array.astype(np.uint32) << 15)"),
    (TENSORS, "(data)[len(data) - size :]", "(data)[len(data) - size - 1 : -1]"),
    # people stand elsewhere
    ("body.kinematics", "above @ turns[..., joint, :, :]", "turns[..., joint, :, :] @ above"),
    ("motion.clips", "turns[:, joint], moves[:, joint] = turn, move", "turns[:, joint] = turn"),
]
"""Faults: (module, text of the module, text that replaces it)."""


class Faulty(importlib.abc.MetaPathFinder, importlib.machinery.SourceFileLoader):
    """Imports one module with a fault in it."""

    def __init__(self, module, text, other):
        path = ROOT / "humangs_jax" / (module.replace(".", "/") + ".py")
        super().__init__(f"humangs_jax.{module}", str(path))
        source = path.read_text()
        assert text in source, f"{module} has no {text!r}"
        self.source = source.replace(text, other).encode()

    def find_spec(self, name, path=None, target=None):
        """Returns the spec of the faulty module, and None for other names."""
        return importlib.util.spec_from_loader(name, self) if name == self.name else None

    def get_code(self, name):
        """Compiles the faulty source; a cached program would lack the fault."""
        return compile(self.source, self.path, "exec")


if "HUMANGS_FAULT" in os.environ:  # as a plugin of pytest
    finder = Faulty(*FAULTS[int(os.environ["HUMANGS_FAULT"])])
    sys.meta_path.insert(0, finder)


def pytest_sessionstart():
    """Moves this finder before that of jaxtyping, which was added later."""
    sys.meta_path.remove(finder)
    sys.meta_path.insert(0, finder)


def main():
    """Runs the tests for each fault; exits with 1 if one is not found. A fault is also found if the
    tests end at their limit of CPU time.
    """
    wanted, missed = sys.argv[1] if len(sys.argv) > 1 else "", 0
    for number, (module, text, other) in enumerate(FAULTS):
        if wanted not in module:
            continue
        command = [sys.executable, "-m", "pytest", "-p", "faults", "-x", "-q", *TESTS[module]]
        environment = os.environ | {
            "HUMANGS_FAULT": str(number),
            "PYTHONPATH": f"{ROOT}:{ROOT}/tests",
        }
        code = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True).returncode
        by_limit = code < 0 and -code in (signal.SIGXCPU, signal.SIGKILL)
        missed += code != 1 and not by_limit
        found = {0: "NOT FOUND", 1: "found"}.get(code, f"pytest ended with {code}")
        if by_limit:
            found = "found"
        print(f"{found:10} {module}: {text[:60]!r} -> {other[:40]!r}", flush=True)
    print(f"{missed} not found")
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
