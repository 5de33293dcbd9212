"""Figures as people read them."""

from __future__ import annotations

import pytest

from crossloc3d_ros.pages.wording import count, degrees, metres, percent


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1.0, "100 %"), (0.00054, "0.05 %"), (0.0512, "5.1 %"), (0.5, "50 %"), (0.994, "99 %"),
     (0.9961, "99.6 %"), (0.99996, "99.9 %"), (float("nan"), "–")],
)  # fmt: skip
def test_a_share_that_is_not_whole_never_reads_as_whole(share: float, text: str) -> None:
    assert percent(share) == text


def test_lengths_and_angles_keep_two_figures() -> None:
    assert [metres(v) for v in (0.04, 0.994, 0.996, 3.14, 9.96, 47.2, 1234.0)] == [
        "0.04 m", "0.99 m", "1.0 m", "3.1 m", "10 m", "47 m", "1.2 km",
    ]  # fmt: skip
    assert [degrees(v) for v in (0.04, 1.26, 14.7)] == ["0.04°", "1.3°", "15°"]
    assert metres(float("nan")) == degrees(float("inf")) == "–"


def test_nouns_follow_their_number() -> None:
    assert [count(n, "gap") for n in (0, 1, 2000)] == ["0 gaps", "1 gap", "2,000 gaps"]
