# ruff: noqa: I001
"""The public interface, in the order photos -> avatar -> image.

This file is the only list of its names. `__init__.py` reads the list from here.
"""

# captures: photos, cameras, poses of one person
from .data.capture import Capture as Capture
from .data.capture import load_capture as load_capture
from .data.capture import capture_from_arrays as capture_from_arrays
from .data.capture import save_capture as save_capture
from .data.prepared import PreparedCapture as PreparedCapture
from .data.prepared import prepare_capture as prepare_capture
from .avatar.reconstruct import stack_captures as stack_captures
from .motion import load_motion as load_motion
from .apps.video_motion import motion_from_video as motion_from_video

# bodies
from .body.model import BodyModel as BodyModel, BodyPose as BodyPose
from .body.library import load_body as load_body

# photos -> avatar
from .network.weights import load_weights as load_weights
from .avatar.reconstruct import reconstruct as reconstruct
from .avatar.reconstruct import reconstruct_batch as reconstruct_batch
from .avatar.reconstruct import reconstruct_views as reconstruct_views
from .refinement.refine import refine as refine
from .refinement.config import RefineConfig as RefineConfig
from .apps.from_photos import avatar_from_photos as avatar_from_photos
from .apps.settings import reconstruct_with as reconstruct_with
from .apps.settings import Settings as Settings
from .apps.settings import PRESETS as PRESETS
from .apps.settings import tune as tune

# avatar -> poses, videos, files
from .avatar.avatar import Avatar as Avatar
from .avatar.animate import animate as animate, skin as skin
from .avatar.video import write_video as write_video
from .avatar.export.gaussians import export as export
from .viewer.page import show as show

# Gaussians -> image
from .rendering.gaussians import Gaussians as Gaussians
from .avatar.export.gaussians import (
    load_gaussians as load_gaussians,
    save_gaussians as save_gaussians,
)
from .capture.calibration.loaded import load_cameras as load_cameras
from .geometry.camera import Camera as Camera, look_at as look_at, orbit as orbit
from .rendering.splatting import render as render, render_views as render_views
from .rendering.reference import render_reference as render_reference
from .rendering.splat_config import SplatConfig as SplatConfig, SPLAT_PRESETS as SPLAT_PRESETS
from .rendering.buffers import plan_buffers as plan_buffers
from .rendering.gaussians import constrain as constrain, unconstrain as unconstrain

# posed photos -> Gaussians
from .scenes.fitting import fit_scene as fit_scene
from .scenes.config import SceneConfig as SceneConfig
from .scenes.mcmc import (
    mcmc_relocate as mcmc_relocate,
    mcmc_noise as mcmc_noise,
    mcmc_penalty as mcmc_penalty,
)

# the network, training and scores
from .network.config import HumanGSConfig as HumanGSConfig
from .network.humangs import init_humangs as init_humangs
from .network.weights import save_weights as save_weights
from .training.config import TrainConfig as TrainConfig
from .training.loop import train as train
from .training.ablation import ablate as ablate
from .core.configuration import vary as vary
from .evaluation.run import evaluate as evaluate

# JAX
from .core.pytree import replace as replace
from .core.processes import (
    compiler_options as compiler_options,
    enable_compile_cache as enable_compile_cache,
)

__version__: str
