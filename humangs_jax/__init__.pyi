"""The public interface, in the order photos -> avatar -> image. This file is its only list: `__init__.py` imports from it."""

# captures: photos, cameras, poses
# photos -> avatar
from .apps.settings import PRESETS as PRESETS
from .apps.settings import Budget as Budget
from .apps.settings import Settings as Settings
from .apps.settings import reconstruct_with as reconstruct_with
from .apps.settings import tune as tune

# avatar -> poses, videos, files
from .avatar.animate import animate as animate
from .avatar.animate import skin as skin
from .avatar.avatar import Avatar as Avatar
from .avatar.export.files import export as export
from .avatar.reconstruct import reconstruct as reconstruct
from .avatar.reconstruct import reconstruct_batch as reconstruct_batch
from .avatar.reconstruct import reconstruct_views as reconstruct_views
from .avatar.reconstruct import stack_captures as stack_captures
from .avatar.shot import Shot as Shot
from .avatar.video import write_video as write_video

# bodies
from .body.library import load_body as load_body
from .body.model import BodyModel as BodyModel
from .body.model import BodyPose as BodyPose
from .body.model import rest_pose as rest_pose
from .core.compiling import compiler_options as compiler_options

# JAX
from .core.compiling import enable_compile_cache as enable_compile_cache

# training and scores
from .core.configuration import vary as vary
from .core.pytree import replace as replace
from .data.capture import Capture as Capture
from .data.capture import capture_from_arrays as capture_from_arrays
from .data.capture import load_capture as load_capture
from .data.capture import save_capture as save_capture
from .data.motion import load_motion as load_motion
from .evaluation.run import evaluate as evaluate

# Gaussians -> image
from .geometry.camera import Camera as Camera
from .geometry.camera import look_at as look_at
from .geometry.camera import orbit as orbit

# the network
from .network.config import HumanGSConfig as HumanGSConfig
from .network.humangs import init_humangs as init_humangs
from .network.weights import load_weights as load_weights
from .network.weights import save_weights as save_weights
from .refinement.config import RefineConfig as RefineConfig
from .refinement.refine import refine as refine
from .rendering.buffers import plan_buffers as plan_buffers
from .rendering.gaussians import Gaussians as Gaussians
from .rendering.reference import render_reference as render_reference
from .rendering.splat_config import SPLAT_PRESETS as SPLAT_PRESETS
from .rendering.splat_config import SplatConfig as SplatConfig
from .rendering.splatting import render as render
from .rendering.splatting import render_views as render_views
from .rendering.unconstrained import constrain as constrain
from .rendering.unconstrained import unconstrain as unconstrain
from .training.config import TrainConfig as TrainConfig
from .training.loop import train as train
from .viewer.page import show as show

__version__: str
