# MuJoCo's classes and functions live in extension modules that ship no types; all of them count as Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
