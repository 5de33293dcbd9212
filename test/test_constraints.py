"""The versions that results are made with: held by constraints.txt, installed, and declared."""

from __future__ import annotations

import re
import runpy
from functools import cache
from importlib import metadata
from itertools import chain
from pathlib import Path
from unittest import mock

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[1]
LINES = [
    line
    for line in (REPOSITORY / "constraints.txt").read_text().splitlines()
    if line.strip() and not line.startswith("#")
]
CONSTRAINTS = [Requirement(line.partition("#")[0]) for line in LINES]
INDIRECT = {
    Requirement(line.partition("#")[0]).name: line.partition("# indirect:")[2].strip()
    for line in LINES
    if "# indirect:" in line
}


@cache
def declared() -> dict[str, Requirement]:
    """Return the requirements that setup.py declares, those of its extras too."""
    with mock.patch("setuptools.setup") as setup:
        runpy.run_path(str(REPOSITORY / "setup.py"))
    extras = setup.call_args.kwargs["extras_require"].values()
    requirements = map(Requirement, chain(setup.call_args.kwargs["install_requires"], *extras))
    return {canonicalize_name(requirement.name): requirement for requirement in requirements}


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=lambda constraint: constraint.name)
def test_the_installed_version_is_the_constrained_one(constraint: Requirement) -> None:
    try:
        installed = metadata.version(constraint.name)
    except metadata.PackageNotFoundError:
        pytest.fail(f"constraints.txt holds {constraint}, which is not installed: run make setup")
    assert constraint.specifier.contains(installed), (
        f"{constraint.name} {installed} is installed, constraints.txt says {constraint}: run make setup, or, where the "
        "version changes on purpose, measure anew and change constraints.txt"
    )


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=lambda constraint: constraint.name)
def test_what_is_constrained_is_declared_or_required_by_what_it_is_indirect_of(constraint: Requirement) -> None:
    assert re.fullmatch(r"==[^,*]+", str(constraint.specifier)), f"{constraint} does not name one version"
    name = canonicalize_name(constraint.name)
    if constraint.name not in INDIRECT:
        assert name in declared(), f"{name} is neither in setup.py nor marked '# indirect: PACKAGE' in constraints.txt"
        version = str(constraint.specifier).removeprefix("==")
        assert declared()[name].specifier.contains(version), f"setup.py's {declared()[name]} excludes {constraint}"
        return
    assert name not in declared(), f"{name} is declared in setup.py: its mark in constraints.txt is wrong"
    parent = INDIRECT[constraint.name]
    required = {canonicalize_name(Requirement(text).name) for text in metadata.requires(parent) or []}
    assert parent in declared()
    assert name in required, f"{parent} does not require {name}"


def test_the_dependencies_that_shape_results_are_constrained() -> None:
    shaping = {"torch", "numpy", "numba", "faiss-cpu", "scipy", "rosbags", "laspy"}
    assert shaping <= {constraint.name for constraint in CONSTRAINTS}
