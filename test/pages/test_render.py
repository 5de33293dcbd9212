"""Pages from templates: escaped everywhere, complete, and refused where something is missing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from html.parser import HTMLParser
from typing import Any

import pytest
from jinja2 import DictLoader, UndefinedError

from crossloc3d_ros.pages import charts, render

HOSTILE = "</script><!--<script>alert(1)</script> & \"quotes\" 'x' {{ data }} {% raw %} \u2028\u2029"


@dataclass(frozen=True)
class Content:
    text: str = HOSTILE
    data: Any = None
    share: float = 0.5


class Texts(HTMLParser):
    """Collects texts, attributes and the contents of scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.attributes: list[str | None] = []
        self.tags: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [value for _, value in attrs]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that renders the text of a template with the environment of all pages."""

    def render_text(template: str, content: Content) -> str:
        environment = render.environment().overlay(loader=DictLoader({"page": template}))
        monkeypatch.setattr(render, "environment", lambda: environment)
        return render.render_page("page", content)

    return render_text


@pytest.mark.parametrize("name", render.environment().list_templates())
def test_every_template_compiles(name: str) -> None:
    assert render.environment().get_template(name).name == name


def test_what_others_wrote_is_text(rendered: Any) -> None:
    page = Texts(rendered('<p title="{{ text }}">{{ text }}</p>', Content()))
    assert page.tags == ["p"]
    assert "".join(page.texts) == HOSTILE
    assert page.attributes == [HOSTILE]


def test_data_cannot_leave_its_script(rendered: Any) -> None:
    data = {"reason": HOSTILE, "values": [1, 0.5, None]}
    text = rendered('<script type="application/json">{{ data | tojson }}</script>', Content(data=data))
    inside = text.removeprefix('<script type="application/json">').removesuffix("</script>")
    assert not any(character in inside for character in "<>&\u2028\u2029")
    assert json.loads(inside) == data
    assert list(json.loads(inside)) == list(data)


def test_data_that_a_script_could_not_read_is_refused(rendered: Any) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        rendered("{{ data | tojson }}", Content(data=[float("nan")]))


@pytest.mark.parametrize("template", ["{{ missing }}", "{{ text.missing }}", "{% if missing %}{% endif %}"])
def test_a_name_that_is_missing_is_refused(rendered: Any, template: str) -> None:
    with pytest.raises(UndefinedError, match="missing"):
        rendered(template, Content())


def test_figures_are_put_into_words(rendered: Any) -> None:
    template = "{{ share | percent }}, {{ share | percent(1) }}, {{ 1234.56 | number(1) }}, {{ share is finite }}"
    assert rendered(template, Content()) == "50 %, 50.0 %, 1,234.6, True"


def test_charts_are_taken_as_they_are_and_their_texts_are_escaped(rendered: Any) -> None:
    axis = charts.Axis(0.0, 1.0, HOSTILE, [(0.5, HOSTILE)])
    chart = charts.Chart(axis, axis, HOSTILE)
    marks = [chart.mark_x(0.5, "median", HOSTILE), chart.word(0.5, 0.5, HOSTILE), chart.bar(0.0, 1.0, 0.5, "bar")]
    page = Texts(rendered("{{ data }}", Content(data=chart.render(marks, HOSTILE, HOSTILE))))
    assert set(page.tags) == {"svg", "line", "text", "rect"}
    assert page.texts.count(HOSTILE) == 6
    assert HOSTILE in page.attributes
