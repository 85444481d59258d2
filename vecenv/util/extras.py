"""Packages that only some commands need: which extra of vecenv brings a module, and the sentence when it is missing."""

from __future__ import annotations

import importlib.util

# Module, as it is imported -> the extra that has its package.
EXTRAS = {
    "av": "render",
    "fastapi": "serve",
    "h5py": "eval",
    "httpx": "simpler",
    "jinja2": "eval",
    "litellm": "voxposer",
    "matplotlib": "voxposer",
    "msgpack": "clients",
    "OpenGL": "render",
    "PIL": "render",
    "plotly": "eval",
    "pyarrow": "datasets",
    "pydantic": "eval",
    "ruckig": "simpler",
    "sapien": "simpler",
    "tenacity": "clients",
    "tensorboardX": "tensorboard",
    "trackio": "trackio",
    "trimesh": "simpler",
    "uvicorn": "serve",
    "viser": "viser",
    "wandb": "wandb",
    "warp": "warp",
    "websockets": "clients",
    "yaml": "eval",
    "zmq": "clients",
}


def is_installed(module: str) -> bool:
    """Whether a module can be found; it is not imported."""
    return importlib.util.find_spec(module) is not None


def how_to_install(module: str) -> str:
    """A sentence for one of ``EXTRAS`` that is missing, with the pip command."""
    return f"{module} is not installed: pip install 'vecenv[{EXTRAS[module]}]'"
