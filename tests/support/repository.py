"""Path of the repository, for tests of its documents and examples."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
