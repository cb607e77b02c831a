"""Renders training examples of synthetic people on the device, from a bank of dressed people.

`on_the_fly_example` is a pure, jittable function of the bank and a random key;
`on_the_fly_source` makes a `Source` of it. The key picks a person of the bank, colors of the
clothes, whether left and right are exchanged, poses (each between two similar poses of the
person), light and cameras. The same key gives the same bits on the same platform. Images differ
from those of `subject.render_view`: colors come from baked textures, normals are skinned, and
each vertex follows a few joints.

    bank = load_bank("people.npz")
    example = jax.jit(on_the_fly_example, static_argnames="config")(bank, key, OnTheFlyConfig())
    batch = jax.vmap(on_the_fly_example, in_axes=(None, 0, None))(bank, keys, OnTheFlyConfig())
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.body.model import joint_transforms
from humangs_jax.core.array_types import Array, Bool, Float, Int, Key, UInt8
from humangs_jax.core.configuration import Capacity, Count, Share, Side, Spread, configuration, knob
from humangs_jax.core.draws import uniform_by_name
from humangs_jax.core.numerics import safe_divide
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.loading.examples import SUBJECT_STREAM, Example
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.rasterizer import Fragments, rasterize_mesh
from humangs_jax.rendering.tiling import cumsum
from humangs_jax.synthetic import surroundings
from humangs_jax.synthetic.anatomy import MIRROR
from humangs_jax.synthetic.bank import SLOPE_STEP, SLOPE_ZERO, UV_STEPS, PeopleBank
from humangs_jax.synthetic.subject import APPEARANCES, SPLITS, SUPERSAMPLING, subject_key
from humangs_jax.synthetic.surroundings import pick

_POSES = 2
"""Number of poses of an example."""
_Plan = tuple[Float[Array, "_v c"], Float[Array, " _v"], Int[Array, " _v"], Float[Array, " _v"]]
"""A plan of v views: random numbers in [0, 1) for their cameras (v, c), azimuths in radians (v,),
indices of their poses (v,), and probabilities of a close camera (v,).
"""


@configuration
class OnTheFlyConfig:
    """What an example shows."""

    input_views: Count = 4
    """How many views the network reads."""
    view_counts: tuple[Count, ...] = ()
    """Possible numbers of different input views. Each example has one of these numbers, at random.
    Empty: all examples have `input_views`. Copies of the last view fill up to `input_views`, so
    that one program serves all numbers (see `SubjectViews.view_count`).
    """
    target_views: Count = 3
    """How many views the rendering is compared with."""
    input_size: Side = 256
    """Side of the inputs, pixels."""
    target_size: Side = 256
    """Side of the targets, pixels."""
    mixed_pose_share: Share = 0.3
    """Share of the examples in which each input shows one of the example's two poses at random. In
    all other examples the inputs show the first pose. Targets always show one of the two at random.
    """
    jitter: Spread = 0.7
    """How irregular the azimuths of the inputs are: each is off by up to half of this times the
    spacing between neighbours.
    """
    scattered_share: Share = 0.2
    """Probability that the azimuths of the inputs are not evenly spaced, but scattered anywhere."""
    mirrored_share: Share = 0.5
    """Probability that left and right of an example are exchanged."""
    displaced_share: Share = 0.0
    """Probability that an example has a body displaced to the silhouettes of the clothes. Such an
    example is not mirrored.
    """
    depths: bool = False
    """Whether the views have depths."""
    views_at_once: Count = knob(
        1, cost="memory", gain="accelerators: all views of an example at once", measured="data.md"
    )
    """Number of views that are drawn at a time: 1 suits CPUs, all views suit accelerators."""
    pixels_per_step: Capacity = knob(
        1 << 14, cost="memory", gain="accelerators: whole images at once, 2^30", measured="data.md"
    )
    """Number of the person's pixels that are colored at a time: few suit CPUs, whole images suit
    accelerators.
    """

    def __post_init__(self):
        if max(self.view_counts, default=0) > self.input_views:
            raise ValueError(
                f"view_counts {self.view_counts}: expected at most input_views, {self.input_views}"
            )


ON_THE_FLY = OnTheFlyConfig()


@pytree_dataclass
class Scene:
    """What all views of an example share: a dressed person in o poses, the matrices that recolor
    the person's pieces (dyes), and the light.
    """

    person: Int[Array, ""]
    """Index of the person in the bank, ()."""
    rotations: Float[Array, "o j 3"]
    """Poses, (o, j, 3), axis-angle, radians."""
    translations: Float[Array, "o 3"]
    """Translations of the body, (o, 3), metres."""
    vertices: Float[Array, "o n 3"]
    """Posed vertices of the dressed person, (o, n, 3), metres."""
    corners: Float[Array, "o f 15"]
    """Values of the three corners of each face, (o, f, 15). Each corner has five numbers:
    normal (3), openness, and the share of the key light that arrives there.
    """
    dyes: Float[Array, "m 3 3"]
    """Matrix that recolors each piece, (m, 3, 3), see `surroundings.dyes_from`."""
    lights: surroundings.Lights
    """The light that the person stands in."""


def on_the_fly_example(
    bank: PeopleBank,
    key: Key,
    config: OnTheFlyConfig = ON_THE_FLY,
    person: Int[Array, ""] | int | None = None,
) -> Example:
    """Renders the input and target views of a person of the bank. `key` decides all random numbers.

    person: the index of the person in the bank. None: the key chooses.

    Raises: ValueError if `config.displaced_share` is not 0 and the bank has no displacements.
    """
    if config.displaced_share and not bank.displacements.shape[1]:
        raise ValueError(
            "displaced_share: the bank has no displacements: expected one of"
            " build_bank(displaced=body)"
        )
    numbers = _draw_numbers(bank, key, config)
    if person is not None:
        # `pick` takes this number for that person
        numbers["person"] = jnp.asarray(person + 0.5) / bank.people
    scene = scene_from(numbers, bank)
    count = None
    # keys of their own decide how many views there are, and whether the body is displaced
    if config.view_counts:
        number = jax.random.uniform(jax.random.fold_in(key, 2))
        count = jnp.asarray(config.view_counts, jnp.int32)[pick(number, len(config.view_counts))]
    plans = _plans(numbers, config, count)
    if config.input_size == config.target_size:  # one loop over all views: half of the compilation
        both = jax.tree.map(lambda *parts: jnp.concatenate(parts), *plans)
        views = _views(bank, scene, both, config, config.input_size)
        alike = replace(views, betas=None)  # betas have no axis of views
        parts = [
            replace(jax.tree.map(lambda x, part=part: x[part], alike), betas=views.betas)
            for part in (slice(config.input_views), slice(config.input_views, None))
        ]
    else:
        sizes = config.input_size, config.target_size
        parts = [
            _views(bank, scene, plan, config, size) for plan, size in zip(plans, sizes, strict=True)
        ]
    flipped = numbers["mirrored"] < config.mirrored_share
    if config.displaced_share:
        displaced = jax.random.uniform(jax.random.fold_in(key, 1)) < config.displaced_share
        flipped &= ~displaced

    def choose(a, b):
        return jnp.where(flipped, a, b)

    inputs, targets = (
        jax.tree.map(choose, mirrored(views, bank.mirrored_joints), views) for views in parts
    )
    if config.displaced_share:
        moved = bank.displacements[scene.person].astype(inputs.images.dtype)
        inputs = replace(inputs, displacement=jnp.where(displaced, moved, 0))
    return Example(replace(inputs, view_count=count), targets)


def _draw_numbers(
    bank: PeopleBank, key: Key, config: OnTheFlyConfig
) -> dict[str, Float[Array, "..."]]:
    """Draws all random numbers of an example, in [0, 1), by name."""
    shapes = {
        "person": (),
        "poses": (_POSES, 2),
        "lights": (surroundings.LIGHT_NUMBERS,),
        "dyed": (),
    }
    shapes |= {"dyes": (4, bank.groups.shape[1]), "mirrored": (), "mixed": ()}
    for name, count in (("input", config.input_views), ("target", config.target_views)):
        shapes |= {f"{name}_azimuths": (2 + 2 * count,), f"{name}_poses": (count,)}
        shapes |= {f"{name}_cameras": (count, surroundings.CAMERA_NUMBERS)}
    return uniform_by_name(key, shapes)


def scene_from(numbers: dict[str, Array], bank: PeopleBank) -> Scene:
    """Makes the scene that random numbers describe.

    numbers: in [0, 1), as `_draw_numbers` returns them.
    """
    person = pick(numbers["person"], bank.people)
    faces = bank.faces[person].astype(jnp.int32)
    which = pick(numbers["poses"][:, 0], bank.rotations.shape[1])
    poses = bank.rotations[person, which]
    nearest = bank.rotations[person, bank.nearest[person, which]]
    # up to half of the way to the nearest pose: the other half is reached from that pose
    rotations = quaternion.interpolate(poses, nearest, 0.5 * numbers["poses"][:, 1:])
    dyes = surroundings.dyes_from(
        numbers["dyes"], bank.groups[person].astype(jnp.int32), bank.dyeable[person]
    )
    dyes = jnp.where(numbers["dyed"] < 0.7, dyes, jnp.eye(3))  # others keep their colors
    lights = surroundings.lights_from(numbers["lights"])

    def pose(rotations):
        vertices, normals, translation = _pose_person(bank, person, rotations)
        openness, lit = surroundings.shaded_vertices(vertices, normals, lights.directions[0], faces)
        values = jnp.concatenate([normals, openness[:, None], lit[:, None]], axis=-1)
        return vertices, translation, values[faces].reshape(faces.shape[0], 15)

    vertices, translations, corners = lax.map(pose, rotations)
    return Scene(person, rotations, translations, vertices, corners, dyes, lights)


def _pose_person(
    bank: PeopleBank, person: Int[Array, ""], rotations: Float[Array, "j 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "3"]]:
    """Poses a person of the bank so that the lowest vertex has y = 0.

    Returns: vertices (n, 3) in metres, unit normals (n, 3), and the body's translation (3,).
    """
    nowhere = jnp.zeros(3, rotations.dtype)
    transforms = joint_transforms(bank.joints[person], bank.parents, rotations, nowhere)[
        :, :3
    ].reshape(-1, 12)
    ids = bank.joint_ids[person].astype(jnp.int32)
    weights = bank.joint_weights[person].astype(rotations.dtype)
    weights = weights / weights.sum(-1, keepdims=True)  # they are stored in few bits
    blended = jnp.asarray(
        sum(weights[:, i : i + 1] * transforms[ids[:, i]] for i in range(ids.shape[1]))
    )
    x, y, z = jnp.split(bank.vertices[person], 3, axis=-1)
    nx, ny, nz = jnp.split(bank.normals[person].astype(rotations.dtype), 3, axis=-1)
    # written out: matrix products are of low precision on GPU and TPU
    vertices = blended[:, 0::4] * x + blended[:, 1::4] * y + blended[:, 2::4] * z + blended[:, 3::4]
    normals = blended[:, 0::4] * nx + blended[:, 1::4] * ny + blended[:, 2::4] * nz
    translation = nowhere.at[1].set(-vertices[:, 1].min())
    return (
        vertices + translation,
        normals / (jnp.linalg.norm(normals, axis=-1, keepdims=True) + 1e-9),
        translation,
    )


def _plans(
    numbers: dict[str, Float[Array, "..."]], config: OnTheFlyConfig, count: Int[Array, ""] | None
) -> tuple[_Plan, _Plan]:
    """Makes the plans of the inputs and of the targets, see `_Plan`.

    count: the number of different inputs; the last of these is repeated to fill up the plan. None:
    all inputs differ.
    """
    azimuths = surroundings.azimuths_from(
        numbers["input_azimuths"], config.jitter, config.scattered_share, count
    )
    own, other = (pick(numbers[name], _POSES) for name in ("input_poses", "target_poses"))
    own = jnp.where(numbers["mixed"] < config.mixed_pose_share, own, 0)
    anywhere = surroundings.azimuths_from(numbers["target_azimuths"], 0.0, 1.0)
    close = jnp.full(config.target_views, 0.2)  # share of close cameras
    inputs = numbers["input_cameras"], azimuths, own, jnp.zeros(config.input_views)
    if count is not None:
        inputs = jax.tree.map(
            lambda x: x[jnp.minimum(jnp.arange(config.input_views), count - 1)], inputs
        )
    return inputs, (numbers["target_cameras"], anywhere, other, close)


def _views(
    bank: PeopleBank, scene: Scene, plan: _Plan, config: OnTheFlyConfig, size: int
) -> SubjectViews:
    """Renders the views of a plan as square images of `size` pixels."""

    def view(plan):
        u, azimuth, pose, close_share = plan
        camera = surroundings.camera_from(
            u, scene.vertices[pose], bank.vertex_counts[scene.person], azimuth, close_share, size
        )
        return *draw_view(bank, scene, pose, camera, config), camera

    poses = plan[2]
    batch = None
    if config.views_at_once != 1:
        batch = min(config.views_at_once, len(poses))
    images, masks, depths, found = lax.map(view, plan, batch_size=batch)
    rotations = scene.rotations[poses]
    translations = scene.translations[poses]
    betas = bank.betas[scene.person]
    if not config.depths:
        depths = None
    return SubjectViews(images, masks, found, rotations, translations, betas, depths=depths)


def draw_view(
    bank: PeopleBank,
    scene: Scene,
    pose: Int[Array, ""],
    camera: Camera,
    config: OnTheFlyConfig = ON_THE_FLY,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"]]:
    """Renders one pose of a scene.

    Returns: the image (h, w, 3) on white, in [0, 1]; the covered share of each pixel (h, w); and
    the mean depth z of the covered part of each pixel (h, w), metres, 0 in the background.
    """
    fine = camera.resized(camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING)
    vertices, faces = scene.vertices[pose], bank.faces[scene.person].astype(jnp.int32)
    fragments = rasterize_mesh(vertices, faces, fine)
    behind = surroundings.seen_from_behind(vertices, faces, camera.center)
    colors = _light_pixels(
        bank, scene, scene.corners[pose], behind, fragments, config.pixels_per_step
    )
    covered = (fragments.face_ids >= 0).reshape(-1, 1).astype(colors.dtype)
    z = _box_average(fragments.depth.reshape(-1, 1) * covered, camera)[..., 0]
    coverage = _box_average(covered, camera)[..., 0]
    return _box_average(colors, camera), coverage, safe_divide(z, coverage)


def _box_average(samples: Float[Array, "samples c"], camera: Camera) -> Float[Array, "h w c"]:
    """Returns the mean of the s x s samples of each pixel, where s is SUPERSAMPLING.

    The samples are added one by one, because XLA's CPU backend reduces two axes slowly.
    """
    s = SUPERSAMPLING
    samples = samples.reshape(camera.height, s, camera.width, s, -1)
    return jnp.asarray(sum(samples[:, i, :, j] for i in range(s) for j in range(s))) / (s * s)


def _light_pixels(
    bank: PeopleBank,
    scene: Scene,
    corners: Float[Array, "f 15"],
    behind: Bool[Array, " f"],
    fragments: Fragments,
    step: int,
) -> Float[Array, "hw 3"]:
    """Returns the colors of all pixels (h w, 3), white in the background.

    Covered pixels are colored `step` at a time.
    """
    ids, weights = fragments.face_ids.reshape(-1), fragments.barycentrics.reshape(-1, 3)
    covered = ids >= 0
    count = ids.shape[0]
    step = min(step, count)
    place = jnp.where(covered, cumsum(covered.astype(jnp.int32)) - 1, count)
    # the numbers of the covered pixels in order; steps may reach beyond their end, where "no pixel"
    # is
    listed = (
        jnp.full(-(-count // step) * step, count, jnp.int32)
        .at[place]
        .set(jnp.arange(count), mode="drop")
    )
    total = jnp.sum(covered, dtype=jnp.int32)

    def light(state):
        start, colors = state
        pixels = lax.dynamic_slice_in_dim(listed, start, step)
        face = jnp.maximum(ids.at[pixels].get(mode="fill", fill_value=0), 0)
        weight = weights[pixels]
        lit = _color_points(bank, scene, corners[face], face, weight, behind[face])
        return start + step, colors.at[pixels].set(lit, mode="drop")

    blank = jnp.ones((count, 3), weights.dtype)
    return lax.while_loop(lambda state: state[0] < total, light, (jnp.zeros((), jnp.int32), blank))[
        1
    ]


def _color_points(
    bank: PeopleBank,
    scene: Scene,
    corners: Float[Array, "p 15"],
    faces: Int[Array, " p"],
    weights: Float[Array, "p 3"],
    behind: Bool[Array, " p"],
) -> Float[Array, "p 3"]:
    """Returns the colors (p, 3) of points on faces.

    faces: index of each point's face (p,). corners: values of the corners of that face (p, 15), see
    `Scene`. weights: the point's weights of the three corners (p, 3). behind: whether the inner
    side of the face is seen (p,).
    """
    person = scene.person
    wa, wb, wc = (weights[:, i : i + 1] for i in range(3))
    uv = bank.uvs[person, faces].astype(weights.dtype)
    painted = _sample(
        bank.texture, person, (wa * uv[:, 0] + wb * uv[:, 1] + wc * uv[:, 2]) / UV_STEPS
    )
    pieces = bank.face_pieces[person, faces].astype(jnp.int32)
    dye = scene.dyes[pieces]
    albedo = sum(painted[:, i : i + 1] * dye[:, :, i] for i in range(3)) / 255
    slopes = (painted[:, 3:] - SLOPE_ZERO) * SLOPE_STEP
    albedo, sheen = jnp.clip(albedo, 0.01, None), bank.sheen[person, pieces]
    return surroundings.light_points(scene.lights, corners, weights, behind, albedo, slopes, sheen)


def _sample(
    texture: UInt8[Array, "people t t 6"], person: Int[Array, ""], at: Float[Array, "p 2"]
) -> Float[Array, "p 6"]:
    """Returns a person's texture (p, 6) at uv coordinates `at` (p, 2) in [0, 1], with v down.

    Values are floats in [0, 255], interpolated bilinearly.
    """
    size = texture.shape[1]
    at = jnp.clip(at * size - 0.5, 0, size - 1)
    low = jnp.floor(at)
    along = at - low
    column, row = low[:, 0].astype(jnp.int32), low[:, 1].astype(jnp.int32)
    right, below = jnp.minimum(column + 1, size - 1), jnp.minimum(row + 1, size - 1)

    def texel(r, c):
        return texture[person, r, c].astype(at.dtype)

    x, y = along[:, :1], along[:, 1:]
    upper = texel(row, column) * (1 - x) + texel(row, right) * x
    lower = texel(below, column) * (1 - x) + texel(below, right) * x
    return upper * (1 - y) + lower * y


def mirrored(views: SubjectViews, joints: tuple[int, ...]) -> SubjectViews:
    """Returns views of a person with left and right exchanged. `displacement` and `unknown` stay as
    they are.

    joints: for each joint, the index of the joint on the other side.
    """
    flip = jnp.asarray(MIRROR, views.images.dtype)
    side = jnp.asarray([-1.0, 1.0, 1.0], views.images.dtype)
    camera = views.cameras
    K = camera.K.at[..., 0, 2].set(camera.width - camera.K[..., 0, 2])
    signs = jnp.concatenate([side, jnp.ones(1, side.dtype)])
    return replace(
        views,
        images=views.images[..., :, ::-1, :],
        masks=views.masks[..., :, ::-1],
        depths=None if views.depths is None else views.depths[..., :, ::-1],
        cameras=replace(camera, K=K, cam_from_world=camera.cam_from_world * signs[:, None] * signs),
        rotations=views.rotations[..., jnp.asarray(joints), :] * flip,
        translations=views.translations * side,
    )


@dataclasses.dataclass(frozen=True)
class GeneratedSource:
    """Source of examples that `make` computes from random keys.

    All keys are made from seeds of one split, see `subject.SPLITS`.

    Raises: ValueError if there is no split of that name.
    """

    make: Callable[[Key, int], Example]
    """Pure function that makes an example, called as make(key, input_count). The caller jits it,
    usually with input_count static.
    """
    split: str = "train"
    """Name of the split that the people are from."""
    input_counts: tuple[int, ...] = (4,)
    """Numbers of input photos that an example may have, see `ViewSampling`."""
    on_host: bool = False
    """Whether the arrays of an example are copied to the host. There they can be mixed with
    examples from files and divided among devices.
    """
    person_of: Callable[[Key, int], int] | None = None
    """Function that returns the seed of the person that `make` shows, called as person_of(key,
    input_count). None: `make` shows the person of the seed that the key was made from.
    """

    def __post_init__(self):
        if self.split not in SPLITS:
            raise ValueError(f"no split {self.split!r}: expected one of {', '.join(SPLITS)}")

    @property
    def broken(self) -> Mapping[str, str]:
        """Empty: there are no files."""
        return {}

    def __len__(self) -> int:
        return len(SPLITS[self.split])

    def drawn_key(self, seed: int, index: int) -> Key:
        """Returns the key of example number `index` in a run that starts from `seed`.

        The key is the `subject_key` of a random person of the split; its appearance has the number
        `index`. `make` may show another person, see `person_of`.
        """
        return subject_key(self._person(seed, index), index)

    def _person(self, seed: int, index: int) -> int:
        people = SPLITS[self.split]
        return people[
            int(np.random.default_rng([SUBJECT_STREAM, seed, index]).integers(len(people)))
        ]

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """Returns a text that names the person and the appearance of an example, see `Source`."""
        person = self._person(seed, index)
        if self.person_of is not None:
            person = self.person_of(self.drawn_key(seed, index), input_count)
        return _described(person, index)

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """Returns example number `index` of a run that starts from `seed`, see `Source`."""
        example = self.make(self.drawn_key(seed, index), input_count)
        return jax.tree.map(np.asarray if self.on_host else jnp.asarray, example)


def _described(person: int, appearance: int) -> str:
    return f"synthetic person {person} in appearance {appearance}"


@dataclasses.dataclass(frozen=True)
class EachPerson:
    """Source that shows each person of a bank once, in order, and then begins again. It is for
    comparisons.
    """

    bank: PeopleBank
    """The people."""
    config: OnTheFlyConfig
    """What each example shows. The number of inputs that `example` is asked for takes the place of
    `input_views`.
    """
    input_counts: tuple[int, ...] = (4,)
    """Numbers of input photos that an example may have, as in `GeneratedSource`."""
    on_host: bool = False
    """Whether the arrays of an example are copied to the host, as in `GeneratedSource`."""

    @property
    def broken(self) -> Mapping[str, str]:
        """Empty: there are no files."""
        return {}

    def __len__(self) -> int:
        return self.bank.people

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """Returns a text that names the person and the appearance of an example, see `Source`."""
        person = int(self.bank.seeds[index % self.bank.people])
        return _described(person, self._appearance(seed, index))

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """Returns an example of a person of the bank, see `Source`. The person has the number
        `index` modulo the number of people. seed and index decide the appearance.
        """
        person = index % self.bank.people
        key = subject_key(int(self.bank.seeds[person]), self._appearance(seed, index))
        config = dataclasses.replace(self.config, input_views=input_count)
        example = jitted_example(self.bank, key, config=config, person=person)
        return jax.tree.map(np.asarray if self.on_host else jnp.asarray, example)

    def _appearance(self, seed: int, index: int) -> int:
        """Returns the number of the appearance that an example shows."""
        return int(np.random.default_rng([SUBJECT_STREAM, seed, index]).integers(APPEARANCES))


def jitted_example(
    bank: PeopleBank, key: Key, config: OnTheFlyConfig = ON_THE_FLY, person: int | None = None
) -> Example:
    """Calls `on_the_fly_example`, compiled once for each configuration and shape of the bank.

    On a CPU it is compiled with `core.processes.CPU_COMPILER_OPTIONS`. Raises: as
    `on_the_fly_example`.
    """
    return _compiled()(bank, key, config=config, person=person)


@functools.cache
def _compiled() -> Callable[..., Example]:
    return jax.jit(
        on_the_fly_example, static_argnames="config", compiler_options=compiler_options()
    )


def on_the_fly_source(
    bank: PeopleBank,
    config: OnTheFlyConfig,
    input_counts: tuple[int, ...] = (4,),
    on_host: bool = False,
    each_once: bool = False,
) -> GeneratedSource | EachPerson:
    """Makes a source of examples of a bank, for `Loader` and `Mixture`.

    each_once: whether each person of the bank is shown once, in order; otherwise people are random.
    input_counts: numbers of input views, in place of `config.input_views`. A program is compiled
    for each number. on_host: see `GeneratedSource`.

    Raises: ValueError if the bank is from no split, unless `each_once` is True.
    """
    if each_once:
        return EachPerson(bank, config, input_counts, on_host)

    def drawn(count: int) -> OnTheFlyConfig:
        return dataclasses.replace(config, input_views=count)

    def make(key: Key, count: int) -> Example:
        return jitted_example(bank, key, config=drawn(count))

    def person_of(key: Key, count: int) -> int:
        """Returns the seed of the person that `make` shows."""
        number = _draw_numbers(bank, key, drawn(count))["person"]
        return int(bank.seeds[pick(number, bank.people)])

    return GeneratedSource(make, bank.split, input_counts, on_host, person_of)
