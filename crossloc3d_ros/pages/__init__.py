"""Figures as text, charts as SVG, self-contained HTML pages from templates."""
