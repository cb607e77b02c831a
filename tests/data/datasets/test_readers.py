"""Every layout is read as it was written, photos only when needed; missing parts are counted."""

import dataclasses
import json

import numpy as np
import pytest
from dataset_files import (
    CAMERAS,
    FRAMES,
    HEIGHT,
    h5py,
    model_arrays,
    recording,
    write_actorshq,
    write_avatarrex,
    write_dna,
    write_model,
    write_photo,
    write_scenes,
    write_thuman,
    write_thuman4,
)

from humangs_jax.data.datasets.scene_list import read_evaluation, read_scene_list
from humangs_jax.data.datasets.subject import (
    BodyParameters,
    FileBody,
    open_people,
    posed_people,
    turned,
)
from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.loading import CaptureSource, Loader, PeopleCache, Source, ViewSampling
from humangs_jax.evaluation.run import evaluate
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import write_json
from humangs_jax.training.config import tiny
from humangs_jax.training.forward import validation_examples
from humangs_jax.training.sources import people_on_disk, training_people

FLOAT32 = 1e-6
JPEG = 3
"""Largest error in levels of JPEG images of one grey."""
SIZE = 16


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("body"))


VIDEOS = {"avatarrex": write_avatarrex, "thuman4": write_thuman4, "actorshq": write_actorshq}


OF_CAPTURE = ("avatarrex", "thuman4")
"""Layouts whose calibration is read by a module of capture/."""


@pytest.mark.parametrize(
    "layout",
    [
        pytest.param(layout, marks=[pytest.mark.wings] if layout in OF_CAPTURE else [])
        for layout in VIDEOS
    ],
)
def test_a_video_is_read_as_it_was_written(layout, tmp_path, body):
    (person,) = open_people(VIDEOS[layout](tmp_path / "set"), body, SIZE)
    subject = person.subject
    shown = [(frame, camera) for frame in range(FRAMES) for camera in range(CAMERAS)]
    if layout == "thuman4":  # one is listed as missing
        shown.remove((1, 1))
        assert subject.missing == {"listed as missing": 1}
    else:
        assert not subject.missing
    assert (
        subject.frames.tolist() == [frame for frame, _ in shown] and subject.frame_count == FRAMES
    )
    made = recording()
    for view, (_, camera) in enumerate(shown):
        np.testing.assert_allclose(
            subject.cam_from_world[view, :3, :3], made.R[camera], atol=FLOAT32
        )
        np.testing.assert_allclose(
            subject.cam_from_world[view, :3, 3], made.T[camera], atol=FLOAT32
        )
        # pixel centres at +0.5; padded by 2 columns on each side
        np.testing.assert_allclose(subject.K[view, :2, 2], made.K[:2, 2] + 0.5)
        np.testing.assert_allclose(
            subject.squared_K([view], SIZE)[0, :2, 2], made.K[:2, 2] + 0.5 + [2, 0]
        )
    values = made.parameters
    betas, rotations, translations = subject.parameters([2, 0])
    np.testing.assert_allclose(betas[:10], values["betas"][0], atol=FLOAT32)
    np.testing.assert_allclose(translations, values["transl"][[2, 0]], atol=FLOAT32)
    np.testing.assert_allclose(
        rotations[:, :22].reshape(2, -1)[:, 3:], values["body_pose"][[2, 0]], atol=FLOAT32
    )
    np.testing.assert_array_equal(rotations[:, 23:25], 0)  # no poses of the eyes
    # flat_hand_mean is True: the numbers are whole rotations
    np.testing.assert_allclose(
        rotations[:, 40:].reshape(2, -1), values["right_hand_pose"][[2, 0]], atol=FLOAT32
    )
    image, mask = subject.photo(0, SIZE)
    assert image.shape == (SIZE, SIZE, 3) and set(np.unique(mask)) == {0, 255}
    person_box = np.zeros((SIZE, SIZE), bool)
    person_box[4:12, 5:11] = True
    np.testing.assert_array_equal(mask > 0, person_box)
    assert (image[~person_box] == 255).all() and np.abs(
        image[person_box].astype(int) - 100
    ).max() <= JPEG
    capture = subject.capture([0, 2], body, SIZE)
    assert capture.view_count == 2 and capture.names[0].endswith("00000000")


@pytest.mark.wings
def test_photos_without_mask_or_pose_and_missing_ones_are_counted(tmp_path, body):
    folder = write_avatarrex(tmp_path / "a")
    (folder / "22010708" / "00000000.jpg").unlink()
    (folder / "22010710" / "mask" / "pha" / "00000002.jpg").unlink()
    camera = folder / "22010710"
    write_photo(
        camera / "00000009.jpg", camera / "mask" / "pha" / "00000009.jpg", recording().shot(1, 9)
    )
    (folder / "22010710" / "notes.txt").write_text("not a photo")
    (person,) = open_people(folder, body)
    assert person.subject.missing == {"no photo": 1, "no mask": 1, "no pose": 1}
    assert len(person.subject) == 2 * 3 - 2


