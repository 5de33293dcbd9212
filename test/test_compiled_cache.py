"""Compiled code has a place also where nothing may be written beside the package and there is no home."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

import crossloc3d_ros
from crossloc3d_ros.compiled_cache import VARIABLE, ensure_cache

NOWHERE = Path("/proc/nowhere")
"""Nothing can be made there, whoever asks."""
NOBODY = 65_534


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Without a cache of its own; return the directory for temporary files."""
    monkeypatch.setenv("HOME", str(NOWHERE))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_temporary_folder_of_ones_own_is_used_again(homeless: Path, caplog: pytest.LogCaptureFixture) -> None:
    ensure_cache(NOWHERE)
    first = Path(os.environ.pop(VARIABLE))
    assert first.parent == homeless
    assert first.stat().st_mode & 0o777 == 0o700
    assert f"set {VARIABLE} to a folder that lasts" in caplog.text
    ensure_cache(NOWHERE)
    assert Path(os.environ[VARIABLE]) == first


def test_a_folder_that_others_can_write_to_is_not_trusted(homeless: Path) -> None:
    theirs = homeless / f"crossloc3d_ros-numba-{os.getuid()}"
    theirs.mkdir()
    theirs.chmod(0o777)
    ensure_cache(NOWHERE)
    assert Path(os.environ[VARIABLE]) != theirs


@pytest.mark.parametrize("where", ["given", "package", "user"])
def test_what_can_be_written_is_left_as_it_is(homeless: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    if where == "given":
        monkeypatch.setenv(VARIABLE, str(homeless / "mine"))
    if where == "user":
        monkeypatch.setenv("XDG_CACHE_HOME", str(homeless))
    before = os.environ.get(VARIABLE)
    ensure_cache(homeless if where == "package" else NOWHERE)
    assert os.environ.get(VARIABLE) == before


@pytest.fixture
def read_only() -> Iterator[Path]:
    """A folder that any user can read, with the package that nobody can write to."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    package = folder / "crossloc3d_ros"
    source = Path(crossloc3d_ros.__file__).parent
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__", "weights"))
    for path in [package, *package.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    yield folder
    for path in [package, *package.rglob("*")]:
        path.chmod(0o755)
    shutil.rmtree(folder)


def test_a_read_only_package_of_a_user_without_a_home_can_be_imported(read_only: Path) -> None:
    user = NOBODY if os.geteuid() == 0 else None
    temporary = read_only / "tmp"
    temporary.mkdir()
    temporary.chmod(0o777)
    environment = {
        "PATH": os.environ["PATH"], "HOME": "/nonexistent", "PYTHONPATH": str(read_only), "TMPDIR": str(temporary),
        "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip

    def run(code: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=environment, cwd="/", user=user, text=True, capture_output=True, timeout=240)

    try:
        if run("import numba").returncode:
            pytest.skip("another user cannot run this Python")
    except PermissionError:
        pytest.skip("another user cannot run this Python")
    found = run("import crossloc3d_ros.clouds.raster as module; print(module.__file__)")
    assert found.returncode == 0, found.stderr
    assert found.stdout.startswith(str(read_only))
    assert f"set {VARIABLE} to a folder that lasts" in found.stderr
    assert [path.name.startswith("crossloc3d_ros-numba-") for path in temporary.iterdir()] == [True]
