import pickle
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.library import load_body, load_hands, load_smplx
from humangs_jax.body.model import BodyPose, pose_body, shape_body, without_expression

DATA = Path(__file__).parent / "data"
MODEL, ARRAYS = DATA / "smplx_reduced_model.npz", DATA / "smplx_reduced_arrays.npz"
ATOL = 1e-6  # float32 numbers of a metre, read and multiplied once


def made_up_file(n=9, columns=20, seed=0):
    """Returns a model file's arrays: root's parent is 2^32 - 1, indices are unsigned, numbers
    float64.
    """
    rng = np.random.default_rng(seed)
    weights = rng.uniform(size=(n, 55))
    regressor = np.where(rng.uniform(size=(55, n)) < 0.5, rng.uniform(size=(55, n)), 0)
    regressor[:, 0] = 1 - regressor[:, 1:].sum(1)
    parents = np.asarray(PARENTS, np.int64)
    parents[0] = 2**32 - 1
    return {
        "v_template": rng.normal(size=(n, 3)),
        "f": rng.integers(0, n, size=(4, 3)).astype(np.uint32),
        "shapedirs": rng.normal(size=(n, 3, columns)),
        "posedirs": rng.normal(size=(n, 3, 486)),
        "J_regressor": regressor,
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(55)]).astype(np.uint32),
        "hands_meanl": rng.normal(size=45),
        "hands_meanr": rng.normal(size=45),
        "hands_componentsl": rng.normal(size=(45, 45)),
        "hands_componentsr": rng.normal(size=(45, 45)),
        "vt": rng.uniform(size=(6, 2)),
        "ft": rng.integers(0, 6, size=(4, 3)).astype(np.uint32),
    }


TOLERANCE = 1e-5
CONVENTIONS = {  # name: (suffix of the hand arrays, use_pca, flat_hand_mean)
    "axis_flat": ("pose_45", False, True),
    "axis_mean": ("pose_45", False, False),
    "pca12_mean": ("pca_12", True, False),
}
PARTS = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose")


def compare_body(model: Path, arrays: Path) -> list[tuple[str, int, float, float, float]]:
    """Returns rows (convention, pose index, vertex error, joint error, pose error)."""
    expected = np.load(arrays, allow_pickle=False)
    counts = {
        "shape_count": expected["betas"].shape[1],
        "expression_count": expected["expression"].shape[1],
    }
    body, hands = load_smplx(model, **counts), load_hands(model)

    @jax.jit
    def run(betas, pose):
        posed = pose_body(body, shape_body(body, betas), pose)
        return posed.vertices[expected["vertex_indices"]], posed.joints

    rows = []
    number = lambda key, i: jnp.asarray(expected[key][i])
    for convention, (suffix, use_pca, flat_hand_mean) in CONVENTIONS.items():
        for i in range(len(expected["betas"])):
            # hands are coefficients of PCA or angles, from flat hands or from the mean
            hand = [number(f"{side}_hand_{suffix}", i) for side in ("left", "right")]
            if use_pca:
                hand = [own @ hands.components[side, : len(own)] for side, own in enumerate(hand)]
            if not flat_hand_mean:
                hand = [own + hands.means[side] for side, own in enumerate(hand)]
            rotations = jnp.concatenate([*(number(part, i).ravel() for part in PARTS), *hand])
            pose = BodyPose(rotations.reshape(55, 3), number("transl", i))
            found = run(jnp.concatenate([number("betas", i), number("expression", i)]), pose)
            wanted = [
                expected[f"{convention}_{name}"][i] for name in ("vertices", "joints", "full_pose")
            ]
            vertices, joints, rotations = (
                float(np.abs(np.asarray(a, np.float64) - b).max())
                for a, b in zip((*found, pose.rotations.reshape(-1)), wanted, strict=True)
            )
            rows.append((convention, i, vertices, joints, rotations))
    return rows


