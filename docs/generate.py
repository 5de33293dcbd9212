"""Write what the documents take from the code: `python docs/generate.py`, or `make docs`.

These are the parameter file of the node, the pages of parameters, training settings and commands, and the picture of
the packages in CONTRIBUTING.md. A test fails where one of them is not what this script would write.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import re
import tomllib
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from crossloc3d_ros.config import (
    RENAMED,
    LocalizerNodeConfig,
    PlacesConfig,
    Setting,
    TrainConfig,
    settings_of,
)

REPOSITORY = Path(__file__).resolve().parents[1]
NOTICE = "<!-- Written by docs/generate.py from the code: edit the code, then run `make docs`. -->\n"
PARAMETER_FILE_HEAD = """\
# Parameters of the localizer with their defaults. Written by docs/generate.py from crossloc3d_ros/config.
#
#   ros2 run crossloc3d_ros localizer --ros-args --params-file config/localizer.yaml -p map:=maps/amsterdam_ahn2
#
# Unknown names and values out of range are refused.
/**:
  ros__parameters:
"""
PARAMETER_FILE_END = """\

    # QoS of a subscription, where the publisher does not offer what SensorDataQoS asks for:
    # qos_overrides./points.subscription.reliability: reliable
"""
PACKAGES_BEGIN, PACKAGES_END = "<!-- packages: written by docs/generate.py -->", "<!-- end of packages -->"


def generated() -> dict[Path, str]:
    """Return the text of each generated file."""
    return {
        REPOSITORY / "config" / "localizer.yaml": parameter_file(),
        REPOSITORY / "docs" / "reference" / "parameters.md": parameters_page(),
        REPOSITORY / "docs" / "reference" / "training_settings.md": training_page(),
        REPOSITORY / "docs" / "reference" / "commands.md": commands_page(),
        REPOSITORY / "CONTRIBUTING.md": contributing(),
    }


# Settings


@dataclasses.dataclass(frozen=True)
class Group:
    """The plain fields of one configuration dataclass."""

    prefix: str
    """Dotted path with the last dot, such as `scan.mounting.`; empty for the whole."""
    text: str
    settings: tuple[Setting, ...]


def groups_of(kind: type[Any], prefix: str = "", text: str = "") -> Iterator[Group]:
    """Yield the plain fields of a configuration dataclass, then those of the groups that it holds."""
    nested = [
        item for item in dataclasses.fields(kind) if dataclasses.is_dataclass(typing.get_type_hints(kind)[item.name])
    ]
    plain = [each for each in settings_of(kind, prefix) if "." not in each.name.removeprefix(prefix)]
    yield Group(prefix, text, tuple(plain))
    for item in nested:
        inner = typing.get_type_hints(kind)[item.name]
        yield from groups_of(inner, f"{prefix}{item.name}.", str(item.metadata.get("text", "")))


def plain_value(value: Any) -> str:
    """Return a default as YAML writes it."""
    value = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip().replace("''", '""')


def limits_of(setting: Setting) -> str:
    """Return what values a setting takes."""
    if setting.choices:
        return ", ".join(f"`{choice}`" for choice in setting.choices)
    low, high = setting.low, setting.high
    if low is None and high is None:
        return "true, false" if setting.hint is bool else "text"
    if high is None:
        return f"from {low:g}"
    return f"{low:g} to {high:g}"


def parameter_file() -> str:
    """Return config/localizer.yaml."""
    lines = []
    for group in groups_of(LocalizerNodeConfig):
        depth = 4 + 2 * group.prefix.count(".")
        if group.prefix:
            name = group.prefix.rstrip(".").rpartition(".")[2]
            lines.append(f"\n{' ' * (depth - 2)}{name}:  # {group.text}")
        for setting in group.settings:
            choices = f" ({', '.join(setting.choices)})" if setting.choices else ""
            name = setting.name.rpartition(".")[2]
            lines.append(f"{' ' * depth}# {setting.text}{choices}")
            lines.append(f"{' ' * depth}{name}: {plain_value(setting.default)}")
    return PARAMETER_FILE_HEAD + "\n".join(lines) + "\n" + PARAMETER_FILE_END


def settings_table(settings: tuple[Setting, ...]) -> str:
    """Return a Markdown table of settings."""
    rows = ["| name | default | values | meaning |", "|---|---|---|---|"]
    for setting in settings:
        cells = (f"`{setting.name}`", f"`{plain_value(setting.default)}`", limits_of(setting), setting.text)
        rows.append(f"| {' | '.join(map(cell, cells))} |")
    return "\n".join(rows) + "\n"


def parameters_page() -> str:
    """Return the reference of the node's parameters."""
    parts = [
        NOTICE,
        "# Parameters of the localizer\n",
        "Every parameter has a default; only `map` must be given. `ros2 param describe /localizer NAME` shows the same "
        "text. Unknown names, values out of range and values that contradict another are refused with the name.\n",
        "`top_k` and the groups `scan`, `retrieval`, `alignment` and `fusion` may be changed while the node runs: the "
        "next scan uses the new values, the hypotheses are kept. The others are read when the node is configured, "
        "`autostart` when it starts; to set one to the value that it has is no change. "
        "[config/localizer.yaml](../howto/tuning.md#a-parameter-file) holds all of them for editing.\n",
    ]
    for group in groups_of(LocalizerNodeConfig):
        title = f"{group.prefix.rstrip('.')}: {group.text}" if group.prefix else "The node"
        parts += [f"## {title}\n", settings_table(group.settings)]
    parts += [
        "## Renamed since version 0.1\n",
        "The old names are refused with the new one in the message.\n",
        "\n".join(["| old | new |", "|---|---|", *(f"| `{old}` | `{new}` |" for old, new in RENAMED.items())]) + "\n",
    ]
    return "\n".join(parts)


def training_page() -> str:
    """Return the reference of the settings of places and training."""
    parts = [
        NOTICE,
        "# Settings of training\n",
        "The file of `--config` holds the groups `places` (read by `train make-places`) and `train` (read by "
        "`train run` and `compare`). `config/train.yaml` is the recipe of the shipped weights, "
        "`config/train_paper.yaml` that of the paper. Numbers, texts and switches of `train` are also options of "
        "`train run` and `compare`: `learning_rate` becomes `--learning-rate`.\n",
    ]
    groups = [*groups_of(PlacesConfig, "places.", "simulated towns"), *groups_of(TrainConfig, "train.", "the recipe")]
    for group in groups:
        parts += [f"## {group.prefix.rstrip('.')}: {group.text}\n", settings_table(group.settings)]
    return "\n".join(parts)


# Commands


def commands() -> list[str]:
    """Return the names of the executables, as setup.py installs them."""
    tree = ast.parse((REPOSITORY / "setup.py").read_text())
    (names,) = (
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "COMMANDS"
    )
    return list(ast.literal_eval(names))


def parser_of(command: str) -> argparse.ArgumentParser | None:
    """Return the parser of a command; None for the node, which reads ROS arguments alone."""
    if command == "localizer":
        return None
    parser: argparse.ArgumentParser = importlib.import_module(f"crossloc3d_ros.cli.{command}")._parser()
    return parser


def commands_page() -> str:
    """Return the reference of the commands."""
    parts = [
        NOTICE,
        "# Commands\n",
        "`ros2 run crossloc3d_ros NAME` starts each of them; where there is no `ros2`, pip puts NAME on the `PATH`. "
        "`--help` shows the same text. Exit codes: 0 done, 2 refused with one line that says why, 130 interrupted. "
        "Results go to standard output, progress to standard error.\n",
    ]
    for name in commands():
        parser = parser_of(name)
        if parser is None:
            usage = importlib.import_module(f"crossloc3d_ros.cli.{name}").USAGE
            usage = usage.rpartition("parameters")[0].strip()
            parts += [f"## {name}\n", f"```text\n{usage}\n```\n", "Its [parameters](parameters.md).\n"]
        else:
            parts += command_section(name, parser, level=2)
    return "\n".join(parts)


def command_section(name: str, parser: argparse.ArgumentParser, level: int) -> Iterator[str]:
    """Yield the section of a command and, one level deeper, those of its subcommands."""
    yield f"{'#' * level} {name}\n"
    if parser.description and level == 2:
        yield re.sub(r"^`\w+`: (\w)", lambda found: found[1].upper(), " ".join(parser.description.split())) + "\n"
    subcommands = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    shown = [action for action in parser._actions if action not in subcommands and action.dest != "help"]
    if not subcommands:
        yield f"```text\n{usage_of(name, shown)}\n```\n"
        rows = ["| option | meaning |", "|---|---|"]
        recipe = {setting.name for setting in settings_of(TrainConfig)}
        has_recipe = sum(action.dest in recipe for action in shown) > len(recipe) // 2
        for action in shown:
            if has_recipe and action.dest in recipe:
                continue
            choices = ", ".join(f"`{choice}`" for choice in action.choices or ())
            text = (action.help or "") % {**vars(action), "prog": name} + (f"; one of {choices}" if choices else "")
            rows.append(f"| {cell(f'`{spelled(action)}`')} | {cell(text)} |")
        yield "\n".join(rows) + "\n"
        if has_recipe:
            yield "The [settings of training](training_settings.md#train-the-recipe) are options as well.\n"
    if parser.epilog:
        yield parser.epilog + "\n"
    for action in subcommands:
        texts = {choice.dest: choice.help for choice in action._choices_actions}
        for sub, subparser in action.choices.items():
            heading, *rest = command_section(f"{name} {sub}", subparser, level + 1)
            yield heading
            text = texts.get(sub) or ""
            yield text[:1].upper() + text[1:] + ".\n"
            yield from rest


def usage_of(name: str, actions: list[argparse.Action]) -> str:
    """Return a command line with what must be given."""
    needed = [spelled(action) for action in actions if action.option_strings and action.required]
    positional = [spelled(action) for action in actions if not action.option_strings]
    return " ".join([name, *needed, "[OPTIONS]", *positional])


def spelled(action: argparse.Action) -> str:
    """Return an option or argument with the names of its values."""
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    values = action.metavar or (action.dest.upper() if action.option_strings else action.dest)
    value = " ".join(values) if isinstance(values, tuple) else values
    if action.nargs in ("+", "*"):
        value += " ..."
    return f"{names} {value}".strip()


def cell(text: str) -> str:
    """Return a text as a cell of a Markdown table holds it."""
    return " ".join(text.split()).replace("|", "\\|")


# Packages


def layers() -> list[list[str]]:
    """Return the packages of each layer, the uppermost first, from the import contracts."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    contracts = settings["tool"]["importlinter"]["contracts"]
    (found,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    return [[name.strip().rpartition(".")[2] for name in re.split(r"[|:]", layer)] for layer in found]


def picture() -> str:
    """Return the layers as boxes: each imports only from those below it."""
    width = 78
    rows = []
    for names in layers():
        inner = width - 1 - len(names)
        share, rest = divmod(inner, len(names))
        cells = [f" {name}".ljust(share + (i < rest)) for i, name in enumerate(names)]
        rows.append("│" + "│".join(cells) + "│")
    lines = [_rule("", rows[0])]
    for above, below in zip(rows, [*rows[1:], ""], strict=True):
        lines += [above, _rule(above, below)]
    return "\n".join(lines)


def _rule(above: str, below: str) -> str:
    """Return the line between two rows of boxes; either may be empty."""
    left, right = "┌┐" if not above else "└┘" if not below else "├┤"
    crossings = {(True, True): "┼", (True, False): "┴", (False, True): "┬", (False, False): "─"}
    width = max(len(above), len(below))
    pairs = zip(above.ljust(width), below.ljust(width), strict=True)
    line = [crossings[up == "│", down == "│"] for up, down in pairs]
    return left + "".join(line[1:-1]) + right


def contributing() -> str:
    """Return CONTRIBUTING.md with the picture of the packages as the import contracts and docstrings have it."""
    text = (REPOSITORY / "CONTRIBUTING.md").read_text()
    before, _, rest = text.partition(PACKAGES_BEGIN)
    _, _, after = rest.partition(PACKAGES_END)
    rows = ["| package | what it holds |", "|---|---|"]
    for name in (name for names in layers() for name in names):
        rows.append(f"| `{name}` | {cell(first_sentence(name))} |")
    body = f"```text\n{picture()}\n```\n\n" + "\n".join(rows)
    return f"{before}{PACKAGES_BEGIN}\n{body}\n{PACKAGES_END}{after}"


def first_sentence(name: str) -> str:
    """Return the first line of the docstring of a package or module."""
    folder = REPOSITORY / "crossloc3d_ros"
    path = folder / name / "__init__.py" if (folder / name).is_dir() else folder / f"{name}.py"
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return text.split("\n\n")[0].replace("\n", " ").rstrip(".")


def main() -> None:
    """Write the files."""
    for path, text in generated().items():
        path.write_text(text)


if __name__ == "__main__":
    main()
