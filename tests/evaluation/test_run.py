"""The evaluator: which views are compared, predictions by file name, and errors in one line."""

import dataclasses
import functools
import json
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_cases import capture_from, random_views
from PIL import Image
from small import small_body

import humangs_jax as hg
from humangs_jax import cli
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.data.datasets.scene_list import read_evaluation
from humangs_jax.data.loading import Example
from humangs_jax.data.views import SubjectViews
from humangs_jax.evaluation import run as evaluation
from humangs_jax.evaluation.cases import Case, Predicted, _short_names, find_people, spread_views
from humangs_jax.evaluation.kept import case_key, method_key
from humangs_jax.io.images import write_png

NAMES = ("front", "left", "back", "right")
evaluate = functools.partial(hg.evaluate, protocol="lhm")
"""No package has the LPIPS network of this protocol, so that no time is spent on it here."""


@pytest.fixture(scope="module")
def people():
    """Returns (capture, predicted images) of two people with two frames of two views."""
    made = {}
    for i, name in enumerate(("ann", "bob")):
        predicted, truth, masks = random_views(i, 4, 40, 32)
        made[name] = capture_from(truth, masks, frames=[0, 0, 1, 1], names=NAMES), predicted
    return made


def cases(people):
    return [Case(name, capture) for name, (capture, _) in people.items()]


def predicting(people):
    def method(case, background):
        alpha = np.ones(case.truth.images.shape[:3], np.float32)
        return Predicted(people[case.name][1], alpha, tuple(range(case.truth.view_count)))

    return method


def psnr(x, y):
    return -10 * np.log10(np.square(x.astype(np.float64) - y).mean())


def test_every_image_is_a_row_and_means_are_in_their_order(people, tmp_path):
    found = evaluate(cases(people), method=predicting(people), protocol="lhm")
    # scores and their mean, computed here
    expected = {
        name: [psnr(*pair) for pair in zip(p, c.images, strict=True)]
        for name, (c, p) in people.items()
    }
    assert [(row.person, row.frame, row.view) for row in found.rows][1:3] == [
        ("ann", 0, "left"),
        ("ann", 1, "back"),
    ]
    scored = [row.scores["psnr"] for row in found.rows]
    np.testing.assert_allclose(scored, [*expected["ann"], *expected["bob"]], atol=1e-4)
    mean = found.means["psnr"]
    assert mean.mean == pytest.approx(np.mean([np.mean(x) for x in expected.values()]), abs=1e-4)
    assert mean.low < mean.mean < mean.high and mean.over == "people"
    assert "lpips_squeeze" in found.reasons and found.means["lpips_squeeze"] is None
    text = found.summary()
    assert (
        "8 images of 2 people" in text
        and "no weights of LPIPS squeeze were given" in text
        and "IoU" in text
    )
    # the same numbers in every kind of report
    files = {kind: tmp_path / f"a.{kind}" for kind in ("json", "html", "csv", "markdown", "latex")}
    found.write(**files)
    report = json.loads(files["json"].read_text())
    assert report["means"]["psnr"]["mean"] == mean.mean and report["order"].startswith(
        "mean over the images of a frame"
    )
    assert list(evaluation.COLUMNS)[-2:] == ["patch_lpips_squeeze", "patches"]
    assert report["protocol"] == {
        "name": "lhm",
        "settings": {
            "background": "white",
            "crop": {"kind": "WholeFrame"},
            "lpips_crop": None,
            "masked": False,
            "lpips": ["squeeze"],
            "ssim": {"kind": "SsimWindow", "size": 11, "sigma": 1.5, "sample": False},
            "published_side": None,
        },
    }
    assert len(report["images"]) == 8 and report["images"][0]["scores"]["lpips_squeeze"] is None
    assert (
        files["csv"].read_text().count("\n") == 9 and files["markdown"].read_text().count("\n") == 5
    )
    assert files["latex"].read_text().count(r"\\") == 4
    page = files["html"].read_text()
    assert page.count("data:image/jpeg") == 3 * 8 and "http" not in page.replace("http-equiv", "")


def test_a_page_keeps_the_worst(people):
    found = evaluate(cases(people), method=predicting(people), page_images=3)
    order = np.argsort([row.scores["psnr"] for row in found.rows])
    assert set(found.gallery.shots) == set(order[:3].tolist())


