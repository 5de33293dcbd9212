"""The networks that the paper compares itself with, on the same sparse convolution and the same points."""
