"""Callbacks: all that only looks at a run; none of them changes it."""