def test_hdf5_is_read_as_it_was_written(tmp_path, body):
    h5py()
    (person,) = open_people(write_dna(tmp_path / "dna"), body, SIZE)
    subject, made = person.subject, recording()
    assert len(subject) == FRAMES * CAMERAS and not subject.missing
    np.testing.assert_allclose(subject.cam_from_world[1, :3, 3], made.T[1], atol=FLOAT32)
    np.testing.assert_allclose(subject.K[0, :2, 2], made.K[:2, 2] + 0.5)
    _, rotations, translations = subject.parameters([1])
    # flat_hand_mean is False
    hands = made.parameters["right_hand_pose"][1] + model_arrays()["hands_meanr"]
    np.testing.assert_allclose(rotations[0, 40:].reshape(-1), hands, atol=FLOAT32)
    np.testing.assert_allclose(translations[0], made.parameters["transl"][1], atol=FLOAT32)
    image, mask = subject.photo(3, SIZE)
    assert (image[mask > 0] == 100).all() and (image[mask == 0] == 255).all() and mask[8, 8] == 255


def test_a_scene_list_gives_back_shape_pose_and_metres(tmp_path, body):
    file, betas, known = write_scenes(tmp_path, model_arrays())
    (person,) = open_people(file, body)
    subject = person.subject
    found, rotations, translations = subject.parameters([1, 0])
    np.testing.assert_allclose(found, betas, atol=1e-3)
    for i, frame in enumerate((1, 0)):
        wanted, translation = known[frame]
        np.testing.assert_allclose(rotations[i], wanted, atol=1e-5)
        np.testing.assert_allclose(translations[i], translation, atol=1e-4)
    np.testing.assert_allclose(subject.cam_from_world[:, 2, 3], 3.0, atol=1e-4)  # not 3.9
    image, mask = subject.photo(0, HEIGHT)
    assert mask[7, 6] == 255 and mask.sum() == 255 * 8 * 6  # a white spot inside is the person's
    assert (image[mask == 0] == 255).all()


def test_a_scene_list_leaves_out_and_counts_what_is_missing(tmp_path, body):
    write_scenes(tmp_path, model_arrays())
    (tmp_path / "images" / "0_1.png").unlink()
    (tmp_path / "smpl" / "1.npz").unlink()
    (person,) = open_people(tmp_path, body)
    assert person.subject.missing == {"no image": 1, "no smpl_path": 3} and len(person.subject) == 2


def test_a_scene_without_frames_spoils_no_other(tmp_path, body):
    file, *_ = write_scenes(tmp_path, model_arrays())
    (scene,) = json.loads(file.read_text())
    write_json(file, [{"scene_name": "empty"}, scene])
    empty, whole = open_people(file, body)
    assert whole.size == HEIGHT and len(whole.subject)
    with pytest.raises(ValueError, match=r"empty\.frames: missing"):
        empty.open()


def test_canonical_hands_that_the_release_bent_do_not_matter(tmp_path, body):
    arrays = model_arrays()
    file, betas, _ = write_scenes(tmp_path, arrays)
    of_hands = arrays["weights"][:, 25:].sum(1) > 0
    for i in range(2):
        values = dict(np.load(tmp_path / "smpl" / f"{i}.npz"))
        values["v_cano"][of_hands] += 0.05
        np.savez(tmp_path / "smpl" / f"{i}.npz", **values)
    found = open_people(file, body)[0].subject.parameters([0]).betas
    np.testing.assert_allclose(found, betas, atol=1e-3)


def test_evaluation_indices_are_read_and_checked(tmp_path):
    write_json(tmp_path / "e.json", {"s": {"context": [0, 3], "target": [1]}})
    assert read_evaluation(tmp_path / "e.json")["s"]["context"] == [0, 3]
    write_json(tmp_path / "e.json", {"s": {"context": [0, -3], "target": [1]}})
    with pytest.raises(ValueError, match=r"e.json: s.context: expected numbers of views"):
        read_evaluation(tmp_path / "e.json")


@pytest.mark.wings
def test_scans_without_a_fit_are_skipped_with_the_reason(tmp_path):
    folder = write_thuman(tmp_path / "t", model_arrays())
    (folder / "smplx" / "0001" / "smplx_param.pkl").unlink()
    names, skipped = open_thuman(folder)
    assert names == ["0000", "0002"] and "smplx_param.pkl: no such file" in skipped["0001"]
    with pytest.raises(ValueError, match="preprocess thuman"):
        open_people(folder, FileBody.load())
    (person,) = open_people(write_avatarrex(tmp_path / "a"), FileBody.load())
    with pytest.raises(
        ValueError, match=r"smpl_params.npz: betas: of SMPL-X, and body 'makehuman'"
    ):
        person.summary()


