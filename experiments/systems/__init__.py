"""The systems that the paper compares with, and HumanGS itself, as configurations of parts: one bench for all.

    config = SYSTEMS["lhm"]("bench")

"published" has the sizes of their papers where these are known, "bench" trains on two cores at 128 pixels: the same body,
tokens, width and losses for all, so that only the system differs. Sizes and sources: the modules of the parts. Each takes the
data, the body and the loop of this package, and none of the pretrained networks that some of them have.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

from experiments.systems.correction import CorrectionMLP
from experiments.systems.cross_attention import CrossAttentionReader
from experiments.systems.grouped import GroupDecoder, GroupReader
from experiments.systems.pixel_queries import NoReader, PhotoDecoder, QueryDriver
from experiments.systems.shell_textures import PlainPhotos, ShellDecoder, ShellTextureReader
from experiments.systems.surface_gaussians import PoseMapDriver, SurfaceDecoder, TextureDriver, TextureReader
from experiments.systems.surface_map import SurfaceMap
from experiments.systems.two_stream import TwoStreamReader
from humangs_jax.network import presets
from humangs_jax.network.config import Architecture, Conventions, HumanGSConfig, paper_parts
from humangs_jax.network.encoder import PatchTransformer, TriplaneConfig
from humangs_jax.network.parts import Driver, Reader
from humangs_jax.network.reader import PixelAlignedReader
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import TransformerConfig
from humangs_jax.network.vertex_decoder import VertexDecoder

Size = Literal["published", "bench"]

BENCH_WIDTH, BENCH_HEAD = 128, 32
BENCH_TRANSFORMER = TransformerConfig(width=BENCH_WIDTH, layers=4, head_width=BENCH_HEAD)
BENCH_TOKENS = 336
"""Token capacity: the person in 4 photos of 128 pixels."""


def bench() -> HumanGSConfig:
    """HumanGS at the size of the bench: the preset `small` with half of its width and photos of 128 pixels."""
    encoder, reader, decoder = paper_parts(presets.small().architecture)
    encoder = encoder.clone(texture=TriplaneConfig(resolution=32, channels=8), transformer=BENCH_TRANSFORMER)
    decoder = decoder.clone(hidden=BENCH_WIDTH)
    conventions = dataclasses.replace(
        presets.small().conventions,
        image_size=128,
        skinning_reach=None,
        light=False,
        body_vertices=1500,
        longest_edge=0.05,
    )
    return HumanGSConfig(Architecture(encoder, reader, decoder), conventions, Runtime(token_capacity=BENCH_TOKENS))


def humangs(size: Size = "published") -> HumanGSConfig:
    """The paper's network; on the bench the one that we ship, in small."""
    return presets.paper() if size == "published" else bench()


def lvsm(size: Size = "published") -> HumanGSConfig:
    """LVSM-style (`pixel_queries`), decoder-only, 24 layers. Novel views only: it cannot be animated."""
    parts, conventions = (PlainPhotos(patch_size=8), NoReader(), PhotoDecoder()), Conventions(image_size=256)
    if size == "published":
        return HumanGSConfig(Architecture(*parts, QueryDriver()), conventions, Runtime(dtype="bfloat16"))
    blocks = dataclasses.replace(BENCH_TRANSFORMER, class_token=False)
    conventions = dataclasses.replace(bench().conventions, tokens="all", pixels="all")
    return HumanGSConfig(Architecture(*parts, QueryDriver(blocks)), conventions)


def humanram(size: Size = "published") -> HumanGSConfig:
    """HumanRAM-style (`pixel_queries`): LVSM of 12 layers with the neural texture, and a convolutional decoder, at 512 pixels."""
    config = lvsm(size)
    if size == "published":
        driver = QueryDriver(TransformerConfig(layers=12, class_token=False), TriplaneConfig(), fusion=256)
        return config.with_parts(driver=driver).with_conventions(image_size=512)
    blocks = dataclasses.replace(BENCH_TRANSFORMER, class_token=False)
    return config.with_parts(driver=QueryDriver(blocks, TriplaneConfig(resolution=32, channels=8), fusion=32))


def giga(size: Size = "published") -> HumanGSConfig:
    """GIGA-style (`surface_gaussians`): a texture of 512 texels, a U-Net for every pose, one Gaussian a texel."""
    driver = TextureDriver() if size == "published" else TextureDriver((16, 32, 64, BENCH_WIDTH), BENCH_WIDTH, 8)
    surface = SurfaceMap("atlas", 512 if size == "published" else 96)
    return _on_the_surface(size, TextureReader(surface), surface, driver)


def animatable(size: Size = "published") -> HumanGSConfig:
    """Animatable-Gaussians-style (`surface_gaussians`): maps of front and back, fitted to ONE person: train it on that person's
    photos alone, and anew for the next. Photos that reconstruction or evaluation give are ignored.
    """
    driver = PoseMapDriver() if size == "published" else PoseMapDriver((16, 32, 64))
    surface = SurfaceMap("front_back", 1024 if size == "published" else 96)
    return _on_the_surface(size, NoReader(), surface, driver)


def lca(size: Size = "published") -> HumanGSConfig:
    """LCA-style: LHM with the tokens of all photos for the canonical Gaussians, and an MLP that corrects them for every driving
    frame (`correction`). Their sizes are not known.
    """
    driver = CorrectionMLP() if size == "published" else CorrectionMLP(BENCH_WIDTH, 2)
    return lhm_views(size).with_parts(driver=driver)


