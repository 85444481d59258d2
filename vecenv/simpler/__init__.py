"""SIMPLER: its 25 tasks on SAPIEN, with the interface of ``vecenv.contract``."""

import warnings

# SAPIEN warns whenever it is imported, in every worker process. Physics needs no Vulkan, and rendering raises
# RendererMissing where it is missing.
warnings.filterwarnings("ignore", message="Failed to find system libvulkan", category=UserWarning)