def test_people_who_are_scored_are_kept(people, tmp_path):
    """An interrupted call keeps their scores; the next call completes them."""
    asked, stop = [], ["bob"]

    def method(case, background):
        asked.append(case.name)
        if case.name in stop:
            raise KeyboardInterrupt
        return predicting(people)(case, background)

    def run(**options):
        return evaluate(
            cases(people), method=method, keep=tmp_path / "kept", **{"page_images": 5, **options}
        )

    with pytest.raises(KeyboardInterrupt):
        run()
    stop.clear()
    found, plain = run(), evaluate(cases(people), method=predicting(people), page_images=5)
    assert asked == ["ann", "bob", "bob"]
    assert (
        found.rows == plain.rows and found.about == plain.about and found.reasons == plain.reasons
    )
    assert (
        found.gallery.shots == plain.gallery.shots and found.gallery.inputs == plain.gallery.inputs
    )
    with pytest.raises(
        ValueError, match=r"written with settings other than asked for now \(images 5 -> 6\)"
    ):
        run(page_images=6)


def white(case, background):
    return Predicted(np.ones_like(case.truth.images), None, tuple(range(case.truth.view_count)))


def test_scores_of_other_photos_views_or_people_are_never_taken_for_kept_ones(people, tmp_path):
    (ann, _), (bob, _) = people["ann"], people["bob"]
    brighter = dataclasses.replace(ann, images=np.clip(ann.images + 0.1, 0, 1))
    renamed = Case("ann", bob)

    def run(*cases, **options):
        return evaluate(cases, method=white, keep=tmp_path / "kept", page_images=0, **options).rows

    plain = lambda *cases: evaluate(cases, method=white, page_images=0).rows
    first = Case("ann", ann)
    assert run(first) == plain(first)
    for other in (
        Case("ann", brighter),
        renamed,
        Case("ann", ann.select([0, 2])),
        Case("eve", ann),
    ):
        assert run(other) == plain(other) != plain(first)
        assert run(other, first) == plain(other, first)


def test_a_folder_of_scores_made_with_other_inputs_weights_or_body_is_refused(
    people, folders, tmp_path
):
    def run(**options):
        return evaluate(
            folders, **{"method": white, "keep": tmp_path / "kept", "page_images": 0, **options}
        )

    views = {name: {"context": [0], "target": [1]} for name in people}
    run(inputs=1)
    problem = "written with settings other than asked for now "
    with pytest.raises(ValueError, match=problem + r"\(inputs 1 -> 2\)"):
        run(inputs=2)
    with pytest.raises(ValueError, match=problem + r"\(indices None -> '\w+', inputs 1 -> None\)"):
        run(indices=views)
    with pytest.raises(ValueError, match=problem + r"\(body None -> '\w+'\)"):
        run(inputs=1, body=small_body())
    with pytest.raises(ValueError, match=problem + r"\(method .*, name .*\)"):
        run(inputs=1, method=predicting(people))


def test_scores_of_images_that_were_drawn_again_are_not_kept(people, folders, tmp_path):
    theirs = tmp_path / "theirs"
    write_predictions(theirs, people)

    def run():
        return [
            row.scores["psnr"]
            for row in evaluate(folders, predictions=theirs, keep=tmp_path / "kept").rows
        ]

    before = run()
    write_png(theirs / "bob" / "left.png", np.zeros((40, 32, 3)))
    after = run()
    assert [old == new for old, new in zip(before, after, strict=True)] == [True] * 5 + [False] + [
        True
    ] * 2


def test_weights_of_other_values_have_another_key():
    config = hg.reconstruct  # any object that prints
    keys = [
        method_key(1, None, ({"params": {"a": np.full(2, x)}}, config), None, None)[0]
        for x in (1.0, 1.0, 2.0)
    ]
    assert keys[0] == keys[1] != keys[2]


def write_predictions(folder, people, alpha=False):
    for name, (capture, predicted) in people.items():
        (folder / name).mkdir(parents=True)
        for view, image in zip(capture.names, predicted, strict=True):
            pixels = image
            if alpha:
                pixels = np.concatenate([image, np.full((*image.shape[:2], 1), 1.0)], axis=-1)
            write_png(folder / name / f"{view}.png", pixels)


@pytest.fixture
def folders(people, tmp_path, monkeypatch):
    """Returns the folder of the captures, whose body is the tiny one."""
    for name, (capture, _) in people.items():
        save_capture(tmp_path / "people" / name, capture)
    load = hg.load_capture
    monkeypatch.setattr(
        "humangs_jax.evaluation.cases.load_capture",
        lambda path, body=None: load(path, body=body or small_body()),
    )
    return tmp_path / "people"