def test_a_turned_world_moves_the_posed_body_along(body):
    rng = np.random.default_rng(3)
    parameters = BodyParameters(
        0.3 * rng.normal(size=20), 0.4 * rng.normal(size=(1, 55, 3)), rng.normal(size=(1, 3))
    )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0.3, -2, 1]
    before = next(posed_people(body.model, parameters)).vertices
    after = next(
        posed_people(body.model, turned(parameters, matrix, body.rest_joints(parameters.betas)[0]))
    ).vertices
    np.testing.assert_allclose(after, before @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)


@pytest.mark.wings
def test_opening_people_reads_no_photo(tmp_path, body):
    folder = write_avatarrex(tmp_path / "a")
    for photo in folder.glob("*/*.jpg"):
        photo.write_bytes(photo.read_bytes()[:400])  # the head alone
    (person,) = open_people(folder, body, SIZE)
    assert len(person.summary().frames) == FRAMES * CAMERAS
    with pytest.raises(ValueError, match="not a readable image"):
        person.subject.photo(0, SIZE)


@pytest.mark.wings
def test_every_data_set_is_a_source_of_the_loader(tmp_path, body):
    folders = {layout: write(tmp_path / layout) for layout, write in VIDEOS.items()}
    folders["scenes"] = write_scenes(tmp_path / "scenes", model_arrays())[0]
    people = [person for folder in folders.values() for person in open_people(folder, body, SIZE)]
    (tmp_path / "avatarrex" / "22010708" / "00000001.jpg").write_bytes(b"\xff\xd8 not a photo")
    source = CaptureSource(
        PeopleCache(people), ViewSampling(input_counts=(2,), target_count=2), SIZE // 2, SIZE
    )
    assert isinstance(source, Source) and len(source) == 4
    loader = Loader(source, batch_size=4, seed=1)
    batch = loader.batch_at(0)
    assert batch.inputs.images.shape == (4, 2, SIZE // 2, SIZE // 2, 3)
    assert batch.targets.images.shape == (4, 2, SIZE, SIZE, 3) and batch.inputs.rotations.shape == (
        4,
        2,
        55,
        3,
    )
    again = Loader(
        CaptureSource(PeopleCache(people), source.sampling, SIZE // 2, SIZE), batch_size=4, seed=1
    ).batch_at(0)
    np.testing.assert_array_equal(batch.targets.images, again.targets.images)
    for step in range(1, 5):
        loader.batch_at(step)
    (problem,) = source.broken.values()
    assert "00000001.jpg" in problem and len(read_scene_list(folders["scenes"])) == 1


@pytest.mark.wings
def test_training_takes_a_scene_list_and_a_data_set(tmp_path, body):
    config = tiny()
    model = config.model.with_conventions(image_size=SIZE)
    views = ViewSampling(input_counts=(2,), target_count=2, rule="window")
    config = dataclasses.replace(config, model=model, target_size=SIZE, views=views)
    write_avatarrex(tmp_path / "videos" / "avatarrex_zzr")
    for data in (write_scenes(tmp_path / "scenes", model_arrays())[0], tmp_path / "videos"):
        make = training_people(data, 0, tmp_path / "run", body.model, body.file)
        example = make(config).example(0, 0, 2)
        assert example.inputs.rotations.shape == (2, 55, 3) and example.inputs.images.shape == (
            2,
            SIZE,
            SIZE,
            3,
        )
        (example,) = validation_examples(people_on_disk(data, body, split=None), config, 8)
        assert example.targets.images.shape == (2, SIZE, SIZE, 3)
    with pytest.raises(
        ValueError, match="synthetic people have the body that comes with the package"
    ):
        training_people(None, 5, tmp_path / "run", body.model, body.file)
    with pytest.raises(ValueError, match=r"no captures, scene list or data set"):
        training_people(tmp_path / "run", 0, tmp_path / "run", body.model, body.file)


def test_the_evaluator_compares_views_of_a_scene_list(tmp_path, body):
    """The indices are the published ones; predictions are named like the views."""
    file = write_scenes(tmp_path / "scenes", model_arrays())[0]
    (name,) = read_scene_list(file)
    (person,) = open_people(file, body)
    write_json(tmp_path / "views.json", {name: {"context": [0], "target": [2, 1]}})
    capture = person.subject.capture([2, 1], body, person.size)
    (tmp_path / "theirs").mkdir()
    for image, view in zip(capture.images, capture.names, strict=True):
        write_png(tmp_path / "theirs" / f"{view}.png", image)
    found = evaluate(
        file, predictions=tmp_path / "theirs", indices=tmp_path / "views.json", body=body.file
    )
    assert [row.view for row in found.rows] == ["00002", "00001"] and found.rows[0].person == name
    assert all(row.scores["psnr"] == 100 for row in found.rows)
