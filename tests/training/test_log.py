"""The log: a killed run's extra lines go, faults are reported, TensorBoard has the same numbers."""

import json
import re
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from training_cases import source_of

from humangs_jax.data.loading import CaptureCache, Loader, Waiting
from humangs_jax.data.loading.examples import subject_order
from humangs_jax.io.reading import FileError
from humangs_jax.training.config import tiny
from humangs_jax.training.loop import MANY_SKIPPED, RunLog, Watch, forget_after
from humangs_jax.training.sources import bad_samples
from humangs_jax.training.state import GuardState, TrainState


def read(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def tensorboard_events(folder):
    """Returns the events of all TFRecord files, each: length, checksum, message, checksum."""
    from tensorboardX.proto.event_pb2 import Event

    events = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            events.append(Event.FromString(data[12 : 12 + length]))
            data = data[16 + length :]
    return events


def test_lines_of_later_steps_and_half_written_ones_go(tmp_path):
    path = tmp_path / "log.jsonl"
    whole = [
        {"step": 1, "loss": 0.5},
        {"step": 2, "loss": 0.4},
        {"step": 2, "val_psnr": 20.0},
        {"step": 3, "loss": 0.3},
    ]
    path.write_text("".join(json.dumps(line) + "\n" for line in whole) + '{"step": 2, "lo')
    forget_after(path, 2)
    assert read(path) == whole[:3]
    assert [p.name for p in tmp_path.iterdir()] == ["log.jsonl"]
    forget_after(tmp_path / "none.jsonl", 2)


def test_what_is_no_log_is_one_line_and_stays_as_it_is(tmp_path):
    path = tmp_path / "log.jsonl"
    for content in (
        b"\xff\xfe",
        b'{"step": 1}\n[' + b"[" * 10_000 + b'\n{"step": 2}\n',
        b'{"step": 1}\nhello\n{"step": 2}\n',
    ):
        path.write_bytes(content)
        with pytest.raises(FileError, match=re.escape(str(path))) as error:
            forget_after(path, 2)
        assert "\n" not in str(error.value) and path.read_bytes() == content


def test_tensorboard_reads_the_numbers_and_the_images(tmp_path):
    waiting = Waiting()
    with RunLog(tmp_path, 0, 10, progress=False) as log:
        waiting.add(0.5)
        log.steps(
            4,
            {"loss": jnp.asarray(0.25), "psnr": jnp.asarray(21.0)},
            subjects=2,
            waiting=waiting,
            broken=1,
        )
        log.numbers(4, {"val_psnr": 19.0}, "validation")
        log.image(4, "validation/sheet", np.random.default_rng(0).random((8, 16, 3)))
    training, validation = read(tmp_path / "log.jsonl")
    assert np.isclose(training["samples_per_second"] * training["seconds_per_step"], 2.0)
    assert training["data_seconds_per_step"] == 0.5 / 4 and training["broken_folders"] == 1
    assert validation == {"step": 4, "val_psnr": 19.0}
    values = {
        v.tag: (e.step, v)
        for e in tensorboard_events(tmp_path / "tensorboard")
        for v in e.summary.value
    }
    for name, value in training.items():
        if name != "step":
            step, found = values[f"train/{name}"]
            assert step == 4 and np.isclose(found.simple_value, value)
    assert np.isclose(values["validation/val_psnr"][1].simple_value, 19.0)
    assert values["validation/sheet"][1].image.width == 16


def test_numbers_that_are_not_finite_are_no_json_and_a_full_disk_names_the_log(tmp_path):
    with RunLog(tmp_path, 0, 10, progress=False) as log:
        log.event(3, "skipped", "skipped", loss=float("nan"), grad_norm=2.0)
    assert (
        tmp_path / "log.jsonl"
    ).read_text() == '{"step": 3, "event": "skipped", "loss": null, "grad_norm": 2.0}\n'
    (tmp_path / "log.jsonl").unlink()
    (tmp_path / "log.jsonl").symlink_to("/dev/full")
    with (
        pytest.raises(OSError, match=r"No space left on device: .*log\.jsonl"),
        RunLog(tmp_path, 0, 10, progress=False) as log,
    ):
        log.event(3, "skipped", "skipped")


def test_a_process_that_does_not_record_writes_nothing(tmp_path):
    with RunLog(tmp_path, 0, 10, recording=False) as log:
        log.steps(1, {"loss": jnp.ones(()), "psnr": jnp.ones(())}, 1, Waiting(), 0)
        log.event(1, "skipped", "skipped")
        log.image(1, "sheet", np.zeros((2, 2, 3)))
    assert list(tmp_path.iterdir()) == []


def test_a_bad_sample_is_named(tmp_path, body, captures, capsys):
    config = tiny()
    loader = Loader(
        source_of(CaptureCache(captures, body), config, spoilt_at=3, bright_at=4), batch_size=2
    )
    assert bad_samples(loader, 0) == bad_samples(loader, 0, loader.batch_at(0)) == []
    (one,), (other,) = bad_samples(loader, 1), bad_samples(loader, 2, loader.batch_at(2))
    order = [captures[i] for epoch in (0, 1) for i in subject_order(0, epoch, len(captures))]
    assert (
        one.endswith(f"the first at [0, 1, 2, 0]: nan ({order[3]})")
        and "sample 1: targets.images: " in one
    )
    assert "sample 0: inputs.masks: expected numbers in [0, 1]" in other and other.endswith(
        f"({order[4]})"
    )
    (event,) = watched(tmp_path, [(2, 1, 1, np.nan, 0.0)], lambda: bad_samples(loader, 1))
    assert event["samples"] == [one] and one in capsys.readouterr().out


def watched(folder, steps, bad_samples=list, before=0):
    """Returns the log after `Watch` saw steps.

    A step is (number, skipped so far, nonfinite so far, loss, norm of the gradient), and perhaps
    the number of (splat, tile) pairs without room.
    """
    names = ("skipped", "nonfinite", "loss", "grad_norm", "overflow")
    state = TrainState(
        jnp.asarray(0), {}, {}, GuardState(*[jnp.asarray(before)] * 2, jnp.zeros(()), ()), None
    )
    with RunLog(folder, 0, 100, progress=False) as log:
        watch = Watch(log, state)
        for done, *numbers in steps:
            numbers = (*numbers, 0.0)[: len(names)]
            watch(done, dict(zip(names, map(np.asarray, numbers), strict=True)), bad_samples)
        watch.look()
        watch.look()
    return read(folder / "log.jsonl")


def test_steps_that_went_wrong_are_reported_by_number(tmp_path, capsys):
    bad = [(3 + i, 3 + i, 4 + i, np.nan, 1.0) for i in range(MANY_SKIPPED)]
    events = watched(tmp_path, [(1, 2, 2, 1.0, 1.0), (2, 2, 3, 1.0, 1.0), *bad], before=2)
    skipped = [(3 + i, "skipped") for i in range(MANY_SKIPPED)]
    assert [(line["step"], line["event"]) for line in events] == [
        (2, "nonfinite"),
        *skipped,
        (2 + MANY_SKIPPED, "stuck"),
    ]
    assert "--diagnose" in capsys.readouterr().out


def test_a_gradient_that_stays_0_is_reported_once(tmp_path, capsys):
    events = watched(tmp_path, [(1 + i, 0, 0, 0.0, float(i == 0)) for i in range(2 * MANY_SKIPPED)])
    assert [(line["step"], line["event"]) for line in events] == [(1 + MANY_SKIPPED, "stuck")]
    assert "had a gradient of 0" in capsys.readouterr().out


def test_the_first_step_that_had_no_room_for_all_pairs_is_reported(tmp_path, capsys):
    overflows = (0.0, 7.0, 9.0, 0.0, 3.0)
    events = watched(tmp_path, [(1 + i, 0, 0, 1.0, 1.0, x) for i, x in enumerate(overflows)])
    assert [(line["step"], line["event"]) for line in events] == [(2, "overflow")]
    assert "7 (splat, tile) pairs of a step had no room" in capsys.readouterr().out
