"""SIMPLER: its 25 tasks on SAPIEN, behind the verbs of ``vecenv.contract``."""

import warnings

# SAPIEN says so whenever it is imported, in every worker process; physics needs no Vulkan, and pictures name what is
# missing when they are asked for.
warnings.filterwarnings("ignore", message="Failed to find system libvulkan", category=UserWarning)