def _on_the_surface(size: Size, reader: Reader, surface: SurfaceMap, driver: Driver) -> HumanGSConfig:
    """Systems whose Gaussians are texels: their photos and bodies are those of the others."""
    conventions = Conventions(pixels="person") if size == "published" else bench().conventions
    parts = Architecture(PlainPhotos(), reader, SurfaceDecoder(surface), driver)
    return HumanGSConfig(parts, dataclasses.replace(conventions, tokens="all"))


def back_projection(size: Size = "published") -> HumanGSConfig:
    """The paper's reader and decoder without what we added (photo colors, shells, normal frames) and without an upsampler: the
    partner of `cross_attention`, from which it differs in the reader alone.
    """
    config = humangs(size)
    encoder, _, decoder = paper_parts(config.architecture)
    encoder = encoder.clone(upsampler=None)
    decoder = decoder.clone(frame="canonical", residual_color=False)
    return config.with_parts(encoder=encoder, reader=PixelAlignedReader(output_width=None), decoder=decoder)


def cross_attention(size: Size = "published") -> HumanGSConfig:
    """The same with vertices that attend to all image tokens: what the paper's second claim is about."""
    reader = CrossAttentionReader() if size == "published" else CrossAttentionReader(BENCH_WIDTH, 1, 4, BENCH_HEAD)
    return back_projection(size).with_parts(reader=reader)


def lhm(size: Size = "published", most_views: int | None = 1, pooling: int = 1) -> HumanGSConfig:
    """LHM-style (`two_stream`), LHM-500M's sizes: one photo without its camera and pose.

    Tokens have 16 pixels a side as those of Sapiens. A Gaussian a vertex; edges of 1 cm give the default body 58,855 vertices,
    where theirs has 40,000 points.
    """
    if size == "published":
        encoder = _photo_encoder(TransformerConfig(width=1024, class_token=False), patch_size=16)
        reader, decoder = (TwoStreamReader(pooling=pooling, most_views=most_views), VertexDecoder(hidden=512))
        conventions = Conventions(tokens="foreground", pixels="person", longest_edge=0.01)
    else:
        encoder = _photo_encoder(dataclasses.replace(BENCH_TRANSFORMER, class_token=False))
        reader = TwoStreamReader(BENCH_WIDTH, 2, 4, BENCH_HEAD, pooling, most_views)
        decoder, conventions = VertexDecoder(hidden=BENCH_WIDTH), bench().conventions
    decoder = decoder.clone(tight=1, free=0, offset_scale=0.5, initial_log_scale=-4.0)
    runtime = Runtime() if size == "published" else bench().runtime
    return HumanGSConfig(Architecture(encoder, reader, decoder), conventions, runtime)


def lhm_views(size: Size = "published") -> HumanGSConfig:
    """LHM-style with the tokens of all photos side by side: the multi-view row that the paper cites from LCA
    (https://arxiv.org/abs/2604.02320), without LCA's correction per driving frame.
    """
    return lhm(size, most_views=None)


def lhm_plus(size: Size = "published") -> HumanGSConfig:
    """LHM++-style: any number of photos, tokens meet points that four vertices share."""
    return lhm(size, most_views=None, pooling=4)


def gst(size: Size = "published") -> HumanGSConfig:
    """GST-style (`grouped`): one photo of 256 pixels; HMR2's ViT-H in size (1280 wide, 32 layers, patches of 16)."""
    if size == "published":
        encoder = _photo_encoder(TransformerConfig(width=1280, layers=32, class_token=False, head_width=80), patch_size=16)
        conventions = Conventions(image_size=256, body_vertices=6890)  # those of SMPL
        return HumanGSConfig(Architecture(encoder, GroupReader(), GroupDecoder()), conventions)
    config = lhm("bench")
    reader = GroupReader(26, BENCH_WIDTH, 2, 2, BENCH_HEAD)
    return config.with_parts(reader=reader, decoder=GroupDecoder(group_size=128))


def ghg(size: Size = "published") -> HumanGSConfig:
    """GHG-style (`shell_textures`): copied colors on five shells; no transformer."""
    published = size == "published"
    reader = ShellTextureReader(SurfaceMap("atlas", 1024 if published else 64))
    # texels of the bench are 3 cm wide on the innermost shell
    decoder = ShellDecoder() if published else ShellDecoder((16, 24, 48), largest_scale=0.03)
    conventions = dataclasses.replace(
        Conventions(pixels="person") if published else bench().conventions, tokens="all", longest_edge=None
    )
    return HumanGSConfig(Architecture(PlainPhotos(), reader, decoder), conventions)


def _photo_encoder(transformer: TransformerConfig, patch_size: int = 8) -> PatchTransformer:
    """Of photos without cameras and poses: nothing reads the neural texture, so it is as small as can be."""
    return PatchTransformer(patch_size, "place", TriplaneConfig(2, 1), transformer, upsampler=None)


SYSTEMS: dict[str, Callable[[Size], HumanGSConfig]] = {
    "humangs": humangs,
    "lvsm": lvsm,
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
}
"""By name; each is called with a `Size`."""
ONE_PHOTO = ("lhm", "gst")
"""Systems that refuse a second photo."""