def test_agrees_with_the_public_package_in_every_hand_convention(tmp_path):
    rows = compare_body(MODEL, ARRAYS)
    assert {convention for convention, *_ in rows} == set(CONVENTIONS) and len(rows) == 6
    assert max(max(errors) for _, _, *errors in rows) < TOLERANCE
    arrays = dict(np.load(ARRAYS))
    np.savez(
        tmp_path / "other.npz", **arrays | {"axis_mean_joints": arrays["axis_mean_joints"] + 2e-5}
    )
    assert (
        max(max(errors) for _, _, *errors in compare_body(MODEL, tmp_path / "other.npz"))
        > TOLERANCE
    )


def test_an_npz_is_read_as_it_is(tmp_path):
    arrays = made_up_file()
    objects = np.asarray({"pelvis": 0}, dtype=object)
    np.savez(tmp_path / "SMPLX_NEUTRAL.npz", **arrays, joint2num=objects)
    body = load_smplx(tmp_path / "SMPLX_NEUTRAL.npz", shape_count=3, expression_count=2)
    assert body.name == "SMPLX_NEUTRAL"
    assert body.parents == PARENTS and body.joint_names == JOINT_NAMES
    assert body.shape_names == ("shape_0", "shape_1", "shape_2", "expression_0", "expression_1")
    assert np.allclose(
        body.shape_directions, arrays["shapedirs"][..., [0, 1, 2, 10, 11]], atol=ATOL
    )
    for field, key in (
        ("template", "v_template"),
        ("pose_directions", "posedirs"),
        ("joint_regressor", "J_regressor"),
    ):
        assert np.allclose(getattr(body, field), arrays[key], atol=ATOL)
    for field, key in (
        ("skinning_weights", "weights"),
        ("faces", "f"),
        ("uvs", "vt"),
        ("uv_faces", "ft"),
    ):
        assert np.allclose(getattr(body, field), arrays[key], atol=ATOL)
    assert body.template.dtype == jnp.float32
    with jax.enable_x64(True):
        assert np.array_equal(
            load_smplx(tmp_path / "SMPLX_NEUTRAL.npz").template, arrays["v_template"]
        )


def test_expressions_are_no_shape_of_a_person(tmp_path):
    np.savez(tmp_path / "SMPLX_NEUTRAL.npz", **made_up_file())
    body = load_smplx(tmp_path / "SMPLX_NEUTRAL.npz", shape_count=3, expression_count=2)
    shape = without_expression(body)
    assert shape.shape_names == ("shape_0", "shape_1", "shape_2")
    np.testing.assert_array_equal(shape.shape_directions, body.shape_directions[..., :3])
    assert without_expression(shape) is shape


def test_current_files_hold_expressions_after_300_columns(tmp_path):
    arrays = made_up_file(n=2, columns=400)
    np.savez(tmp_path / "model.npz", **{k: v % 2 if k == "f" else v for k, v in arrays.items()})
    body = load_body(tmp_path / "model.npz", shape_count=1, expression_count=1)
    assert np.allclose(body.shape_directions, arrays["shapedirs"][..., [0, 300]], atol=ATOL)
    assert load_smplx(
        tmp_path / "model.npz", shape_count=300, expression_count=100
    ).shape_directions.shape == (2, 3, 400)
    with pytest.raises(ValueError, match="shapedirs: has 300 shape directions, asked for 301"):
        load_smplx(tmp_path / "model.npz", shape_count=301)


