"""Weights of one network for another that grew, to train on."""

import jax

from humangs_jax.network.config import HumanGSConfig, paper_parts
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import Variables
from humangs_jax.network.weights import expected_variables, flatten_variables

HEADS = "params/decoder/"


def fit_variables(variables: Variables, old: HumanGSConfig, new: HumanGSConfig) -> Variables:
    """Variables of the network `old` for the network `new`, to train on.

    Both have the paper's reader and decoder. `new` may have shells where `old` has none, another number of free Gaussians and
    other settings without tensors. New tensors start as initialised, and with zero weight where they enter a layer. With
    another `decoder.frame` offsets and rotations are initialised again, because their axes differ.

    Raises: ValueError naming the setting or the tensor if more differs.
    """
    (_, old_reader, old_decoder), (_, new_reader, new_decoder) = map(paper_parts, (old.architecture, new.architecture))
    for name, was, wanted in (  # either shifts what tensors hold
        ("reader.sample_rgb", old_reader.sample_rgb, new_reader.sample_rgb),
        ("decoder.tight", old_decoder.tight, new_decoder.tight),
    ):
        if was != wanted:
            raise ValueError(f"{name} {was}: that of trained weights cannot become {wanted}")
    if old_reader.shells not in ((), new_reader.shells):
        raise ValueError(f"shells {old_reader.shells}: those of trained weights cannot become {new_reader.shells}")
    ours, wanted = flatten_variables(variables), flatten_variables(expected_variables(new))
    anew = {key for key in wanted if key.startswith(f"{HEADS}shells_")} - set(ours)
    if unknown := sorted((set(ours) - set(wanted)) | (set(wanted) - set(ours) - anew)):
        raise ValueError(f"tensor {unknown[0]!r} is in one of the two networks alone")
    if old_decoder.frame != new_decoder.frame:
        anew |= {key for key in ours if key.startswith(f"{HEADS}geometry_out")}

    differ = {key for key in set(ours) - anew if ours[key].shape != wanted[key].shape}
    heads = {key for key in differ if key.startswith(HEADS) and key.split("/")[-2].endswith("_out")}
    trunk = {key for key in differ if key == f"{HEADS}trunk_0/kernel" and len(ours[key]) <= len(wanted[key])}
    if wrong := sorted(differ - heads - trunk):
        was, now = ours[wrong[0]].shape, wanted[wrong[0]].shape
        raise ValueError(f"tensor {wrong[0]!r} has shape {was}, the other network wants {now}")
    if not (anew | differ):
        return variables

    def fit(key, leaf):
        if key in trunk:  # shells and normals enter last
            return leaf.at[len(ours[key]) :].set(0).at[: len(ours[key])].set(ours[key])
        if key in heads:  # Gaussians come one after the other
            both = min(leaf.shape[-1], ours[key].shape[-1])
            return leaf.at[..., :both].set(ours[key][..., :both])
        return leaf if key in anew else ours[key]

    fresh = flatten_variables(init_humangs(jax.random.key(0), new))  # compiles for a while: only where it is needed
    structure = jax.tree.structure(expected_variables(new))
    return jax.tree.unflatten(structure, [fit(key, leaf) for key, leaf in fresh.items()])
