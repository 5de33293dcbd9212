"""Pages from the templates in `templates/`: one Jinja2 environment that escapes all of HTML and refuses gaps.

Two things alone are not escaped: charts, which `charts.Chart.render` marks as safe, and the package's own style sheets
and scripts. Data for a page's script goes through `tojson`, which leaves no `<`, `>` or `&` in it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from importlib import resources
from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from crossloc3d_ros.pages import wording

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def render_page(template: str, context: DataclassInstance) -> str:
    """Return the page of a template, which knows the context's fields by their names.

    `template`: a name in `templates/`. Raises jinja2.UndefinedError where it asks for something that is not there, and
    ValueError where its data for a script holds NaN or infinity.
    """
    values = {field.name: getattr(context, field.name) for field in dataclasses.fields(context)}
    return environment().get_template(template).render(values)


@functools.cache
def environment() -> Environment:
    """Return the environment of all pages."""
    result = Environment(
        loader=PackageLoader("crossloc3d_ros.pages"),
        autoescape=lambda name: name is None or not name.endswith(".md.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    result.filters |= {
        "count": wording.count,
        "degrees": wording.degrees,
        "finite": wording.finite,
        "fine_percent": wording.fine_percent,
        "interval": wording.interval,
        "metres": wording.metres,
        "number": wording.number,
        "percent": wording.percent,
        "percent_range": wording.percent_range,
    }
    result.tests |= {"finite": math.isfinite, "infinite": math.isinf}
    result.globals["asset"] = _asset
    result.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return result


@functools.cache
def _asset(name: str) -> Markup:
    return Markup((resources.files("crossloc3d_ros.pages") / "assets" / name).read_text(encoding="utf-8"))