def test_predictions_are_found_by_file_name(people, folders, tmp_path):
    """One program writes alpha, another none; one numbers its files; some are missing."""
    for alpha in (False, True):
        write_predictions(tmp_path / f"theirs{alpha}", people, alpha)
        found = evaluate(folders, predictions=tmp_path / f"theirs{alpha}")
        expected = [
            psnr(np.rint(255 * p) / 255, np.rint(255 * c.images) / 255) for c, p in people.values()
        ]
        assert (
            len(found.rows) == 8
            and abs(np.mean([r.scores["psnr"] for r in found.rows]) - np.mean(expected)) < 0.5
        )
        assert ("iou" in found.reasons) is not alpha and (found.means["iou"] is not None) is alpha
        assert any("Compared on all views" in note for note in found.notes())
    one = tmp_path / "numbered"
    one.mkdir()
    for i, image in enumerate(people["bob"][1]):
        write_png(one / f"view_{i:03d}.png", image)
    assert len(evaluate(folders / "bob", predictions=one).rows) == 4
    for image in tmp_path.glob("theirsFalse/bob/*.png"):  # any of the formats of photos
        Image.open(image).save(image.with_suffix(".webp"), lossless=True)
        image.unlink()
    (tmp_path / "theirsFalse" / "bob" / "left.webp").unlink()
    found = evaluate(folders, predictions=tmp_path / "theirsFalse")
    assert len(found.rows) == 7 and [file.endswith("bob/left.png") for file in found.missing] == [
        True
    ]
    assert "1 prediction missing:" in found.summary()


def test_views_whose_true_mask_is_empty_are_not_compared(people, folders, tmp_path, caplog):
    write_predictions(tmp_path / "theirs", people)
    all_views = evaluate(folders / "bob", predictions=tmp_path / "theirs" / "bob")
    write_png(folders / "bob/masks/left.png", np.zeros(people["bob"][0].masks.shape[1:]))
    found = evaluate(folders / "bob", predictions=tmp_path / "theirs" / "bob")
    assert [row.view for row in found.rows] == ["front", "back", "right"]
    kept = [row.scores for row in all_views.rows if row.view != "left"]
    assert [row.scores["psnr"] for row in found.rows] == [scores["psnr"] for scores in kept]
    assert "bob: 1 view is not compared, its mask is empty: left" in caplog.text


def test_what_is_wrong_is_one_line(people, folders, tmp_path):
    theirs = tmp_path / "theirs"
    with pytest.raises(FileNotFoundError, match="no such folder of predictions"):
        evaluate(folders, predictions=theirs)
    theirs.mkdir()
    with pytest.raises(
        ValueError, match=r"no prediction was found; 8 were expected: .*ann/front\.png"
    ):
        evaluate(folders, predictions=theirs)
    # predictions of another size, and only some with transparency
    write_predictions(theirs, {"ann": people["ann"]})
    write_png(theirs / "ann" / "back.png", np.zeros((20, 30, 3)))
    with pytest.raises(
        ValueError, match=r"ann/back\.png: size 30 x 20, but the true image has 32 x 40"
    ):
        evaluate(folders, predictions=theirs)
    write_png(theirs / "ann" / "back.png", np.zeros((40, 32, 4)))
    with pytest.raises(
        ValueError, match="1 of 4 images have an alpha channel: expected all or none"
    ):
        evaluate(folders, predictions=theirs)
    # methods and protocols that do not fit the people
    with pytest.raises(ValueError, match="avatar and weights: expected one of them"):
        evaluate(folders, avatar=tmp_path, weights="w.safetensors")
    with pytest.raises(
        ValueError, match=r"one avatar for 2 people: expected a folder with PERSON\.npz"
    ):
        evaluate(folders, avatar=tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"no prediction was found; 2 were expected: .*ann\.npz"):
        evaluate(folders, avatar=theirs)
    with pytest.raises(
        ValueError, match="no protocol 'ours': expected one of humangs, animatable-gaussians"
    ):
        evaluate(folders, predictions=theirs, protocol="ours")
    masks = capture_from(people["ann"][0].images)
    with pytest.raises(ValueError, match="ann: the protocol needs a mask for every view"):
        evaluate(Case("ann", masks), method=predicting(people), protocol="giga")


