"""Where things lie in this clone."""

from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent
REPOSITORY = TESTS.parent
DATA = TESTS / "data"
