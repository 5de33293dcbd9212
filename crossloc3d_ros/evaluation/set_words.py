"""What readers of a page should know of the data behind it."""

from __future__ import annotations

SIMULATED = (
    "The towns are simulated and held out: their seeds belong to no training set, and the families named as held out "
    "were never learned from. Flown at one epoch, driven at another: cars, people and some trees and buildings differ."
)
AMSTERDAM = (
    "The geometry is real, the scans are not: a laser was cast through a surface made of the survey of 2014 and looked "
    "for in the survey of 2010. Facades are guessed from above and nothing moves in the streets."
)
AMSTERDAM_PLACES = "The map is small: at chance level, one answer in fifteen lies within 100 m."
