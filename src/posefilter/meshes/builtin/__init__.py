"""The built-in objects, drawn by code."""