def test_which_views_are_inputs_and_which_are_compared(people, folders, tmp_path):
    capture = people["ann"][0]
    first_person = lambda *arguments, **options: find_people(*arguments, **options).load(0)
    case = first_person(capture, 2)
    assert case.inputs.names == ("front", "left") and case.truth.names == ("back", "right")
    assert (
        first_person(folders, reconstructs=False).truth.names == NAMES
        and first_person(folders, 1).truth.names == NAMES[1:]
    )
    (tmp_path / "views.json").write_text('{"ann": {"context": [3, 0], "target": [1]}}')
    indices = read_evaluation(tmp_path / "views.json")
    case = first_person(folders, indices=indices)
    assert case.inputs.names == ("right", "front") and case.truth.names == ("left",)
    save_capture(folders / "ann" / "held_out", capture.select([3]))
    case = first_person(folders)
    assert case.inputs.names == ("front", "left") and case.truth.names == ("right",)
    assert first_person(folders, 1).inputs.names == ("front",)
    with pytest.raises(ValueError, match="indices: 'eve' is no capture in"):
        first_person(folders, indices={"eve": {"context": [], "target": [0]}})
    with pytest.raises(ValueError, match="indices: 'bob' is missing"):
        find_people(folders, indices=indices).load(1)
    with pytest.raises(ValueError, match="ann: expected views from 0 to 3 and at least one target"):
        first_person(folders, indices={"ann": {"context": [0], "target": [4]}})
    with pytest.raises(ValueError, match="capture: 3 inputs, but 2 views show the first frame"):
        first_person(capture, 3)


def test_inputs_stand_around_the_person():
    cameras = np.asarray(capture_from(np.ones((12, 16, 16, 3), np.float32)).cameras.cam_from_world)
    order = [0, 7, 2, 9, 4, 11, 6, 1, 8, 3, 10, 5]
    found = spread_views("ann", np.zeros(12, int), cameras[order], 4)
    assert found == sorted(found) and sorted(order[i] for i in found) == [0, 3, 6, 9]


class People:
    """A source of examples that are chosen by number."""

    input_counts = (2,)

    def __init__(self, capture):
        self._capture, self.broken = capture, {}

    def __len__(self):
        return 3

    def example(self, seed, index, input_count):
        return Example(self._views([0, 1]), self._views([2, 3, 0]))

    def describe(self, seed, index, input_count):
        return "a person"

    def _views(self, chosen):
        capture = self._capture.select(chosen)
        poses = capture.poses
        return SubjectViews(
            images=jnp.asarray(capture.images),
            masks=jnp.asarray(capture.masks),
            cameras=capture.cameras,
            rotations=poses.rotations[capture.frames],
            translations=poses.translation[capture.frames],
            betas=jnp.asarray(capture.betas),
        )


def test_people_of_one_name_are_kept_apart():
    paths = [Path("/data/Actor01/Sequence1"), Path("/data/Actor02/Sequence1")]
    assert _short_names(paths) == ("Actor01_Sequence1", "Actor02_Sequence1")
    assert _short_names([Path("a/x"), Path("a/y")]) == ("x", "y")
    assert _short_names([Path("a"), Path("a")]) == ("0000", "0001") and _short_names(
        [Path("scene")]
    ) == ("scene",)


def test_a_source_gives_people(people):
    """Views of equal poses are a frame, in the order of their first appearance."""
    found = find_people(People(people["ann"][0]), body=small_body())
    assert found.names == ("0000", "0001", "0002")
    case = found.load(1)
    assert case.truth.frames.tolist() == [0, 0, 1] and case.inputs.frames.tolist() == [0, 0]
    np.testing.assert_array_equal(
        case.truth.poses.rotations[0], people["ann"][0].poses.rotations[1]
    )
    np.testing.assert_array_equal(case.truth.images[2], people["ann"][0].images[0])
    seen = []

    def method(case, background):
        seen.append((case.name, background))
        return Predicted(case.truth.images, None, (0, 1, 2))

    found = evaluate(People(people["ann"][0]), method=method, protocol="giga", body=small_body())
    assert seen == [("0000", 0.0), ("0001", 0.0), ("0002", 0.0)] and len(found.rows) == 9


def test_the_command(people, folders, tmp_path, humangs):
    write_predictions(tmp_path / "theirs", people, alpha=True)
    run = functools.partial(humangs, "evaluate")
    out = tmp_path / "out"
    out.mkdir()
    options = ("--predictions", tmp_path / "theirs", "--protocol", "lhm++")
    code, printed, error = run(
        folders,
        *options,
        "--json",
        out / "a.json",
        "--html",
        out / "a.html",
        "--csv",
        out / "a.csv",
    )
    assert code == 0, error
    assert (
        "theirs, protocol lhm++: 8 images of 2 people" in printed and str(out / "a.html") in printed
    )
    assert json.loads((out / "a.json").read_text())["means"]["iou"]["count"] == 2


