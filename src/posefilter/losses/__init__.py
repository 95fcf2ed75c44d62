"""Losses of a filter's trace, one value for each image."""
