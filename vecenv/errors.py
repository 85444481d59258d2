"""What vecenv raises: one base class, ``VecenvError``, and a few kinds below it.

Every exception of ``vecenv``, ``voxposer`` and ``vecenv_eval`` that a caller may want to handle derives from
``VecenvError`` and from the built-in exception that fits (``ValueError``, ``LookupError``, ...), so either can be
caught. Messages name what was wrong, where, and what would be right. ``voxposer.sandbox`` imports nothing of ours and
has exceptions of its own; the agent turns them into refusals.
"""

from __future__ import annotations


class VecenvError(Exception):
    """Base of all exceptions that are raised on purpose."""


class InvalidInput(VecenvError, ValueError):
    """An argument, option, action or text that cannot be used."""


class NotFound(VecenvError, LookupError):
    """A name or index that does not exist: suite, task, object, camera."""

    def __str__(self) -> str:
        # KeyError, which some subclasses also are, would show the repr of the message.
        return str(self.args[0]) if self.args else ""


class InvalidFile(VecenvError, RuntimeError):
    """A file or folder that is missing, damaged, or of another version."""


class MissingDependency(VecenvError, ImportError):
    """A package that is not installed; the message has the pip command."""


class SimulationError(VecenvError, RuntimeError):
    """A simulator or renderer that cannot do what was asked on this machine."""


class ServiceError(VecenvError, RuntimeError):
    """A server or provider that cannot be reached, refuses, or answers with something unusable."""
