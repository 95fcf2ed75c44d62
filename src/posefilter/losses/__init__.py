"""Losses: each judges a run of the filter, one value an image."""
