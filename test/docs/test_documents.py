"""README and docs: what is generated is fresh, links lead somewhere, commands parse, parameters exist."""

from __future__ import annotations

import importlib.util
import itertools
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import yaml

from crossloc3d_ros.config import LocalizerNodeConfig, from_dict, settings_of

REPOSITORY = Path(__file__).resolve().parents[2]
GENERATE = runpy.run_path(str(REPOSITORY / "docs" / "generate.py"))
PAGES = sorted((REPOSITORY / "docs").rglob("*.md"))
TEXTS = [*PAGES, *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md", "maps/README.md"))]
SETTINGS = {setting.name for setting in settings_of(LocalizerNodeConfig)}
TOPICS = ("points", "odom", "imu", "initialpose")
LAUNCH_ARGUMENTS = set(re.findall(r'^\s+"(\w+)":', (REPOSITORY / "launch/localizer.launch.py").read_text(), re.M))


@pytest.mark.parametrize("path", GENERATE["generated"]().keys(), ids=lambda path: path.name)
def test_a_generated_file_is_fresh(path: Path) -> None:
    assert path.read_text() == GENERATE["generated"]()[path], f"{path.name} is stale: run make docs"


# The site


class Page(HTMLParser):
    """Links, assets and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.assets: list[str] = []
        self.anchors: set[str] = {""}
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attributes}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif tag in ("link", "image", "use") and "href" in given:
            self.assets.append(given["href"])
        elif "src" in given:
            self.assets.append(given["src"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("mkdocs", "material"):
        if importlib.util.find_spec(module) is None:
            pytest.skip("the site needs MkDocs and its theme Material: pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    made = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout + made.stderr
    return folder


def pages_of(site: Path) -> dict[Path, Page]:
    # The page of missing pages has absolute links, because it is served under any address.
    return {path: Page(path.read_text()) for path in site.rglob("*.html") if path.name != "404.html"}


def test_every_link_of_the_site_leads_to_a_page_and_an_anchor(site: Path) -> None:
    pages = pages_of(site)
    assert len(pages) == len(PAGES)
    broken = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file() or (target in pages and unquote(parts.fragment) not in pages[target].anchors):
                broken.append(f"{path.relative_to(site)}: {link}")
    assert broken == []


def test_no_page_of_the_site_asks_another_server_for_anything(site: Path) -> None:
    outside = []
    for path, page in pages_of(site).items():
        for asset in page.assets:
            if urlsplit(asset).netloc or not (
                asset.startswith("data:") or (path.parent / urlsplit(asset).path).is_file()
            ):
                outside.append(f"{path.relative_to(site)}: {asset}")
    for path in site.rglob("*.css"):
        outside += [
            f"{path.name}: {found}"
            for found in re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//[^)\s]+", path.read_text())
        ]
    assert outside == []


def test_every_page_is_in_the_navigation() -> None:
    navigation = (REPOSITORY / "mkdocs.yml").read_text()
    missing = [page for page in PAGES if page.relative_to(REPOSITORY / "docs").as_posix() not in navigation]
    assert missing == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_every_link_between_the_files_of_the_repository_leads_somewhere(path: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(path.read_text())):
        parts = urlsplit(link)
        if parts.scheme:
            continue
        target = (path.parent / parts.path).resolve() if parts.path else path
        assert target.exists(), f"{path.name}: {link}"
        if parts.fragment:
            assert parts.fragment in headings(target), f"{path.name}: {link}"


def without_code(text: str) -> str:
    return re.sub(r"`[^`\n]*`", "", re.sub(r"```.*?```", "", text, flags=re.S))


def headings(path: Path) -> set[str]:
    """Return the anchors of a Markdown file as MkDocs and GitHub make them."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", path.read_text(), flags=re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


# Commands and parameters


def command_lines(path: Path) -> Iterator[str]:
    """Yield the lines of the code blocks that name no language."""
    language = None
    for line in path.read_text().splitlines():
        if line.startswith("```"):
            language = line.removeprefix("```") if language is None else None
        elif language == "":
            yield from (part.strip() for part in line.split("  #")[0].split(" && ") if part.strip())


@pytest.mark.parametrize("line", sorted({line for path in TEXTS for line in command_lines(path)}))
def test_a_command_of_the_documents_is_understood(line: str) -> None:
    words = shlex.split(line)
    if words[:1] == ["make"]:
        assert re.search(rf"^{words[1]}:", (REPOSITORY / "Makefile").read_text(), re.M), line
        return
    if words[:3] == ["ros2", "launch", "crossloc3d_ros"]:
        assert {word.partition(":=")[0] for word in words[4:]} <= LAUNCH_ARGUMENTS
        return
    if words[:3] == ["ros2", "param", "set"]:
        check_parameters([f"{words[4]}:={words[5]}"])
        return
    words = words[3:] if words[:3] == ["ros2", "run", "crossloc3d_ros"] else words
    if not words or words[0] not in GENERATE["commands"]():
        return
    shipped = [word for word in words if word.startswith(("config/", "maps/amsterdam/", "crossloc3d_ros/"))]
    assert all((REPOSITORY / word).exists() for word in shipped), line
    parser = GENERATE["parser_of"](words[0])
    if parser is not None:
        parser.parse_args(words[1:])  # exits where it does not understand
        return
    pairs = list(itertools.pairwise(words))
    check_parameters([value for flag, value in pairs if flag == "-p"])
    assert all(value.partition(":=")[0] in TOPICS for flag, value in pairs if flag == "-r")


def check_parameters(assignments: list[str]) -> None:
    for assignment in assignments:
        name, _, value = assignment.partition(":=")
        nested: Any = yaml.safe_load(value)
        for part in reversed(name.split(".")):
            nested = {part: nested}
        from_dict(LocalizerNodeConfig, nested)  # raises ConfigError


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_a_parameter_that_a_page_names_exists(path: Path) -> None:
    text = path.read_text().partition("## Renamed since version")[0].replace("/velodyne_points:=", "")
    named = set(re.findall(r"`((?:scan|retrieval|alignment|fusion)\.[a-z0-9_.]*[a-z0-9_])", text))
    assert {
        name for name in named if name not in SETTINGS and not any(s.startswith(f"{name}.") for s in SETTINGS)
    } == set()
    assigned = set(re.findall(r"([a-z0-9_.]+):=", text))
    assert assigned <= SETTINGS | LAUNCH_ARGUMENTS | set(TOPICS)


def test_the_topics_of_the_reference_are_those_of_the_node() -> None:
    from crossloc3d_ros.cli.localizer import USAGE

    topics = set(re.findall(r"^(?:\w+)?\s+(~?/?\w[\w/]*|~/\w+)\s+\w+_msgs/", USAGE, re.M))
    reference = (REPOSITORY / "docs" / "reference" / "topics.md").read_text()
    assert len(topics) >= 12
    assert {topic for topic in topics if f"| `{topic}`<br>" not in reference} == set()


def test_the_values_of_the_diagnostics_are_those_of_the_node() -> None:
    page = (REPOSITORY / "docs" / "howto" / "diagnostics.md").read_text()
    table = page.partition("## Values in `/diagnostics`")[2].partition("## ")[0]
    named = [name for row in re.findall(r"^\| (`.*?) \|", table, re.M) for name in re.findall(r"`([^`]+)`", row)]
    source = "".join(path.read_text() for path in (REPOSITORY / "crossloc3d_ros" / "ros").glob("*.py"))
    assert len(named) >= 20
    assert [name for name in named if f'"{name}"' not in source] == []
