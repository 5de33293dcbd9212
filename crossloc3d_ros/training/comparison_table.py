"""Results of a comparison as CSV, Markdown and one HTML page."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crossloc3d_ros.evaluation.statistics import Recall
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages.render import render_page
from crossloc3d_ros.training.comparison import RADII_M, RANKS, Result

CSV, MARKDOWN, HTML = "comparison.csv", "comparison.md", "comparison.html"


@dataclass(frozen=True)
class TableTexts:
    """Title and facts above a table."""

    title: str
    facts: tuple[str, ...]
    """Sentences on the data, the budget and the recipe."""


@dataclass(frozen=True)
class ComparisonPage:
    """What the templates of the table know."""

    title: str
    facts: tuple[str, ...]
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    """The cells of each result."""
    recalls: Sequence[Recall]
    """R@1 within 100 m of each result."""
    first: Sequence[Recall]
    """All recalls of the first result, for their chance levels; empty without results."""


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
    return render_page("comparison.md.j2", _page(results, texts))


def as_html(results: Sequence[Result], texts: TableTexts) -> str:
    """Return the table as a page that needs nothing but itself."""
    return render_page("comparison.html.j2", _page(results, texts))


def _page(results: Sequence[Result], texts: TableTexts) -> ComparisonPage:
    head, *rows = _cells(results)
    return ComparisonPage(
        title=texts.title,
        facts=texts.facts,
        head=head,
        rows=rows,
        recalls=[result.recall(1, 100.0) for result in results],
        first=[results[0].recall(rank, radius) for radius in RADII_M for rank in RANKS] if results else [],
    )


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
