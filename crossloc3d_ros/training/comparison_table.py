"""Results of a comparison as CSV, Markdown and one HTML page."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path

from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.training.comparison import RADII_M, RANKS, Result

CSV, MARKDOWN, HTML = "comparison.csv", "comparison.md", "comparison.html"


@dataclass(frozen=True)
class TableTexts:
    """What is said above a table."""

    title: str
    facts: tuple[str, ...]
    """Sentences on the data, the budget and the recipe."""


def write_tables(folder: Path, results: Sequence[Result], texts: TableTexts) -> list[Path]:
    """Write the three files and return their paths; CrossLocError where one cannot be written."""
    contents = {CSV: as_csv(results), MARKDOWN: as_markdown(results, texts), HTML: as_html(results, texts)}
    for name, text in contents.items():
        write_atomically(folder / name, text)
    return [folder / name for name in contents]


def as_csv(results: Sequence[Result]) -> str:
    """Return one line a row with every figure as a plain number; recalls are shares, not per cent."""
    text = io.StringIO()
    recalls = [f"r{rank}_{radius:.0f}m" for radius in RADII_M for rank in RANKS]
    columns = [
        "slug", "name", "descriptor_size", "parameters", "query_headings", "one_thread_ms", "encode_ms", "search_ms",
        "steps", "clouds", "hours", *(f"{name}{end}" for name in recalls for end in ("", "_low", "_high", "_chance")),
        "ahead_r1_100m", "ahead_low", "ahead_high", "published_ar1", "published_ar1_percent", "encoder", "data",
    ]  # fmt: skip
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for result in results:
        figures = []
        for radius in RADII_M:
            for rank in RANKS:
                recall = result.recall(rank, radius)
                share = recall.share
                figures += [round(value, 6) for value in (share.value, share.low, share.high, recall.chance)]
        ahead = result.ahead
        writer.writerow(
            [
                result.slug, result.name, result.descriptor_size, result.parameters, result.query_headings,
                result.one_thread_ms, result.encode_ms, result.search_ms, result.steps, result.clouds, result.hours,
                *figures, *(("", "", "") if ahead is None else (ahead.value, ahead.low, ahead.high)),
                *(result.published or ("", "")), result.encoder, result.data,
            ]
        )  # fmt: skip
    return text.getvalue()


def as_markdown(results: Sequence[Result], texts: TableTexts) -> str:
    """Return the table for people."""
    head, *body = _cells(results)
    lines = [f"# {texts.title}", "", *(f"* {fact}" for fact in texts.facts), ""]
    lines += [f"| {' | '.join(head)} |", "|---" + "|---:" * (len(head) - 1) + "|"]
    lines += [f"| {' | '.join(row)} |" for row in body]
    return "\n".join([*lines, "", *_notes(results), ""])


def as_html(results: Sequence[Result], texts: TableTexts) -> str:
    """Return the table as a page that needs nothing but itself."""
    head, *body = _cells(results)
    best = max((result.recall(1, 100.0).share.value for result in results), default=0.0)
    style = (resources.files("crossloc3d_ros.pages") / "assets" / "page.css").read_text(encoding="utf-8")
    rows = []
    for result, cells in zip(results, body, strict=True):
        width = 100.0 * result.recall(1, 100.0).share.value
        mark = "best" if result.recall(1, 100.0).share.value == best else ""
        bar = f'<td><span class="bar" style="width:{width:.1f}px"></span></td>'
        rows.append(f'<tr class="{mark}">{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}{bar}</tr>')
    return (
        f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>{escape(texts.title)}</title>\n'
        f"<style>{style}{_STYLE}</style>\n<main><h1>{escape(texts.title)}</h1>\n"
        f"<ul>{''.join(f'<li>{escape(fact)}</li>' for fact in texts.facts)}</ul>\n"
        f'<div class="wide"><table><thead><tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}'
        f"<th>R@1 100 m</th></tr></thead>\n<tbody>{''.join(rows)}</tbody></table></div>\n"
        f"{''.join(f'<p>{escape(note)}</p>' for note in _notes(results))}</main></html>\n"
    )


_STYLE = """
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .35em .7em; border-bottom: 1px solid var(--rule); text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td:last-child { text-align: left; }
.bar { display: inline-block; height: .7em; background: var(--accent); }
.best { font-weight: 650; }
.wide { overflow-x: auto; }
"""


def _cells(results: Sequence[Result]) -> list[list[str]]:
    """Return the header and a list of cells for each result."""
    recalls = [(rank, radius) for radius in RADII_M for rank in RANKS]
    some_published = any(result.published for result in results)
    compared = any(result.ahead for result in results)
    head = ["", "numbers", "parameters", "ms, 1 thread", "ms", "ms search"]
    head += [f"R@{rank} {radius:.0f} m" for rank, radius in recalls]
    head += ["R@1 100 m against the reference", "clouds seen"] + ["paper's AR@1"] * some_published
    table = [head]
    for result in results:
        cells = [
            result.name,
            f"{result.descriptor_size:,}",
            f"{result.parameters / 1e6:.2f} M" if result.parameters else "none",
            f"{result.one_thread_ms:.1f}",
            f"{result.encode_ms:.1f}",
            f"{result.search_ms:.1f}",
        ]
        for rank, radius in recalls:
            share = result.recall(rank, radius).share
            cells.append(f"{100 * share.value:.1f} [{100 * share.low:.0f}–{100 * share.high:.0f}]")
        ahead = result.ahead
        cells.append(
            ("reference" if compared else "") if ahead is None
            else f"{100 * ahead.value:+.1f} [{100 * ahead.low:+.0f}, {100 * ahead.high:+.0f}]"
        )  # fmt: skip
        cells.append(f"{result.clouds:,}" if result.clouds else "none")
        if some_published:
            cells.append(f"{result.published[0]:.1f}" if result.published else "")
        table.append(cells)
    return table


def _notes(results: Sequence[Result]) -> list[str]:
    if not results:
        return ["No row is done yet."]
    recalls = [results[0].recall(rank, radius) for radius in RADII_M for rank in RANKS]
    chances = ", ".join(f"{r.label} {r.radius_m:.0f} m {100 * r.chance:.1f} %" for r in recalls)
    return [
        f"Recall in per cent with its 95 % interval; chance level: {chances}.",
        "Milliseconds: the median to encode one query in all the headings that the method tries, on the CPU, and to "
        "search the whole database; other work on the machine makes them longer.",
        "Against the reference: difference of R@1 at 100 m on the same queries in points; an interval without 0 says "
        "that one is ahead.",
    ]
