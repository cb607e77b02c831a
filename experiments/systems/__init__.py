"""Configurations of HumanGS and of the systems that the paper compares with, built of parts.

    config = SYSTEMS["lhm"]("bench")

The size "published" has the sizes of the systems' papers where they are known. "bench" trains on
two cores at 32 pixels, with the same body, width and losses for all, so that only the system
differs. The modules of the parts name sizes and sources. All systems use the data, the body and the
training loop of this package. Pretrained networks, which some of them have, are left out.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

from experiments.systems.correction import CorrectionMLP
from experiments.systems.cross_attention import CrossAttentionReader
from experiments.systems.grouped import GroupDecoder, GroupReader
from experiments.systems.pixel_queries import NoReader, PhotoDecoder, QueryDriver
from experiments.systems.shell_textures import PlainPhotos, ShellDecoder, ShellTextureReader
from experiments.systems.stereo import NearestPairDriver, StereoDecoder
from experiments.systems.surface_gaussians import (
    PoseMapDriver,
    SurfaceDecoder,
    TextureDriver,
    TextureReader,
)
from experiments.systems.surface_map import SurfaceMap
from experiments.systems.two_stream import TwoStreamReader
from humangs_jax.network import presets
from humangs_jax.network.config import Architecture, Conventions, HumanGSConfig, paper_parts
from humangs_jax.network.encoder import PatchTransformer, TriplaneConfig
from humangs_jax.network.transformer import TransformerConfig
from humangs_jax.network.upsampler import UpsamplerConfig
from humangs_jax.network.vertex_decoder import VertexDecoder

Size = Literal["published", "bench"]

BENCH_WIDTH, BENCH_HEAD = 128, 32
BENCH_TRANSFORMER = TransformerConfig(width=BENCH_WIDTH, layers=4, head_width=BENCH_HEAD)
BENCH_BLOCKS = dataclasses.replace(BENCH_TRANSFORMER, class_token=False)
BENCH = {"image_size": 32, "body_vertices": 800, "max_edge_length": None}
"""Conventions of the bench that differ from the published ones."""


def humangs(size: Size = "published") -> HumanGSConfig:
    """The paper's network. On the bench it is narrower and has four layers, for smaller photos of a
    coarser body. Nothing else differs.
    """
    config = presets.paper()
    if size == "published":
        return config
    encoder, reader, decoder = paper_parts(config.architecture)
    encoder = encoder.clone(
        transformer=BENCH_TRANSFORMER, upsampler=UpsamplerConfig(BENCH_WIDTH // 3)
    )
    parts = Architecture(
        encoder, reader.clone(output_width=BENCH_WIDTH), decoder.clone(hidden=BENCH_WIDTH)
    )
    return HumanGSConfig(parts, _scaled(config.conventions))


def ours(size: Size = "published") -> HumanGSConfig:
    """The shipped network with our additions: shells, photo colors, Gaussians in the frame of the
    normals, and tokens of the person alone. It has 1 + 2 Gaussians a vertex and no upsampler.
    """
    config = presets.small()
    if size == "published":
        return config
    encoder, reader, decoder = paper_parts(config.architecture)
    encoder = encoder.clone(
        texture=TriplaneConfig(resolution=32, channels=8), transformer=BENCH_TRANSFORMER
    )
    conventions = dataclasses.replace(
        _scaled(config.conventions), leg_blend_distance=None, light=False
    )
    return HumanGSConfig(
        Architecture(encoder, reader, decoder.clone(hidden=BENCH_WIDTH)), conventions
    )


def _scaled(conventions: Conventions) -> Conventions:
    """Returns conventions for the photos and bodies of the bench."""
    return dataclasses.replace(conventions, **BENCH)


def _sized(size: Size, conventions: Conventions, *parts: Any) -> HumanGSConfig:
    """Returns a system of these parts, with the conventions of its size."""
    if size == "bench":
        conventions = _scaled(conventions)
    return HumanGSConfig(Architecture(*parts), conventions)


def lvsm(size: Size = "published") -> HumanGSConfig:
    """LVSM-style (`pixel_queries`): a decoder alone, with 24 layers.

    It shows novel views only, and cannot be animated.
    """
    parts = PlainPhotos(patch_size=8), NoReader(), PhotoDecoder()
    if size == "bench":
        return _sized(size, Conventions(image_size=256), *parts, QueryDriver(BENCH_BLOCKS))
    return _sized(size, Conventions(image_size=256), *parts, QueryDriver()).with_runtime(
        dtype="bfloat16"
    )


def lvsm_latents(size: Size = "published") -> HumanGSConfig:
    """LVSM's encoder-decoder: photos become latents once, and a target attends to the latents.

    It has 12 + 12 layers and 3,072 latents.
    """
    if size == "published":
        driver = QueryDriver(TransformerConfig(layers=12, class_token=False), latents=3072)
    else:
        driver = QueryDriver(dataclasses.replace(BENCH_BLOCKS, layers=2), latents=64)
    return lvsm(size).with_parts(driver=driver)


def humanram(size: Size = "published") -> HumanGSConfig:
    """HumanRAM-style (`pixel_queries`): LVSM of 12 layers with the neural texture, and a
    convolutional decoder, at 512 pixels.
    """
    config = lvsm(size)
    if size == "published":
        driver = QueryDriver(
            TransformerConfig(layers=12, class_token=False), TriplaneConfig(), fusion=256
        )
        return config.with_parts(driver=driver).with_conventions(image_size=512)
    return config.with_parts(
        driver=QueryDriver(BENCH_BLOCKS, TriplaneConfig(resolution=32, channels=8), fusion=32)
    )


def giga(size: Size = "published") -> HumanGSConfig:
    """GIGA-style (`surface_gaussians`): a texture of 512 texels, a U-Net for every pose, one
    Gaussian a texel.
    """
    if size == "published":
        driver, surface = TextureDriver(), SurfaceMap("atlas", 512)
    else:
        driver = TextureDriver((16, 32, 64, BENCH_WIDTH), BENCH_WIDTH, 8)
        surface = SurfaceMap("atlas", 48)
    return _sized(
        size,
        Conventions(pixels="person"),
        PlainPhotos(),
        TextureReader(surface),
        SurfaceDecoder(surface),
        driver,
    )


def animatable(size: Size = "published") -> HumanGSConfig:
    """Animatable-Gaussians-style (`surface_gaussians`): maps of front and back, fitted to ONE
    person. It is trained on that person's photos alone, and anew for the next person. Photos of
    reconstruction or evaluation are ignored.
    """
    if size == "published":
        driver, surface = PoseMapDriver(), SurfaceMap("front_back", 1024)
    else:
        driver, surface = PoseMapDriver((16, 32, 64)), SurfaceMap("front_back", 96)
    return _sized(
        size,
        Conventions(pixels="person"),
        PlainPhotos(),
        NoReader(),
        SurfaceDecoder(surface),
        driver,
    )


def lca(size: Size = "published") -> HumanGSConfig:
    """LCA-style: LHM with the tokens of all photos for the canonical Gaussians, and an MLP that
    corrects them for every driving frame (`correction`). Their sizes are not known.
    """
    driver = CorrectionMLP() if size == "published" else CorrectionMLP(BENCH_WIDTH, 2)
    return lhm_views(size).with_parts(driver=driver)


def back_projection(size: Size = "published") -> HumanGSConfig:
    """The paper's network without its upsampler. It differs from `cross_attention` in the reader
    alone.
    """
    config = humangs(size)
    encoder, reader, _ = paper_parts(config.architecture)
    return config.with_parts(
        encoder=encoder.clone(upsampler=None), reader=reader.clone(output_width=None)
    )


def cross_attention(size: Size = "published") -> HumanGSConfig:
    """The network of `back_projection` with vertices that attend to all image tokens, which the
    paper's second claim is about.
    """
    reader = CrossAttentionReader()
    if size == "bench":
        reader = CrossAttentionReader(BENCH_WIDTH, 1, 4, BENCH_HEAD)
    return back_projection(size).with_parts(reader=reader)


def lhm(size: Size = "published", most_views: int | None = 1, pooling: int = 1) -> HumanGSConfig:
    """LHM-style (`two_stream`) with the sizes of LHM-500M: one photo without its camera and pose.

    Tokens have 16 pixels a side, as those of Sapiens. Each vertex has a Gaussian. With edges of
    1.28 cm the default body has about as many vertices as LHM has points, 40,000.
    """
    if size == "published":
        encoder = _photo_encoder(TransformerConfig(width=1024, class_token=False), patch_size=16)
        reader = TwoStreamReader(pooling=pooling, most_views=most_views)
        decoder = VertexDecoder(hidden=512)
    else:
        encoder = _photo_encoder(BENCH_BLOCKS)
        reader = TwoStreamReader(BENCH_WIDTH, 2, 4, BENCH_HEAD, pooling, most_views)
        decoder = VertexDecoder(hidden=BENCH_WIDTH)
    decoder = decoder.clone(tight=1, free=0, offset_scale=0.5, initial_log_scale=-4.0)
    conventions = Conventions(tokens="foreground", pixels="person", max_edge_length=0.0128)
    return _sized(size, conventions, encoder, reader, decoder)


def lhm_views(size: Size = "published") -> HumanGSConfig:
    """LHM-style with the tokens of all photos side by side: the multi-view row that the paper cites
    from LCA (https://arxiv.org/abs/2604.02320), without LCA's correction per driving frame.
    """
    return lhm(size, most_views=None)


def lhm_plus(size: Size = "published") -> HumanGSConfig:
    """LHM++-style: any number of photos, whose tokens meet points that four vertices share."""
    return lhm(size, most_views=None, pooling=4)


def gst(size: Size = "published") -> HumanGSConfig:
    """GST-style (`grouped`): one photo of 256 pixels, with an encoder of the size of HMR2's ViT-H
    (1280 wide, 32 layers, patches of 16).
    """
    if size == "published":
        encoder = _photo_encoder(
            TransformerConfig(width=1280, layers=32, class_token=False, head_width=80),
            patch_size=16,
        )
        conventions = Conventions(image_size=256, body_vertices=6890)  # those of SMPL
        return HumanGSConfig(Architecture(encoder, GroupReader(), GroupDecoder()), conventions)
    config = lhm("bench")
    reader = GroupReader(26, BENCH_WIDTH, 2, 2, BENCH_HEAD)
    return config.with_parts(reader=reader, decoder=GroupDecoder(group_size=128))


def ghg(size: Size = "published") -> HumanGSConfig:
    """GHG-style (`shell_textures`): colors copied to five shells, without a transformer."""
    if size == "published":
        reader, decoder = ShellTextureReader(SurfaceMap("atlas", 1024)), ShellDecoder()
    else:
        # texels of the bench are 4 cm wide on the innermost shell
        reader = ShellTextureReader(SurfaceMap("atlas", 48))
        decoder = ShellDecoder((16, 24, 48), largest_scale=0.04)
    return _sized(size, Conventions(pixels="person"), PlainPhotos(), reader, decoder)


def gps(size: Size = "published") -> HumanGSConfig:
    """GPS-Gaussian-style (`stereo`): a Gaussian for every pixel of the two nearest photos.

    It shows novel views only.
    """
    decoder = StereoDecoder() if size == "published" else StereoDecoder((16, 32, 64), planes=24)
    parts = PlainPhotos(patch_size=8), NoReader(), decoder, NearestPairDriver()
    return _sized(size, Conventions(image_size=1024, pixels="person"), *parts)


def _photo_encoder(transformer: TransformerConfig, patch_size: int = 8) -> PatchTransformer:
    """Returns an encoder of photos without cameras and poses.

    Nothing reads the neural texture, so it is as small as possible.
    """
    return PatchTransformer(patch_size, "place", TriplaneConfig(2, 1), transformer, upsampler=None)


SYSTEMS: dict[str, Callable[[Size], HumanGSConfig]] = {
    "humangs": humangs,
    "ours": ours,
    "lvsm": lvsm,
    "lvsm_latents": lvsm_latents,
    "humanram": humanram,
    "giga": giga,
    "animatable": animatable,
    "lca": lca,
    "back_projection": back_projection,
    "cross_attention": cross_attention,
    "lhm": lhm,
    "lhm_views": lhm_views,
    "lhm_plus": lhm_plus,
    "gst": gst,
    "ghg": ghg,
    "gps": gps,
}
"""{system: function from a `Size` to its configuration}."""
ONE_PHOTO = ("lhm", "gst")
"""Systems that take only one photo."""
ADDED = ("gps",)
"""Systems that were added after the bench's queue had begun, and so are the last of the queue."""
