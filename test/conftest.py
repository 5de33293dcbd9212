"""Fixtures that several packages' tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


def shared_path(relative: str) -> Path:
    """Return a file of the shared reference data, or skip the test where it is not at hand."""
    root = Path(os.environ.get("CROSSLOC3D_SHARED", REPOSITORY.parent / "shared"))
    path = root / relative
    if not path.exists():
        pytest.skip(f"reference data not found: {path} (set CROSSLOC3D_SHARED to its folder)")
    return path


@pytest.fixture(scope="session")
def shared() -> object:
    """Give the function that finds shared reference data."""
    return shared_path