def chumpy_pickle(path, content, wrap):
    """Writes a pickle of chumpy's classes with the attributes that chumpy saves.

    `wrap` names two arrays of `content`: the first becomes a `Ch`, the second a selection of one.
    """
    modules = {
        name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")
    }

    class Ch:
        pass

    class Select:
        pass

    for cls, module in ((Ch, "chumpy.ch"), (Select, "chumpy.reordering")):
        cls.__module__, cls.__qualname__ = module, cls.__name__
        setattr(modules[module], cls.__name__, cls)
    chumpy = Ch()
    chumpy.x = content[wrap[0]]
    chumpy._dirty_vars = {}
    # an array that is a selection from another one: its first number is left out
    source, select = Ch(), Select()
    source.x = np.concatenate([[7.0], content[wrap[1]].ravel()])
    select.a, select.idxs, select.preferred_shape = (
        source,
        np.arange(1, source.x.size),
        content[wrap[1]].shape,
    )
    sys.modules.update(modules)
    try:
        path.write_bytes(pickle.dumps({**content, wrap[0]: chumpy, wrap[1]: select}, protocol=2))
    finally:
        for name in modules:
            del sys.modules[name]


@pytest.mark.parametrize(
    "sparse", [scipy.sparse.csc_matrix, scipy.sparse.csr_matrix, scipy.sparse.coo_matrix]
)
def test_a_pickle_with_sparse_and_chumpy_arrays_is_the_same_model(tmp_path, sparse):
    arrays = made_up_file()
    np.savez(tmp_path / "model.npz", **arrays)
    chumpy_pickle(
        tmp_path / "model.pkl",
        {**arrays, "J_regressor": sparse(arrays["J_regressor"])},
        ("v_template", "posedirs"),
    )
    one, other = load_smplx(tmp_path / "model.npz"), load_body(tmp_path / "model.pkl")
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.array_equal(a, b)


def test_every_pickle_protocol_is_read(tmp_path):
    arrays = made_up_file()
    for protocol in (0, 2, 4, 5):
        (tmp_path / "model.pkl").write_bytes(pickle.dumps(arrays, protocol=protocol))
        assert np.allclose(
            load_smplx(tmp_path / "model.pkl").template, arrays["v_template"], atol=ATOL
        )


def broken(**changes):
    return {key: value for key, value in {**made_up_file(), **changes}.items() if value is not None}


def with_bad_number(key):
    array = made_up_file()[key].copy()
    array.flat[0] = np.nan
    return broken(**{key: array})


@pytest.mark.parametrize(
    "content, message",
    [
        (broken(weights=None), r"weights: missing"),
        (broken(weights=np.ones((9, 52))), r"weights: expected shape \(9, 55\), got \(9, 52\)"),
        (broken(v_template=np.ones((9, 4))), r"v_template: expected shape \(any, 3\)"),
        (broken(shapedirs=np.ones((9, 3, 12))), "shapedirs: expected 20 or 400 columns"),
        (broken(f=np.full((4, 3), 9, np.uint32)), r"f: expected indices in \[0, 9\)"),
        (
            broken(f=np.full((4, 3), 0.5)),
            r"f: expected whole numbers, got 0\.5 at index \[0, 0\]",
        ),
        (
            broken(kintree_table=made_up_file()["kintree_table"] + 0.25),
            r"kintree_table: expected whole numbers, got ",
        ),
        (
            broken(kintree_table=np.zeros((2, 55), np.uint32)),
            "kintree_table: expected SMPL-X's joint tree",
        ),
        (broken(J_regressor=np.asarray([None] * 3, dtype=object)), "J_regressor: "),
        (broken(posedirs=np.full((9, 3, 486), "a")), "posedirs: expected real numbers"),
        (with_bad_number("posedirs"), "posedirs: expected finite numbers"),
    ],
)
def test_bad_files_are_named_with_the_key(tmp_path, content, message):
    np.savez(tmp_path / "bad.npz", **content)
    with pytest.raises(ValueError, match=r"bad\.npz: " + message):
        load_smplx(tmp_path / "bad.npz")


def test_what_is_no_model_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_smplx(tmp_path / "nowhere.npz")
    (tmp_path / "text.npz").write_text("no")
    (tmp_path / "text.pkl").write_text("no")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1]))
    for name in ("text.npz", "text.pkl", "list.pkl"):
        with pytest.raises(ValueError, match=name):
            load_smplx(tmp_path / name)
