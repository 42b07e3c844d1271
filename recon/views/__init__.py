"""The views of a fit: its pictures at working size, what of them is sky or the recording car, and how each was exposed."""
