"""Figures as text, charts as SVG, templates as self-contained HTML."""