@pytest.mark.slow
def test_avatars_and_weights_are_drawn_on_the_protocols_background(tmp_path):
    """Weights, and the avatar that they make of the same photos, give the same numbers."""
    weights = hg.load_weights()
    avatar = hg.reconstruct(*weights, hg.load_capture("demo_capture"))
    avatar.save(tmp_path / "demo_capture.npz")
    for protocol, background in (("humangs", 1.0), ("ghg", 0.0)):
        by_weights = hg.evaluate("demo_capture", weights=weights, protocol=protocol, page_images=0)
        by_avatar = hg.evaluate(
            "demo_capture", avatar=tmp_path / "demo_capture.npz", protocol=protocol
        )
        by_folder = hg.evaluate("demo_capture", avatar=tmp_path, protocol=protocol)
        assert by_weights.rows == by_avatar.rows == by_folder.rows and len(by_weights.rows) == 6
        assert by_weights.means["psnr"].mean > 24 and by_weights.means["iou"].mean > 0.9
        corner = by_avatar.gallery.shots
        assert len(corner) == 6 and by_weights.gallery.shots == {}
        # an invisible avatar leaves the background of the protocol
        dimmed = replace(avatar.gaussians, opacities=jnp.zeros_like(avatar.gaussians.opacities))
        nobody = hg.evaluate(
            "demo_capture", avatar=replace(avatar, gaussians=dimmed), protocol=protocol
        )
        truth = hg.load_capture("demo_capture/held_out")
        expected = truth.images
        if not background:
            expected = np.clip(truth.images - (1 - truth.masks[..., None]), 0, 1)
        if protocol == "humangs":
            found = [row.scores["psnr"] for row in nobody.rows]
            np.testing.assert_allclose(
                found, [psnr(x, np.ones_like(x)) for x in expected], atol=1e-3
            )
        assert nobody.means["iou"].mean == 0


def test_the_command_goes_on_after_an_interruption(people, folders, tmp_path, monkeypatch, capsys):
    """It continues if its files have not changed."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_predictions(tmp_path / "theirs", people, alpha=True)
    scored, interrupting = [], [True]
    score = evaluation.score_views

    def score_views(predicted, truth, *rest):
        if scored and interrupting:
            raise KeyboardInterrupt
        scored.append(truth)
        return score(predicted, truth, *rest)

    monkeypatch.setattr(evaluation, "score_views", score_views)

    def run(*more):
        return cli.execute(
            [
                "evaluate",
                str(folders),
                "--predictions",
                str(tmp_path / "theirs"),
                "--protocol",
                "lhm",
                *more,
            ]
        )

    kept = lambda: [file.name for file in (tmp_path / "cache").rglob("person_*.json")]
    assert run() == cli.INTERRUPTED and [name[:11] for name in kept()] == ["person_ann_"]
    interrupting.clear()
    assert run("--csv", str(tmp_path / "a.csv")) == 0 and len(scored) == 2 and kept() == []
    assert "going on: 1 person is scored" in capsys.readouterr().out
    interrupting.append(True)
    scored.clear()
    assert run() == cli.INTERRUPTED and [name[:11] for name in kept()] == ["person_ann_"]
    os.utime(max(folders.rglob("*.png"), key=lambda file: len(file.parts)), (0, 0))  # deep in there
    interrupting.clear()
    assert run() == 0 and len(scored) == 3 and "going on" not in capsys.readouterr().out


@pytest.mark.parametrize("field", ["gains", "calibrated"])
def test_the_key_of_a_case_depends_on_how_its_capture_was_taken(field):
    capture = load_capture("demo_capture").resized(32)
    other = {"gains": np.full((capture.view_count, 3), 0.9, np.float32), "calibrated": False}
    changed = dataclasses.replace(capture, **{field: other[field]})
    assert case_key(Case("a", capture)) != case_key(Case("a", changed))


def test_indices_are_refused_where_cases_say_what_is_compared():
    case = Case("a", load_capture("demo_capture").resized(32))
    for source in (case, [case]):
        with pytest.raises(ValueError, match="indices: expected none, since cases"):
            find_people(source, indices={"a": {"context": [0], "target": [1]}})
